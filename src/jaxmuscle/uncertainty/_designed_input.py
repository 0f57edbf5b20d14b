"""A motion that was designed: the signal for a motor, and what its record is expected to tell."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxmuscle import plot
from jaxmuscle._common.arrays import with_nulls
from jaxmuscle._common.cards import Printed, Result
from jaxmuscle._common.files import replacing, write_json
from jaxmuscle._common.text import folded
from jaxmuscle.data._perturbed import MARGIN
from jaxmuscle.model._parameters import PARAMETERS
from jaxmuscle.objective._derived import MEAN, TANGENTS

from ._identifiability_report import BASE
from ._lengthening import Lengthening
from ._multisine import speed_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure, SubFigure

USUAL = PARAMETERS["m_w"].default  # kg
FEWER_LINES = 1.6  # times as long as a part of a longer motion
SHORTEST = 1.0  # s of a record that are worth telling of
SHOWN = 2.0  # times the even density: where a design moves the most
DOUBTFUL = 0.3  # relative standard error
ENDURED = 3600.0  # s of a record
# a motion this much smaller, or this near to its limit
LIMITS, SMALLER = ("peak", "speed", "acceleration"), 0.9
MUCH, EXACT = 1.3, 0.05  # times as exact; a relative error that needs no other motion
LOOSE = 0.33  # a third of the usual prior, 1 in the logarithm
OPEN = (
    "  a quantity with a larger error than about 33 % will stay 'not determined' in the fit: its"
    " error must be at most a third of its prior's"
)
ASSUMED = (
    (
        "  assumed: two parts in series answer, as in the model. If the limb answers as one spring,"
        " the record tells its stiffness (tangent_stiffness), but not that of two parts"
    ),
    (
        "  assumed: no reflex. A reflex can change K_w0 by 10 to 55 %, and the fit does not notice:"
        " call it muscle plus reflex"
    ),
    (
        "  assumed: no fatigue. Split a long or strong hold into trials with rests between, and"
        " give all trials to one fit"
    ),
)
OF_MUSCLE = (*BASE.values(), *TANGENTS)


class DesignedInput(Printed, Result, eqx.Module):
    """A periodic motion of the insertion, made by `design_input`, and what one record of it is
    expected to tell.

    `quantity`, the names of what it was made for; `lengthening`, its lines; `even`, those of a flat
    motion: of even density in the band and as large as the same limits allow; `displacement` [m] at
    `time` [s], one period at `rate` [Hz], positive where the muscle gets longer (the motor pulls
    away from it: x_z = -displacement); `values` and `units` of every free parameter and derived
    quantity, and their standard errors in these units: `prior`, without any data; `now`, without
    the record; `flat`, with the flat motion; `stderr`, with this one; `by_seconds`, with records of
    it that have other lengths [s]; `needed`, the relative error that was asked for and the length
    [s] of the record that reaches it, or None; `notices`, what to know before; `elsewhere`, of each
    quantity that is hardly known so far: its value one standard error below and above, and the
    error that this motion gives there, both in its unit; `masses` [kg] that the given fit does not
    have free. Those among them that are `held` count as known: that fit has a moved record already,
    and had them fixed. All others are fitted with the new record; `wider`, a frequency [Hz] twice
    as high as the band's highest, and the errors with a flat motion up to there, or None; `moved`,
    whether a moved record is known already; `allowed`, the rms [m] that was asked for, and the
    largest displacement [m], speed [m/s] and acceleration [m/s²], infinite where there is no limit.
    """

    quantity: tuple[str, ...] = eqx.field(static=True)
    lengthening: Lengthening
    even: Lengthening
    displacement: Float[np.ndarray, " samples"]
    rate: float
    values: dict[str, float]
    units: dict[str, str] = eqx.field(static=True)
    now: dict[str, float]
    flat: dict[str, float]
    stderr: dict[str, float]
    by_seconds: dict[float, dict[str, float]]
    needed: tuple[float, float] | None
    notices: tuple[str, ...] = eqx.field(static=True, default=())
    elsewhere: dict[str, tuple[tuple[float, float], ...]] = eqx.field(default_factory=dict)
    masses: dict[str, float] = eqx.field(default_factory=dict)
    held: tuple[str, ...] = eqx.field(static=True, default=())
    prior: dict[str, float] = eqx.field(default_factory=dict)
    wider: tuple[float, dict[str, float]] | None = None
    moved: bool = eqx.field(static=True, default=False)
    allowed: tuple[float, float, float, float] = eqx.field(
        static=True, default=(0.0, np.inf, np.inf, np.inf)
    )

    @property
    def time(self) -> Float[np.ndarray, " samples"]:
        """Time of every sample [s]."""
        return np.arange(len(self.displacement)) / self.rate

    @property
    def frequency(self) -> Float[np.ndarray, " lines"]:
        """Frequencies of its lines [Hz]."""
        return self.lengthening.frequency

    @property
    def density(self) -> Float[np.ndarray, " lines"]:
        """One-sided density of the displacement [m²/Hz]."""
        return self.lengthening.power * self.lengthening.seconds

    @property
    def rms(self) -> float:
        """Root of the mean square of the displacement [m]."""
        return self.lengthening.rms

    @property
    def peak(self) -> float:
        """Largest displacement to either side [m]."""
        return float(np.max(np.abs(self.displacement)))

    @property
    def speed(self) -> float:
        """Largest speed [m/s]."""
        return float(np.max(np.abs(speed_of(self.displacement, self.lengthening.seconds))))

    @property
    def acceleration(self) -> float:
        """Largest acceleration [m/s²]."""
        period = self.lengthening.seconds
        return float(np.max(np.abs(speed_of(speed_of(self.displacement, period), period))))

    @property
    def gain(self) -> float:
        """Sum of the relative variances of the quantities with the flat motion, over that with this
        one."""
        flat, own = (
            sum((e[n] / (self.values[n] or 1.0)) ** 2 for n in self.quantity)
            for e in (self.flat, self.stderr)
        )
        return flat / own

    @property
    def moves(self) -> tuple[tuple[float, float, float], ...]:
        """Where the density is more than twice the even one: lowest and highest frequency [Hz],
        share of the mean square."""
        power = self.lengthening.power
        high = np.flatnonzero(power > SHOWN * np.mean(power))
        runs = [run for run in np.split(high, np.flatnonzero(np.diff(high) > 1) + 1) if len(run)]
        return tuple(
            (
                float(self.frequency[r[0]]),
                float(self.frequency[r[-1]]),
                float(np.sum(power[r]) / np.sum(power)),
            )
            for r in runs
        )

    @property
    def told(self) -> list[str]:
        """The quantities to be told of: those of the muscle, and what it was made for."""
        return list(
            dict.fromkeys(
                [*self.quantity, *(n for n in self.values if n.partition("@")[0] in OF_MUSCLE)]
            )
        )

    def percent(self, name: str, errors: dict[str, float]) -> float:
        """A standard error in percent of the value."""
        return 100 * errors[name] / abs(self.values[name])

    @property
    def window(self) -> tuple[float, float]:
        """From when to when a record is analysed [s]: whole periods of the motion, after half of
        one. One period, or as many as reach the error that was asked for; one period if that takes
        more than an hour."""
        period, seconds = self.lengthening.seconds, 0.0 if self.needed is None else self.needed[1]
        periods = max(1, int(np.ceil(seconds / period - 1e-9))) if seconds <= ENDURED else 1
        return period / 2, period / 2 + periods * period

    @property
    def played(self) -> float:
        """How long the motion is to be played [s]: to the end of the window, and a little longer,
        which a fit needs."""
        return self.window[1] + MARGIN

    def to_dict(self) -> dict[str, Any]:
        """As nested tables of numbers and strings, without the signal."""
        errors = {"prior": self.prior, "now": self.now, "flat": self.flat, "stderr": self.stderr}
        known = {
            n: {"value": v, "unit": self.units[n]} | {which: e[n] for which, e in errors.items()}
            for n, v in self.values.items()
        }
        return {
            "format": 1,
            "quantity": list(self.quantity),
            "gain": self.gain,
            "seconds": self.lengthening.seconds,
            "rate": self.rate,
            "rms": self.rms,
            "peak": self.peak,
            "speed": self.speed,
            "acceleration": self.acceleration,
            "by_seconds": [
                {"seconds": seconds, "stderr": errors}
                for seconds, errors in self.by_seconds.items()
            ],
            "needed": (
                None
                if self.needed is None
                else {"error": self.needed[0], "seconds": with_nulls(self.needed[1])}
            ),
            "frequency_hz": self.frequency.tolist(),
            "density": self.density.tolist(),
            "quantities": known,
            "elsewhere": {
                n: [
                    {"value": with_nulls(value), "stderr": with_nulls(error)}
                    for value, error in sides
                ]
                for n, sides in self.elsewhere.items()
            },
            "wider": None if self.wider is None else {"hz": self.wider[0], "stderr": self.wider[1]},
            "masses": {
                n: {"value": value, "fitted": n not in self.held}
                for n, value in self.masses.items()
            },
            "notices": list(self.notices),
        }

    def save(self, path: str | Path) -> None:
        """Write the signal for the motor as CSV (`time_s`, `displacement_mm`); `to_dict` where the
        name ends in .json."""
        if Path(path).suffix == ".json":
            return write_json(path, self.to_dict())
        made = (
            f"designed by jaxmuscle for {', '.join(self.quantity)}"
            if self.moves
            else "flat, made by jaxmuscle"
        )
        head = (
            f"one period of a lengthening of {self.lengthening.seconds:g} s, to be repeated;"
            f" positive: the muscle gets longer\nrms {1e3 * self.rms:.4g} mm, peak"
            f" {1e3 * self.peak:.4g} mm, {1e3 * self.speed:.4g} mm/s, {self.acceleration:.3g}"
            f" m/s^2; {made}"
        )
        with replacing(path) as temporary, temporary.open("w", encoding="utf-8") as file:
            file.write(
                "".join(f"# {line}\n" for line in head.splitlines()) + "time_s,displacement_mm\n"
            )
            np.savetxt(file, np.stack([self.time, 1e3 * self.displacement], axis=1), "%.7g", ",")
        return None

    def plot(self, ax: Any = None) -> "Figure | SubFigure":
        """Density, the beginning of the motion, and the expected errors, beside those of the flat
        one."""
        return plot.designed_input(self, ax)

    def __str__(self) -> str:
        low, high = self.frequency[0], self.frequency[-1]
        best = ", ".join(f"{n} to {_digits(self.percent(n, self.stderr))} %" for n in self.quantity)
        flat = ", ".join(f"{_digits(self.percent(n, self.flat))} %" for n in self.quantity)
        most = " and ".join(
            f"{100 * share:.0f} % at {a:.2g} to {b:.2g} Hz" for a, b, share in self.moves
        )
        rows = [
            f"    {n:<22}" + "".join(f"{_digits(self.percent(n, e)):>10}" for e in self._columns)
            for n in self.told
        ]
        names = " and ".join(filter(None, [", ".join(self.quantity[:-1]), self.quantity[-1]]))
        single = len(self.quantity) == 1
        square = (
            f"squared relative error of {names}"
            if single
            else f"sum of the squared relative errors of {names}"
        )
        return folded(
            [
                (
                    f"{'designed' if self.moves else 'flat'} motion: one more record of"
                    f" {self.lengthening.seconds:g} s would measure {best} (standard"
                    f" error{'s' * (not single)})"
                ),
                *self._vague(),
                *self._elsewhere(),
                *(f"  note: {notice}" for notice in self.notices),
                (
                    f"  a flat motion of {1e3 * self.even.rms:.3g} mm rms: {flat}. The {square} is"
                    f" then {self.gain:.2g} times as large"
                    if self.moves
                    else "  this motion is flat itself: no frequency is preferred"
                ),
                (
                    f"  lengthening of the muscle: {1e3 * self.rms:.3g} mm rms, at most"
                    f" {1e3 * self.peak:.3g} mm to either side, {1e3 * self.speed:.3g} mm/s and"
                    f" {self.acceleration:.2g} m/s², {low:.2g} to {high:.2g} Hz"
                ),
                *self._limited(),
                *[f"  most of the motion: {most}"] * bool(most),
                (
                    "  expected standard errors, in percent of the value (prior: without any data;"
                    " now: before this record):"
                ),
                f"    {'':<22}{'prior':>10}{'now':>10}{'flat':>10}"
                + f"{'designed':>10}" * bool(self.moves),
                *rows,
                *(
                    [OPEN]
                    if any(self.percent(n, self.stderr) > 100 * LOOSE for n in self.told)
                    else []
                ),
                *self._wider(),
                *self._by_duration(),
                *self._as_fitted(),
                *ASSUMED,
            ]
        )

    @property
    def _columns(self) -> tuple[dict[str, float], ...]:
        """The errors that are printed; a motion that is flat itself is no other one."""
        return (
            (self.prior, self.now, self.flat, self.stderr)
            if self.moves
            else (self.prior, self.now, self.stderr)
        )

    @property
    def _limit(self) -> str | None:
        """Which limit keeps the motion smaller than was asked for, by its option, or None."""
        rms, *limits = self.allowed
        reached = np.array([self.peak, self.speed, self.acceleration]) / limits
        return (
            LIMITS[int(np.argmax(reached))]
            if self.rms < SMALLER * rms and np.max(reached) > SMALLER
            else None
        )

    def _limited(self) -> list[str]:
        """Why the motion is smaller than was asked for."""
        limit = self._limit
        slower = ", or a band with lower frequencies" * (limit in LIMITS[1:])
        return [
            f"  the limit that you gave with --{limit} ({limit}=) keeps it below"
            f" {1e3 * self.allowed[0]:.3g} mm rms. A motor that can do more{slower} makes it larger"
        ] * (limit is not None)

    @property
    def _larger(self) -> str:
        """How a record gets to tell more."""
        return (
            "raise rms"
            if self._limit is None
            else f"take a motor that can do more (--{self._limit})"
        )

    def _wider(self) -> list[str]:
        """Whether a band twice as wide tells much more: up to 5 Hz a stiff muscle shows too little
        of its parts."""
        if self.wider is None or all(
            self.percent(n, self.stderr) < 100 * EXACT for n in self.quantity
        ):
            return []
        if all(self.flat[n] < MUCH * self.wider[1][n] for n in self.quantity):
            return []
        low, high = self.frequency[0], self.wider[0]
        told = " and ".join(
            f"{n} to {_digits(self.percent(n, self.wider[1]))} %" for n in self.quantity
        )
        return [
            f"  a flat motion up to {high:g} Hz would tell {told}. If your motor can do that,"
            f" design again with --band {low:.2g}:{high:g} (band=({low:.2g}, {high:g}))"
        ]

    def _by_duration(self) -> list[str]:
        """The errors by the length of the record, and how long it takes to reach the one that was
        asked for."""
        lines = []
        if self.by_seconds:
            heads = "".join(f"{f'{seconds:g} s':>10}" for seconds in self.by_seconds)
            lines += [
                "  the same for records of other lengths, in which the motion repeats:",
                f"    {'':<22}{heads}",
            ]
            lines += [
                f"    {n:<22}"
                + "".join(f"{_digits(self.percent(n, e)):>10}" for e in self.by_seconds.values())
                for n in self.told
            ]
        if self.needed is not None:
            error, seconds = self.needed
            goal = f"{' and '.join(self.quantity)} to {100 * error:.3g} % (standard error)"
            if not np.isfinite(seconds):
                return [
                    *lines,
                    (
                        f"  no length of the record tells {goal}: {self._larger}, or choose another"
                        " band"
                    ),
                ]
            if all(self.percent(name, self.now) <= 100 * error for name in self.quantity):
                return [*lines, f"  {goal}: what is known without this record is enough for that"]
            if seconds < SHORTEST:
                return [
                    *lines,
                    (
                        f"  {goal}: less than {SHORTEST:g} s of this motion would tell that. Play"
                        " one period"
                    ),
                ]
            if seconds > ENDURED:
                return [
                    *lines,
                    (
                        f"  to know {goal}, a record of {seconds / 3600:.2g} hours would be needed,"
                        f" which nobody holds: {self._larger}, or choose another band"
                    ),
                ]
            begin, end = self.window
            period, periods = (
                self.lengthening.seconds,
                round((end - begin) / self.lengthening.seconds),
            )
            if_so = ", if the muscle is like the one given here" if self._vague() else ""
            lines += [f"  to know {goal}, {seconds:.3g} s of record are enough{if_so}"]
            if periods > 1:
                lines[-1] += (
                    f": {periods} periods of this motion. Play {self.played:.3g} s and analyse"
                    f" {begin:.3g} to {end:.3g} s"
                )
            elif (shorter := float(np.ceil(FEWER_LINES * seconds))) < period:
                lines[-1] += (
                    f"; this motion lasts {period:.3g} s. To record less, design again with"
                    f" --seconds {shorter:g} (seconds={shorter:.1f}). That is longer than"
                    f" {seconds:.3g} s, since a shorter motion has fewer frequencies"
                )
            else:
                lines[-1] += (
                    f": one period of this motion. Play {self.played:.3g} s and analyse {begin:.3g}"
                    f" to {end:.3g} s"
                )
        return lines

    def _as_fitted(self) -> list[str]:
        """What the design takes from the fit, and what to do if that is doubtful."""
        mean = [self.values[name] for name in self.values if name.partition("@")[0] == MEAN]
        lines = [
            "  assumed: the muscle is the one given here"
            + f", with a mean force of {mean[0]:.3g} N" * bool(mean)
        ]
        if mean:
            lines[0] += (
                ". If you measured another mean force, fit with it first (mean and unit of the"
                " target)"
            )
        lines[0] += (
            ". If the person is softer and the force fluctuates as much, errors in percent are"
            " larger in proportion"
        )
        if "K_w0" in {name.partition("@")[0] for name in self.quantity}:
            lines += [
                "  assumed: the reference displacement x_ref_w. No record determines it, and the"
                " value of K_w0 depends on it. K_w_tangent, the stiffness as displaced in the hold,"
                " hardly depends on it (docs/perturbed.md, limits)"
            ]
        values = " and ".join(f"{name} = {value:.3g} kg" for name, value in self.masses.items())
        if "m_w" in self.held:
            lines += [
                "  assumed: the active mass m_w is right, as in the fit. No record determines it. A"
                " wrong m_w makes C_w0 and K_w0 wrong, too (docs/perturbed.md has by how much)"
            ]
        elif not self.held and any(value != USUAL for value in self.masses.values()):
            lines += [
                f"  assumed: {values}, as in this fit or preset. A held force tells no mass. Is m_z"
                " your estimate of what moves? Then go on. If not, fit with your estimate (--fix"
                f" m_w={USUAL:g} --fix m_z=KG) and design again. The fit of the new record leaves"
                f" both masses free, and starts them at {USUAL:g} kg"
            ]
        return lines

    def _vague(self) -> list[str]:
        """A motion designed for what is hardly known is none to begin with."""
        known = {name: self.percent(name, self.now) for name in self.quantity}
        vague = [
            (name, f"{_digits(percent)} %")
            for name, percent in known.items()
            if percent > 100 * DOUBTFUL
        ]
        what = (
            "This motion is flat, so it is a good one to begin with. Fit its record, and design"
            " again from that fit"
        )
        if self.moves:
            what = (
                "That is too vague for a design. First record a minute with a flat motion (--spread"
                " 1, spread=1.0). Fit it, and design again from that fit"
            )
        if self.moved:
            what = (
                "The moved record that was fitted did not tell more. So trust the errors below"
                " less, and try a wider band or a larger motion"
            )
        said = [
            f"{name} {'to' if i else 'is known only to'} {error}"
            for i, (name, error) in enumerate(vague)
        ]
        return [f"  so far {', '.join(said)}. {what}"] * bool(vague)

    def _elsewhere(self) -> list[str]:
        """What the record would tell if the muscle is not as fitted, as far as that is likely."""
        lines = []
        for name, sides in self.elsewhere.items():
            unit = "" if self.units[name] == "1" else f" {self.units[name]}"
            known = [(value, error) for value, error in sides if np.isfinite(value) and value != 0]
            may = " or ".join(f"{value:.3g}{unit}" for value, _ in known)
            to = " or ".join(f"{_digits(100 * error / abs(value))} %" for value, error in known)
            lines += [
                f"  {name} may well be {may} instead of {self.values[name]:.3g}{unit}. Then this"
                f" record would tell it to {to}"
            ] * bool(known)
        return lines


def _digits(percent: float) -> str:
    """Two digits, or all of a number above 100."""
    return f"{percent:.2g}" if percent < 99.5 else f"{percent:.0f}"
