"""Targets: a measured, digitised or reconstructed proportional power spectrum to fit a model to."""

import dataclasses
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypedDict, Unpack, get_args

import equinox as eqx
import numpy as np
import tomli_w
from jaxtyping import Float, Int

from jaxmuscle import plot
from jaxmuscle._common.arguments import check_options
from jaxmuscle._common.cards import Card, Shown, facts
from jaxmuscle._common.errors import TargetError
from jaxmuscle._common.files import write_text
from jaxmuscle._common.units import NEWTONS
from jaxmuscle.model._noise import AbstractNoise
from jaxmuscle.model._noises import with_noise
from jaxmuscle.model._tasks import (
    AbstractTask,
    Isometric,
    Observed,
    PrescribedForce,
    PrescribedLength,
)
from jaxmuscle.spectra._bin_law import bin_statistics, dispersion_of, mean_error, trial_samples
from jaxmuscle.spectra._settings import SpectrumSettings

from . import _target_fields as check
from ._frequency_response import FrequencyResponse
from ._measure import Measure
from ._measured import measure_spectrum, widen_errors
from ._target_data import TargetData
from ._target_fields import Provenance, Quantity
from ._target_files import on_grid, read_target

# A sum this near to 1 is rounding of the printed numbers, not another scale.
SUM_TOLERANCE = 1e-3
# Of the mean, where nothing says how far it may be from the person's; and the least, that of a good
# calibration.
MEAN_ERROR, LEAST_MEAN_ERROR = 0.02, 0.002
UNUSUAL = 1.25  # dispersion from which trials are said to differ


@dataclasses.dataclass(frozen=True)
class Samples:
    """The samples of every trial. All are equal: what a target says is its spectrum."""

    each: tuple[Float[np.ndarray, " _"], ...] = dataclasses.field(compare=False, repr=False)


class Stated(TypedDict, total=False):
    """What a target may state besides its powers, see `Target`."""

    quantity: str
    provenance: str
    source: str
    sigma: Any
    segments: int | Sequence[int] | None
    coefficient_of_variation: float | Sequence[float] | None
    mvc_fraction: float | None
    mean: float | Sequence[float] | None
    unit: str | None
    recorded_at: float | int | None
    trial_power: Any
    dispersion: float | Sequence[float] | None
    reason: str | None
    stiffness: FrequencyResponse | Mapping[str, Any] | None
    measured: Mapping[str, Any] | tuple[tuple[Any, ...], ...] | None


UNSTATED: Stated = {"quantity": "force", "provenance": "user", "source": "given by the user"}


