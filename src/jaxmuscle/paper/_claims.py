"""What the papers state, as data: each statement with the numbers that jaxmuscle finds, how, and whether they agree."""

import json
import re
from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np

from jaxmuscle.response._scaling import relative_variation
from jaxmuscle.spectra._measures import peaks
from jaxmuscle.spectra._settings import WINDOW, SpectrumSettings

from ._numbers import LEVELS, Reproduction
from ._readings import HIGH, LINE, LOW

Verdict = Literal["agrees", "agrees within the grid", "does not agree", "cannot be checked"]
AGREES, GRID, DIFFERS, UNCHECKED = "agrees", "agrees within the grid", "does not agree", "cannot be checked"
SETTINGS = SpectrumSettings()
HALF_BIN = SETTINGS.resolution / 2
Numbers = tuple[float, ...]


class Claim(NamedTuple):
    """One statement: where it stands, what it says, our numbers and how they are shown, how they were obtained, the rule.

    `why` is shown unless the verdict is a plain "agrees"; `words` and `why` are formats of the numbers.
    """

    key: str
    source: str
    says: str
    numbers: Callable[[Reproduction], Numbers]
    words: str
    how: str
    rule: Callable[..., Verdict]
    why: str = "because our numbers are outside what is stated"


class Row(NamedTuple):
    """A claim, checked."""

    key: str
    source: str
    says: str
    ours: str
    numbers: Numbers
    how: str
    verdict: Verdict
    why: str


def check(found: Reproduction) -> tuple[Row, ...]:
    """Every claim with its numbers and its verdict."""
    return tuple(_row(claim, found) for claim in CLAIMS)


def _row(claim: Claim, found: Reproduction) -> Row:
    numbers = tuple(float(x) for x in claim.numbers(found))
    verdict = claim.rule(*numbers)
    why = "" if verdict == AGREES else claim.why.format(*numbers)
    ours = re.sub(r"(?<=\d)%", " %", claim.words.format(*numbers))
    return Row(claim.key, claim.source, claim.says, ours, numbers, claim.how, verdict, why)


def claims_json(rows: tuple[Row, ...]) -> str:
    """The table for programs."""
    return json.dumps([row._asdict() for row in rows], indent=1, ensure_ascii=False) + "\n"


def _if(condition: Callable[..., bool], otherwise: Verdict = DIFFERS) -> Callable[..., Verdict]:
    return lambda *numbers: AGREES if condition(*numbers) else otherwise


def _near(stated: float) -> Callable[..., Verdict]:
    """Within half a bin of the stated frequency, which is not on the grid."""
    return lambda *found: GRID if all(abs(f - stated) <= HALF_BIN for f in found) else DIFFERS


def _unchecked(*_: float) -> Verdict:
    return UNCHECKED


def _local(spectrum, stated: float) -> tuple[float, float]:
    """The local maximum nearest to a stated frequency: bin and interpolated frequency."""
    nearest = min(peaks(spectrum).local_maxima, key=lambda p: abs(p.frequency - stated), default=None)
    return (np.nan, np.nan) if nearest is None else (nearest.frequency, nearest.interpolated)


def _both_bins(stated: float) -> Callable[[Reproduction], Numbers]:
    below = np.floor(stated / SETTINGS.resolution) * SETTINGS.resolution
    return lambda _: (below, below + SETTINGS.resolution)


def _off_grid(stated: float) -> Claim:
    return Claim(
        f"grid-{stated:g}", "the grid", f"{stated:g} Hz is stated; bins are 0.390625 Hz apart", _both_bins(stated),
        "bins at {0:.3f} and {1:.3f} Hz", "arithmetic: 100 Hz / 256",
        lambda low, high: GRID if low < stated < high else DIFFERS,
        "not a bin: read by interpolation, or from a finer transform than 256 points",
    )  # fmt: skip


FIT, SCALE = "isometric task, fitted to a curve reconstructed from the text of [30]", "carried to ten levels, 5 to 95 % MVC"
TASK1, SEEDS32 = "preset zagrodny-slifkin, Task 1, expected spectrum", "32 seeds"
LAW, FIG = "the law of at_level with its steadiest level at 30 % (docs/scaling.md)", "the paper, Fig."
PEOPLE = "Figures 7, 8: simulated people, 10 % apart, Ornstein-Uhlenbeck noise (or your own recordings)"

