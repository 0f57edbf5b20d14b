"""Do the error bars hold? Recordings of known muscles, simulated nonlinearly; how often intervals
cover the truth.

    python benchmarks/calibration.py --recordings 200 --seconds 10 \\
        --draws 200 --warmup 200 --out out/calibration-10.json
    python benchmarks/calibration.py --recordings 200 --seconds 60 \\
        --draws 250 --warmup 250 --out out/calibration-60.json

Truths are drawn from the prior of the fit itself (simulation-based calibration, Talts et al. 2018,
arXiv:1804.06788), about muscles whose perturbations are a third of the default, so that nearly all
respond linearly. Interrupted runs go on where they stopped; `--first` and `--recordings` split a
run over processes with files of their own, `--merge` joins them. `--figure FILE` draws the coverage
at every credibility.
"""

import argparse
import json
import sys
from pathlib import Path

import jax
import numpy as np
import scipy.stats

import jaxmuscle as jm
from jaxmuscle._common.files import write_json
from jaxmuscle.fits._search import search_together
from jaxmuscle.model._parameters import DEFAULT_FREE, PARAMETERS
from jaxmuscle.objective._arguments import planned
from jaxmuscle.objective._consequences import expand, quantities
from jaxmuscle.objective._options import FitOptions

PERTURBED = ("noise_K_w", "noise_K_z", "harmonic_amplitude")
SOFTER = 3.0
START = 5.0
BATCH = 20
CHAINS, DRAWS, WARMUP, RANKED = 2, 150, 150, 60
MIXED = 1.05  # R-hat
HELD = 0.8  # share of its bin above which the harmonic's frequency is judged
SHOWN = (
    "corner_frequency",
    "harmonic_share",
    "harmonic_frequency",
    "model_coefficient_of_variation",
)
JUDGED = (*SHOWN, *(name for name in DEFAULT_FREE if name not in SHOWN))


def base() -> jm.model.AbstractTask:
    """The task whose values are the prior's centre."""
    return jm.Isometric().replace(**{name: PARAMETERS[name].default / SOFTER for name in PERTURBED})


def truth(number: int) -> jm.model.AbstractTask:
    """Muscle number `number`, drawn from the prior."""
    task, rng = base(), np.random.default_rng([2026, number])
    values = {name: float(task[name]) * np.exp(rng.normal()) for name in DEFAULT_FREE}
    row = PARAMETERS["harmonic_frequency"]
    while not row.fit_lower < values["harmonic_frequency"] < row.fit_upper:
        values["harmonic_frequency"] = float(task["harmonic_frequency"]) * np.exp(rng.normal())
    return task.replace(**values)


def recorded(task: jm.model.AbstractTask, number: int, seconds: float) -> jm.Target:
    """One recording of it, by the nonlinear simulator, as a target."""
    key = jax.random.fold_in(jax.random.key(41), number)
    runs = jm.ensemble(task.settled(), key, seeds=1, duration=START + seconds, control=False)
    settings, window = task.settings, (START, START + seconds)
    power = np.asarray(runs.spectrum(settings, window).proportional)[0]
    held = runs.filtered(settings, window)[0]
    segments = settings.segments(round(seconds * settings.rate))
    variation = float(held.std() / abs(held.mean()))
    return jm.Target(
        f"truth-{number}", power, segments=segments, coefficient_of_variation=variation
    )


def true_values(task: jm.model.AbstractTask, target: jm.Target) -> tuple[dict[str, float], float]:
    """Derived quantities of the truth by its linear response, and the share of its bin that the
    harmonic holds."""
    problem = planned(base(), target, FitOptions()).problem
    seen = expand(problem.linear(), problem.theta_of((task,))[None])
    values = {name: float(x[0]) for name, x in quantities(problem.linear(), seen)[0][0].items()}
    share = np.asarray(seen.moments[0].line / seen.moments[0].power)[0]
    nearest = np.argmin(np.abs(np.asarray(target.frequency) - values["harmonic_frequency"]))
    inside = values["harmonic_frequency"] <= target.frequency[-1] + target.settings.resolution / 2
    values |= {name: float(task[name]) for name in problem.coordinates.names}
    return {name: values[name] for name in JUDGED}, float(share[nearest]) if inside else 0.0


