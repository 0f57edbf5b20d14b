"""What the mean spectrum of recordings cannot show: fluctuations that change their size, a sharp
rhythm. `Endpoint` of `_verdict.py` asks for it.
"""

import functools
import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxmuscle._common.errors import SimulationError
from jaxmuscle._common.text import probability
from jaxmuscle._common.types import Key
from jaxmuscle.data._measured import RECORDED
from jaxmuscle.data._recording import BURST
from jaxmuscle.data._target import Target
from jaxmuscle.ensembles._ensemble import ensemble
from jaxmuscle.model._resonant_noise import narrow_resonances
from jaxmuscle.model._task import AbstractTask
from jaxmuscle.response._density import noise_density
from jaxmuscle.response._equilibrium import slowest_rate
from jaxmuscle.response._linearised import settled
from jaxmuscle.spectra._bin_law import ENOUGH
from jaxmuscle.spectra._whitened import (
    BAND,
    PADDED,
    Density,
    envelope_power,
    log_powers,
    sharpest,
    slopes_of,
    trend_p,
    whiten,
)

LEVEL = 0.01  # of either notice
UNSURE, GONE = 0.05, 0.1  # p at which the muscle is simulated, and at which that ends
DRAWS = 399  # Gaussian records; of the nonlinear muscle
RECORDS, BLOCK = 600, 2000.0  # s simulated at once
CHANGES = "the size of the fluctuations changes during the record (bursts, pauses, fatigue)"
EVENT = "where the force leaves its level, it fluctuates more than a steady muscle's"
AT_ONCE = 4_000_000  # padded samples
SUMS = 4999  # of several trials, of which each is drawn from the simulated ones
LEAD, FORGOTTEN, LONGEST_LEAD = 5.0, 8.0, 20.0  # s; decay times before the record begins; s
STEP = 5.0  # s: one program for records that differ by less
RATE = float(RECORDED.rate)
DO = (
    "A muscle's noise does not make one. What to do: look for its source (mains, motor, a display,"
    " the pulse). If it is the person's own, record longer, and take its frequency from"
    " Recording.fft_spectrum"
)


class SignalTest(NamedTuple):
    """What the samples of a target show: `notices`, and, where the size of the fluctuations
    changes, by how much errors are too small.

    `widening`, √(E / E₀), E the slow power of the envelope and E₀ what is expected of it in a
    steady record; `common`, (E - E₀) / n: the relative variance of the mean power of n samples that
    is due to the change.
    """

    notices: tuple[str, ...] = ()
    widening: float = 1.0
    common: float = 0.0

    def widened(self, target: Target) -> Target:
        """The target with the measured errors that follow."""
        if self.widening == 1:
            return target
        return target.with_unsteady_errors(self.widening, self.common)


class _Pool(NamedTuple):
    """Of steady records as long as one of the trials: power of the envelope, slope of the log power
    of their parts."""

    envelope: Float[np.ndarray, " records"]
    slope: Float[np.ndarray, " records"]

    @classmethod
    def of(cls, signals: np.ndarray, density: Density) -> "_Pool":
        w = whiten(signals, RATE, density)
        return cls(envelope_power(w, RATE), slopes_of(log_powers(w)))


def check_signals(target: Target, task: AbstractTask, key: Key) -> SignalTest:
    """Look at the samples of a target to which this task was fitted; without samples nothing is
    said."""
    signals = [np.asarray(x)[None] for x in target.signals]
    if not signals:
        return SignalTest()
    resolution = target.settings.resolution
    density = _smooth(task, resolution)
    seen = density(np.linspace(*BAND))
    if not np.all(np.isfinite(seen) & (seen > 0)):  # no linear response, or no noise
        return SignalTest()
    sharp = _sharp_rhythm(signals, density)
    if not sharp:
        sharp = tuple(
            f"a sharp rhythm at {float(noise.frequency):.2f} Hz: the fitted resonance is"
            f" {float(noise.width):.2g} Hz wide, narrower than a bin ({resolution:.2g} Hz). {DO}"
            for noise in narrow_resonances(task.noise, resolution)
        )
    event = any(BURST in notice for notice in target.notices)
    steady = _steadiness(signals, task, density, key, event=event)
    return steady._replace(notices=(*steady.notices, *sharp))


def _smooth(task: AbstractTask, resolution: float) -> Density:
    """The fitted spectrum without harmonic and without resonances that are narrower than a bin."""
    narrow = narrow_resonances(task.noise, resolution)
    smooth = [all(noise is not each for each in narrow) for noise in task.noise.components]
    return lambda f: np.sum(noise_density(task, f)[np.array(smooth)], axis=0)


def _lengths(signals: list[np.ndarray]) -> list[int]:
    return [x.shape[-1] for x in signals]


def _flat(f: np.ndarray) -> np.ndarray:
    return np.ones(len(f))


def _sharp_rhythm(signals: list[np.ndarray], density: Density) -> tuple[str, ...]:
    frequency, height = (float(found[0]) for found in sharpest(signals, RATE, density))
    among = _white_heights(tuple(sorted(_lengths(signals))))
    p = (1 + np.sum(among >= height)) / (1 + len(among))
    if p >= LEVEL:
        return ()
    times = f"{float(f'{height:.2g}'):g}"
    return (
        f"a sharp rhythm at {frequency:.2f} Hz ({probability(p)}): its power density is {times}"
        " times that of its neighbourhood in the samples themselves. The bins of the spectrum are"
        f" too wide to show this. {DO}",
    )


