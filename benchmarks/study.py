"""What a study states, on simulated studies: do its intervals hold the difference, how often does
it see one where is none?

    python benchmarks/study.py [--count N] [--rung N|auto] [--people 6] [--trials 5] [--seed 0]

A study: two groups of people, whose muscle, activation and tremor scatter from person to person,
each with some trials of 15 s of the nonlinear model, in files. Half of the studies have two groups
of one kind; in the others the old have a slower twitch and a slower, stronger tremor. The outcome
stands in docs/study.md.
"""

import argparse
import tempfile
import time
import warnings
from collections import defaultdict
from pathlib import Path

import jax
import numpy as np
import scipy
from ladder import QUANTITIES, QUIET, TWITCH, consequences, with_shares

import jaxmuscle as jm

LEAD, SECONDS, RATE = 4.0, 15.0, 100.0
SPREAD = {
    "k_w": 0.15,
    "c_w": 0.2,
    "noise_K_w": 0.2,
    "activation_time": 0.15,
    "resonance_frequency": 0.08,
    "resonance_width": 0.15,
    "resonance_amplitude": 0.2,
}
OLD = {"activation_time": 1.25, "resonance_frequency": 0.85, "resonance_amplitude": 1.4}
SHARE = 0.1
DRAWN = 200  # people that stand for the whole population, the same deviates in both groups


def centre() -> jm.Isometric:
    with jax.enable_x64(True):
        return with_shares(
            jm.model.on_rung(QUIET, 2).replace(activation_time=TWITCH), {"resonance": SHARE}
        )


def person(task: jm.Isometric, factors: dict[str, float], rng: np.random.Generator) -> jm.Isometric:
    return task.replace(
        **{
            name: (
                float(task[name])
                * factors.get(name, 1.0)
                * float(np.exp(sd * rng.standard_normal()))
            )
            for name, sd in SPREAD.items()
        }
    )


def population(
    task: jm.Isometric, factors: dict[str, float], rng: np.random.Generator
) -> dict[str, float]:
    """Mean of every quantity over a group's population; a study estimates it, each person's in
    linear response."""
    drawn = [consequences(person(task, factors, rng)) for _ in range(DRAWN)]
    return {name: float(np.mean([each[name] for each in drawn])) for name in drawn[0]}


def recorded(tasks: dict[str, jm.Isometric], trials: int, key: int, folder: Path) -> Path:
    """The files of a study and its table."""
    rows = ["file,person,group,trial"]
    sweep = jm.ensembles.Sweep.of([task.settled() for task in tasks.values()])
    for number, (name, task) in enumerate(zip(tasks, sweep, strict=True)):
        runs = jm.ensemble(
            task,
            jax.random.key(1000 * key + number),
            seeds=trials,
            duration=LEAD + SECONDS,
            control=False,
        )
        for trial, force in enumerate(np.asarray(runs.output), 1):
            np.save(folder / f"{name}-{trial}.npy", force[round(LEAD * RATE) :])
            rows.append(f"{name}-{trial}.npy,{name},{name[:-2]},{trial}")
    (folder / "study.csv").write_text("\n".join(rows) + "\n")
    return folder / "study.csv"


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--people", type=int, default=6)
    parser.add_argument("--trials", type=int, default=5)
    parser.add_argument("--rung", default="2")
    parser.add_argument("--starts", type=int, default=32)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    rung = asked.rung if asked.rung == "auto" else int(asked.rung)
    task, rng = centre(), np.random.default_rng(asked.seed)
    means = {
        group: population(task, factors, np.random.default_rng(1))
        for group, factors in (("young", {}), ("old", OLD))
    }
    print(
        ", ".join(f"{q} {means['young'][q]:.3g} and {means['old'][q]:.3g}" for q in QUANTITIES),
        flush=True,
    )
    seen: dict[bool, dict[str, list[tuple[bool, float]]]] = {
        effect: defaultdict(list) for effect in (False, True)
    }
    any_found, seconds = [], []
    for number in range(asked.count):
        effect = bool(number % 2)
        factors = {"young": {}, "old": OLD if effect else {}}
        tasks = {
            f"{g}-{i}": person(task, factors[g], rng) for g in factors for i in range(asked.people)
        }
        with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            table = recorded(tasks, asked.trials, 1000 * asked.seed + number, Path(folder))
            start = time.process_time()
            found = jm.run_study(table, rung=rung, rate=RATE, units="N", starts=asked.starts)
            seconds.append(time.process_time() - start)
        differences = found.differences()
        for d in differences:
            truth = means["old" if effect else "young"].get(d.quantity, np.nan) - means[
                "young"
            ].get(d.quantity, np.nan)
            seen[effect][d.quantity].append((d.low <= truth <= d.high, d.p))
        if not effect:
            any_found.append(any(d.p_corrected < 0.05 for d in differences))
        print(f"study {number}: {seconds[-1]:.0f} s, {found.cohort.verdict}", flush=True)
        if number % 10 == 9 or number == asked.count - 1:
            report(seen, any_found, seconds)


def report(seen: dict, any_found: list[bool], seconds: list[float]) -> None:
    for effect, quantities in seen.items():
        print("with a difference" if effect else "without a difference")
        every = [each for rows in quantities.values() for each in rows]
        for name, rows in [*quantities.items(), ("all", every)]:
            held, below = sum(ok for ok, _ in rows), sum(p < 0.05 for _, p in rows)
            law = scipy.stats.binomtest(held, len(rows)).proportion_ci()
            print(
                f"  {name:<26} intervals hold it in {held} of {len(rows)} ({law.low:.2f} to"
                f" {law.high:.2f}), p < 0.05 in {below}"
            )
    print(
        f"any difference after correction where is none: {sum(any_found)} of {len(any_found)}"
        " studies"
    )
    print(
        f"processor time of a study: first {seconds[0]:.0f} s, then"
        f" {np.median(seconds[1:] or seconds):.0f} s",
        flush=True,
    )


if __name__ == "__main__":
    main()
