"""The identifiability report: what is known now, what it would be with further measurements, in
words and tables."""

import re
import textwrap
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxmuscle import plot
from jaxmuscle._common.cards import Printed, Result
from jaxmuscle._common.files import write_json
from jaxmuscle._common.tables import frame
from jaxmuscle._common.text import WIDTH
from jaxmuscle.fits._part import ALIASES, RELATIVE, in_use
from jaxmuscle.objective._covariance import DETERMINED, spelt
from jaxmuscle.objective._derived import MEAN

if TYPE_CHECKING:
    import pandas
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure


COLUMNS, CELL = 4, 6  # designs beside each other, letters
PAIRS_TOLD = 3
TOGETHER = " together with "
SAME = 1e-6
FAR = 999  # percent
STRICTER = (
    "The fit is stricter: it also looks for other solutions, and at combinations that are open."
    " Believe the fit"
)
TIRING = (
    "fatigue is not considered: split a long or strong hold into short trials with rests between,"
    " and give all trials to one fit"
)
NO_NOISE = (
    "no further measurement is tried: the fit has no spectrum, so the noise that limits a"
    " measurement is not known. Fit the recording of both channels, or a spectrum beside the"
    " response (fit_joint)"
)
FITTED_TOO = "fitted in this measurement"
DOUBTED = "; in the column now also what the fit does not call determined"
OPENED = "; but fitted in those measurements whose details say so"
BASE = {"k_w": "K_w0", "k_z": "K_z0", "c_w": "C_w0", "c_z": "C_z0"}


class Known(eqx.Module):
    """How well a quantity is known: `stderr` by data and prior, `prior_sd` by the prior alone, both
    to first order.

    `determined` if the data leave at most a tenth of the prior's variance.
    """

    value: float
    unit: str
    stderr: float
    prior_sd: float
    determined: bool

    @property
    def left(self) -> float:
        """Share of the prior's standard deviation that is left."""
        return self.stderr / self.prior_sd

    def row(self) -> dict[str, Any]:
        """As columns of a table."""
        return {
            "value": self.value,
            "unit": self.unit,
            "stderr": self.stderr,
            "prior_sd": self.prior_sd,
            "left": self.left,
            "determined": self.determined,
        }

    @property
    def percent(self) -> str:
        """The standard error in percent of the value, or in its unit where the value has either
        sign."""
        if self.value > 0 and self.unit not in ("m", "rad"):
            return f"{100 * self.stderr / self.value:.2g} %"
        return f"{self.stderr:.2g} {self.unit}"


class Outlook(Printed, Result, eqx.Module):
    """What is known with the data of a design, or of several, added to the present ones.

    `task` and `data` in words; `separate`, the parameters that have other values there;
    `singular_values`: by how many of their standard errors the data move if the parameters change
    by a standard deviation of the prior along each direction; `determined`, how many directions are
    (singular value at least 3); `undetermined`, sentences: what can be scaled together unnoticed;
    `products` and ratios of parameters that are determined, with their relative standard errors;
    `quantities` by name, each with `value`, `unit`, `stderr` by data and prior, `prior_sd` by the
    prior alone, and whether it is `determined` (at most a tenth of the prior's variance is left);
    `gained`, those that become determined; `failed`, why the design is impossible, or None. An
    impossible design adds nothing: its numbers are those of the present data.
    """

    name: str
    task: str
    data: str
    separate: tuple[str, ...]
    singular_values: Float[np.ndarray, " free"]
    determined: int
    undetermined: tuple[str, ...]
    products: dict[str, float]
    quantities: dict[str, Known]
    gained: tuple[str, ...]
    failed: str | None

    @property
    def log_left(self) -> float:
        """Sum over all quantities of the logarithm of what is left of the prior's error: the lower,
        the more is known."""
        return float(sum(np.log(known.left) for known in self.quantities.values()))

    def __str__(self) -> str:
        if self.failed is not None:
            return f"{self.name} is impossible: {self.failed}"
        names = sorted(
            set(self.gained) & set(told(self.quantities)), key=lambda n: self.quantities[n].left
        )
        if not names:
            return f"{self.name} would determine no further quantity"
        parts = [f"{n} to {self.quantities[n].percent}" for n in names]
        listed = parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"
        return f"{self.name} would determine {listed}"

    def to_dict(self) -> dict[str, Any]:
        """As nested tables of numbers and strings."""
        return {
            "name": self.name,
            "task": self.task,
            "data": self.data,
            "separate": list(self.separate),
            "failed": self.failed,
            "singular_values": self.singular_values.tolist(),
            "determined": self.determined,
            "undetermined": list(self.undetermined),
            "products": self.products,
            "gained": list(self.gained),
            "quantities": {n: k.row() for n, k in self.quantities.items()},
        }


