"""How steady a held force is: a report of one recording or of several trials, without any model."""

import math
from collections.abc import Iterable, Iterator
from os import PathLike
from typing import TYPE_CHECKING, Any

import equinox as eqx
import numpy as np
import scipy

from jaxmuscle import plot
from jaxmuscle._common.arguments import require
from jaxmuscle._common.cards import Printed, Result
from jaxmuscle._common.environment import versions
from jaxmuscle._common.files import nulled, write_json
from jaxmuscle._common.names import name_of_all
from jaxmuscle._common.tables import frame
from jaxmuscle._common.text import choices, folded
from jaxmuscle.spectra._bin_law import ENOUGH
from jaxmuscle.spectra._fluctuations import variance_spectrum

from ._measure import Measure, likelier_error
from ._measured import (
    FLOATING,
    LEVEL_NAME,
    MEAN,
    MOTION_BAND,
    RANGES,
    RECORDED,
    SEEN,
    SLOWEST,
    VARIATION,
    measure_signals,
    searched_band,
)
from ._measured_text import (
    BY_ITSELF,
    WITHIN,
    heading,
    measured_lines,
    range_words,
    read_line,
    scatter_of,
)
from ._recording import FOUND, SEGMENTS, SHORTEST, UNRAMPED, Recording, notices_of, unlike
from ._trials import Trials

if TYPE_CHECKING:
    import pandas
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

ALL = "all"
ALIKE = 1.2  # longest trial over shortest
NEXT, WANDERS = 12, 0.05  # ordinates; level of the test whether the slowest of them stand out


class Steadiness(Printed, Result, eqx.Module):
    """What `steadiness` found; `print` shows it as a table, `found["sample_entropy"]` is one
    `Measure`.

    `measures` of all trials together, by name; `trials`, the measures of each by its name, and
    their `durations` [s]; the `unit` and `quantity` of the signal; the `band` [Hz] in which a
    tremor was looked for; the Welch `spectrum`, as frequency [Hz], power of every trial and of all
    [unit²/Hz]; `notices`, sentences on what was done and what to mind.
    """

    measures: dict[str, Measure]
    trials: dict[str, dict[str, Measure]]
    durations: dict[str, float]
    unit: str
    quantity: str | None
    band: tuple[float, float]
    spectrum: tuple[np.ndarray, np.ndarray, np.ndarray]
    notices: tuple[str, ...]

    def __getitem__(self, name: str) -> Measure:
        require(name in self.measures, "name", name, choices(name, self.measures))
        return self.measures[name]

    def to_dict(self) -> dict[str, Any]:
        """The same for JSON, with `None` for what does not exist."""
        each = {
            name: {"duration_s": self.durations[name], "measures": _plain(own)}
            for name, own in self.trials.items()
        }
        return {
            "unit": self.unit,
            "quantity": self.quantity,
            "tremor_band_hz": list(self.band),
            "measures": _plain(self.measures),
            "trials": each,
            "notices": list(self.notices),
            "versions": versions(),
        }

    def save(self, path: str | PathLike[str]) -> None:
        """Write `to_dict()` as JSON."""
        write_json(str(path), self.to_dict())

    def to_dataframe(self) -> "pandas.DataFrame":
        """A row per trial and quantity, then those of all trials together, whose `trial` is "all".

        Columns `trial`, `duration_s`, `quantity`, `value`, `stderr`, `low` and `high` (ends of the
        95 % interval), `unit`, `error_from`.
        """
        lasted = self.durations | {ALL: sum(self.durations.values())}
        rows = [
            {"trial": name, "duration_s": lasted[name], "quantity": quantity, **m.row()}
            for name, own in (self.trials | {ALL: self.measures}).items()
            for quantity, m in own.items()
        ]
        return frame(rows)

    def plot(self, ax: "Axes | None" = None) -> "Figure | SubFigure":
        """Draw spectrum, power by band, coefficients of variation and regularity, every trial as a
        dot; returns the figure."""
        return plot.steadiness(self, ax)

    def __str__(self) -> str:
        seconds = list(self.durations.values())
        count, chosen = len(seconds), any(notice.startswith(FOUND) for notice in self.notices)
        head = read_line(name_of_all(list(self.trials)), count, self.quantity, self.unit, seconds)
        title = f"MEASURED{scatter_of(count)}"
        notices = [n for n in self.notices if FOUND not in n and UNRAMPED not in n]
        checks = [f"CHECK  {n}" for n in (*notices, *[WITHIN] * (count < ENOUGH))]
        rows = [f"  {row}" for row in measured_lines(self.measures, self.band)]
        return folded([head + BY_ITSELF * chosen, heading(title), *rows, *checks])


def _plain(measures: dict[str, Measure]) -> dict[str, Any]:
    return {name: nulled(vars(m)) for name, m in measures.items()}


