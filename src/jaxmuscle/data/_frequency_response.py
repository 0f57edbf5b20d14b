"""Frequency responses: the dynamic stiffness of a muscle, measured or published, with its
errors."""

import os
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Unpack

import equinox as eqx
import numpy as np
import scipy
from jaxtyping import Complex, Float

from jaxmuscle import plot
from jaxmuscle._common.arguments import check_options, require
from jaxmuscle._common.cards import Card, Shown, facts
from jaxmuscle._common.documents import Table, checked, says
from jaxmuscle._common.files import write_text
from jaxmuscle._common.text import probability, rounded

from ._recording_choice import Origin
from ._second_order import averages_of, parts, second_order_shape, shortened
from ._target_fields import frozen

Numbers = list[float]
Bins = Float[np.ndarray, " bins"]
UNSEEN = 1e-3  # how probable by chance a response may be at most, to be one
SQUARED = "give the squared coherence, 0 to 1"
FITTED = ("frequency_hz", "real", "imaginary", "stderr")  # columns of stiffness.csv
HEADER = re.compile(
    r"(frequency|freq|f|gain|phase|coherence|stderr)(?:[ _/]*[\[(]?([^\[\]()]*?)[\])]?)"
)
COLUMNS = ("frequency_hz", "gain_N/m", "phase_deg", "stderr_N/m", "coherence")
JOINT = "N m/rad"
IMPASSIVE = 0.01  # how probable a negative imaginary part may be at most, to be said


class ResponseTable(Table, kw_only=True):
    """A dynamic stiffness as a table: `stiffness` of a target."""

    name: Annotated[str, says("How reports call it")]
    source: Annotated[str, says("Where it comes from")]
    notices: Annotated[list[str], says("What was done to it")]
    frequency_hz: Annotated[Numbers, says("Frequencies [Hz], rising, above 0")]
    real: Annotated[Numbers, says("Real part [N/m]")]
    imaginary: Annotated[Numbers, says("Imaginary part [N/m]")]
    stderr: Annotated[
        list[float | Literal["inf"]],
        says(
            'Standard error of both [N/m]; "inf" (a text) where a fit is to leave the frequency out'
        ),
    ]
    coherence: Annotated[Numbers | None, says("Squared coherence, 0 to 1", missing="unknown")] = (
        None
    )
    unit: Annotated[
        Literal["N/m", "N m/rad"],
        says("Of real, imaginary and stderr: N m/rad of a joint", missing="N/m"),
    ] = "N/m"
    lever_arm: Annotated[
        float | None,
        says("From the axis [m], where they were made of torque and angle", missing="unknown"),
    ] = None