CLAIMS: tuple[Claim, ...] = (
    Claim("levels", "[30]", "forces of 5 to 95 % MVC", lambda r: (r.levels.fractions[0], r.levels.fractions[-1]),
          "{0:.0%} to {1:.0%} MVC", f"{FIT} at 95 %, {SCALE} by at_level",
          _if(lambda low, high: low <= 0.05 and high >= 0.95)),
    Claim("window", "[30]", "10 s analysed, 5 s to 15 s", lambda r: (*WINDOW, len(r.slifkin.force.between()[0]) / 100),
          "{0:g} s to {1:g} s, {2:g} s", "by construction; the inputs rise from 0.5 s to 1.5 s",
          _if(lambda a, b, length: (a, b, length) == (5.0, 15.0, 10.0))),
    Claim("max-124", "[30]", "absolute power has its maximum near 1.24 Hz at every level",
          lambda r: (r.levels.maxima.min(), r.levels.maxima.max()), "{0:.3f} Hz (lowest) to {1:.3f} Hz (highest)",
          f"{FIT} at 95 %, harmonic at 1.24 Hz, {SCALE}", _near(1.24), "1.24 Hz is no bin; 1.172 and 1.563 Hz are; with "
          "the harmonic free the fit puts it at 1.57 Hz and the maximum into the higher of the two"),
    Claim("varies", "[30]", "proportional power varies slightly with the level", lambda r: (r.levels.shifted,),
          "at most {0:.0%} of the power in other bins than at 95 % MVC, from 15 % on", f"{FIT}, {SCALE}",
          _if(lambda share: 0.001 < share < 0.2), "the change is not slight"),
    Claim("max-7", "[30]", "an additional local maximum at 7 Hz at 35 % MVC", lambda r: _local(r.levels.at_35, 7.0),
          "{0:.3f} Hz (interpolated {1:.3f} Hz)", f"{FIT} at 35 %; the curve was made with it",
          lambda bin_, _: _near(7.0)(bin_), "7 Hz is not a bin; the nearest is 7.031 Hz"),
    Claim("max-7-only", "[30]", "the 7 Hz maximum is named for 35 % MVC alone", lambda r: _local(r.levels.at_35_moved, 7.0),
          "carried from 35 to 95 % MVC it is still at {0:.3f} Hz", f"{FIT} at 35 %, at_level to 95 %",
          lambda bin_, _: DIFFERS if abs(bin_ - 7) < HALF_BIN else AGREES, "because at_level changes all amplitudes by one "
          "factor: a rhythm that comes and goes with the level has to be fitted at each level"),
    Claim("largest", "[30]", "variability is largest at 95 % MVC", lambda r: (LEVELS[np.argmax(r.levels.variation)],
          r.levels.variation.max(), r.levels.variation[0]), "largest at {0:.0%}: {1:.1%}; at 5 %: {2:.1%}", LAW,
          _if(lambda level, *_: level == 0.95)),
    Claim("smallest", "[30]", "variability is smallest at 35 % MVC", lambda r: (LEVELS[np.argmin(r.levels.variation)],
          r.levels.variation.min()), "smallest of the ten levels at {0:.0%}: {1:.2%}", LAW,
          lambda level, _: GRID if level == 0.35 else DIFFERS, "the law's own minimum is at 30 % (Taylor et al. 2003); "
          "of the levels in steps of 10 % the smallest is 35 %, by construction"),
    Claim("comparison", "[30]", "white Gaussian noise and sines as comparison signals", lambda r: (max(r.regularity.sines),
          r.regularity.force, r.regularity.white), "approximate entropy: sines up to {0:.2f}, force {1:.2f}, noise {2:.2f}",
          "10 s at 100 Hz low-passed at 30 Hz, m = 2, r = 0.2 SD; sines of 1.24, 4.251 and 7 Hz",
          _if(lambda sine, force, white: sine < force < white), "the force does not lie between them"),
    Claim("entropy", "[30]", "approximate entropy of force is reported", lambda r: (r.regularity.force,), "{0:.3f}",
          f"{TASK1.split(',')[0]}, Task 1, one seed", _unchecked, "its values are not known here: only text is at hand"),
    Claim("low", f"{FIG} 3, 4", "force spectrum: maximum at 0.391 Hz",
          lambda r: (peaks(r.slifkin.spectrum).maximum.frequency,), "{0:.3f} Hz", TASK1,
          _if(lambda f: abs(f - LOW) < 0.001), "found in another bin"),
    Claim("high", f"{FIG} 3, 4", "force spectrum: local maximum at 4.251 Hz", lambda r: (*_local(r.slifkin.spectrum, HIGH),
          len(peaks(r.slifkin.spectrum).local_maxima), r.slifkin.both),
          "{0:.3f} Hz (interpolated {1:.3f} Hz), {2:.0f} local maximum; both maxima in {3:.0%} of single seeds",
          f"{TASK1}; single seeds: {SEEDS32}", lambda f, _, count, __: _near(HIGH)(f) if count == 1 else DIFFERS,
          "4.251 Hz is not a bin; the nearest is 4.297 Hz"),
    Claim("series", f"{FIG} 2", "force: a slow sine and fast noise", lambda r: (r.slifkin.sine[0], r.slifkin.sine[10],
          r.slifkin.fast), "sine: {0:.0%} of the power at 0.391 Hz, {1:.0%} at 4.297 Hz; noise above 10 Hz: {2:.0%}",
          f"{TASK1}; noise from {SEEDS32}", _if(lambda low, _, fast: low >= LINE and fast > 0.1), "because the slow part of "
          "this preset is relaxation, not a sine; its sine is the 4.25 Hz one (see the three readings)"),
    Claim("displacement", f"{FIG} 5", "displacement at constant force oscillates",
          lambda r: (peaks(r.slifkin.moved).maximum.frequency, _local(r.slifkin.moved, HIGH)[0],
                     r.slifkin.displacement_variation),
          "maxima at {0:.3f} and {1:.3f} Hz, coefficient of variation {2:.2%}",
          "the same muscle in Task 2, P_w as Task 1 needs it to hold 1 mm", _if(lambda low, high, _: low < 1 < 4 < high < 5),
          "no oscillation found"),
    Claim("amplitudes", "the paper", "noise 0.16 % of stiffness, 0.01 % of damping",
          lambda r: tuple(np.asarray(r.slifkin.force.task.noise.amplitude)), "{0:.2%} and {1:.2%}; {2:.2%} and {3:.2%}",
          "both presets, by construction", _if(lambda *a: np.allclose(a, (0.0016, 0.0016, 0.0001, 0.0001)))),
    Claim("variation", "the paper", "these amplitudes give a coefficient of variation near 0.1 to 0.2 %",
          lambda r: (r.slifkin.variation, r.hamilton.variation, r.readings[1].force.std() / r.readings[1].force.mean()),
          "low-passed force in Task 1: {0:.3%} and {1:.3%}; isometric (reading B): {2:.2%}",
          "expected, presets zagrodny-slifkin and zagrodny-hamilton; one run of reading B",
          _if(lambda *v: all(0.001 <= x <= 0.0025 for x in v)), "because most of P_w in Task 1 holds against spring, load, "
          "steadily; isometric force is in the range (measured while designing jaxmuscle, the paper does not state it)"),
    Claim("people", "people", "people show 1.3 to 5 %", lambda r: (r.levels.variation.min(), r.levels.variation.max()),
          "{0:.1%} to {1:.1%} at 5 to 95 % MVC", f"{LAW}, amplitudes set to 1.7 % at 30 % MVC",
          _if(lambda low, high: low >= 0.013 and high <= 0.05), "outside the range"),
    Claim("smaller", "the paper, [12]", "tuned to [12]: a smaller harmonic",
          lambda r: tuple(float(t.force.task["harmonic_amplitude"]) for t in (r.hamilton, r.slifkin)),
          "{0:.2e} of K_0 against {1:.2e}", "preset zagrodny-hamilton; a bound of its fit kept it below",
          _if(lambda own, other: own < other)),
    Claim("smoother", "the paper, [12]", "tuned to [12]: smoother", lambda r: (r.hamilton.fast, r.slifkin.fast),
          "{0:.1%} of the variance above 10 Hz against {1:.0%}", f"{SEEDS32} of both presets, unfiltered",
          _if(lambda own, other: own < other / 2)),
    Claim("changing", f"{FIG} 6a", "tuned to [12]: amplitude changing in time", lambda r: r.hamilton.swing,
          "harmonic in the force {0:.3%} of the mean in the first quarter of the window, {1:.3%} in the last",
          f"preset zagrodny-hamilton, mean of {SEEDS32}; its envelope falls from 1 to 0.35, our choice",
          _if(lambda first, last: abs(first / last - 1) > 0.2)),
    Claim("dominated", f"{FIG} 6b", "displacement dominated by 0.391 Hz",
          lambda r: (peaks(r.hamilton.moved).maximum.frequency, peaks(r.hamilton.moved).maximum.power,
                     len(peaks(r.hamilton.moved).local_maxima)),
          "maximum at {0:.3f} Hz with {1:.0%} of the power, {2:.0f} local maxima", "preset zagrodny-hamilton in Task 2",
          _if(lambda f, share, count: abs(f - LOW) < 0.001 and share > 0.5 and count == 0)),
    Claim("recordings", f"{FIG} 7, 8", "3 people, 60 s, marker at 120 Hz", lambda r: (len(r.experiment.recordings),
          min(x.duration for x in r.experiment.recordings), r.experiment.recordings[0].rate),
          "{0:.0f} recordings of {1:g} s at {2:g} Hz", PEOPLE,
          _if(lambda n, length, rate: (n, round(length, 2), rate) == (3, 60.0, 120.0)), "these are your recordings"),
    Claim("fft-grid", f"{FIG} 7", "FFT with a resolution of 1/60 Hz",
          lambda r: (np.diff(r.experiment.fft[0].frequency)[0],), "{0:.4f} Hz", "the whole recording as one segment",
          _if(lambda df: abs(df * 60 - 1) < 1e-3), "the recordings are not 60 s long"),
    Claim("welch-grid", f"{FIG} 7", "Welch with a resolution of 0.39 Hz, at 120 Hz",
          lambda r: (np.diff(r.experiment.welch[0].frequency)[0], 120 / 256, 120 / 307),
          "{0:.4f} Hz after resampling to 100 Hz", "256 points, half overlap",
          lambda df, *_: GRID if abs(df - 0.39) < 0.001 else DIFFERS,
          "at 120 Hz itself 256 points give {1:.3f} Hz; 0.39 Hz would take 307 points"),
    Claim("rho-welch", f"{FIG} 8", "Spearman correlation between people above 0.98 (Welch)",
          lambda r: r.experiment.rho_welch, "{0:.4f}, {1:.4f}, {2:.4f}", f"30 bins; {PEOPLE}",
          _if(lambda *rho: min(rho) > 0.98), "because these recordings' spectra differ in shape, or hold few segments"),
    Claim("rho-fft", f"{FIG} 8", "Spearman correlation between people at least 0.74 (FFT)",
          lambda r: r.experiment.rho_fft, "{0:.3f}, {1:.3f}, {2:.3f}", f"0.39 to 11.72 Hz; {PEOPLE}",
          _if(lambda *rho: min(rho) >= 0.74), "because a bin of the FFT has two degrees of freedom: its log power scatters "
          "by 1.28 whatever the length of the recording, and only a spectrum that falls steeply keeps its ranks"),
    Claim("rho-tuned", f"{FIG} 8", "the same two correlations", lambda r: (min(r.same_muscle.rho_welch),
          max(r.same_muscle.rho_welch), min(r.same_muscle.rho_fft), max(r.same_muscle.rho_fft)),
          "Welch {0:.2f} to {1:.2f}, FFT {2:.2f} to {3:.2f}", "three runs of one muscle, zagrodny-slifkin in Task 2",
          _if(lambda welch, _, fft, __: welch > 0.98 and fft >= 0.74), "because stationary white noise on this muscle gives "
          "a flat spectrum above 5 Hz, whose bins differ by chance alone: high correlations take power that falls steeply"),
    _off_grid(1.24), _off_grid(HIGH), _off_grid(7.0),
    Claim("taylor", "Taylor et al. 2003", "smallest coefficient of variation 1.7 % near 30 % MVC (first dorsal interosseus)",
          lambda r: (min(np.linspace(0.05, 0.95, 91), key=lambda x: float(relative_variation(float(x)))),
                     float(np.interp(0.3, r.levels.fractions, r.levels.variation))),
          "smallest at {0:.0%}: {1:.1%}", f"{LAW}; both numbers put in", _if(lambda level, v: abs(level - 0.3) < 0.01 and
          abs(v - 0.017) < 0.001)),
    Claim("readings", "the paper", "0.391 and 4.251 Hz in the force, a slow sine, fast noise, an oscillating displacement",
          lambda r: tuple(sum(x.facts.values()) for x in r.readings),
          "of six facts reading A gives {0:.0f}, B {1:.0f} (in Task 1 {2:.0f}), C {3:.0f} and {4:.0f}",
          "three readings, built as tasks; see below", _if(lambda *n: max(n) == 6), "because none of the three gives all: "
          "in Task 1 only a harmonic makes a local maximum, and then the slow part is no sine"),
)  # fmt: skip