UNDESCRIBED = "the fit does not describe its data"


class IdentifiabilityReport(Printed, Result, eqx.Module):
    """What the data of a fit determine (`present`), and what they would with further `designs` or
    `pairs` of these.

    `target` and `free` name the data and the fitted parameters; the pairs are sorted, best first;
    `notices` of the fit; `mean_force` [N] of the fitted muscle where the data have no newtons:
    print states values per newton of it, as the fit does, and `to_dict` in newtons; `open_in_fit`,
    what is determined here and was not in the fit, which is stricter; `masses` [kg] that are taken
    as known.
    """

    target: str
    free: tuple[str, ...]
    present: Outlook
    designs: tuple[Outlook, ...]
    pairs: tuple[Outlook, ...]
    notices: tuple[str, ...]
    mean_force: float | None = None
    open_in_fit: tuple[str, ...] = ()
    masses: dict[str, float] = eqx.field(default_factory=dict)

    @property
    def telling_pairs(self) -> tuple[Outlook, ...]:
        """Pairs after which more quantities become determined than after any single design, best
        first."""
        most = max((len(design.gained) for design in self.designs), default=0)
        return tuple(pair for pair in self.pairs if len(pair.gained) > most)

    together: ClassVar[str] = TOGETHER
    threshold: ClassVar[float] = DETERMINED

    @staticmethod
    def letter(number: int) -> str:
        """What tables and figures call the design of that number: A, B, …"""
        return letter(number)

    @property
    def doubt(self) -> str:
        """What stands in red above the figure: nothing, or that the fit misses its data."""
        return (
            "The fit does not describe its data"
            if any(n.startswith(UNDESCRIBED) for n in self.notices)
            else ""
        )

    @property
    def told(self) -> list[str]:
        """Names of the quantities that tables and figures show."""
        return told(self.present.quantities)

    def to_dict(self) -> dict[str, Any]:
        """As nested tables of numbers and strings."""
        return {
            "format": 1,
            "target": self.target,
            "free": list(self.free),
            "threshold": DETERMINED,
            "present": self.present.to_dict(),
            "designs": [d.to_dict() for d in self.designs],
            "pairs": [d.to_dict() for d in self.pairs],
            "notices": list(self.notices),
            "not_determined_in_fit": list(self.open_in_fit),
            "masses": self.masses,
        }

    def to_dataframe(self) -> "pandas.DataFrame":
        """A row for each design ("" is the present data) and quantity.

        Columns: `design`, `quantity`, `value`, `unit`, `stderr`, `prior_sd`, the share `left` of
        it, `determined`.
        """
        known = {"": self.present, **{o.name: o for o in (*self.designs, *self.pairs)}}
        return frame(
            [
                {"design": design, "quantity": name, **quantity.row()}
                for design, outlook in known.items()
                for name, quantity in outlook.quantities.items()
            ]
        )

    def save(self, path: str | Path) -> None:
        """Write `to_dict` as JSON, atomically."""
        write_json(path, self.to_dict())

    def plot(self, ax: "Axes | None" = None) -> "Figure | SubFigure":
        """Singular values, and the standard errors of all quantities, now and with every design."""
        return plot.identifiability(self, ax)

    def __str__(self) -> str:
        return "\n".join([*_present(self), *_next(self), *_table(self), *_details(self)])


