"""Three readings of the 0.391 Hz and 4.251 Hz maxima: which of the facts that the paper states does
each of them give?"""

from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from jaxmuscle.ensembles._ensemble import ensemble
from jaxmuscle.model._muscle import Muscle
from jaxmuscle.model._parameters import CHANNELS
from jaxmuscle.model._signals import Harmonic, Sampled
from jaxmuscle.model._tasks import AbstractTask, Isometric, PrescribedForce, PrescribedMotion
from jaxmuscle.model._white_noise import BandLimitedNoise
from jaxmuscle.response._expected import Moments
from jaxmuscle.response._expected_moments import expected_moments
from jaxmuscle.simulation._trajectory import Trajectory
from jaxmuscle.spectra._measures import peaks
from jaxmuscle.spectra._settings import WINDOW, SpectrumSettings
from jaxmuscle.spectra._welch import Spectrum

LOW, HIGH = 0.391, 4.251  # Hz, the paper's maxima
LOW_BIN, HIGH_BIN = 1, 11
LINE = 0.5  # a bin is called a sine if at least half of its power is one
# Hz, and the share of the variance above it that is seen as fast noise
FAST, FAST_SHARE = 10.0, 0.1
HELD = 0.001  # m; Task 2 about x_z = 0, as in Task 1, has a displacement that cannot be normalised
SILENT = {f"noise_{channel}": 0.0 for channel in CHANNELS} | {"harmonic_amplitude": 0.0}
PAPER_NOISE = [0.0016, 0.0016, 0.0001, 0.0001]
SEEDS = 16

Times = Float[np.ndarray, " times"]
CONCLUSION = (
    "{first} all that is stated. A lacks: {A}. B lacks: {B}. In Task 1 there is no resonance at"
    " all: with x_z prescribed x_w obeys one equation of first order, so white noise gives P_w the"
    " density (a + bω² + cω⁴)/(ω² + p²), which has a minimum at most, never a local maximum; there"
    " the local maximum can only be the harmonic. C puts all power into bin 1 and leaves no local"
    " maximum of 1 %, and its force holds no sine. So A is the reading of the figures of Task 1,"
    " with the 4.25 Hz sine as the slow one beside noise that reaches 50 Hz; if the text of Figure"
    " 2 means the lower frequency, only B has that sine, and then the force is not that of Task 1."
)
FACTS = {
    "low": "maximum of proportional force power in bin 1 (0.391 Hz)",
    "high": "one local maximum of at least 1 % of it, in bin 11 (4.297 Hz)",
    "sine": "the slow part of the force is a sine, of the lower frequency",
    "fast": "fast noise in the force",
    "displacement": "displacement at constant force oscillates",
    "task": "the force is that of the paper's Task 1",
}


def fast_share(samples: Times, rate: float) -> float:
    """Share of a signal's variance above 10 Hz, up to half the sampling rate (nothing is
    filtered)."""
    power = np.abs(np.fft.rfft(samples - samples.mean())) ** 2
    return float(power[np.fft.rfftfreq(samples.size, 1 / rate) > FAST].sum() / power.sum())


def runs_of(task: AbstractTask, seeds: int = SEEDS, key: int = 0, **options: Any) -> Trajectory:
    """A task's output from so many seeds."""
    return ensemble(task, jax.random.key(key), seeds=seeds, control=False, **options)


def expected_of(task: AbstractTask) -> tuple[Moments, Spectrum]:
    """The moments of a task's output in the window, and its expected spectrum."""
    moments, _ = expected_moments(task, task.settings, WINDOW)
    power = np.asarray(moments.power)
    return moments, Spectrum(task.settings.frequency, power, task.settings, task.output_unit)


