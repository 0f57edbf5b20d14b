"""What the papers state (claims.toml), with the numbers that jaxmuscle finds, and whether they
agree."""

import json
import tomllib
from collections.abc import Callable

import numpy as np

from jaxmuscle._common.bundled import bundled_text
from jaxmuscle._common.files import nulled
from jaxmuscle.response._scaling import relative_variation
from jaxmuscle.spectra._measures import peaks
from jaxmuscle.spectra._settings import WINDOW, SpectrumSettings

from ._levels import LEVELS
from ._numbers import MOVED, Reproduction
from ._readings import HIGH, LINE, LOW
from ._verdicts import (
    DIFFERS,
    GRID,
    Claim,
    Numbers,
    Row,
    Verdict,
    check_claim,
    holds,
    near,
    unchecked,
)

SETTINGS = SpectrumSettings()
HALF_BIN = SETTINGS.resolution / 2
MAXIMUM_30, LOCAL_30 = 1.24, 7.0  # Hz, the maxima that [30] states
SLIGHT = 0.2  # of the power in other bins
WITHIN = 0.95  # of the power is "within" a band
STEADY, UNSTEADY = 0.013, 0.05  # coefficient of variation that people show


def check(found: Reproduction) -> tuple[Row, ...]:
    """Every claim with its numbers and its verdict."""
    return tuple(check_claim(claim, found) for claim in CLAIMS)