def judged(
    number: int, target: jm.Target, result: jm.fits.FitResult, length: tuple[int, int]
) -> dict:
    """What fit and posterior say of one recording, against the truth."""
    task = truth(number)
    true, share = true_values(task, target)
    row = {
        "number": number,
        "share": share,
        "true": true,
        "fitted": bool(result.success),
        "curvature": {},
        "posterior": {},
    }
    for name, estimate in result.derived.items():
        if estimate.stderr is not None:
            row["curvature"][name] = [estimate.value, estimate.stderr]
    found = jm.posterior(result, key=number, chains=CHAINS, draws=length[0], warmup=length[1])
    row |= {
        "divergences": found.divergences,
        "r_hat": max(d[0] for d in found.diagnostics.values()),
    }
    row["p_value"] = found.replicates.p_value
    for name in JUDGED:
        draws = found.quantities[name]
        step = max(1, draws.size // RANKED)
        thin = draws.ravel()[step - 1 :: step]
        row["posterior"][name] = [
            *np.quantile(draws, [0.025, 0.975]).tolist(),
            int(np.sum(thin < true[name])),
            thin.size,
        ]
    return row


def run(
    numbers: list[int], seconds: float, out: Path, length: tuple[int, int] = (DRAWS, WARMUP)
) -> list[dict]:
    """All recordings that are not in the file yet, in batches; the file is replaced after each."""
    asked = {"seconds": seconds, "draws": length[0], "warmup": length[1]}
    table = json.loads(out.read_text()) if out.exists() else asked | {"rows": [], "failed": {}}
    if (
        there := {
            name: table.get(name, default)
            for name, default in zip(asked, (0, DRAWS, WARMUP), strict=True)
        }
    ) != asked:
        raise SystemExit(f"{out}: holds {there}, not {asked}; give another file")
    done = {row["number"] for row in table["rows"]} | {int(n) for n in table["failed"]}
    left = [n for n in numbers if n not in done]
    for start in range(0, len(left), BATCH):
        targets = {}
        for number in left[start : start + BATCH]:
            try:
                targets[number] = recorded(truth(number), number, seconds)
            except (jm.errors.SimulationError, jm.errors.OperatingPointError) as error:
                table["failed"][str(number)] = str(error)
        with jax.enable_x64(True):
            plans = [planned(base(), target, FitOptions(starts=32)) for target in targets.values()]
            results = search_together(plans, lambda text, share: None)
            for (number, target), result in zip(targets.items(), results, strict=True):
                table["rows"].append(judged(number, target, result, length))
                write_json(out, table)
                print(
                    f"{seconds:g} s: {len(table['rows'])} of {len(numbers)}",
                    file=sys.stderr,
                    flush=True,
                )
    return table["rows"]


def places(rows: list[dict], name: str) -> list[float]:
    """Where the truth lies in its posterior: its rank among the draws as a share."""
    return [(r["posterior"][name][2] + 0.5) / (r["posterior"][name][3] + 1) for r in rows]


def figure(rows: list[dict], path: Path) -> None:
    """Coverage at every credibility."""
    ax = jm.plot.coverage({name: places(rows, name) for name in SHOWN})
    ax.get_figure(root=True).savefig(path, dpi=130)


def report(rows: list[dict]) -> str:
    """Coverage of 95 % intervals with its binomial error, and uniformity of the truth's rank among
    the draws."""
    lines = [
        (
            "| quantity | posterior: covered | within 3 s.e. of 95 % | ranks: p | curvature:"
            " covered | stated |"
        ),
        "|---|---|---|---|---|---|",
    ]
    for name in JUDGED:
        chosen = [r for r in rows if name != "harmonic_frequency" or r["share"] >= HELD]
        inside = [
            r["posterior"][name][0] <= r["true"][name] <= r["posterior"][name][1] for r in chosen
        ]
        stated = [r for r in chosen if name in r["curvature"]]
        near = [
            abs(r["curvature"][name][0] - r["true"][name]) <= 1.96 * r["curvature"][name][1]
            for r in stated
        ]
        p = scipy.stats.kstest(places(rows, name), "uniform").pvalue
        fine = (
            abs(np.mean(inside) - 0.95) <= 3 * np.sqrt(0.95 * 0.05 / len(inside))
            if inside
            else False
        )
        curvature = f"{100 * np.mean(near):.1f} %" if near else "-"
        lines.append(
            f"| {name} | {100 * np.mean(inside):.1f} % of {len(inside)} | {'yes' if fine else 'NO'}"
            f" | {p:.2g} | {curvature} | {len(near)} |"
        )
    strange = np.mean([r["p_value"] < 0.05 for r in rows])
    lines.append(
        f"\n{len(rows)} recordings; fits that succeeded {sum(r['fitted'] for r in rows)}; divergent"
        f" draws {sum(r['divergences'] for r in rows)}; posterior-predictive p below 0.05:"
        f" {strange:.3f}"
    )
    return "\n".join(lines)


def main() -> None:
    """Run, or merge, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--recordings", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--draws", type=int, default=DRAWS, help="of each of two chains")
    parser.add_argument("--warmup", type=int, default=WARMUP)
    parser.add_argument("--out", type=Path, default=Path("out/calibration.json"))
    parser.add_argument(
        "--merge", type=Path, nargs="*", help="print the table of these files instead"
    )
    parser.add_argument(
        "--figure", type=Path, help="draw the coverage at every credibility, of all recordings"
    )
    given = parser.parse_args()
    if given.merge:
        rows = [row for path in given.merge for row in json.loads(path.read_text())["rows"]]
    else:
        given.out.parent.mkdir(parents=True, exist_ok=True)
        numbers = list(range(given.first, given.first + given.recordings))
        rows = run(numbers, given.seconds, given.out, (given.draws, given.warmup))
    mixed = [row for row in rows if row["r_hat"] <= MIXED]
    print(
        report(mixed),
        f"\n\nChains that had mixed (R-hat <= {MIXED}): {len(mixed)} of {len(rows)}. All of"
        " them:\n",
    )
    print(report(rows))
    if given.figure:
        figure(rows, given.figure)


if __name__ == "__main__":
    main()