def steadiness(
    recordings: Recording | Iterable[Recording],
    *,
    band: tuple[float, float] | None = None,
    mvc: float | int | None = None,
) -> Steadiness:
    """How steady a force, torque or displacement is held, or how a limb trembles: variability, power
    by band, regularity.
    No model is fitted.

        print(jm.data.steadiness(jm.load_recordings(["trial1.csv", "trial2.csv"]).steady()))

    Everything is computed of the window of each recording (`steady()` finds it), as
    `Recording.filtered` gives it: resampled to 100 Hz and low-passed at 30 Hz.

    | name | what it is |
    |---|---|
    | `mean`, `standard_deviation` | μ and σ [unit]; σ² divides by the number of samples |
    | `level` | μ / `mvc`, a fraction, if it is given |
    | `coefficient_of_variation` | σ / abs(μ), a fraction; NaN where σ exceeds abs(μ), and of an acceleration or angular velocity |
    | `..._without_drift` | the same about the least-squares line, over abs(μ) |
    | `..._above_0.5` | the same without what is slower than 0.5 Hz: √(Σ of the powers above) / abs(μ) |
    | `power_0_0.5` ... `power_8_12`, `power_above_12` | power in the bands of the fits' `band_...`, and from 12 to 30 Hz [unit²] |
    | `relative_power_0_0.5` ... | the same over μ² |
    | `share_0_0.5` ... | the same over σ², a fraction |
    | `median_frequency` | below which half of the power in the Welch bins from 0.39 to 11.72 Hz lies, each bin being even [Hz] |
    | `approximate_entropy`, `sample_entropy` | of templates of 2 samples, within 0.2 σ |
    | `dfa_exponent` | slope of detrended fluctuations, windows from 0.04 s to a tenth of the recording, order 1 |
    | `tremor_p` | how often a smooth spectrum shows a peak in the band as clear as the clearest one here |
    | `tremor_frequency` | of that peak, if p is at most 0.01 [Hz]; else NaN |
    | `tremor_size` | √(power of the peak) / abs(μ), a fraction; where there is no variation √power [unit] |
    | `tremor_detectable` | the size, in the same unit, that nine of ten such recordings would show |

    **Power by band** is the sum of `jaxmuscle.spectra.variance_spectrum` over low ≤ f < high. It
    takes the whole window, of length T, at once, resolves 1/(2T), and loses nothing: the seven
    powers add up to σ². A drift is in the lowest band. The shares of a fit (`band_0_0.5`) are of
    the 30 bins from 0.39 to 11.72 Hz only, and so are larger above 0.5 Hz.

    **The tremor** is the clearest peak of the Welch spectrum (2.56 s, bins of 0.39 Hz) in `band`,
    tested against smooth spectra, see `jaxmuscle.spectra.find_peaks`. That of several trials is of
    their mean spectrum.

    **Several trials** count alike: any other value is the mean of the trials' values.

    **Standard errors**, by the number of trials:

    - Three or more, "trials": the standard deviation between the trials over √n; of the tremor, the
      jackknife over trials.
    - One or two, "spectrum": the ordinates of the spectrum are taken as independent, the variance
      of each as 2/3 of its square, as in a stationary Gaussian signal; of the mean, from the four
      slowest. What is slower than the recording is not in it: where the level wanders, the mean of
      the next trial differs by more.
    - One or two, "parts" (entropies, DFA exponent): the standard deviation of the values of the
      four quarters over 2; "segments" (tremor, median frequency): the jackknife over
      Welch segments.

    **95 % intervals**, value ± t errors, with Student's t of ν degrees of freedom, cut where no
    value can lie (below 0; of a share above 1): "trials" ν = n - 1; "parts" 3n; "segments" their
    number less 1; the mean 4n. For if the spectrum is flat up to 2/T, the squared error of the mean
    is the mean of 4n squares of normal numbers, which are independent of the mean. What else is
    from the "spectrum": value · exp(± 1.96 error / value); of a share p the same of its odds p /
    (1 - p). How often they hold the expected value stands in `docs/recordings.md`.

    **Arguments:** `recordings`, one or several trials of one condition of one person, in one unit;
    `band` (low, high) [Hz] in which a tremor is looked for, by default 6 to 12 Hz in a force, 3 to
    20 Hz in what moves (displacement, angle, acceleration, angular velocity).

    `mvc` [unit], the mean of a maximal voluntary contraction, counted from rest as the recordings.

    **Returns:** a `Steadiness`; it prints, plots and saves itself.

    **Raises:** `ValueError` for no recordings, different units, a window that is constant or
    shorter than 3.84 s.
    """  # noqa: E501 (a row of a table is one line)
    each = Trials([recordings] if isinstance(recordings, Recording) else recordings).recordings
    for recording in each:
        recording._require_change()
        remedy = f"{recording.name} lasts {recording.duration:.3g} s; give at least {SHORTEST:g} s"
        require(recording.segments() >= SEGMENTS, "window", recording.window, remedy)
    given = [*(recording.name for recording in each), ALL]
    names = [
        name if given.count(name) == 1 else f"{name} {i}" for i, name in enumerate(given[:-1], 1)
    ]
    durations = dict(zip(names, (recording.duration for recording in each), strict=True))
    signals = [recording.filtered() for recording in each]
    unit, quantity, few = each[0].unit, each[0].quantity, len(each) < ENOUGH
    highest = min(recording.rate for recording in each) / 2
    usual = searched_band(quantity, highest)
    band = usual if band is None else (float(band[0]), float(band[1]))
    own, together = measure_signals(signals, unit, quantity, band, highest)
    own = list(own)
    if mvc is not None:
        mean = abs(together[MEAN].value)
        require(mean <= mvc < math.inf, "mvc", mvc, f"give a force above the mean, {mean:.4g}")
        own, together = [_with_level(m, mvc) for m in own], _with_level(together, mvc)
    trials = dict(zip(names, own, strict=True))
    notices = [*notices_of(each, signals, float(RECORDED.rate), quantity)]
    if few and quantity in ("force", "torque") and unlike(names, signals, unit):
        notices.append(
            "the errors do not contain how much two trials differ: for that give three or more"
        )
    notices += _notice_wandering(signals) if few else ()
    notices += _notice_limits(durations, together, quantity, highest)
    notices += () if few else _notice_agreement(own)
    fastest = min(MOTION_BAND[1], SEEN * highest)
    settings = RECORDED.replace(last_bin=int(fastest / RECORDED.resolution))
    spectra = [recording.spectrum(settings) for recording in each]
    power = np.stack([np.asarray(one.power) for one in spectra])
    whole = np.average(power, axis=0, weights=[r.segments(settings) for r in each])
    spectrum = np.asarray(spectra[0].frequency), power, whole
    return Steadiness(together, trials, durations, unit, quantity, band, spectrum, tuple(notices))


