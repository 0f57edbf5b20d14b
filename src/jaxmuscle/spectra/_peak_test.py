"""Does a spectrum have a peak in a band? A test against smooth spectra."""

import functools
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxmuscle._common.arguments import require

from ._bin_law import draw_powers, log_power_moments, welch_law
from ._settings import SpectrumSettings

DEGREE = 3  # of the polynomial in ln f that a smooth spectrum is, in the logarithm
WIDTHS = (0.8, 1.2, 1.8, 2.7)  # Hz at half height: from a line, seen through a taper, to a hill
DRAWS = 1999  # of smooth spectra: p is at least 1/2000
MOST = 4  # peaks that are looked for
# A hill that the polynomial can follow as well leaves little of itself: then nothing is seen there.
LEFT = 0.05
FINE = 4  # centres in a bin
TURNS = 20  # by which the centre of a peak has come to rest


Bins = Float[np.ndarray, " bins"]
Terms = Float[np.ndarray, "bins terms"]


class Peak(NamedTuple):
    """A bell that stands out of a smooth spectrum.

    Its `frequency` [Hz], the centre of the power above the smooth spectrum, and that `power`, the
    density summed over the bell [unit² of the density times Hz]; the full `width` of the bell at
    half its height in the logarithm [Hz]; `p`, how often a smooth spectrum shows one as clear.
    """

    frequency: float
    power: float
    width: float
    p: float


class PeakTest(NamedTuple):
    """What `find_peaks` found in a spectrum.

    `p`, how often a smooth spectrum shows a peak as clear as the clearest one in the band; the
    `peaks` with p up to the level, the clearest first; `detectable`, the power of a peak in the
    middle of the band, 1.8 Hz wide, that nine of ten such spectra would show.
    """

    p: float
    peaks: tuple[Peak, ...]
    detectable: float


class _Family(NamedTuple):
    """What is the same for all spectra of the same bins, segments and band.

    `whiten` makes the errors of log powers independent, of unit variance; `bias`, of the log power;
    columns of `smooth`, the polynomials; of `bells`, unit bells of `centre` and `width`; `null`,
    the largest statistic of smooth spectra, sorted.
    """

    frequency: Bins
    bins: Int[np.ndarray, " bins"]
    whiten: Float[np.ndarray, "bins bins"]
    bias: Bins
    smooth: Terms
    bells: Float[np.ndarray, "bins bells"]
    centre: Float[np.ndarray, " bells"]
    width: Float[np.ndarray, " bells"]
    null: Float[np.ndarray, " draws"]


def bins_around(band: tuple[float, float], settings: SpectrumSettings) -> tuple[int, int]:
    """First and last bin that say what is smooth about a band: from half its lower end to 1.8 times
    its upper end, below the low-pass of the settings."""
    cut = np.inf if settings.filter_cutoff is None else 0.8 * settings.filter_cutoff
    top = min(1.8 * band[1], cut, 0.45 * settings.rate)
    first = max(1, int(np.ceil(0.5 * band[0] / settings.resolution)))
    return first, int(top / settings.resolution)


def bins_in(band: tuple[float, float], settings: SpectrumSettings) -> Int[np.ndarray, " bins"]:
    """The bins of the settings about a band, by their numbers; none where they are too few for the
    test.

    Where the settings end before the bins that are wanted above the band, as many more are taken
    below it, in octaves: a hill is seen against what is smooth on both sides.
    """
    first, last = bins_around(band, settings)
    first = max(1, int(np.ceil(first * min(1.0, settings.last_bin / last))))
    bins = np.arange(max(first, settings.first_bin), min(last, settings.last_bin) + 1)
    # The polynomial, a bell, and as many bins again for the scatter.
    enough = len(bins) >= 2 * (DEGREE + 2) and bins[-1] * settings.resolution >= (
        band[0] + settings.resolution
    )
    return bins if enough and 0 < band[0] < band[1] else bins[:0]


