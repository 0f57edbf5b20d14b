"""What `jaxmuscle reproduce` computes: the numbers behind the paper's figures and statements."""

import itertools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Float

from jaxmuscle.data._recording import RECORDED, Recording
from jaxmuscle.model._signals import SmoothStep
from jaxmuscle.model._tasks import AbstractTask, PrescribedForce
from jaxmuscle.model._white_noise import OrnsteinUhlenbeckNoise
from jaxmuscle.response._presets import load_preset
from jaxmuscle.simulation._trajectory import Trajectory, stack
from jaxmuscle.spectra._measures import approximate_entropy, peaks
from jaxmuscle.spectra._settings import WINDOW
from jaxmuscle.spectra._welch import Spectrum, lowpass

from ._levels import Levels, levels
from ._readings import (
    HIGH_BIN,
    LOW_BIN,
    SILENT,
    Reading,
    expected_of,
    fast_share,
    in_task_2,
    readings,
    runs_of,
    within_bins,
)

SEEDS = 32
PERSON = ("k_w", "c_w", "noise_K_w", "harmonic_amplitude")
SINES = (1.24, 4.251, 7.0)
MOVED = 0.005  # m, how far the insertion moves in the concentric phase: our choice
Progress = Callable[[str, float], Any]


class Tuned(eqx.Module):
    """A preset in Task 1 (force) and in Task 2 (displacement).

    **Fields:** `force`, 32 seeds of P_w; `spectrum`, its expected one; `sine`, the harmonic's share
    of every bin; `variation`, the expected coefficient of variation; `fast`, the share of the
    force's variance above 10 Hz; `within`, the share of its power that is in the compared bins
    (`within_bins`); `displacement`, one seed of x_z at constant forces, with `moved`, its expected
    spectrum, and `displacement_variation`; `both`, the share of single seeds with the maximum in
    bin 1 and a local one in bin 11; `swing`, the amplitude of the harmonic in the force, relative
    to the mean, in the first and the last quarter of the window.
    """

    force: Trajectory
    spectrum: Spectrum
    sine: Float[np.ndarray, " bins"]
    variation: float
    fast: float
    within: float
    displacement: Trajectory
    moved: Spectrum
    displacement_variation: float
    both: float
    swing: tuple[float, float]


class Concentric(eqx.Module):
    """Task 1 while the insertion moves by 5 mm against its rising load, and what the force needed
    does in Task 2.

    **Fields:** `mean` of the held P_w [N]; `low`, `high` [Hz], its maximum and the highest local
    one; `error`, the largest difference between the insertion's way in Task 2 and the prescribed
    one, relative to the 5 mm.
    """

    mean: float
    low: float
    high: float
    error: float


class Regularity(eqx.Module):
    """Approximate entropy (m = 2, r = 0.2 σ) of 10 s at 100 Hz, low-passed at 30 Hz as the force
    is."""

    white: float
    white_unfiltered: float
    sines: tuple[float, ...]
    force: float
    force_unfiltered: float


class Experiment(eqx.Module):
    """Three people's recordings and their spectra, whole recording ("FFT") against Welch.

    **Fields:** `recordings`; `fft`, `welch`; `rho_fft`, `rho_welch`, Spearman
    correlations of the pairs.
    """

    recordings: tuple[Recording, ...]
    fft: tuple[Spectrum, ...]
    welch: tuple[Spectrum, ...]

    @property
    def pairs(self) -> tuple[tuple[int, int], ...]:
        """Which two people a correlation compares."""
        return tuple(itertools.combinations(range(len(self.recordings)), 2))

    @property
    def rho_fft(self) -> tuple[float, ...]:
        """Spearman correlation of the FFT power of each pair."""
        return self._rho(self.fft)

    @property
    def rho_welch(self) -> tuple[float, ...]:
        """Spearman correlation of the Welch power of each pair."""
        return self._rho(self.welch)

    def _rho(self, spectra: tuple[Spectrum, ...]) -> tuple[float, ...]:
        powers = ((a.power, b.power) for a, b in itertools.combinations(spectra, 2))
        return tuple(float(scipy.stats.spearmanr(*pair).statistic) for pair in powers)


def run_preset(task: AbstractTask) -> Tuned:
    """A preset's force in Task 1, and its displacement in Task 2 under the force that it needs
    there."""
    moments, spectrum = expected_of(task)
    runs, second = runs_of(task, SEEDS), in_task_2(task)
    pulling, moved = expected_of(second)
    return Tuned(
        force=runs,
        spectrum=spectrum,
        sine=np.asarray(moments.line / moments.power),
        variation=float(moments.variation),
        fast=float(np.mean([fast_share(row, runs.rate) for row in np.asarray(runs.between())])),
        within=within_bins(task),
        displacement=stack([runs_of(second, 1)], 1),
        moved=moved,
        displacement_variation=float(pulling.variation),
        both=_both(runs),
        swing=_swing(runs),
    )


def concentric(task: AbstractTask) -> Concentric:
    """A preset of Task 1 with a moving insertion; what its force does in Task 2 without noise and
    harmonic."""
    way = SmoothStep(MOVED)
    moving = task.with_parts(x_z=way)
    moments, spectrum = expected_of(moving)
    found = peaks(spectrum)
    high = max(found.local_maxima, key=lambda peak: peak.power, default=found.maximum)
    back = runs_of(in_task_2(moving, MOVED).replace(**SILENT), 1)
    wanted = np.asarray(jax.vmap(way)(jnp.asarray(back.time)))
    error = np.abs(np.asarray(back.output)[0] - wanted).max() / MOVED
    return Concentric(float(moments.mean), found.maximum.frequency, high.frequency, float(error))