def _with_level(measures: dict[str, Measure], mvc: float | int) -> dict[str, Measure]:
    """The measures with the mean over that of a maximal contraction behind it."""
    (name, mean), *others = measures.items()
    level = mean.times(math.copysign(1 / mvc, mean.value), "1")
    return dict([(name, mean), (LEVEL_NAME, level), *others])


def _notice_wandering(signals: list[np.ndarray]) -> tuple[str, ...]:
    """What to say where the spectrum still rises towards the slowest ordinates, which say how sure
    the mean is.

    If it is flat there, each ordinate is s χ²(1), and the ratio of the mean of the first 4 to that
    of the next 8, of n recordings together, has an F distribution of 4n and 8n degrees of freedom.
    """
    power = np.mean([variance_spectrum(x, 1.0)[1][:NEXT] for x in signals], axis=0)
    ratio = float(np.mean(power[:SLOWEST]) / np.mean(power[SLOWEST:]))
    count = len(signals)
    if scipy.special.fdtrc(SLOWEST * count, (NEXT - SLOWEST) * count, ratio) > WANDERS:
        return ()
    return (
        f"the level wanders: the slowest fluctuations have {ratio:.2g} times the power of the next"
        " ones. Then the mean of another recording may differ by more than the interval of the mean"
        " says. Three trials or more show by how much",
    )


def _notice_limits(
    durations: dict[str, float],
    together: dict[str, Measure],
    quantity: str | None,
    highest: float,
) -> Iterator[str]:
    """What to say of numbers that do not exist, and of lengths that differ."""
    short, long = min(durations.values()), max(durations.values())
    if long > ALIKE * short:
        yield (
            f"the trials last {short:.3g} s to {long:.3g} s: what is slow (variation, power below"
            " 0.5 Hz, DFA exponent) grows with the length, so choose windows of one length"
        )
    if quantity in FLOATING:
        yield (
            f"the mean of an {quantity} is {'gravity and' if quantity == FLOATING[0] else 'the'}"
            " offset of the sensor: there is no coefficient of variation"
        )
    elif math.isnan(together[VARIATION].value):
        yield "the mean is near zero: there is no coefficient of variation"
    left_out = ", ".join(
        range_words(*edges)
        for name, edges in RANGES.items()
        if f"power{name}" in together and math.isnan(together[f"power{name}"].value)
    )
    if left_out:
        yield (
            f"nothing above {highest:g} Hz was recorded: the power from {left_out} is"
            " left out. Entropies and DFA exponent are of what is slower, so compare them with"
            " recordings of the same rate only"
        )
    if math.isnan(together["tremor_p"].value):
        yield "a tremor was not looked for: its band is not in what was recorded"


def _notice_agreement(own: list[dict[str, Measure]]) -> Iterator[str]:
    """What to say where trials agree by chance, so that the error from their scatter is too
    small."""
    errors = {name: likelier_error([m[f"power{name}"] for m in own]) for name in RANGES}
    likelier = ", ".join(
        f"± {error:.2g} from {range_words(*RANGES[name])}"
        for name, error in errors.items()
        if error is not None
    )
    if likelier:
        yield (
            "in some bands the trials happen to agree much better than recordings of this length"
            f" do: {likelier} is a more likely error of the power than the one in the table"
        )