def find_peaks(
    power: Bins,
    settings: SpectrumSettings,
    segments: tuple[int, ...],
    band: tuple[float, float],
    level: float = 0.01,
) -> PeakTest:
    """Peaks of a Welch spectrum in a band, each tested against smooth spectra.

        settings = jm.SpectrumSettings()
        power = 1 / settings.frequency**2 + 0.05 * np.exp(-((settings.frequency - 9) ** 2))
        jm.spectra.find_peaks(power, settings, segments=(20, 20), band=(6.0, 12.0)).peaks

    In the logarithm a smooth spectrum is a cubic in ln f, and a peak adds a bell:

        ln P_k - bias_k = Σ_j β_j (ln f_k)^j + h exp(-4 ln 2 (f_k - f_0)² / w²) + ε_k

    ε has the law of the bins (`welch_law`: segments, overlap, taper). For each f_0 in the band and
    each of four widths w generalised least squares give h, its standard error for a known law and,
    by what is left, the factor s by which the bins scatter more than the law says (a level that
    changes from segment to segment does that). The statistic is the largest h / (s · error). Its
    law is known by `DRAWS` smooth spectra that are drawn by the law of the bins: it does not depend
    on β, since all is linear in the logarithm. A peak that is found counts as known when the next
    one is looked for, further away than its width.

    **Arguments:** `power` (bins,) in any unit, on the bins of the settings; `segments` of each
    averaged trial; `band` (low, high) [Hz]; `level` of the test of each peak.

    **Raises:** `ValueError` for a band that is not covered by bins, and for power that is not
    positive.
    """
    require(bool(np.all(np.asarray(power) > 0)), "power", power, "give positive power")
    family, logged = _log_powers(power, settings, segments, band)
    whole, known, found, ps = family, family.smooth, list[Peak](), list[float]()
    for _ in range(MOST):
        statistic, place, _ = _find_clearest(family, known, logged[None])
        at, width = family.centre[place[0]], family.width[place[0]]
        beyond = len(family.null) - np.searchsorted(family.null, statistic[0])
        ps.append((1 + int(beyond)) / (1 + len(family.null)))
        # A hill is no exact bell: what is left of its flanks is no peak of its own.
        apart = np.abs(family.centre - at) > np.maximum(width, family.width)
        if ps[-1] > level:
            break
        found.append(Peak(*_measure(family, known, logged, place[0]), float(width), ps[-1]))
        known = np.column_stack([known, family.bells[:, place[0]]])
        if not np.any(apart):
            break
        family = family._replace(
            bells=family.bells[:, apart], centre=family.centre[apart], width=family.width[apart]
        )
    threshold = float(np.quantile(family.null, 1 - level))
    return PeakTest(ps[0], tuple(found), _detectable_power(whole, known, logged, threshold))


def measure_peak(
    power: Any, settings: SpectrumSettings, segments: tuple[int, ...], band: tuple[float, float]
) -> tuple[float, float]:
    """Frequency [Hz] and power of the clearest peak of the band, whether or not it is
    significant."""
    family, logged = _log_powers(power, settings, segments, band)
    _, place, _ = _find_clearest(family, family.smooth, logged[None])
    return _measure(family, family.smooth, logged, place[0])


def _log_powers(
    power: Any, settings: SpectrumSettings, segments: tuple[int, ...], band: tuple[float, float]
) -> tuple[_Family, Bins]:
    """The log powers of the bins about a band, without their bias, and what is known of them."""
    family = _build_family(settings, tuple(segments), (float(band[0]), float(band[1])))
    at = family.bins - settings.first_bin
    return family, np.log(np.asarray(power, float)[at]) - family.bias


@functools.lru_cache(maxsize=64)
def _build_family(
    settings: SpectrumSettings, segments: tuple[int, ...], band: tuple[float, float]
) -> _Family:
    bins = bins_in(band, settings)
    remedy = f"the bins reach from {settings.frequency[0]:.3g} to {settings.frequency[-1]:.3g} Hz"
    require(len(bins) > 0, "band", band, remedy)
    frequency = bins * settings.resolution
    law = welch_law(settings, bins, segments)
    bias, variance = log_power_moments(law.degrees)
    sd = np.sqrt(variance)
    whiten = np.linalg.inv(np.linalg.cholesky(sd[:, None] * law.correlation * sd))
    x = np.log(frequency)
    smooth = np.polynomial.legendre.legvander(2 * (x - x[0]) / (x[-1] - x[0]) - 1, DEGREE)
    top = min(band[1], frequency[-1])
    centres = np.arange(band[0], top + 1e-9, settings.resolution / FINE)
    centre, width = np.repeat(centres, len(WIDTHS)), np.tile(WIDTHS, len(centres))
    bells = np.exp(-4 * np.log(2) * ((frequency[:, None] - centre) / width) ** 2)
    family = _Family(frequency, bins, whiten, bias, smooth, bells, centre, width, np.empty(0))
    drawn = draw_powers(law, DRAWS, np.random.default_rng(0))
    statistic, _, _ = _find_clearest(family, smooth, np.log(drawn) - bias)
    return family._replace(null=np.sort(statistic))