class FrequencyResponse(Shown, eqx.Module):
    """The dynamic stiffness of a muscle: force per lengthening of its insertion, over frequency.

        H(f) = F(f) / X(f)  [N/m]

    X counts *lengthening* as positive, so that H has a positive real part at low frequency (a
    spring), and a positive phase where it damps.

    **Arguments:**

    - `frequency` [Hz], shape `(bins,)`: above 0 and rising.
    - `value` [N/m], shape `(bins,)`: H, complex.
    - `stderr` [N/m], shape `(bins,)`: standard error of the real part, and of the imaginary part;
      infinite where the value is of no use.
    - `coherence`, shape `(bins,)`: the share of the force's power that follows the displacement, 0
      to 1; or `None`.
    - `name`, `source`, `notices`: how reports call it, where it comes from, what was done to it.
    - `unit`: of `value` and `stderr`; "N m/rad" of a joint, torque over angle.
    - `lever_arm` [m]: with which a response in N/m was made of torque and angle.

    **Raises:** `ValueError` naming the argument, the entry and the remedy.
    """

    frequency: Bins
    value: Complex[np.ndarray, " bins"]
    stderr: Bins
    coherence: Bins | None
    name: str = eqx.field(static=True)
    source: str = eqx.field(static=True)
    notices: tuple[str, ...] = eqx.field(static=True)
    unit: str = eqx.field(static=True)
    lever_arm: float | None = eqx.field(static=True)

    def __init__(
        self,
        frequency: Any,
        value: Any,
        stderr: Any,
        coherence: Any = None,
        *,
        unit: str = "N/m",
        lever_arm: float | None = None,
        **words: Unpack[Origin],
    ):
        check_options(FrequencyResponse, Origin, words)
        rising = "give rising frequencies above 0 Hz, each once"
        self.frequency = _column("frequency", frequency, None, _rises, rising)
        size = self.frequency.size
        usable = "give finite numbers other than 0"
        self.value = _column("value", value, size, _is_usable, usable, complex)
        above = "give standard errors above 0, infinite where a value is of no use"
        self.stderr = _column("stderr", stderr, size, lambda error: error > 0, above)
        one = bool(np.any(np.isfinite(self.stderr)))
        require(one, "stderr", "all infinite", "give one that is finite")
        self.coherence = (
            None
            if coherence is None
            else _column("coherence", coherence, size, lambda x: (x >= 0) & (x <= 1), SQUARED)
        )
        self.name = words.get("name", "response")
        self.source = words.get("source", "given by the user")
        self.notices = tuple(words.get("notices", ()))
        require(unit in ("N/m", JOINT), "unit", unit, f"give N/m or {JOINT}")
        self.unit, self.lever_arm = unit, lever_arm

    @classmethod
    def from_gain(
        cls,
        frequency: Any,
        gain: Any,
        phase: Any,
        *,
        coherence: Any = None,
        segments: Any = None,
        stderr: Any = None,
        unit: str = "N/m",
        lever_arm: float | None = None,
        **words: Unpack[Origin],
    ) -> "FrequencyResponse":
        """A response as figures show it: gain, phase and coherence.

        Where `stderr` is not known, coherence γ² and the number K of independent averages give it:

            stderr = gain √((1 - γ²) / (2 K γ²))

        **Arguments:**

        - `frequency` [Hz]
        - `gain` [N/m]
        - `phase` [deg]: positive where the force leads
        - `coherence` γ²
        - `segments`: K, one number or one for each frequency
        - `stderr` [N/m]
        - `unit`, `lever_arm`, and `words` (`name`, `source`, `notices`), as in `FrequencyResponse`

        **Raises:** `ValueError` without `stderr` and without (`coherence` and `segments`), and as
        `FrequencyResponse` does.

        **Source:** Bendat & Piersol, Random Data, 4th ed. 2010, section 9.2 (docs/perturbed.md
        derives it).
        """
        check_options(cls.from_gain, Origin, words)
        size = np.size(frequency)
        real = "give positive numbers; a negative stiffness has the phase 180"
        gain = _column("gain", gain, size, lambda x: x > 0, real)
        phase = _column("phase", phase, size, np.isfinite, "give finite numbers")
        if stderr is None:
            if coherence is None or segments is None:
                raise ValueError(
                    "stderr: is not known; give it, or the coherence and the number of independent"
                    " averages, as coherence=[0.9, ...], segments=40"
                )
            remedy = f"{SQUARED}; of 1 the formula has no error: give `stderr`"
            shared = _column("coherence", coherence, size, lambda x: (x >= 0) & (x < 1), remedy)
            averages = np.broadcast_to(np.asarray(segments, float), shared.shape)
            remedy = "give the number of independent averages, at least 1"
            _column("segments", averages, size, lambda count: count >= 1, remedy)
            with np.errstate(divide="ignore"):
                stderr = gain * np.sqrt((1 - shared) / (2 * averages * shared))
        value = gain * np.exp(1j * np.radians(phase))
        return cls(frequency, value, stderr, coherence, unit=unit, lever_arm=lever_arm, **words)

    def at_lever_arm(self, arm: float) -> "FrequencyResponse":
        """The response of a joint as force over displacement at a distance [m] from its axis."""
        require(self.unit == JOINT, "unit", self.unit, f"only one in {JOINT} has a lever arm")
        remedy = "give a distance above 0 m"
        require(0 < arm < np.inf, "arm", arm, remedy)
        return self._with(
            value=self.value / arm**2, stderr=self.stderr / arm**2, unit="N/m", lever_arm=float(arm)
        )

    def _with(self, **changed: Any) -> "FrequencyResponse":
        return FrequencyResponse(**{**vars(self), **changed})

    @property
    def known(self) -> "FrequencyResponse":
        """The response where its error is finite."""
        kept = np.isfinite(self.stderr)
        if np.all(kept):
            return self
        names = ("frequency", "value", "stderr", "coherence")
        arrays = {name: getattr(self, name) for name in names}
        return self._with(**{n: None if a is None else a[kept] for n, a in arrays.items()})

    @property
    def gain(self) -> Bins:
        """`|H|` [N/m]."""
        return np.abs(self.value)

    @property
    def phase(self) -> Bins:
        """The phase of H [deg], -180 to 180: positive where the force leads the lengthening."""
        return np.degrees(np.angle(self.value))

    @property
    def phase_stderr(self) -> Bins:
        """Standard error of the phase [deg], to first order in stderr / gain."""
        return np.degrees(self.stderr / self.gain)

    @property
    def averages(self) -> Bins | None:
        """How many independent averages errors and coherence imply: K = (1 - γ²) gain² / (2 γ²
        stderr²); or `None`."""
        if self.coherence is None:
            return None
        return averages_of(self.value, self.stderr, self.coherence)

    @property
    def p_none(self) -> float:
        """How probable a response as large as this one is if the force does not follow the
        displacement at all.

            chi² = Σ |H|² / stderr²   over the frequencies,
            and the part of it along (K + iωB - ω²I) / stderr

        have the chi² distribution with 2 · frequencies and with 3 degrees of freedom where H is 0.
        The smaller of both probabilities is doubled, since two are looked at. With a `coherence`
        the errors are estimated from few averages, n of them (`averages`), and the frequencies are
        those of overlapping segments, neighbours being correlated by 0.45. Then every H / stderr is
        made shorter, its phase kept, so that its square is

            2 (n - 1) ln(1 + |H|² / (2 (n - 1) stderr²))

        which has the chi² distribution that it should have. Both sums are made of these. Since
        neighbours are correlated, the first sum and its degrees of freedom are divided by 1.4; the
        second sum is divided by 1.9, and keeps its 3. Above 0.001 (`UNSEEN`) the displacement says
        nothing of the muscle, and a fit refuses it.
        """
        one, shared = self.known, (1.0, 1.0)
        size = (np.abs(one.value) / one.stderr) ** 2
        squares = size
        if one.averages is not None:
            squares, shared = shortened(size, one.averages), (1.4, 1.9)
        weight = np.tile(np.sqrt(squares / size) / one.stderr, 2)
        shapes = [
            parts(second_order_shape(one.frequency, unit)) / np.tile(one.stderr, 2)
            for unit in np.eye(3)
        ]
        basis = np.linalg.qr(np.stack(shapes, axis=1))[0]
        along = np.sum((basis.T @ (parts(one.value) * weight)) ** 2)
        count = 2 * squares.size
        p = scipy.stats.chi2.sf(
            np.divide([squares.sum(), along], shared), [count / shared[0], min(3, count)]
        )
        return float(min(1.0, 2 * p.min()))

    @property
    def spring_and_mass(self) -> tuple[float, float]:
        """K [N/m] and I [kg] of K + iωB - ω²I, none of them negative, by weighted least squares.
        Neither is less than a twentieth of what else answers."""
        one = self.known
        error, turn = np.tile(one.stderr, 2), 2 * np.pi * one.frequency.max()
        scale = one.gain.max() / turn ** np.arange(3)
        shapes = [
            parts(second_order_shape(one.frequency, unit * scale)) / error for unit in np.eye(3)
        ]
        found = scipy.optimize.nnls(np.stack(shapes, axis=1), parts(one.value) / error)[0]
        k, _, i = np.maximum(found, 0.05 * found.sum()) * scale
        return float(k), float(i)

    @property
    def p_passive(self) -> tuple[float, int]:
        """How probable it is that a passive limb shows an imaginary part as negative as the most
        negative one, and which entry that is.

        What is passive takes up energy: Im H(f) >= 0. The probability of Im H / stderr is that of
        Student's t with 2 (n - 1) degrees of freedom for `averages` n, of the normal distribution
        without a coherence. It is multiplied by the number of frequencies, since the least of all
        is taken.
        """
        size = np.imag(self.value) / self.stderr
        averages = self.averages
        free = np.inf if averages is None else np.maximum(2 * (averages - 1), 1.0)
        p = scipy.stats.t.cdf(size, free)
        return float(min(1.0, p.size * np.min(p))), int(np.argmin(p))

    @property
    def activity(self) -> tuple[str, ...]:
        """A notice if the imaginary part is surely negative, else nothing."""
        one = self.known
        p, i = one.p_passive
        if p > IMPASSIVE:
            return ()
        late = "force" if np.real(one.value[i]) > 0 else "displacement"
        said = "p < 1e-6" if p < 1e-6 else f"p = {p:.1g}"
        least = " ± ".join(rounded(np.imag(one.value[i]), one.stderr[i]))
        return (
            f"the imaginary part of the stiffness is negative: {least} {self.unit} at"
            f" {one.frequency[i]:.3g} Hz ({said}, {one.frequency.size} frequencies being looked"
            " at). A passive limb, whatever it is made of, takes up energy and cannot do that. A"
            f" reflex can. But a {late} channel that is late looks the same, and so does a rig that"
            " bends between the two sensors: exclude these first",
        )

    def to_table(self) -> dict[str, Any]:
        """The response as plain lists, for TOML and JSON; an infinite error is the text "inf"."""
        table: dict[str, Any] = {
            "name": self.name,
            "source": self.source,
            "notices": list(self.notices),
            "frequency_hz": self.frequency.tolist(),
            "real": np.real(self.value).tolist(),
            "imaginary": np.imag(self.value).tolist(),
            "stderr": [e if np.isfinite(e) else "inf" for e in self.stderr.tolist()],
        }
        table |= {} if self.coherence is None else {"coherence": self.coherence.tolist()}
        table |= {} if self.unit == "N/m" else {"unit": self.unit}
        return table | ({} if self.lever_arm is None else {"lever_arm": self.lever_arm})

    @classmethod
    def from_table(cls, table: Mapping[str, Any]) -> "FrequencyResponse":
        """The reverse of `to_table`, exactly. Raises `ValueError` for a key that is missing,
        unknown or of a wrong type."""
        said = checked(dict(table), ResponseTable, "stiffness")
        count = len(said.real)
        equal = len(said.imaginary) == count
        require(equal, "imaginary", len(said.imaginary), f"give {count} numbers, as in real")
        value = np.asarray(said.real, float) + 1j * np.asarray(said.imaginary, float)
        names = ("name", "source", "notices", "unit", "lever_arm")
        words = {name: getattr(said, name) for name in names}
        stderr = np.array(said.stderr, float)
        return cls(said.frequency_hz, value, stderr, said.coherence, **words)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a CSV that `jaxmuscle.data.load_frequency_response` reads; an existing file is
        replaced in one step.

        **Raises:** `ValueError` if the path does not end in .csv.
        """
        path = Path(path).expanduser()
        require(
            path.suffix.lower() == ".csv",
            "path",
            str(path),
            "a response is saved as text; give a name that ends in .csv",
        )
        columns = [self.frequency, self.gain, self.phase, self.stderr]
        columns += [] if self.coherence is None else [self.coherence]
        rows = [",".join(map(repr, row)) for row in np.stack(columns, axis=1).tolist()]
        write_text(
            path,
            "\n".join([f"# {self.source}", self._header(len(columns)), *rows]) + "\n",
        )

    def _header(self, columns: int) -> str:
        unit = self.unit.replace(" ", "")
        return ",".join(COLUMNS[:columns]).replace("N/m", unit)

    def plot(self, ax: Any = None) -> Any:
        """Draw gain, phase and coherence with their errors, see
        `jaxmuscle.plot.frequency_response`; returns the figure."""
        return plot.frequency_response(self, ax)

    def _card(self) -> Card:
        f, gain, phase, shared = self.frequency, self.gain, self.phase, self.coherence
        error = f"{100 * np.median(self.stderr / gain):.2g} %"
        known = [
            ("source", self.source),
            (
                "gain",
                f"{gain.min():.4g} to {gain.max():.4g} {self.unit}, standard error {error}"
                " (median)",
            ),
            ("phase", f"{phase.min():.0f} to {phase.max():.0f} deg"),
        ]
        if shared is not None:
            low = int(np.argmin(shared))
            lowest = f"lowest {shared[low]:.2f} at {f[low]:.3g} Hz"
            known.append(("coherence", f"{np.median(shared):.2f} (median), {lowest}"))
        unseen = (
            "the force does not follow the displacement: no gain is larger than chance makes it."
            " Is this the channel that moved the insertion?"
        )
        notices = (*((unseen,) if self.p_none > UNSEEN else ()), *self.notices)
        known += [("notice", notice) for notice in notices]
        span = f"{f.size} frequencies from {f[0]:.3g} to {f[-1]:.3g} Hz"
        return facts(f"{self.name}: dynamic stiffness [{self.unit}], {span}", known, width=9)


def check_seen(response: FrequencyResponse, whose: str) -> None:
    """Raise a `ValueError` if chance alone explains a response: the force does not follow the
    displacement."""
    if response.p_none <= UNSEEN:
        return
    raise ValueError(
        f"{whose}: the force does not follow the displacement at any frequency: chance alone makes"
        f" a response this large with {probability(response.p_none)}. So it tells nothing of"
        " stiffness and damping. Check that the displacement is the channel that moved the"
        " insertion, and that one clock timed both. If they are right, move more or record longer."
        " The force alone is fitted with jaxmuscle.Isometric() (--task isometric)"
    )


def _column(
    name: str,
    given: Any,
    size: int | None,
    holds: Callable[[Any], Any],
    remedy: str,
    kind: type = float,
) -> Any:
    """A number for each frequency, of which all must hold."""
    try:
        values = np.array(given, dtype=kind)
    except (TypeError, ValueError):
        raise ValueError(f"{name}: give numbers, one for each frequency") from None
    right = values.ndim == 1 and values.size > 0 and size in (None, values.size)
    wanted = "a list of numbers" if size is None else f"{size} values, one for each frequency"
    require(right, f"{name} shape", values.shape, f"give {wanted}")
    wrong = np.flatnonzero(~holds(values))
    if wrong.size:
        raise ValueError(f"{name}, entry {wrong[0] + 1}: {values[wrong[0]]:g}: {remedy}")
    return frozen(values)


def _rises(f: Any) -> Any:
    return (f > 0) & (np.diff(f, prepend=0.0) > 0) & (f < np.inf)


def _is_usable(value: Any) -> Any:
    return np.isfinite(value) & (value != 0)