def told(quantities: dict[str, Known]) -> list[str]:
    """The quantities to be told of: K_j0 and C_j0 stand for the k_j and c_j to which they are
    proportional.

    What has two names, as the tremor's frequency, is told by the one that people use.
    """
    twins = {
        k: base for k, base in (BASE | ALIASES).items() if k in quantities and base in quantities
    }
    doubled = {
        k for k, base in twins.items() if abs(quantities[k].left - quantities[base].left) < SAME
    }
    return [name for name in quantities if name not in doubled]


def letter(number: int) -> str:
    """A, B, ... Z, A1, B1, ..."""
    return chr(ord("A") + number % 26) + (str(number // 26) if number >= 26 else "")


def _wrapped(text: str, indent: int, first: str | None = None) -> list[str]:
    start = " " * indent if first is None else first
    return textwrap.wrap(
        text,
        WIDTH,
        initial_indent=start,
        subsequent_indent=" " * max(indent, len(start)),
        break_long_words=False,
        break_on_hyphens=False,
    )


def _present(report: IdentifiabilityReport) -> list[str]:
    now = report.present
    lines = _wrapped(f"what the data of {report.target} determine", 2, "")
    lines += _wrapped(f"{now.task}; {now.data}", 2)
    for notice in report.notices:
        lines += _wrapped(notice, 4, "  note: ")
    lines += _wrapped(
        f"{now.determined} of {len(report.free)} combinations of the parameters are determined:"
        f" those left of the bar, with a singular value of {DETERMINED:g} or more",
        4,
        "  ",
    )
    values = [f"{v:.3g}" for v in now.singular_values]
    lines += _wrapped("  ".join([*values[: now.determined], "|", *values[now.determined :]]), 4)
    if now.products:
        lines += _wrapped(
            f"determined parameters, products and ratios, with standard errors: {_products(now)}",
            4,
            "  ",
        )
    if doubted := [name for name in told(now.quantities) if name in report.open_in_fit]:
        lines += _wrapped(
            f"known here, but not determined in the fit: {', '.join(doubted)}. {STRICTER}", 4, "  "
        )
    if now.undetermined:
        lines += ["  the data leave open:"]
        for sentence in now.undetermined:
            lines += _wrapped(sentence, 6, "    - ")
    return lines


def _as_people_say(product: str) -> str:
    """A product of parameters by the names of the table above it."""
    return re.sub(r"\w+", lambda word: in_use(word[0]) or word[0], spelt(product))


def _products(outlook: Outlook) -> str:
    return ", ".join(
        f"{_as_people_say(name)} (± {100 * error:.2g} %)"
        for name, error in outlook.products.items()
    )


def _next(report: IdentifiabilityReport) -> list[str]:
    """The answer before its details: what each measurement would tell, and which one tells most."""
    if not report.designs:
        return []
    free = len(report.free)
    lines = ["  what to measure next:"]
    if (best := _most(report, (*report.designs, *report.pairs))) is not None:
        count = free - best.determined
        rest = (
            f"{count} of {free} combinations would stay open"
            if count
            else "nothing would stay open"
        )
        letters = _letters(report, best)
        if len(letters) > 1 and (single := _most(report, report.designs)) is not None:
            rest += (
                f". If you make only one: {_letters(report, single)[0]} ({free - single.determined}"
                " would stay open)"
            )
        both = zip(letters, best.name.split(TOGETHER), strict=False)
        what = (
            f"{letters[0]}, {best.name}"
            if len(letters) == 1
            else TOGETHER.join(f"{at} ({name})" for at, name in both)
        )
        lines += _wrapped(f"most would be learnt from {what}: {rest}", 4)
    for number, design in enumerate(report.designs):
        count = "" if design.failed else f" ({design.determined} of {free} combinations determined)"
        lines += _wrapped(f"{design}{count}", 8, f"    {letter(number):<2}  ")
    for pair in report.telling_pairs[:PAIRS_TOLD]:
        label = "+".join(_letters(report, pair))
        lines += _wrapped(str(pair).replace(pair.name, "both together"), 8, f"    {label:<3} ")
    return lines + _wrapped(TIRING, 4)


def _letters(report: IdentifiabilityReport, outlook: Outlook) -> list[str]:
    """The letters of a design, or of the two of a pair."""
    alone = [letter(i) for i, design in enumerate(report.designs) if design.name == outlook.name]
    return alone or [
        letter(i) for i, d in enumerate(report.designs) if d.name in outlook.name.split(TOGETHER)
    ]


def _details(report: IdentifiabilityReport) -> list[str]:
    """Task and data of each measurement."""
    lines = ["  the measurements in detail:"] if report.designs else []
    for number, design in enumerate(report.designs):
        values = "values" if len(design.separate) > 1 else "value"
        own = f"; with its own {values} of {', '.join(design.separate)}" if design.separate else ""
        lines += _wrapped(f"{design.task}; {design.data}{own}", 8, f"    {letter(number):<2}  ")
    return lines


def _table(report: IdentifiabilityReport) -> list[str]:
    """Standard errors of every quantity by the prior, now, and with each design; those of open
    quantities in brackets."""
    names = told(report.present.quantities)
    possible = [(letter(i), d) for i, d in enumerate(report.designs) if d.failed is None]
    wide = max(24, *(1 + len(name) for name in names))
    doubted, added = (
        DOUBTED * bool(report.open_in_fit),
        ". A, B, ...: with that measurement added" * bool(possible),
    )
    lines = _wrapped(
        "standard errors in percent of the value. In brackets: not determined, since about a third"
        f" or more of the error without data is left{doubted}. >>: {FAR} % or more. prior: without"
        f" data. now: with the data of the fit{added}",
        4,
        "  ",
    )
    if report.mean_force is not None:
        lines += _wrapped(
            "no mean force in newtons was given: forces, stiffness and damping are stated per"
            f" newton of mean force (that of the fitted muscle is {report.mean_force:.3g} N)",
            4,
            "  ",
        )
    elif report.masses:
        known = ", ".join(f"{name} = {value:.3g} kg" for name, value in report.masses.items())
        opened = OPENED * any(FITTED_TOO in outlook.data for outlook in report.designs)
        lines += _wrapped(f"taken as known, as in the fit: {known}{opened}", 4, "  ")
    # two more stand before them
    across = min(COLUMNS, (WIDTH - wide - 17) // CELL - 2)
    for start in range(0, max(len(possible), 1), across):
        block = possible[start : start + across]
        heads = ["prior", "now", *(label for label, _ in block)]
        lines.append(
            f"  {'':<{wide}}{'value':>9} {'unit':<5}" + "".join(f"{head:>6}" for head in heads)
        )
        for name in names:
            now = report.present.quantities[name]
            here = f"({_cell(now, now.stderr)})" if name in report.open_in_fit else _shown(now)
            cells = [
                f"({_cell(now, now.prior_sd)})",
                here,
                *(_shown(d.quantities[name]) for _, d in block),
            ]
            value, unit = _stated(now, None if name == MEAN else report.mean_force)
            lines.append(
                f"  {name:<{wide}}{value:>9.3g} {unit:<5}" + "".join(f"{cell:>6}" for cell in cells)
            )
    return lines


def _stated(known: Known, mean_force: float | None) -> tuple[float, str]:
    """Value and unit as the fit prints them."""
    value, unit = known.value, known.unit
    if mean_force is not None and unit in RELATIVE:
        value, unit = value / mean_force, RELATIVE[unit]
    return value, "" if unit == "1" else unit


def _shown(known: Known) -> str:
    cell = _cell(known, known.stderr)
    return cell if known.determined else f"({cell})"


def _cell(known: Known, error: float) -> str:
    share = 100 * error / abs(known.value) if known.value else np.inf
    return f"{share:.2g}" if share < 99.5 else f"{share:.0f}" if share < FAR else ">>"


def _most(report: IdentifiabilityReport, outlooks: Iterable[Outlook]) -> Outlook | None:
    """What determines most; among equals one measurement before two, then that with the smaller
    errors."""
    alone = {design.name for design in report.designs}
    possible = [outlook for outlook in outlooks if outlook.failed is None]
    return max(
        possible,
        key=lambda o: (o.determined, len(o.gained), o.name in alone, -o.log_left),
        default=None,
    )
