"""How often 95 % intervals hold the truth, and how often a tremor is found, in recordings made by
NumPy from a known spectrum, without the model.

    python benchmarks/intervals.py steadiness [--count N]
    python benchmarks/intervals.py tremor [--count N]

`steadiness` looks at the intervals of `jm.data.steadiness`. The spectrum relaxes from a corner of
0.5, 1 or 2 Hz on, and has a floor; half of the recordings have a tremor at 9 Hz. Others have a
level that wanders: 1/f^1.5, with periods up to eight recordings long. Takes ten minutes; the
outcome stands in docs/recordings.md.

`tremor` looks at the test for a tremor: 1/f with a bend at 1, 1.8 or 4 Hz, a floor, an amplitude
that swells and fades in half of the recordings, and a hill between 8 and 10.5 Hz. Takes a few
minutes; the outcome stands in docs/force.md.
"""

import functools
import itertools
import math
from collections import defaultdict
from collections.abc import Callable
from typing import Any
from unittest import mock

import numpy as np
from verdict import run

import jaxmuscle as jm
from jaxmuscle.data import _measured

RATE, MEAN, DEVIATION = 100.0, 10.0, 0.2
LEVELS = {
    "steady": [(corner, tremor) for corner in (0.5, 1.0, 2.0) for tremor in (False, True)],
    "wandering": [(0.0, False)],
}
FLOOR, TREMOR = 1e-3, 0.05  # density over that at 0; share of the variance
LENGTHS = (15.0, 30.0)
TRIALS = (1, 2, 3, 5, 10)
PERIODS = 8  # so many recordings long is the period that one is cut from
NORMAL = 1.96

Counts = dict[str, dict[int, list[tuple[bool, bool]]]]


def density(f: np.ndarray, corner: float, tremor: bool) -> np.ndarray:
    """Of a force; not normalised. A corner of 0 makes it wander."""
    if corner == 0:
        return np.append(0.0, f[1:] ** -1.5)
    slow, hill = 1 / (1 + (f / corner) ** 2) + FLOOR, np.exp(-0.5 * (f - 9) ** 2)
    return slow + tremor * TREMOR / (1 - TREMOR) * hill * slow.sum() / hill.sum()


def forces(count: int, seconds: float, corner: float, tremor: bool, seed: int) -> np.ndarray:
    """Stationary Gaussian recordings, whose level also differs as that of a part of a longer one
    does."""
    n, rng = (
        round(PERIODS * seconds * RATE),
        np.random.default_rng([seed, round(seconds), round(10 * corner), tremor]),
    )
    f = np.fft.rfftfreq(n, 1 / RATE)
    power = density(f, corner, tremor)
    power *= DEVIATION**2 / power.sum()
    z = rng.standard_normal((count, f.size)) + 1j * rng.standard_normal((count, f.size))
    z[:, 0] *= np.sqrt(2)  # half of a bin, and real: E x² of it is power / 2
    return (
        MEAN
        + (np.fft.irfft(z * np.sqrt(power / 2), n) * n / np.sqrt(2))[:, : round(seconds * RATE)]
    )


def steadiness(count: int) -> None:
    """How often the interval, and value ± 1.96 errors, hold the truth; both lengths together.

    The truth is the mean over all recordings; of the force, what was put in; of the peak, the hill
    of the mean spectrum.
    """
    for level, kinds in LEVELS.items():
        held: Counts = defaultdict(lambda: defaultdict(list))
        # A recording is in five groups: what takes long is computed once.
        with mock.patch.multiple(
            _measured, regularity=kept(_measured.regularity), dfa=kept(_measured.dfa)
        ):
            for seconds, (corner, tremor) in itertools.product(LENGTHS, kinds):
                count_held(forces(count, seconds, corner, tremor, 1), tremor, held)
        print(
            f"{level} level, held by the interval (by ± 1.96 errors) of so many trials:"
            f" {', '.join(map(str, TRIALS))}"
        )
        for name, by_trials in held.items():
            shares = [
                (100 * np.mean(by_trials[n], axis=0), len(by_trials[n]))
                for n in TRIALS
                if by_trials[n]
            ]
            print(
                f"  {name}: "
                + ", ".join(f"{law:.1f} ({plain:.1f}) % of {n}" for (law, plain), n in shares),
                flush=True,
            )


def kept(measure: Callable[[np.ndarray], Any]) -> Callable[[np.ndarray], Any]:
    """The same, remembered."""
    known = functools.cache(lambda signal: measure(np.frombuffer(signal)))
    return lambda x: known(x.tobytes())


