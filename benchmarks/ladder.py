"""How often the ladder of a fit chooses the right model, and whether what it then states is right,
on simulated recordings.

    python benchmarks/ladder.py selection|recovery [--count N]

Takes a quarter of an hour to an hour each; the outcome stands in docs/force.md.
"""

import collections

import jax
import numpy as np
from verdict import SETTINGS, STARTS, recordings, run, targets

import jaxmuscle as jm
from jaxmuscle.objective._arguments import planned
from jaxmuscle.objective._consequences import expand, quantities
from jaxmuscle.objective._options import FitOptions

TASK = jm.Isometric()
# with the default's floor a tremor of 3 % is a quarter of the power at 9 Hz
QUIET = TASK.replace(noise_K_z=0.002)
TWITCH = 0.08
SHARES = {"resonance": 0.03, "resonance_2": 0.08}
# trials, segments of each
DESIGNS = {"10 s": (1, 6), "60 s": (1, 45), "ten trials of 15 s": (10, 10)}
QUANTITIES = (
    "resonance_frequency",
    "resonance_width",
    "resonance_share",
    "contraction_time",
    "half_power_frequency",
)


def with_shares(task: jm.Isometric, shares: dict[str, float]) -> jm.Isometric:
    """The task whose rhythms have these shares of the expected power of the bins; linear response
    is quadratic in them."""
    names = {f"{name}_amplitude": share for name, share in shares.items()}

    def power(amplitudes: dict[str, float]) -> float:
        return float(jm.expected_spectrum(task.replace(**amplitudes)).power.sum())

    without = dict.fromkeys(names, 0.0)
    rest = power(without)
    own = {name: (power(without | {name: 0.005}) - rest) / 0.005**2 for name in names}
    whole = rest / (1 - sum(shares.values()))
    return task.replace(
        **{name: float(np.sqrt(share * whole / own[name])) for name, share in names.items()}
    )


def truth(rung: int) -> jm.Isometric:
    """The default muscle, its floor lower, on a rung."""
    task = jm.model.on_rung(QUIET, rung)
    if rung:
        task = task.replace(activation_time=TWITCH)
    with jax.enable_x64(True):
        return with_shares(task, dict(list(SHARES.items())[: rung - 1])) if rung >= 2 else task


def simulated(task: jm.Isometric, design: str, count: int, key: int) -> list[jm.Target]:
    trials, segments = DESIGNS[design]
    with jax.enable_x64(True):
        return targets(*recordings(task, segments, count * trials, key), segments, trials)


def described(task: jm.Isometric) -> str:
    """What the truth has at which size."""
    known = consequences(task)
    shown = [
        name
        for name in ("resonance_share", "resonance_2_share", "harmonic_share")
        if known.get(name, 0.0) > 0
    ]
    return ", ".join(f"{name} {known[name]:.3f}" for name in shown)


def consequences(task: jm.Isometric) -> dict[str, float]:
    """Derived quantities of a task, from its linear response."""
    example = jm.Target("x", np.ones(30), segments=[10] * 10, settings=SETTINGS)
    with jax.enable_x64(True):
        objective = planned(task, example, FitOptions()).problem.linear()
        values = quantities(
            objective, expand(objective, np.zeros((1, len(objective.parts[0].coordinates.names))))
        )[0][0]
    return {name: float(value[0]) for name, value in values.items()}


def fitted(target: jm.Target, check_seeds: int = 0) -> jm.fits.FitResult:
    return jm.fit(TASK, target, check_seeds=check_seeds, seeds=0, starts=STARTS)


def chosen(result: jm.fits.FitResult) -> int:
    return next(rung.number for rung in result.ladder if rung.chosen)


def selection(count: int) -> None:
    """Which rung is chosen for recordings of a truth on each."""
    for design in DESIGNS:
        for rung in range(4):
            task = truth(rung)
            found = [
                fitted(target)
                for target in simulated(task, design, count, 10 * DESIGNS[design][1] + rung)
            ]
            counts = collections.Counter(map(chosen, found))
            adequate = np.mean([bool(result.adequate) for result in found])
            print(
                f"{design}, truth on rung {rung} ({described(task)}): chosen "
                + ", ".join(f"{n}: {counts[n]}" for n in range(4))
                + f" of {count}; adequate {100 * adequate:.0f} %",
                flush=True,
            )


def recovery(count: int) -> None:
    """How often stated intervals hold the truth, of a tremor at 9 Hz, 2 Hz wide."""
    task = truth(2)
    known = consequences(task)
    print(", ".join(f"{name} {known[name]:.4g}" for name in QUANTITIES), flush=True)
    inside: dict[str, list[bool]] = {name: [] for name in QUANTITIES}
    values: dict[str, list[float]] = {name: [] for name in QUANTITIES}
    counts: collections.Counter[int] = collections.Counter()
    for target in simulated(task, "ten trials of 15 s", count, 77):
        result = fitted(target)
        counts[chosen(result)] += 1
        for name in QUANTITIES:
            if name not in result.derived:
                continue
            values[name].append(result.derived[name].value)
            if name in result.determined:
                low, high = result.derived[name].interval or (None, None)
                inside[name].append(
                    (low is None or known[name] >= low) and (high is None or known[name] <= high)
                )
    print("chosen " + ", ".join(f"{n}: {counts[n]}" for n in range(4)), flush=True)
    for name, held in inside.items():
        low, middle, high = np.quantile(values[name], (0.025, 0.5, 0.975))
        share = (
            f"{np.mean(held):.3f} (three binomial errors {3 * np.sqrt(0.0475 / len(held)):.3f})"
            if held
            else "never"
        )
        print(
            f"{name}: stated {len(held)} times of {count}, holds the truth {share}; "
            f"median {middle:.4g}, 95 % of the values {low:.4g} to {high:.4g}",
            flush=True,
        )


STUDIES = {"selection": selection, "recovery": recovery}

if __name__ == "__main__":
    run(STUDIES, __doc__, 100)