@functools.cache
def _white_heights(lengths: tuple[int, ...]) -> Float[np.ndarray, " draws"]:
    """What is sharpest in white noise; long records a few at a time, for the memory's sake."""
    rng, at_once = np.random.default_rng(0), max(1, AT_ONCE // (PADDED * max(lengths)))
    sizes = [min(at_once, DRAWS - first) for first in range(0, DRAWS, at_once)]
    return np.concatenate(
        [
            sharpest([rng.standard_normal((size, n)) for n in lengths], RATE, _flat)[1]
            for size in sizes
        ]
    )


@functools.cache
def _white_pool(n: int) -> _Pool:
    return _Pool.of(np.random.default_rng(1).standard_normal((DRAWS, n)), _flat)


def _steadiness(
    signals: list[np.ndarray], task: AbstractTask, density: Density, key: Key, *, event: bool
) -> SignalTest:
    """Whether the size of the fluctuations stays (`event`: a cough is named already), first against
    Gaussian noise, then, where that is doubtful, against the nonlinear muscle.

    That one's envelope varies more. It is simulated in blocks, until p is clearly above the level
    (sequential tests: Besag & Clifford 1991, doi:10.1093/biomet/78.2.301).
    """
    w = [whiten(x, RATE, density) for x in signals]
    envelope = [float(envelope_power(x, RATE)[0]) for x in w]
    parts = np.concatenate([log_powers(x) for x in w])
    slope = float(np.mean(slopes_of(parts)))
    lengths = _lengths(signals)
    p, steady = _compared(envelope, slope, {n: _white_pool(n) for n in lengths}, lengths)
    if p >= UNSURE:
        return SignalTest()
    pools: dict[int, _Pool] = {}
    try:
        for records in _simulated(task, max(lengths), key):
            for n in set(lengths):
                own = _Pool.of(records[:, :n], density)
                pools[n] = (
                    _Pool(*map(np.concatenate, zip(pools[n], own, strict=True)))
                    if n in pools
                    else own
                )
            p, steady = _compared(envelope, slope, pools, lengths)
            if p >= GONE:
                break
    except (SimulationError, ValueError):
        return SignalTest()
    if p >= LEVEL:
        return SignalTest()
    here, expected = (float(np.dot(lengths, each)) for each in (envelope, steady))
    ratio = max(1.0, here / expected)
    common = (ratio - 1) * expected / sum(lengths) ** 2
    found = SignalTest((), math.sqrt(ratio), common)
    what = _trend(slope) if trend_p(parts) < LEVEL else EVENT if event else CHANGES
    return found._replace(notices=(f"{what}, {probability(p)}. {_of_errors(found, len(signals))}",))


def _compared(
    envelope: list[float], slope: float, pools: dict[int, _Pool], lengths: list[int]
) -> tuple[float, list[float]]:
    """The p-value of both tests, twice the smaller one; and the expected envelope of each trial.

    Trials are independent: several are drawn one by one from the records of their length.
    """
    rng, each = np.random.default_rng(2), [pools[n] for n in lengths]
    alone = len(each) == 1
    rows = [
        np.arange(len(pool.slope)) if alone else rng.integers(len(pool.slope), size=SUMS)
        for pool in each
    ]
    drawn = [(pool.envelope[row], pool.slope[row]) for pool, row in zip(each, rows, strict=True)]
    sums, slopes = np.sum(drawn, axis=0)
    p = min(
        (1 + np.sum(sums >= sum(envelope))) / (1 + len(sums)),
        (1 + np.sum(np.abs(slopes) >= len(each) * abs(slope))) / (1 + len(slopes)),
    )
    return 2 * float(p), [float(np.mean(pool.envelope)) for pool in each]


def _simulated(
    task: AbstractTask, samples: int, key: Key
) -> Iterator[Float[np.ndarray, "records times"]]:
    """Records of the nonlinear muscle, low-passed as the measured ones, block by block."""
    still = settled(task)
    lead = min(max(LEAD, FORGOTTEN / float(slowest_rate(still))), LONGEST_LEAD)
    start = STEP * math.ceil(lead / STEP)
    stop = STEP * math.ceil((start + samples / RATE) / STEP)
    count = min(max(10, round(BLOCK / stop)), RECORDS)
    for first in range(0, RECORDS, count):
        numbers = np.arange(first, first + count)
        runs = ensemble(still, key, seeds=numbers, duration=stop, control=False)
        yield np.asarray(runs.filtered(RECORDED, (start, start + samples / RATE)), float)


def _trend(slope: float) -> str:
    factor = math.exp(0.5 * abs(slope))
    return (
        f"the fluctuations {'grow' if slope > 0 else 'shrink'} within the trials, {factor:.2g} fold"
        " from beginning to end (fatigue)"
    )


def _of_errors(found: SignalTest, trials: int) -> str:
    model = f"the errors of the model are widened {found.widening:.2g} fold"
    if trials >= ENOUGH:
        return (
            f"So {model}, as far as the scatter of the trials has not widened them. The measured"
            " errors come from this scatter, which contains the change already"
        )
    return (
        f"So {model}, and so are the measured ones of shares, powers and variation. Besides, all"
        f" powers may be too large or too small together, by {100 * math.sqrt(found.common):.2g} %,"
        " and the variation by half of that: their errors contain it. What to do: record more"
        f" trials. From {ENOUGH} on errors come from their scatter"
    )
