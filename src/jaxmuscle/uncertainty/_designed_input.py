"""A motion that was designed: the signal for a motor, and what its record is expected to tell."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import equinox as eqx
import numpy as np

from jaxmuscle import plot
from jaxmuscle._common.cards import Printed, Result
from jaxmuscle._common.files import nulled, replacing, write_json
from jaxmuscle._common.text import folded
from jaxmuscle.data._perturbed import MARGIN
from jaxmuscle.model._parameters import PARAMETERS
from jaxmuscle.objective._derived import MEAN, TANGENTS

from ._identifiability_report import BASE
from ._lengthening import Lengthening, Lines, Samples
from ._multisine import Motion, derivatives

if TYPE_CHECKING:
    from matplotlib.figure import Figure, SubFigure

USUAL = PARAMETERS["m_w"].default  # kg
SHOWN = 2.0  # times the even density: where a design moves the most
DOUBTFUL = 0.3  # relative standard error
ENDURED = 3600.0  # s of a record
# a motion this much smaller, or this near to its limit
LIMITS, SMALLER = ("peak", "speed", "acceleration"), 0.9
LOOSE = 0.33  # a third of the usual prior, 1 in the logarithm
# What is printed, by what it is about.
WORDS = {
    "heading": (
        "{kind} motion: one more record of {seconds:g} s would measure {best} (standard error{s})"
    ),
    "vague": "  so far {name} is known only to {error}{others}. {advice}",
    "gain": (
        "  a flat motion of {rms:.3g} mm rms: {flat}. The {square} is then {gain:.2g} times as"
        " large"
    ),
    "is flat": "  this motion is flat itself: no frequency is preferred",
    "motion": (
        "  lengthening of the muscle: {rms:.3g} mm rms, at most {peak:.3g} mm to either side,"
        " {speed:.3g} mm/s and {acceleration:.2g} m/s², {low:.2g} to {high:.2g} Hz"
    ),
    "limited": (
        "  the limit that you gave with --{limit} ({limit}=) keeps it below {rms:.3g} mm rms. A"
        " motor that can do more{slower} makes it larger"
    ),
    "most": "  most of the motion: {most}",
    "errors": (
        "  expected standard errors, in percent of the value (prior: without any data; now: before"
        " this record):"
    ),
    "open": (
        "  a quantity with a larger error than about 33 % will stay 'not determined' in the fit:"
        " its error must be at most a third of its prior's"
    ),
}
# The record that reaches the error that was asked for.
GOAL = {
    "no record": ("  no record that a person holds tells {goal}: {larger}, or choose another band"),
    "is known": "  {goal}: what is known without this record is enough for that",
    "enough": (
        "  to know {goal}, {seconds:.3g} s of record are enough{if_so}; the motion repeats after"
        " {period:.3g} s. Play {played:.3g} s and analyse {begin:.3g} to {end:.3g} s"
    ),
}
ADVICE = {
    "flat": (
        "This motion is flat, so it is a good one to begin with. Fit its record, and design again"
        " from that fit"
    ),
    "designed": (
        "That is too vague for a design. First record a minute with a flat motion (--spread 1,"
        " spread=1.0). Fit it, and design again from that fit"
    ),
    "moved": (
        "The moved record that was fitted did not tell more. So trust the errors below less, and"
        " try a wider band or a larger motion"
    ),
}
ASSUMED = {
    "muscle": (
        "  assumed: the muscle is the one given here{mean}. If the person is softer and the force"
        " fluctuates as much, errors in percent are larger in proportion"
    ),
    "mean": (
        ", with a mean force of {:.3g} N. If you measured another mean force, fit with it first"
        " (mean and unit of the target)"
    ),
    "x_ref_w": (
        "  assumed: the reference displacement x_ref_w. No record determines it, and the value of"
        " K_w0 depends on it. K_w_tangent, the stiffness as displaced in the hold, hardly depends"
        " on it (docs/perturbed.md, limits)"
    ),
    "m_w": (
        "  assumed: the active mass m_w is right, as in the fit. No record determines it. A wrong"
        " m_w makes C_w0 and K_w0 wrong, too (docs/perturbed.md has by how much)"
    ),
    "masses": (
        "  assumed: {masses}, as in this fit or preset. A held force tells no mass. Is m_z your"
        " estimate of what moves? Then go on. If not, fit with your estimate (--fix m_w={usual:g}"
        " --fix m_z=KG) and design again. The fit of the new record leaves both masses free, and"
        " starts them at {usual:g} kg"
    ),
}
ALWAYS_ASSUMED = (
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
HEAD = """\
# one period of a lengthening of {seconds:g} s, to be repeated; positive: the muscle gets longer
# rms {rms:.4g} mm, peak {peak:.4g} mm, {speed:.4g} mm/s, {acceleration:.3g} m/s^2; {made}
time_s,displacement_mm
"""
NAME = "    {:<22}"  # of a quantity, before its errors
OF_MUSCLE = (*BASE.values(), *TANGENTS)
Errors = dict[str, float]  # of quantities, in their units


class DesignedInput(Printed, Result, eqx.Module):
    """A periodic motion of the insertion, made by `design_input`, and what one record of it is
    expected to tell.

    `quantity`, the names of what it was made for; `asked`, its limits, band, length and rate;
    `lengthening`, its lines; `even`, those of a flat motion: of even density in the band and as
    large as the same limits allow; `displacement` [m] at `time` [s], one period, positive where the
    muscle gets longer (the motor pulls away from it: x_z = -displacement); `values` and `units` of
    every free parameter and derived quantity, and their standard errors in these units: `prior`,
    without any data; `now`, without the record; `flat`, with the flat motion; `stderr`, with this
    one; `needed`, the relative error that was asked for and the length [s] of the record that
    reaches it, or None; `notices`, what to know before; `masses` [kg] that the given fit does not
    have free. Those among them that are `held` count as known: that fit has a moved record already,
    and had them fixed. All others are fitted with the new record; `moved`, whether a moved record
    is known already.
    """

    quantity: tuple[str, ...] = eqx.field(static=True)
    asked: Motion = eqx.field(static=True)
    lengthening: Lengthening
    even: Lengthening
    displacement: Samples
    values: dict[str, float]
    units: dict[str, str] = eqx.field(static=True)
    prior: Errors
    now: Errors
    flat: Errors
    stderr: Errors
    needed: tuple[float, float] | None
    notices: tuple[str, ...] = eqx.field(static=True, default=())
    masses: dict[str, float] = eqx.field(default_factory=dict)
    held: tuple[str, ...] = eqx.field(static=True, default=())
    moved: bool = eqx.field(static=True, default=False)

    @property
    def time(self) -> Samples:
        """Time of every sample [s]."""
        return np.arange(len(self.displacement)) / self.asked.rate

    @property
    def frequency(self) -> Lines:
        """Frequencies of its lines [Hz]."""
        return self.lengthening.frequency

    @property
    def density(self) -> Lines:
        """One-sided density of the displacement [m²/Hz]."""
        return self.lengthening.power * self.lengthening.seconds

    @property
    def rms(self) -> float:
        """Root of the mean square of the displacement [m]."""
        return self.lengthening.rms

    @property
    def peak(self) -> float:
        """Largest displacement to either side [m]."""
        return self._largest[0]

    @property
    def speed(self) -> float:
        """Largest speed [m/s]."""
        return self._largest[1]

    @property
    def acceleration(self) -> float:
        """Largest acceleration [m/s²]."""
        return self._largest[2]

    @property
    def _largest(self) -> list[float]:
        """Largest displacement [m], speed [m/s] and acceleration [m/s²] to either side."""
        moved = derivatives(self.displacement, self.lengthening.seconds)
        return np.max(np.abs(moved), axis=1).tolist()

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
        power, f = self.lengthening.power, self.frequency
        high = np.flatnonzero(power > SHOWN * np.mean(power))
        runs = [run for run in np.split(high, np.flatnonzero(np.diff(high) > 1) + 1) if len(run)]
        shares = (float(np.sum(power[run]) / np.sum(power)) for run in runs)
        return tuple(
            (float(f[run[0]]), float(f[run[-1]]), share)
            for run, share in zip(runs, shares, strict=True)
        )

    @property
    def names(self) -> list[str]:
        """The quantities to be told of: those of the muscle, and what it was made for."""
        of_muscle = [n for n in self.values if n.partition("@")[0] in OF_MUSCLE]
        return list(dict.fromkeys([*self.quantity, *of_muscle]))

    def percent(self, name: str, errors: Errors) -> float:
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

    @property
    def _size(self) -> dict[str, float]:
        """The size of the motion in the units that are printed."""
        return {
            "rms": 1e3 * self.rms,
            "peak": 1e3 * self.peak,
            "speed": 1e3 * self.speed,
            "acceleration": self.acceleration,
        }

    def to_dict(self) -> dict[str, Any]:
        """As nested tables of numbers and strings, without the signal."""
        own = ("rms", "peak", "speed", "acceleration")
        errors = {which: getattr(self, which) for which in ("prior", "now", "flat", "stderr")}
        table = {
            "format": 1,
            "quantity": self.quantity,
            "gain": self.gain,
            "seconds": self.lengthening.seconds,
            "rate": self.asked.rate,
            **{name: getattr(self, name) for name in own},
            "needed": self.needed and dict(zip(("error", "seconds"), self.needed, strict=True)),
            "frequency_hz": self.frequency,
            "density": self.density,
            "quantities": {
                n: {"value": v, "unit": self.units[n]}
                | {which: e[n] for which, e in errors.items()}
                for n, v in self.values.items()
            },
            "masses": {
                n: {"value": v, "fitted": n not in self.held} for n, v in self.masses.items()
            },
            "notices": self.notices,
        }
        return nulled(table)

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
        with replacing(path) as temporary, temporary.open("w", encoding="utf-8") as file:
            file.write(HEAD.format(seconds=self.lengthening.seconds, made=made, **self._size))
            np.savetxt(file, np.stack([self.time, 1e3 * self.displacement], axis=1), "%.7g", ",")
        return None

    def plot(self, ax: Any = None) -> "Figure | SubFigure":
        """Density, the beginning of the motion, and the expected errors, beside those of the flat
        one."""
        return plot.designed_input(self, ax)

    def __str__(self) -> str:
        return folded(
            [
                *self._heading(),
                *self._motion(),
                *self._table(),
                *self._goal(),
                *self._as_fitted(),
                *ALWAYS_ASSUMED,
            ]
        )

    def _in_percent(self, errors: Errors, words: str = "{} to {} %") -> list[str]:
        """The error of every quantity that it was made for."""
        return [words.format(n, _digits(self.percent(n, errors))) for n in self.quantity]

    def _heading(self) -> list[str]:
        """What the record would tell, and how well the muscle is known so far."""
        lines = [
            WORDS["heading"].format(
                kind="designed" if self.moves else "flat",
                seconds=self.lengthening.seconds,
                best=", ".join(self._in_percent(self.stderr)),
                s="s" * (len(self.quantity) > 1),
            )
        ]
        if vague := self._vague:
            (name, error), *others = vague
            others = "".join(f", {n} to {e}" for n, e in others)
            advice = ADVICE["moved" if self.moved else "designed" if self.moves else "flat"]
            about = {"name": name, "error": error, "others": others, "advice": advice}
            lines += [WORDS["vague"].format(**about)]
        return lines + [f"  note: {notice}" for notice in self.notices]

    @property
    def _vague(self) -> list[tuple[str, str]]:
        """What is hardly known so far, with its error: a motion designed for it is none to begin
        with."""
        known = {name: self.percent(name, self.now) for name in self.quantity}
        return [(n, f"{_digits(e)} %") for n, e in known.items() if e > 100 * DOUBTFUL]

    def _motion(self) -> list[str]:
        """The motion beside the flat one: where it moves, and what limits it."""
        gain = "is flat"
        about: dict[str, Any] = {}
        if self.moves:
            gain, names = (
                "gain",
                " and ".join(filter(None, [", ".join(self.quantity[:-1]), self.quantity[-1]])),
            )
            square = (
                "squared relative error of"
                if len(self.quantity) == 1
                else "sum of the squared relative errors of"
            )
            flat = ", ".join(self._in_percent(self.flat, "{1} %"))
            about = {
                "rms": 1e3 * self.even.rms,
                "flat": flat,
                "square": f"{square} {names}",
                "gain": self.gain,
            }
        lines = [WORDS[gain].format(**about)]
        low, high = self.frequency[0], self.frequency[-1]
        lines += [WORDS["motion"].format(low=low, high=high, **self._size)]
        if (limit := self._limit) is not None:
            slower = ", or a band with lower frequencies" * (limit in LIMITS[1:])
            rms = 1e3 * self.asked.rms
            lines += [WORDS["limited"].format(limit=limit, rms=rms, slower=slower)]
        most = " and ".join(
            f"{100 * share:.0f} % at {a:.2g} to {b:.2g} Hz" for a, b, share in self.moves
        )
        return lines + [WORDS["most"].format(most=most)] * bool(most)

    @property
    def _limit(self) -> str | None:
        """Which limit keeps the motion smaller than was asked for, by its option, or None."""
        size = np.array([self.peak, self.speed, self.acceleration])
        reached = size / self.asked.limits
        limited = self.rms < SMALLER * self.asked.rms and np.max(reached) > SMALLER
        return LIMITS[int(np.argmax(reached))] if limited else None

    def _table(self) -> list[str]:
        """The expected errors; a motion that is flat itself is no other one."""
        columns = {"prior": self.prior, "now": self.now, "flat": self.stderr}
        if self.moves:
            columns |= {"flat": self.flat, "designed": self.stderr}
        loose = any(self.percent(n, self.stderr) > 100 * LOOSE for n in self.names)
        heads = NAME.format("") + "".join(f"{head:>10}" for head in columns)
        rows = [
            NAME.format(n)
            + "".join(f"{_digits(self.percent(n, errors)):>10}" for errors in columns.values())
            for n in self.names
        ]
        return [WORDS["errors"], heads, *rows, *[WORDS["open"]] * loose]

    def _goal(self) -> list[str]:
        """How long a record takes to reach the error that was asked for."""
        if self.needed is None:
            return []
        error, seconds = self.needed
        (begin, end), period = self.window, self.lengthening.seconds
        known = all(self.percent(n, self.now) <= 100 * error for n in self.quantity)
        case = "is known" if known else "enough" if seconds <= ENDURED else "no record"
        about = {
            "goal": f"{' and '.join(self.quantity)} to {100 * error:.3g} % (standard error)",
            "larger": (
                "raise rms"
                if self._limit is None
                else f"take a motor that can do more (--{self._limit})"
            ),
            "if_so": ", if the muscle is like the one given here" * bool(self._vague),
            "seconds": seconds,
            "played": self.played,
        }
        return [GOAL[case].format(begin=begin, end=end, period=period, **about)]

    def _as_fitted(self) -> list[str]:
        """What the design takes from the fit, and what to do if that is doubtful."""
        mean = [self.values[name] for name in self.values if name.partition("@")[0] == MEAN]
        masses = " and ".join(f"{name} = {value:.3g} kg" for name, value in self.masses.items())
        cases = {
            "muscle": True,
            "x_ref_w": "K_w0" in {name.partition("@")[0] for name in self.quantity},
            "m_w": "m_w" in self.held,
            "masses": not self.held and any(value != USUAL for value in self.masses.values()),
        }
        about = {
            "mean": ASSUMED["mean"].format(*mean) if mean else "",
            "masses": masses,
            "usual": USUAL,
        }
        return [ASSUMED[case].format(**about) for case, is_so in cases.items() if is_so]


def _digits(percent: float) -> str:
    """Two digits, or all of a number above 100."""
    return f"{percent:.2g}" if percent < 99.5 else f"{percent:.0f}"
