"""The table of cases that JavaScript and Python must agree on: `python tests/explorer/cases.py`
writes cases.json.

It needs node on the path, and refuses to write what the page's own code does not reproduce. The
table says of which code that was true, so that a test without node notices when that code has
changed.
"""

import hashlib
import json
import subprocess
from pathlib import Path
from typing import Any

import numpy as np

import jaxmuscle as jm
from jaxmuscle import explorer
from jaxmuscle.explorer._facts import bare_table, facts
from jaxmuscle.explorer._page import MODULES, part_of
from jaxmuscle.model import Constant, Decay, RampHold, WhiteNoise
from jaxmuscle.response._expected_moments import expected_moments
from jaxmuscle.spectra._settings import WINDOW

TABLE = Path(__file__).with_name("cases.json")
CHECK = Path(__file__).with_name("check.mjs")
CLOSED_FORM = MODULES[: MODULES.index("spectrum") + 1]
DRAWS = 5
Q = jm.SpectrumSettings
PASSIVE_OFF = {"K_w": 0.1, "K_z": 0.0, "C_w": 0.01, "C_z": 0.0}
SHARED = jm.BandLimitedNoise((0.1, 0.05, 0.1, 0.1, 0.02), shared=True)
OU = jm.OrnsteinUhlenbeckNoise()
TREMOR = jm.ResonantNoise({"K_w": 0.01, "K_z": 0.01})
TOE = jm.Muscle(argument="elongation")
BOTH = (
    jm.BandLimitedNoise({"K_w": 0.1, "K_z": 0.02, "C_w": 0.1, "C_z": 0.1, "P_w": 0.03})
    + jm.ResonantNoise()
)
RIGID = {
    "rate": 200.0,
    "length": 128,
    "window": "boxcar",
    "detrend": "linear",
    "filter_cutoff": None,
    "last_bin": 24,
}

# Every task, noise, way of sampling and kind of settings, alone and together.
STRUCTURES: dict[str, Any] = {
    "isometric": jm.Isometric(),
    "isometric elongation": jm.Isometric(muscle=TOE, x_z=0.004),
    "isometric white": jm.Isometric(noise=WhiteNoise(PASSIVE_OFF)),
    "isometric white activation": jm.Isometric(
        noise=WhiteNoise(PASSIVE_OFF), activation=jm.Activation()
    ),
    "isometric ou": jm.Isometric(noise=OU),
    "isometric pink": jm.Isometric(noise=jm.PinkNoise()),
    "isometric wide pink": jm.Isometric(noise=jm.PinkNoise(f_low=0.001, f_high=200.0)),
    "isometric absolute": jm.Isometric(
        noise=jm.BandLimitedNoise((20.0, 2.0, 1.0, 0.5), relative=False)
    ),
    "isometric shared": jm.Isometric(noise=SHARED, activation=jm.Activation()),
    "isometric richest": jm.model.on_rung(jm.Isometric(), 3),
    "isometric drive": jm.Isometric(noise=BOTH, activation=jm.Activation()),
    "isometric average": jm.Isometric(
        noise=OU, settings=Q(sampling="average", filter_direction="both")
    ),
    "isometric filtered": jm.Isometric(noise=BOTH, settings=Q(sampling="filtered")),
    "isometric multitaper": jm.Isometric(
        settings=Q(length=500, window="dpss", tapers=3, first_bin=2, last_bin=30)
    ),
    "isometric pwelch": jm.Isometric(settings=Q.named("pwelch")),
    "isometric unfiltered": jm.Isometric(settings=Q(**RIGID)),
    "isometric even filter": jm.Isometric(
        settings=Q(filter_order=4, filter_cutoff=10.0, overlap=0.75, first_bin=0)
    ),
    "length": jm.PrescribedLength(P_w=RampHold(5.0), x_z=0.002, noise=jm.PinkNoise() + TREMOR),
    "force": jm.PrescribedForce(F_ext=1.0),
    "force elongation": jm.PrescribedForce(F_ext=-1.0, muscle=TOE, noise=OU),
    "force white": jm.PrescribedForce(noise=WhiteNoise(), F_ext=1.0, activation=jm.Activation()),
    "acceleration": jm.PrescribedForce(observe="acceleration", F_ext=1.0, noise=BOTH),
    "motion": jm.PrescribedMotion(),
    "motion elongation": jm.PrescribedMotion(muscle=TOE, x_z=0.003, activation=jm.Activation()),
    "motion average": jm.PrescribedMotion(settings=Q(sampling="average")),
    "motion fading": jm.load_preset("zagrodny-hamilton"),
    "fading activation": jm.Isometric(
        harmonic=jm.Harmonic(envelope=Decay(start=2.0)),
        activation=jm.Activation(),
        settings=Q(filter_direction="both", sampling="average"),
    ),
    "half harmonic": jm.Isometric(harmonic=jm.Harmonic(phase=1.0, envelope=Constant(0.5))),
}


def digest() -> str:
    """Of the code of the closed form."""
    return hashlib.sha256(
        "\n".join(part_of(f"{name}.mjs") for name in CLOSED_FORM).encode()
    ).hexdigest()[:16]


def rows_of(task: Any, name: str) -> list[dict[str, Any]]:
    """Values of all of the task's parameters about its own, half a prior's sd to either side, and
    what Python makes of them.

    Values without a stable equilibrium are drawn anew.
    """
    random, table, found = np.random.default_rng(list(name.encode())), facts()["parameters"], []
    while len(found) < DRAWS:
        values = {}
        for key in (key for key in task.parameter_names if key in table):
            row, here, far = (
                table[key],
                float(task[key]),
                0.5 * table[key]["prior_sd"] * random.uniform(-1, 1),
            )
            values[key] = float(f"{here * np.exp(far) if row['positive'] else here + far:.6g}")
        values["harmonic_frequency"] = min(values["harmonic_frequency"], 29.0)
        made = expected(task.replace(**values))
        if np.all(np.isfinite(made["power"])):
            found.append({"values": values} | made)
    return found


def expected(task: Any) -> dict[str, Any]:
    """Power, mean and variance by Python, by the program that `expected_spectrum` calls."""
    moments, _ = expected_moments(task, task.settings, WINDOW)
    return {
        "power": [float(f"{p:.11g}") for p in np.asarray(moments.power)],
        "mean": float(moments.mean),
        "variance": float(moments.variance),
    }


def by_javascript(cases: dict[str, Any]) -> dict[str, float]:
    """The largest relative difference of a bin, the mean or the variance in every structure, as
    node finds it."""
    folder = Path(explorer.__file__).parent / "page"
    done = subprocess.run(
        ["node", CHECK, folder],
        input=json.dumps(cases),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def main() -> None:
    import jax

    with jax.enable_x64(True):
        cases = {
            name: {"table": bare_table(task), "rows": rows_of(task, name)}
            for name, task in STRUCTURES.items()
        }
    worst = by_javascript(cases)
    for name, difference in sorted(worst.items(), key=lambda pair: -pair[1]):
        print(f"{difference:.1e}  {name}")
    if max(worst.values()) > 1e-6:
        raise SystemExit("JavaScript and Python differ: nothing written")
    lines = [f'"{name}": {json.dumps(case)}' for name, case in cases.items()]
    TABLE.write_text(
        '{"closed_form": "' + digest() + '",\n"cases": {\n' + ",\n".join(lines) + "\n}}\n",
        encoding="utf-8",
    )


if __name__ == "__main__":
    main()