class Target(Shown, eqx.Module):
    """What a fit is given: a proportional power spectrum p_k = P_k / Σ_j P_j on the bins k that are
    covered, and its origin.

    **Arguments:**

    - `name`: how reports call it.
    - `proportional_power`: p_k > 0, shape `(bins,)`; it is divided by its sum. The target's
      attribute `frequency` has the frequency [Hz] of each.
    - `bins`: bin numbers on the grid of `settings`, increasing; all selected bins by default.
    - `quantity`: what was recorded; torque is fitted as force, since p has no scale.
    - `provenance`, `source`: how and from where the numbers were obtained.
    - `reason`: what a reconstruction assumes.
    - `sigma`: standard deviation of p_k, scaled together with it.
    - `segments`: number K of Welch segments of each trial. They say how much the bins scatter.
    - `coefficient_of_variation`: standard deviation over mean of each trial, a fraction. It is that
      of the force as the spectrum sees it, low-passed as `settings` say. An acceleration has none,
      since its mean is zero.
    - `mvc_fraction`: mean level as a fraction of the maximal voluntary contraction.
    - `mean`, `unit`: mean force or torque of each trial, and its unit. A mean in a unit of force
      fixes its scale in a fit.
    - `recorded_at`: rate [Hz] at which the recording was taken. If `settings` sample it "filtered",
      the model's spectrum has the aliases of this rate (from twice that of `settings` on), as it
      has them without a low-pass before the sampling; if it is `None`, it has none.
    - `trial_power`: spectrum of each trial [unit²/Hz], shape `(trials, bins)`; `proportional_power`
      is their mean, weighted with `segments`.
    - `dispersion`: how many times more the trials' average spectrum scatters than their segments
      explain, and the standard error of this number. Above 1 it widens every error. If
      `trial_power` is given, it follows from that (docs/recordings.md, *Several trials of one
      person*).
    - `stiffness`: the dynamic stiffness measured beside it, by a perturbation. Then
      `proportional_power` may be `None`: the target has no spectrum.
    - `measured`: what was measured of the recordings themselves, a `Measure` by name, as
      `steadiness` lists them. Without it the attribute says what the bins tell (shares by band,
      median frequency, tremor) and what is stated here (mean, variation). `measures` has its
      rows.
    - `settings`: how the spectrum was estimated. The model's spectrum is made in the same way.
    - `signals`: the low-passed samples of every trial at 100 Hz [`unit`], in which a fit looks for
      what the spectrum cannot show. No file keeps them, and targets that differ in them are equal.
    - `notices`: what was done to the numbers, in sentences.

    **Raises:** `TargetError`, a `ValueError`, naming the argument, its value and the remedy.
    """

    frequency: Float[np.ndarray, " bins"]
    bins: Int[np.ndarray, " bins"]
    proportional_power: Float[np.ndarray, " bins"]
    sigma: Float[np.ndarray, " bins"] | None
    name: str = eqx.field(static=True)
    quantity: Quantity = eqx.field(static=True)
    provenance: Provenance = eqx.field(static=True)
    source: str = eqx.field(static=True)
    segments: tuple[int, ...] | None = eqx.field(static=True)
    coefficient_of_variation: tuple[float, ...] | None = eqx.field(static=True)
    mvc_fraction: float | None = eqx.field(static=True)
    mean: tuple[float, ...] | None = eqx.field(static=True)
    unit: str | None = eqx.field(static=True)
    recorded_at: float | int | None = eqx.field(static=True)
    trial_power: Float[np.ndarray, "trials bins"] | None
    dispersion: tuple[float, ...] | None = eqx.field(static=True)
    reason: str | None = eqx.field(static=True)
    stiffness: FrequencyResponse | None
    measures: tuple[tuple[Any, ...], ...] | None = eqx.field(static=True)
    settings: SpectrumSettings = eqx.field(static=True)
    samples: Samples = eqx.field(static=True)
    notices: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        name: str,
        proportional_power: Any,
        *,
        bins: Any = None,
        settings: SpectrumSettings | None = None,
        signals: Iterable[np.ndarray] = (),
        notices: Iterable[str] = (),
        **stated: Unpack[Stated],
    ):
        check_options(Target, Stated, stated)
        settings = SpectrumSettings() if settings is None else settings
        said = UNSTATED | stated | {"name": name}
        for field in check.ALONE:
            setattr(self, field, check.metadata(field, said.get(field)))
        if self.quantity == "acceleration" and self.coefficient_of_variation is not None:
            raise TargetError(
                "coefficient_of_variation: the mean of an acceleration is zero; leave it out"
            )
        self.measures = check.metadata("measured", stated.get("measured"))
        self.settings, self.samples = settings, Samples(tuple(signals))
        stiffness, sigma = stated.get("stiffness"), stated.get("sigma")
        if isinstance(stiffness, Mapping):
            stiffness = FrequencyResponse.from_table(stiffness)
        if not isinstance(stiffness, FrequencyResponse | None):
            raise TargetError(
                f"stiffness: this is a {type(stiffness).__name__}; give a FrequencyResponse, or its"
                " table"
            )
        self.stiffness = stiffness
        if proportional_power is None and stiffness is not None:
            proportional_power, bins = np.zeros(0), np.zeros(0, int)
        if bins is None:
            bins = np.arange(settings.first_bin, settings.last_bin + 1)
        self.bins = check.frozen(check.bin_numbers(bins, settings))
        size = self.bins.size
        self.frequency = check.frozen(settings.frequency[self.bins - settings.first_bin])
        power, deviation = np.zeros(0), None
        if size:
            power = check.bin_powers("proportional_power", proportional_power, size)
            deviation = None if sigma is None else check.bin_powers("sigma", sigma, size)
        # the sum of a saved target is 1 to rounding: it is read back exactly
        total = float(np.sum(power))
        over = 1.0 if abs(total - 1) < 1e-12 or not size else total
        self.proportional_power = check.frozen(power / over)
        self.sigma = None if deviation is None else check.frozen(deviation / over)
        self.trial_power = None
        if (rows := stated.get("trial_power")) is not None:
            self.trial_power = check.trial_powers(rows, self.segments, power)
            self.dispersion = dispersion_of(
                self.trial_power, self.segments or (), settings, self.bins
            )
        own = _own_notices(self, total)
        self.notices = tuple(dict.fromkeys((*check.metadata("notices", list(notices)), *own)))

    @property
    def signals(self) -> tuple[Float[np.ndarray, " _"], ...]:
        """The samples of every trial; none where only a spectrum is known."""
        return self.samples.each

    @property
    def measured(self) -> dict[str, Measure]:
        """What is measured, by name and without any model: of the recordings, or of the bins."""
        if self.measures is None:
            return measure_spectrum(self)
        return {name: Measure.from_row(row) for name, *row in self.measures}

    @property
    def degrees_of_freedom(self) -> float | None:
        """Equivalent degrees of freedom ν of a bin, the sum over the trials; `None` without
        `segments`.

        Bin 1 has fewer (docs/fitting.md, *What is minimised*), which is not counted here.
        """
        if self.segments is None:
            return None
        return float(sum(self.settings.degrees_of_freedom(K) for K in self.segments))

    @property
    def overdispersion(self) -> float:
        """What multiplies the standard deviations of the log powers: the dispersion, if it is above
        1."""
        return 1.0 if self.dispersion is None else max(1.0, self.dispersion[0])

    @property
    def mean_force(self) -> tuple[float, float] | None:
        """Mean force and its standard error [N]; `None` without a mean in newtons.

        The error: that of the trials' scatter or that of a recording of this length, whichever is
        larger. If it is the former, with Student's t, so that ± 1.96 of it hold 95 % (of three
        trials or more). The latter is `√(S₁ / 2T)`, S₁ the density in the lowest bin and T the time
        of all trials together, but at least 0.2 % of the mean; or 2 % of the mean, if the target
        lacks a spectrum, segments or coefficient of variation.
        """
        if self.mean is None or self.unit not in NEWTONS or self.quantity != "force":
            return None
        means = NEWTONS[self.unit] * np.asarray(self.mean)
        relative, varied = MEAN_ERROR, self.coefficient_of_variation
        if self.segments is not None and varied is not None and self.bins.size:
            share = self.proportional_power[0] / self.settings.resolution
            time = len(self.segments) * trial_samples(self) / self.settings.rate
            relative = np.sqrt(np.mean(np.square(varied)) * share / (2 * time))
        mean = float(means.mean())
        return mean, float(mean_error(means, max(relative, LEAST_MEAN_ERROR) * mean))

    def task(
        self, kind: type[AbstractTask] | None = None, *, noise: str | AbstractNoise | None = None
    ) -> AbstractTask:
        """The task that was measured: `Isometric` for force and torque, `PrescribedLength` for a
        dynamic stiffness, `PrescribedForce` for displacement and acceleration (with
        `observe="acceleration"`).

            task = jm.load_target("vastus-lateralis-26mvc").task(noise="pink")

        Of another `kind` if one is given. It has the target's spectrum settings and default
        parameters; `noise` is "white", "band-limited", "ornstein-uhlenbeck", "pink", or a noise
        object.
        """
        what: Any = self.quantity
        held = Isometric() if self.stiffness is None else PrescribedLength()
        task = PrescribedForce(observe=what) if what in get_args(Observed) else held
        task = task if kind in (None, type(task)) else kind()
        return with_noise(task.with_parts(settings=self.settings), noise)

    def data(self) -> TargetData:
        """What `log_likelihood` asks of the target, as arrays alone: a pytree for `jax.jit`,
        `jax.grad` and `jax.vmap`.

            target = jm.load_target("vastus-lateralis-26mvc")
            height = jax.jit(jm.objective.log_likelihood)
            height(target.task(), target.data())

        A function that is given it as an argument is compiled once for all targets with the same
        settings, number of bins and number of trials. A target itself would be compiled in.

        **Raises:** `TargetError` for a spectrum without segments: how much its bins scatter is not
        known.
        """
        return TargetData.of(self)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write TOML that `load_target` reads back equal; an existing file is replaced in one step.

        **Raises:** `TargetError` if the path does not end in .toml or cannot be written.
        """
        path = Path(path).expanduser()
        if path.suffix.lower() != ".toml":
            raise TargetError(f"{path}: a target is saved as TOML; give a name that ends in .toml")
        if not path.parent.is_dir():
            raise TargetError(f"{path}: cannot be written: there is no folder {path.parent}")
        try:
            write_text(path, tomli_w.dumps(self.to_table()))
        except OSError as error:
            raise TargetError(f"{path}: cannot be written: {error.strerror}") from None

    def sampling_band(self) -> tuple[Float[np.ndarray, " bins"], Float[np.ndarray, " bins"]] | None:
        """Lower and upper edge of p_k exp(-bias ± sd), where the expected spectrum lies within one
        standard deviation.

        `bias` and `sd` are mean offset and standard deviation of a bin's log power
        (docs/fitting.md, *What is minimised*). `None` if nothing is known about the sampling error.
        """
        statistics = bin_statistics(self)
        if not statistics.known:
            return None
        centre = self.proportional_power * np.exp(-statistics.bias)
        return centre * np.exp(-statistics.sd), centre * np.exp(statistics.sd)

    def to_table(self, *, whole: bool = False) -> dict[str, Any]:
        """The target as the table that a TOML file holds; `whole`, with None for what it does not
        state, as in fit.json."""
        said = {
            "frequency_hz": self.frequency,
            "dispersion": self.dispersion if self.trial_power is None else None,
            "measured": None if self.measures is None else check.measured_table(self.measures),
            "stiffness": None if self.stiffness is None else self.stiffness.to_table(),
            "settings": self.settings.to_dict(),
        }
        values = ((key, said[key] if key in said else getattr(self, key)) for key in check.FIELDS)
        table = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in values}
        return table if whole else {k: v for k, v in table.items() if v not in (None, ())}

    @classmethod
    def from_table(cls, table: Mapping[str, Any], *, whole: bool = False) -> "Target":
        """The reverse of `to_table`: each frequency counts as the nearest bin. Raises
        `TargetError`."""
        file = "target_table"
        fields = check.fields_of(table, file, whole=whole)
        fields = {key: value for key, value in fields.items() if value is not None}
        stated = fields.pop("settings", {})
        settings = check.settings_of(stated, f"{file}.settings", whole=whole)
        key = "frequency_hz"
        frequency = check.numbers_of(key, fields.pop(key), file, empty="stiffness" in fields)
        with np.errstate(over="ignore"):
            bins = np.rint(np.clip(frequency / settings.resolution, -1e9, 1e9)).astype(int)
        return cls(**fields, bins=bins, settings=settings)

    def with_stiffness(self, stiffness: FrequencyResponse) -> "Target":
        """The same with a dynamic stiffness that was measured beside it."""
        return Target.from_table(self.to_table() | {"stiffness": stiffness})

    def with_measures(self) -> "Target":
        """The same, which keeps what is measured of its bins."""
        if self.measures is not None:
            return self
        return Target.from_table(self.to_table() | {"measured": self.measured})

    def with_unsteady_errors(self, widening: float, common: float) -> "Target":
        """The same with wider errors of what was measured, see `widen_errors`; those of a bare
        spectrum stay."""
        if self.measures is None or not self.signals:
            return self
        wider = widen_errors(self.measured, self.signals, widening, common)
        return Target.from_table(self.to_table() | {"measured": wider})

    def plot(self, ax: Any = None, *, log: bool = False) -> Any:
        """Draw the spectrum, see `jaxmuscle.plot.target`; `log`: both axes logarithmic. Returns the
        axes."""
        return plot.target(self, ax, log=log)

    def _card(self) -> Card:
        f, p, settings = self.frequency, self.proportional_power, self.settings
        known = [("source", self.source)]
        if f.size:
            top, bins = int(np.argmax(p)), f"{f.size} of {settings.frequency.size}"
            known += [
                ("spectrum", settings.name or "settings of its own"),
                ("bins", f"{bins}, {f[0]:.3f} to {f[-1]:.3f} Hz"),
                ("maximum", f"{p[top]:.3f} at {f[top]:.3f} Hz"),
            ]
        if self.stiffness is not None:
            at = self.stiffness.frequency
            known.append(("dynamic stiffness", f"{at.size} points, {at[0]:.3g} to {at[-1]:.3g} Hz"))
        if self.segments is not None:
            count = f"({self.degrees_of_freedom:.1f} degrees of freedom)"
            known.append(("segments", f"{_words(self.segments)} {count}"))
        if self.coefficient_of_variation is not None:
            each = (f"{100 * value:.3g} %" for value in self.coefficient_of_variation)
            known.append(("coefficient of variation", ", ".join(each)))
        if self.mvc_fraction is not None:
            known.append(("level", f"{100 * self.mvc_fraction:.4g} % MVC"))
        if self.mean is not None:
            known.append(("mean", f"{np.mean(self.mean):.4g} {self.unit or '(unit unknown)'}"))
        if self.dispersion:
            known.append(("trials", f"their spectra {_dispersion_in_words(self.dispersion)}"))
        known += [("notice", notice) for notice in self.notices]
        what = "proportional power" if f.size else "dynamic stiffness"
        return facts(f"{self.name}: {what} of {self.quantity}, {self.provenance}", known)


def load_target(
    name_or_path: str | os.PathLike[str],
    *,
    quantity: str | None = None,
    segments: int | Sequence[int] | None = None,
    dataset: str | None = None,
    axis: str = "linear",
) -> Target:
    """Load a bundled target by name, or a .toml or .csv file or a digitised figure by path.

        target = jm.load_target("vastus-lateralis-26mvc")
        print(target)

    A CSV has the columns `frequency_hz,proportional_power[,sigma]`, sorted and unique. A figure
    digitised with WebPlotDigitizer is its CSV of all datasets, or two columns without a header; its
    points are sorted and near-duplicates averaged (docs/digitise.md). Points off the grid are
    interpolated onto the bins in log power, and in log frequency from a logarithmic axis; bins that
    are not covered are left out, and power is rescaled to sum to 1 over the others. The target's
    `notices` say which of these happened.

    **Arguments:**

    - `name_or_path`: see `list_targets` for the names.
    - `quantity` and `segments` (Welch segments of each trial) replace what the file says.
    - `dataset`: which of several datasets of a figure.
    - `axis`: `"log-log"` if a figure's points are log10 of frequency [Hz] and of power, calibrated
      in decades.

    **Raises:** `TargetError`, a `ValueError`, naming file and line or key, what is wrong and what
    is right.
    """
    raw = read_target(name_or_path, dataset, axis)
    file, fields, notices = raw.file, raw.fields, raw.notices
    for key, value in (("quantity", quantity), ("segments", segments)):
        if value is None:
            continue
        asked = check.metadata(key, value)
        if fields.get(key, asked) != asked:
            notices.append(f"{key} {_words(asked)} as asked; the file says {_words(fields[key])}")
        fields[key] = asked
    try:
        points, more = on_grid(raw)
        notices = (*fields.pop("notices", ()), *notices, *more)
        return Target(**(fields | points._asdict()), notices=notices)
    except TargetError as error:
        raise TargetError(f"{file}: {error}") from None


def _dispersion_in_words(dispersion: Sequence[float]) -> str:
    value = " ± ".join(f"{number:.2f}" for number in dispersion[:2])
    return f"differ {value} times as much as by chance"


def _words(value: str | tuple[int, ...]) -> str:
    return value if isinstance(value, str) else " + ".join(map(str, value))


def _own_notices(target: Target, total: float) -> list[str]:
    settings, notices = target.settings, []
    missing = np.setdiff1d(np.arange(settings.first_bin, settings.last_bin + 1), target.bins)
    if missing.size and target.bins.size:
        runs = np.split(missing, np.flatnonzero(np.diff(missing) > 1) + 1)
        spans = ", ".join(
            f"{run[0]}" if run.size == 1 else f"{run[0]} to {run[-1]}" for run in runs
        )
        which, they = ("bin", "it is") if missing.size == 1 else ("the bins", "these are")
        notices.append(
            f"the spectrum has no value in {which} {spans}, so {they} left out (bin k lies at k"
            f" times {settings.resolution:g} Hz)"
        )
    if target.bins.size and abs(total - 1) > SUM_TOLERANCE:
        notices.append(
            f"proportional power summed to {total:.4g} over the bins covered: rescaled to 1"
        )
    if target.overdispersion > UNUSUAL and target.dispersion is not None:
        notices.append(
            f"the spectra of the trials {_dispersion_in_words(target.dispersion)}. So all errors"
            " are widened by it. Did the person tire, drift or change the grip?"
        )
    if target.provenance == "reconstructed":
        if target.reason is None:
            raise TargetError(
                "a reconstructed target needs a reason: a sentence that says what was assumed"
            )
        notices.append(f"reconstructed from what the text states, not measured: {target.reason}")
    return notices
