"""Write expected/NAME.json for every target: medians over noise seeds, and tolerances from their
spread.

And from those of [30] the parameters that `jaxmuscle reproduce` carries over the levels of
contraction.
"""

import importlib
import json
import sys
from pathlib import Path

import numpy as np
import tomli_w

import jaxmuscle as jm

SCRIPTS = {
    "vastus-lateralis-26mvc": "vastus_lateralis_26mvc",
    "fdi-abduction-45mvc": "fdi_abduction_45mvc",
    "slifkin-newell-1999-95mvc": "slifkin_newell_1999_95mvc",
    "slifkin-newell-1999-35mvc": "slifkin_newell_1999_35mvc",
    "hamilton-2004": "hamilton_2004",
    "zagrodny-fig4a": "zagrodny_fig4a",
}
FOLDER = Path(__file__).parent / "expected"
LEVELS = Path(__file__).parents[1] / "src" / "jaxmuscle" / "paper" / "levels.toml"
SEEDS = (1, 2, 3, 4, 5)
WHY = (
    "3 times the largest deviation among fresh seeds 1 to 5, at least 2 % of the median (see"
    " fitting/README.md)"
)


def values(result: jm.fits.FitResult) -> dict[str, float]:
    """Free parameters, derived quantities and chi2 per bin of a fit."""
    found = {name: p.value for name, p in result.parameters.items() if p.free}
    found |= {f"derived.{name}": p.value for name, p in result.derived.items() if p.free}
    return found if result.chi2_per_bin is None else found | {"chi2_per_bin": result.chi2_per_bin}


def expected(name: str) -> dict:
    """Medians and tolerances over the seeds."""
    script = importlib.import_module(SCRIPTS[name])
    fits = [script.fit(jm.load_target(name), seed) for seed in SEEDS]
    if not all(fit.success for fit in fits):
        raise SystemExit(f"{name}: not every seed converged: {[fit.message for fit in fits]}")
    rows = [values(fit) for fit in fits]
    table = {}
    for key in rows[0]:
        seen = np.array([row[key] for row in rows])
        middle = float(np.median(seen))
        tolerance = max(3 * float(np.abs(seen - middle).max()), 0.02 * abs(middle))
        table[key] = {"value": float(f"{middle:.5g}"), "tolerance": float(f"{tolerance:.2g}")}
    return {"target": name, "seeds": list(SEEDS), "tolerance_is": WHY, "values": table}


def levels() -> str:
    """The parameters fitted to [30] at 35 and 95 % MVC, for `jaxmuscle reproduce`, which has no
    fitting/ beside it."""
    found = {}
    for level in ("35", "95"):
        table = json.loads(
            (FOLDER / f"slifkin-newell-1999-{level}mvc.json").read_text(encoding="utf-8")
        )["values"]
        known = jm.model.PARAMETERS
        found[level] = {name: row["value"] for name, row in table.items() if name in known}
    return (
        "# Written by fitting/expected.py from fitting/expected/slifkin-newell-1999-*.json.\n\n"
        + tomli_w.dumps(found)
    )


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for name in sys.argv[1:] or SCRIPTS:
        (FOLDER / f"{name}.json").write_text(
            json.dumps(expected(name), indent=1) + "\n", encoding="utf-8"
        )
        print(f"written: expected/{name}.json", flush=True)
    LEVELS.write_text(levels(), encoding="utf-8")