def claims_json(rows: tuple[Row, ...]) -> str:
    """The table for programs."""
    table = nulled([row._asdict() for row in rows])
    return json.dumps(table, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def _local(spectrum, stated: float) -> tuple[float, float]:
    """The local maximum nearest to a stated frequency: bin and interpolated frequency."""
    nearest = min(
        peaks(spectrum).local_maxima, key=lambda p: abs(p.frequency - stated), default=None
    )
    return (np.nan, np.nan) if nearest is None else (nearest.frequency, nearest.interpolated)


def _with_factors(*variations: float) -> Numbers:
    """Coefficients of variation, and the least and the most that would bring them to the steadiest
    of people."""
    return (*variations, STEADY / max(variations), STEADY / min(variations))


def _both_bins(stated: float) -> Callable[[Reproduction], Numbers]:
    below = np.floor(stated / SETTINGS.resolution) * SETTINGS.resolution
    return lambda _: (below, below + SETTINGS.resolution)


def _off_grid(stated: float) -> Callable[..., Verdict]:
    """The rule of a stated frequency between two bins."""
    return lambda low, high: GRID if low < stated < high else DIFFERS


# Of each claim of claims.toml: our numbers, and the rule that judges them.
FOUND: dict[str, tuple[Callable[[Reproduction], Numbers], Callable[..., Verdict]]] = {
    "levels": (
        lambda r: (r.levels.fractions[0], r.levels.fractions[-1]),
        holds(lambda low, high: low <= 0.05 and high >= 0.95),
    ),
    "window": (
        lambda r: (*WINDOW, len(r.slifkin.force.between()[0]) / 100),
        holds(lambda a, b, length: (a, b, length) == (5.0, 15.0, 10.0)),
    ),
    "max-124": (
        lambda r: (r.levels.maxima.min(), r.levels.maxima.max(), r.levels.line),
        lambda low, high, _: near(MAXIMUM_30, HALF_BIN)(low, high),
    ),
    "varies": (
        lambda r: (
            r.levels.shifted.max(),
            LEVELS[np.argmax(r.levels.shifted)],
            r.levels.shifted[1:].max(),
        ),
        holds(lambda share, *_: 0.001 < share < SLIGHT),
    ),
    "inverted-u": (
        lambda r: (
            LEVELS[np.argmax(r.levels.entropy.mean(1))],
            *r.levels.entropy.mean(1)[[0, 3, -1]],
            r.levels.entropy_rise,
            LEVELS[np.argmax(r.levels.centroid)],
            *r.levels.centroid[[0, 3, -1]],
        ),
        holds(
            lambda level, five, _, most, rise, fastest, *__: (
                0.05 < level < 0.95 and rise > 2 and 0.05 < fastest < 0.95
            )
        ),
    ),
    "max-7": (
        lambda r: _local(r.levels.at_35, LOCAL_30),
        lambda bin_, _: near(LOCAL_30, HALF_BIN)(bin_),
    ),
    "max-7-only": (
        lambda r: _local(r.levels.at_35_moved, LOCAL_30),
        holds(lambda bin_, _: not abs(bin_ - LOCAL_30) < HALF_BIN),
    ),
    "largest": (
        lambda r: (
            LEVELS[np.argmax(r.levels.variation)],
            r.levels.variation.max(),
            r.levels.variation[0],
        ),
        holds(lambda level, *_: level == 0.95),
    ),
    "smallest": (
        lambda r: (LEVELS[np.argmin(r.levels.variation)], r.levels.variation.min()),
        lambda level, _: GRID if level == 0.35 else DIFFERS,
    ),
    "comparison": (
        lambda r: (max(r.regularity.sines), r.regularity.force, r.regularity.white),
        holds(lambda sine, force, white: sine < force < white),
    ),
    "entropy": (
        lambda r: (r.regularity.force,),
        unchecked,
    ),
    "low": (
        lambda r: (peaks(r.slifkin.spectrum).maximum.frequency,),
        holds(lambda f: abs(f - LOW) < 0.001),
    ),
    "high": (
        lambda r: (
            *_local(r.slifkin.spectrum, HIGH),
            len(peaks(r.slifkin.spectrum).local_maxima),
            r.slifkin.both,
        ),
        lambda f, _, count, __: near(HIGH, HALF_BIN)(f) if count == 1 else DIFFERS,
    ),
    "align": (
        lambda _: (
            (MAXIMUM_30 - LOW) / SETTINGS.resolution,
            (LOCAL_30 - HIGH) / SETTINGS.resolution,
        ),
        holds(lambda *bins: all(abs(x) <= 1 for x in bins)),
    ),
    "concentric": (
        lambda r: (
            1000 * MOVED,
            r.concentric.mean,
            r.concentric.low,
            r.concentric.high,
            r.concentric.error,
        ),
        unchecked,
    ),
    "series": (
        lambda r: (r.slifkin.sine[0], r.slifkin.sine[10], r.slifkin.fast),
        holds(lambda low, _, fast: low >= LINE and fast > 0.1),
    ),
    "energy": (
        lambda r: (r.slifkin.within, r.hamilton.within, r.levels.within),
        holds(lambda *shares: min(shares) >= WITHIN),
    ),
    "displacement": (
        lambda r: (
            peaks(r.slifkin.moved).maximum.frequency,
            _local(r.slifkin.moved, HIGH)[0],
            r.slifkin.displacement_variation,
        ),
        holds(lambda low, high, _: low < 1 < 4 < high < 5),
    ),
    "amplitudes": (
        lambda r: tuple(np.asarray(r.slifkin.force.task.noise.amplitude)),
        holds(lambda *a: np.allclose(a, (0.0016, 0.0016, 0.0001, 0.0001))),
    ),
    "variation": (
        lambda r: _with_factors(
            r.slifkin.variation,
            r.hamilton.variation,
            r.readings[1].force.std() / r.readings[1].force.mean(),
        ),
        holds(lambda *v: all(STEADY <= x <= UNSTEADY for x in v[:3])),
    ),
    "people": (
        lambda r: (r.levels.variation.min(), r.levels.variation.max()),
        holds(lambda low, high: low >= STEADY and high <= UNSTEADY),
    ),
    "smaller": (
        lambda r: tuple(float(t.force.task["harmonic_amplitude"]) for t in (r.hamilton, r.slifkin)),
        holds(lambda own, other: own < other),
    ),
    "smoother": (
        lambda r: (r.hamilton.fast, r.slifkin.fast),
        holds(lambda own, other: own < other / 2),
    ),
    "changing": (
        lambda r: r.hamilton.swing,
        holds(lambda first, last: abs(first / last - 1) > 0.2),
    ),
    "dominated": (
        lambda r: (
            peaks(r.hamilton.moved).maximum.frequency,
            peaks(r.hamilton.moved).maximum.power,
        ),
        holds(lambda f, share: abs(f - LOW) < 0.001 and share > 0.5),
    ),
    "higher": (
        lambda r: (
            float(r.hamilton.moved.proportional[r.hamilton.moved.frequency > 1].sum()),
            len(peaks(r.hamilton.moved).local_maxima),
        ),
        unchecked,
    ),
    "recordings": (
        lambda r: (
            len(r.experiment.recordings),
            min(x.duration for x in r.experiment.recordings),
            r.experiment.recordings[0].rate,
        ),
        holds(lambda n, length, rate: (n, round(length, 2), rate) == (3, 60.0, 120.0)),
    ),
    "fft-grid": (
        lambda r: (np.diff(r.experiment.fft[0].frequency)[0],),
        holds(lambda df: abs(df * 60 - 1) < 1e-3),
    ),
    "welch-grid": (
        lambda _: (120 / 256, 120 / 307, SETTINGS.resolution),
        holds(lambda df, *_: abs(df - 0.39) < 0.005),
    ),
    "rho-welch": (
        lambda r: r.experiment.rho_welch,
        holds(lambda *rho: min(rho) > 0.98),
    ),
    "rho-fft": (
        lambda r: r.experiment.rho_fft,
        holds(lambda *rho: min(rho) >= 0.74),
    ),
    "rho-tuned": (
        lambda r: (
            min(r.same_muscle.rho_welch),
            max(r.same_muscle.rho_welch),
            min(r.same_muscle.rho_fft),
            max(r.same_muscle.rho_fft),
        ),
        holds(lambda welch, _, fft, __: welch > 0.98 and fft >= 0.74),
    ),
    "grid-1.24": (
        _both_bins(MAXIMUM_30),
        _off_grid(MAXIMUM_30),
    ),
    "grid-4.251": (
        _both_bins(HIGH),
        _off_grid(HIGH),
    ),
    "grid-7": (
        _both_bins(LOCAL_30),
        _off_grid(LOCAL_30),
    ),
    "taylor": (
        lambda r: (
            min(np.linspace(0.05, 0.95, 91), key=lambda x: float(relative_variation(float(x)))),
            float(np.interp(0.3, r.levels.fractions, r.levels.variation)),
        ),
        holds(lambda level, v: abs(level - 0.3) < 0.01 and abs(v - 0.017) < 0.001),
    ),
    "readings": (
        lambda r: tuple(sum(x.facts.values()) for x in r.readings),
        holds(lambda *n: max(n) == 6),
    ),
}

TEXTS = tomllib.loads(bundled_text("claims", "paper"))
CLAIMS = tuple(
    Claim(key, numbers=FOUND[key][0], rule=FOUND[key][1], **text) for key, text in TEXTS.items()
)