def _both(runs: Trajectory) -> float:
    spectra, count = runs.spectrum(), 0
    for row in np.asarray(spectra.power):
        found = peaks(Spectrum(spectra.frequency, row, spectra.settings))
        local = [peak.bin for peak in found.local_maxima]
        count += found.maximum.bin == LOW_BIN and HIGH_BIN in local
    return count / len(spectra.power)


def _swing(runs: Trajectory) -> tuple[float, float]:
    """From the mean over the seeds, in which noise is smaller: sine, cosine and a straight line by
    least squares."""
    mean = np.asarray(runs.between()).mean(0)
    time, quarter = WINDOW[0] + np.arange(mean.size) / runs.rate, mean.size // 4
    angle = 2 * np.pi * float(runs.task["harmonic_frequency"]) * time
    columns = np.stack([np.sin(angle), np.cos(angle), np.ones_like(time), time], axis=1)

    def amplitude(part: slice) -> float:
        found = np.linalg.lstsq(columns[part], mean[part], rcond=None)[0]
        return float(np.hypot(found[0], found[1]) / mean.mean())

    return amplitude(slice(quarter)), amplitude(slice(-quarter, None))


def regularity(force: Trajectory) -> Regularity:
    """White Gaussian noise and sines beside the model's force, treated alike."""
    settings, time = force.task.settings, np.arange(1500) / 100.0

    def of(signal) -> float:
        return approximate_entropy(np.asarray(lowpass(np.asarray(signal), settings))[500:])

    white = np.random.default_rng(0).normal(size=1500)
    sines = tuple(of(np.sin(2 * np.pi * f * time)) for f in SINES)
    one = np.asarray(force.output)[0, :1500]
    return Regularity(
        of(white), approximate_entropy(white[500:]), sines, of(one), approximate_entropy(one[500:])
    )


def person(number: int) -> AbstractTask:
    """A simulated person, 0 to 2: stiffness, damping, noise and harmonic up to 10 % off the
    defaults, in Task 2.

    Ornstein-Uhlenbeck noise of 5 %: fluctuations of a fraction of a millimetre, as of a finger that
    is held still.
    """
    task = PrescribedForce(P_w=5.0, noise=OrnsteinUhlenbeckNoise([0.05, 0.005, 0.0, 0.0], 0.1))
    factor = (0.9, 1.0, 1.1)[number]
    # what rises with one person falls with another
    factors = [factor, 2 - factor] * 2
    return task.replace(**{n: task[n] * f for n, f in zip(PERSON, factors, strict=True)})


def record(
    task: AbstractTask, seeds: int = 1, key: int = 100, name: str = "run"
) -> tuple[Recording, ...]:
    """60 s of x_z [m] at 120 Hz, after a rise of 5 s, as recordings."""
    runs = runs_of(task, seeds, key, duration=65.0, dt=1 / 1200, rate=120.0)
    about: dict[str, Any] = {"unit": "m", "source": "simulated by jaxmuscle reproduce"}
    return tuple(
        Recording(row, 120.0, name=f"{name} {i + 1}" if seeds > 1 else name, **about)
        for i, row in enumerate(np.asarray(runs.between((5.0, 65.0))))
    )


def simulated_recordings() -> tuple[Recording, ...]:
    """Three simulated people."""
    return tuple(
        record(person(i), key=100 + i, name=f"simulated person {i + 1}")[0] for i in range(3)
    )


def experiment(people: tuple[Recording, ...]) -> Experiment:
    """Spectra of three people, resampled to 100 Hz so that 256 points give the stated 0.39 Hz."""
    fft, welch = (r.fft_spectrum(RECORDED) for r in people), (r.spectrum(RECORDED) for r in people)
    return Experiment(people, tuple(fft), tuple(welch))


class Reproduction(eqx.Module):
    """Everything that the figures and the table of claims are made of.

    `same_muscle`: the experiment with three runs of `zagrodny-slifkin` in Task 2 instead of three
    people.
    """

    slifkin: Tuned
    hamilton: Tuned
    concentric: Concentric
    levels: Levels
    regularity: Regularity
    experiment: Experiment
    same_muscle: Experiment
    readings: tuple[Reading, ...]


def compute(report: Progress) -> Reproduction:
    """All numbers, in float64; nothing is written."""
    with jax.enable_x64(True):
        report("Task 1 and 2, zagrodny-slifkin", 0.0)
        slifkin = run_preset(load_preset("zagrodny-slifkin"))
        report("Task 1 and 2, zagrodny-hamilton", 0.15)
        hamilton = run_preset(load_preset("zagrodny-hamilton"))
        moving = concentric(slifkin.force.task)
        report("levels of contraction", 0.3)
        moved = levels()
        report("comparison signals", 0.45)
        compared = regularity(slifkin.force)
        report("three people", 0.5)
        people = experiment(simulated_recordings())
        tuned_runs = experiment(record(slifkin.displacement.task, seeds=3))
        report("three readings", 0.6)
        judged = readings(slifkin.force.task)
        return Reproduction(slifkin, hamilton, moving, moved, compared, people, tuned_runs, judged)