def count_held(signals: np.ndarray, tremor: bool, held: Counts) -> None:
    """Adds whether the interval, and value ± 1.96 errors, of every measure of every group of trials
    hold the truth."""
    recordings = [jm.Recording(x, RATE) for x in signals]
    each = [jm.data.steadiness(recording) for recording in recordings]
    truth = {name: np.mean([one[name].value for one in each]) for name in each[0].measures} | {
        "mean": MEAN
    }
    truth["tremor_frequency"] = 9.0 if tremor else math.nan
    truth["tremor_size"] = math.nan  # `tremor` below looks at it
    for trials in TRIALS:
        for i in range(0, len(recordings) - trials + 1, trials):
            found = each[i] if trials == 1 else jm.data.steadiness(recordings[i : i + trials])
            for name, m in found.measures.items():
                if m.stderr is not None and m.interval is not None and np.isfinite(truth[name]):
                    low, high = m.interval
                    inside = (
                        low <= truth[name] <= high,
                        abs(m.value - truth[name]) <= NORMAL * m.stderr,
                    )
                    held[name][trials].append((bool(inside[0]), bool(inside[1])))


TRIED = ((15.0, 1), (15.0, 3), (30.0, 1), (30.0, 5))  # seconds, trials
BENDS = (1.0, 1.8, 4.0)  # Hz
WIDTH = 1.5  # Hz, of the hill at half height


def trembling(
    rng: np.random.Generator, seconds: float, trials: int, share: float, kind: int
) -> tuple[list[jm.Recording], float, float]:
    """Trials of one person; the frequency of the tremor, and the deviation that it has within its
    width to either side over the mean."""
    n, at = round(4 * seconds * RATE), rng.uniform(8.0, 10.5)
    f = np.fft.rfftfreq(n, 1 / RATE)[1:]
    slow = 1 / np.hypot(f, 0.1) / (1 + (f / BENDS[kind % 3]) ** 2) ** 1.25
    floor, hill = 1 / (1 + (f / 15) ** 4), np.exp(-4 * np.log(2) * ((f - at) / WIDTH) ** 2)
    power = (0.97 - share) * slow / slow.sum() + 0.03 * floor / floor.sum()
    power += share * hill / hill.sum()
    z = rng.standard_normal((trials, f.size)) + 1j * rng.standard_normal((trials, f.size))
    z = np.column_stack([np.zeros(trials), z * np.sqrt(power / power.sum())])
    x = (np.fft.irfft(z, n) * n / 2)[:, : round(seconds * RATE)]
    if kind >= 3:  # it swells and fades
        time = np.arange(x.shape[1]) / RATE
        x *= 1 + 0.5 * np.sin(2 * np.pi * (time / 8 + rng.uniform(size=(trials, 1))))
    size = DEVIATION / MEAN * math.sqrt(share * (9 / 8 if kind >= 3 else 1))
    names = [f"trial {i}" for i in range(trials)]
    made = [jm.Recording(MEAN + DEVIATION * y, RATE, name=n) for y, n in zip(x, names, strict=True)]
    return made, at, size


def tremor(count: int) -> None:
    """How often a tremor is found, and how often its intervals hold the truth."""
    constant = {"regularity": lambda x: (1.0, 1.0), "dfa": lambda x: 1.0}  # they take long
    with mock.patch.multiple(_measured, **constant):
        for (seconds, trials), share in itertools.product(TRIED, (0.0, 0.02, 0.05, 0.1)):
            rng, held, found = np.random.default_rng(7), [], 0
            for i in range(count):
                made, at, size = trembling(rng, seconds, trials, share, i % 6)
                one = jm.data.steadiness(made)
                if (frequency := one["tremor_frequency"]).interval is not None:
                    found += 1
                    ends = frequency.interval, one["tremor_size"].interval
                    held.append([e[0] <= v <= e[1] for e, v in zip(ends, (at, size), strict=True)])
            said = f"{trials} x {seconds:g} s, {share:.0%}: found {found} of {count}"
            if share:
                frequency, size = 100 * np.mean(held, axis=0)
                said += f"; intervals hold frequency {frequency:.0f} %, size {size:.0f} %"
            print(said, flush=True)


STUDIES = {"steadiness": steadiness, "tremor": tremor}

if __name__ == "__main__":
    run(STUDIES, __doc__, 120)