def _find_clearest(
    family: _Family, known: Terms, logged: Float[np.ndarray, "rows bins"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of every row the largest statistic and the place of its bell; and what the known terms
    leave of every bell."""
    basis, _ = np.linalg.qr(family.whiten @ known)
    bells = family.whiten @ family.bells
    whole = np.linalg.norm(bells, axis=0)
    bells -= basis @ (basis.T @ bells)
    left = np.linalg.norm(bells, axis=0)
    seen = left > LEFT * whole
    rest = logged @ family.whiten.T
    rest -= (rest @ basis) @ basis.T
    score = rest @ np.divide(bells, left, out=np.zeros_like(bells), where=seen)
    degrees = len(family.frequency) - known.shape[1] - 1
    squares = np.sum(rest**2, axis=1, keepdims=True) - score**2
    statistic = np.where(seen, score / np.sqrt(np.maximum(squares, 1e-12) / degrees), -np.inf)
    place = np.argmax(statistic, axis=1)
    return statistic[np.arange(len(place)), place], place, np.where(seen, left, 0.0)


def _fit_terms(family: _Family, columns: Terms, logged: Bins) -> Float[np.ndarray, " terms"]:
    return np.linalg.lstsq(family.whiten @ columns, family.whiten @ logged, rcond=None)[0]


def _measure(
    family: _Family,
    known: Terms,
    logged: Bins,
    place: int | np.integer,
) -> tuple[float, float]:
    """Where the power above the smooth spectrum has its centre, within the bell about that centre;
    and that power.

    The bell itself lies where the power is largest *relative* to the smooth spectrum, which on a
    falling spectrum is too high a frequency.
    """
    columns = np.column_stack([known, family.bells[:, place]])
    terms = _fit_terms(family, columns, logged)[: known.shape[1]]
    excess = np.exp(logged + family.bias) - np.exp(known @ terms)
    f, at, width = family.frequency, float(family.centre[place]), float(family.width[place])
    for _ in range(TURNS):
        weight = np.maximum(excess, 0.0) * np.exp(-4 * np.log(2) * ((f - at) / width) ** 2)
        at = float(np.sum(weight * f) / np.sum(weight)) if np.any(weight > 0) else at
    # A bell has 98 % of its area within its full width to either side.
    power = np.sum(excess[np.abs(f - at) <= width]) * (f[1] - f[0])
    return at, max(float(power), 0.0)


def _detectable_power(
    family: _Family,
    known: Terms,
    logged: Bins,
    threshold: float,
) -> float:
    """The power that a bell in the middle of the band, 1.8 Hz wide, adds to the smooth spectrum,
    where it is as high as nine of ten spectra show.

    A statistic scatters about h / error by about 1: nine of ten lie above h / error - 1.28.
    """
    middle = 0.5 * (family.centre[0] + family.centre[-1])
    place = int(np.argmin(np.abs(family.centre - middle) + 10 * np.abs(family.width - WIDTHS[2])))
    _, _, left = _find_clearest(family, family.smooth, logged[None])
    terms = _fit_terms(family, known, logged)
    rest = family.whiten @ (logged - known @ terms)
    scatter = np.sqrt(np.sum(rest**2) / (len(rest) - known.shape[1]))
    height = (threshold + 1.28) * scatter / max(left[place], 1e-12)
    smooth = np.exp(family.smooth @ terms[: family.smooth.shape[1]])
    added = np.sum(smooth * np.expm1(height * family.bells[:, place]))
    return float(added * (family.frequency[1] - family.frequency[0]))
