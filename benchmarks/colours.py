"""How often `compare_noise` names the wrong colour: `python benchmarks/colours.py --recordings 50
--seconds 60`."""

import argparse
import itertools
import json
import time
from datetime import date
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from run import machine, write

import jaxmuscle as jm
from jaxmuscle.comparison._comparison import NEEDED, Evidence, decide, lowest
from jaxmuscle.comparison._evidence import (
    Candidate,
    Folds,
    held_out,
    masked_bins,
    maxima,
    stack_bins,
)
from jaxmuscle.model._noises import with_noise
from jaxmuscle.model._parameters import DEFAULT_FREE
from jaxmuscle.objective._arguments import planned
from jaxmuscle.objective._options import FitOptions
from jaxmuscle.objective._problem import FitProblem

COLOURS = ("band-limited", "ornstein-uhlenbeck", "pink")
VARIED = (*DEFAULT_FREE, "noise_correlation_time")
MUSCLE = ("k_w", "k_z", "c_w", "c_z")
SPREAD, TOGETHER, GROUPS, DT, SETTLING = 0.5, 25, 10, 2.5e-3, 5.0
SIDES = ("muscle fixed", "muscle free")
CASES = ((True, SIDES[0]), (True, SIDES[1]), (False, SIDES[1]))


class Recording(NamedTuple):
    """A simulated recording: the noise it was made with, whether it has a harmonic, the task it
    came from, its spectrum."""

    colour: str
    harmonic: bool
    truth: jm.model.AbstractTask
    target: jm.Target


def recorded(colour: str, number: int, seconds: float, *, harmonic: bool) -> Recording:
    """Nonlinear simulation of a muscle drawn about the defaults: sd 0.5 in the logarithm of all
    that `VARIED` names.

    A harmonic outside the bins is drawn again.
    """
    rng = np.random.default_rng([COLOURS.index(colour), number, harmonic])
    task = with_noise(jm.Isometric(), colour)
    frequency = task.settings.frequency
    drawn = {
        name: float(task[name]) * np.exp(SPREAD * rng.standard_normal())
        for name in VARIED
        if name in task.parameter_names
    }
    while not frequency[0] < drawn["harmonic_frequency"] < frequency[-1]:
        drawn["harmonic_frequency"] = float(task["harmonic_frequency"]) * np.exp(
            SPREAD * rng.standard_normal()
        )
    truth = task.replace(**(drawn if harmonic else drawn | {"harmonic_amplitude": 0.0}))
    runs = jm.ensemble(
        truth.settled(),
        jax.random.key(COLOURS.index(colour)),
        seeds=np.array([2 * number + harmonic]),
        duration=SETTLING + seconds,
        dt=DT,
        control=False,
    )
    spectrum = runs.spectrum(window=(SETTLING, SETTLING + seconds))
    segments = task.settings.segments(round(seconds * task.settings.rate))
    target = jm.Target(
        f"{colour} {number}",
        np.asarray(spectrum.proportional)[0],
        segments=segments,
        settings=task.settings,
    )
    return Recording(colour, harmonic, truth, target)


def examined(
    recordings: list[Recording], colour: str, *, muscle_free: bool
) -> list[dict[str, Any]]:
    """What `compare_noise` finds for one colour, many recordings in one batch; of those with the
    muscle fixed at its truth.

    All but its four material factors is free as by default.
    """
    targets = [recording.target for recording in recordings]
    problems = [
        planned(with_noise(jm.Isometric(), colour), target, FitOptions()).problem
        for target in targets
    ]
    folds, whole = (
        Folds.of(targets, GROUPS),
        stack_bins([masked_bins(t, np.ones((1, len(t.bins)))) for t in targets]),
    )
    whole = jax.tree.map(lambda x: x[:, 0], whole)
    found: list[dict[str, Any]] = [{} for _ in recordings]
    for harmonic in (True, False):
        models = [Candidate.of(problem, harmonic=harmonic) for problem in problems]
        starts = np.stack([model.starts for model in models])
        moving = np.ones((len(targets), starts.shape[2]))
        if not muscle_free:
            at_truth = [n in MUSCLE for n in problems[0].coordinates.names]
            starts[:, :, at_truth] = np.array(
                [_muscle(s, r.truth) for s, r in zip(problems, recordings, strict=True)]
            )[:, None]
            moving[:, at_truth] = 0.0
        peak = maxima(models[0], starts, whole, moving)
        held = held_out(models[0], peak.theta, folds, moving)
        for i, one in enumerate(found):
            aic = float(2 * (peak.parameters[i] - peak.log_likelihood[i]))
            settled = bool(peak.settled[i] and held.settled[i])
            one[str(harmonic)] = {
                "aic": aic,
                "scores": held.scores[i].tolist(),
                "settled": settled,
                "parameters": float(peak.parameters[i]),
            }
    return found


def _muscle(problem: FitProblem, truth: jm.model.AbstractTask) -> np.ndarray:
    """Coordinates of the material factors at their true values."""
    task = problem.parts[0].task.replace(**{name: float(truth[name]) for name in MUSCLE})
    return problem.theta_of((task,))[[n in MUSCLE for n in problem.coordinates.names]]