def within_bins(task: AbstractTask) -> float:
    """Share of the expected power, after the low-pass, from bin 1 to half the sampling rate that is
    in the compared bins."""
    settings = task.settings.replace(last_bin=task.settings.length // 2)
    power = np.asarray(expected_moments(task, settings, WINDOW)[0].power)
    return float(power[: task.settings.last_bin].sum() / power.sum())


class Reading(eqx.Module):
    """One explanation of the two maxima, built as a task and judged.

    **Fields:** `key`; `words`, what it says; `task`; `force`, one seed's output in the window [N];
    `spectrum`, the mean one of the force; `displacement`, the expected spectrum in Task 2;
    `sine_share`, of bin 1's power; `fast_share`, of the force's variance above 10 Hz; `facts`, the
    keys of `FACTS` with whether they hold.
    """

    key: str
    words: str
    task: AbstractTask
    force: Times
    spectrum: Spectrum
    displacement: Spectrum
    sine_share: float
    fast_share: float
    facts: dict[str, bool]

    @property
    def missing(self) -> tuple[str, ...]:
        """The facts that it does not give, in words."""
        return tuple(FACTS[key] for key, holds in self.facts.items() if not holds)


def in_task_2(task: AbstractTask, x_z: float = HELD) -> AbstractTask:
    """The same muscle in Task 2, constant forces from 5 s on.

    For Task 1 the P_w(t) that it needs, without noise and harmonic, to hold the insertion at `x_z`
    [m] against its load: so nothing else than noise and harmonic moves it in the window. For
    another task its own P_w without load.
    """
    if not isinstance(task, PrescribedMotion):
        return task.as_task(PrescribedForce, P_w=float(task["P_w"]))
    needed = runs_of(task.replace(x_z=x_z, **SILENT), 1)
    force = Sampled.through(needed.time, np.asarray(needed.output)[0])
    return task.as_task(PrescribedForce, P_w=force, F_ext=task.F_ext)


def resonant() -> AbstractTask:
    """Isometric, the paper's noise, a harmonic at 0.391 Hz, and masses and springs that resonate
    near 4.25 Hz."""
    muscle = Muscle(m_w=0.5, m_z=0.5)
    harmonic = Harmonic(amplitude=0.002, frequency=LOW)
    task = Isometric(P_w=3.5, muscle=muscle, harmonic=harmonic, noise=BandLimitedNoise(PAPER_NOISE))
    return task.replace(k_w=2.1e5, k_z=2.1e5, c_w=1.2, c_z=0.5)


def readings(preset: AbstractTask) -> tuple[Reading, ...]:
    """A, B (as it is and in Task 1), C (leakage of the mean, slow transient) about the preset of
    Figures 2 to 5."""
    isometric = "a harmonic at 0.391 Hz, a resonance near 4.25 Hz (isometric: two states)"
    leaking = "no slow part; the mean leaks into bin 1 (pwelch: Hamming, no detrend)"
    slow, pwelch = (
        "a transient slower than the window, mean removed",
        SpectrumSettings.named("pwelch"),
    )
    held = preset.replace(harmonic_frequency=LOW)
    return (
        _judge("A", "a harmonic at 4.25 Hz on slow relaxation", preset),
        _judge("B", isometric, resonant()),
        _judge("B1", "the same in Task 1, whose one state cannot resonate", held),
        # neither a mean that leaks nor a transient has an expected spectrum
        _judge("C1", leaking, preset.replace(c_z=5.0), pwelch),
        _judge("C2", slow, preset.replace(c_z=1000.0), preset.settings),
    )


def _judge(
    key: str, words: str, task: AbstractTask, simulated: SpectrumSettings | None = None
) -> Reading:
    """By the expected spectrum, or by the mean one of 16 seeds with these settings; the time series
    from one seed."""
    runs = runs_of(task)
    moments, spectrum = expected_of(task)
    if simulated is not None:
        moments, _ = expected_moments(task, simulated, WINDOW)
        mean = runs.spectrum(simulated).mean()
        spectrum = Spectrum(simulated.frequency, np.asarray(mean.power), simulated, mean.unit)
    sine, force = float(moments.line[0] / spectrum.power[0]), np.asarray(runs.between())[0]
    pulling, displacement = expected_of(in_task_2(task))
    found, fast = peaks(spectrum), fast_share(force, task.settings.rate)
    oscillates = peaks(displacement).local_maxima or pulling.line[0] / pulling.power[0] >= LINE
    facts = {
        "low": found.maximum.bin == LOW_BIN,
        "high": [peak.bin for peak in found.local_maxima] == [HIGH_BIN],
        "sine": sine >= LINE,
        "fast": fast >= FAST_SHARE,
        "displacement": bool(oscillates),
        "task": isinstance(task, PrescribedMotion),
    }
    return Reading(key, words, task, force, spectrum, displacement, sine, fast, facts)


def conclusion(found: tuple[Reading, ...]) -> str:
    """Which reading reproduces all that is stated, in a few sentences."""
    complete = " and ".join(r.key for r in found if not r.missing)
    first = f"Reading {complete} gives" if complete else "No reading gives"
    lacking = {r.key: "; ".join(r.missing) or "nothing" for r in found}
    return CONCLUSION.format(first=first, **lacking)