def study(count: int, seconds: float, path: Path) -> dict[str, Any]:
    """All recordings under all colours; what has been done is in `path` after every batch and not
    done again."""
    asked = {"recordings": count, "seconds": seconds, "spread": SPREAD, "groups": GROUPS}
    done: dict[str, Any] = {"asked": asked, "found": {}}
    if path.exists() and (old := json.loads(path.read_text(encoding="utf-8")))["asked"] == asked:
        done = old
    started = time.perf_counter()
    for (harmonic, side), true, first in itertools.product(
        CASES, COLOURS, range(0, count, TOGETHER)
    ):
        numbers = range(first, min(first + TOGETHER, count))
        keys = [f"{true}|{number}|{harmonic}|{side}" for number in numbers]
        if all(key in done["found"] for key in keys):
            continue
        batch = [recorded(true, number, seconds, harmonic=harmonic) for number in numbers]
        by_colour = {
            colour: examined(batch, colour, muscle_free=side == SIDES[1]) for colour in COLOURS
        }
        done["found"] |= {
            key: {colour: by_colour[colour][i] for colour in COLOURS} for i, key in enumerate(keys)
        }
        write(path, done)
        print(
            f"{time.perf_counter() - started:6.0f} s  {true}, {'with' if harmonic else 'no'}"
            f" harmonic, {side}: {numbers[-1] + 1} of {count}",
            flush=True,
        )
    return done


def _evidence(one: dict[str, Any]) -> Evidence:
    return Evidence(one["aic"], np.array(one["scores"]))


def verdicts(done: dict[str, Any]) -> list[dict[str, Any]]:
    """Right, wrong and open verdicts of every pair of colours."""
    rows = []
    for (harmonic, side), (a, b) in itertools.product(CASES, itertools.combinations(COLOURS, 2)):
        for true in (a, b):
            count = {"right": 0, "wrong": 0, "open": 0}
            for found in _of(done, harmonic, side, true):
                winner = decide(
                    (a, b), *(lowest([_evidence(one) for one in found[c].values()]) for c in (a, b))
                ).winner
                count["open" if winner is None else "right" if winner == true else "wrong"] += 1
            rows.append(_case(harmonic, side) | {"pair": f"{a} or {b}", "true": true} | count)
    return rows


def harmonics(done: dict[str, Any]) -> list[dict[str, Any]]:
    """How often a harmonic is shown, and how often denied, if an AIC lower by 6 or by 6 + 2
    ln(bins) is asked for."""
    rows = []
    for harmonic, side in CASES:
        for charged in (False, True):
            count = {"shown": 0, "denied": 0, "open": 0}
            for found in _of(done, harmonic, side):
                both = [
                    lowest([_evidence(found[c][str(h)]) for c in COLOURS]) for h in (True, False)
                ]
                needed = NEEDED + 2 * charged * float(np.log(np.size(both[0].scores)))
                count[decide(("shown", "denied"), *both, needed).winner or "open"] += 1
            rows.append(
                _case(harmonic, side) | {"needed": "6 + 2 ln(bins)" if charged else "6"} | count
            )
    return rows


def _of(
    done: dict[str, Any], harmonic: bool, side: str, true: str | None = None
) -> list[dict[str, Any]]:
    parts = ((key.split("|"), found) for key, found in done["found"].items())
    return [
        found
        for (colour, _, present, how), found in parts
        if (present, how) == (str(harmonic), side) and true in (None, colour)
    ]


def _case(harmonic: bool, side: str) -> dict[str, str]:
    return {"muscle": side.removeprefix("muscle "), "harmonic": "present" if harmonic else "absent"}


def markdown(rows: list[dict[str, Any]]) -> str:
    """A table."""
    lines = [
        list(rows[0]),
        ["---"] * len(rows[0]),
        *([str(v) for v in row.values()] for row in rows),
    ]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def main() -> None:
    """Run, or go on with, the study; print its tables and write them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--recordings", type=int, default=50, help="of each colour (default 50)")
    parser.add_argument(
        "--seconds", type=float, default=60.0, help="length of a recording (default 60)"
    )
    parser.add_argument("--out", type=Path, default=Path("out/colours.json"))
    options = parser.parse_args()
    with jax.enable_x64(True):
        done = study(options.recordings, options.seconds, options.out.with_suffix(".part.json"))
    tables = {"noise": verdicts(done), "harmonic": harmonics(done)}
    for title, rows in tables.items():
        print(f"\n{title}\n\n{markdown(rows)}")
    settled = [
        one["settled"]
        for found in done["found"].values()
        for c in found.values()
        for one in c.values()
    ]
    print(f"\n{sum(settled)} of {len(settled)} models settled")
    facts = {
        "asked": done["asked"],
        "machine": machine(),
        "date": date.today().isoformat(),
        "settled": sum(settled),
        "models": len(settled),
    }
    write(options.out, facts | {"tables": tables})


if __name__ == "__main__":
    main()
