"""The identifiability report: what is known now, what it would be with further measurements, in
words and tables."""

import dataclasses
import re
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxmuscle import plot
from jaxmuscle._common.cards import Printed, Result
from jaxmuscle._common.files import nulled, write_json
from jaxmuscle._common.tables import frame
from jaxmuscle._common.text import WIDTH
from jaxmuscle.fits._result import ALIASES, RELATIVE, in_use
from jaxmuscle.objective._covariance import DETERMINED, spelt
from jaxmuscle.objective._derived import MEAN

if TYPE_CHECKING:
    import pandas
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure


COLUMNS, CELL = 4, 6  # designs beside each other, letters
SAME = 1e-6
FAR = 999  # percent
Names = tuple[str, ...]
# What is printed, by what it is about.
WORDS = {
    "heading": "what the data of {target} determine",
    "combinations": (
        "{count} of {free} combinations of the parameters are determined: those left of the bar,"
        " with a singular value of {threshold:g} or more"
    ),
    "products": "determined parameters, products and ratios, with standard errors: {products}",
    "doubted": (
        "known here, but not determined in the fit: {names}. The fit is stricter: it also looks for"
        " other solutions, and at combinations that are open. Believe the fit"
    ),
    "most": "most would be learnt from {letter}, {name}: {rest}",
    "open": "{count} of {free} combinations would stay open",
    "closed": "nothing would stay open",
    "design": "{design} ({count} of {free} combinations determined)",
    "tiring": (
        "fatigue is not considered: split a long or strong hold into short trials with rests"
        " between, and give all trials to one fit"
    ),
    "separate": "; with its own values of {names}",
    "errors": (
        "standard errors in percent of the value. In brackets: not determined, since about a third"
        " or more of the error without data is left{doubted}. >>: {far} % or more. prior: without"
        " data. now: with the data of the fit{added}"
    ),
    "also doubted": "; in the column now also what the fit does not call determined",
    "added": ". A, B, ...: with that measurement added",
    "per newton": (
        "no mean force in newtons was given: forces, stiffness and damping are stated per newton of"
        " mean force"
    ),
    "masses": "taken as known, as in the fit: {masses}{opened}",
    "opened": "; but fitted in a record of a moved insertion",
}
NO_NOISE = (
    "no further measurement is tried: the fit has no spectrum, so the noise that limits a"
    " measurement is not known. Fit the recording of both channels, or a spectrum beside the"
    " response (fit of several targets)"
)
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
        return dataclasses.asdict(self) | {"left": self.left}

    @property
    def percent(self) -> str:
        """The standard error in percent of the value, or in its unit where the value has either
        sign."""
        if self.value > 0 and self.unit not in ("m", "rad"):
            return f"{100 * self.stderr / self.value:.2g} %"
        return f"{self.stderr:.2g} {self.unit}"


class Outlook(Printed, Result, eqx.Module):
    """What is known with the data of a design added to the present ones.

    `separate`, the parameters that have other values there; `masses_open`, whether the masses are
    fitted with it; `singular_values`: by how many of their standard errors the data move if the
    parameters change by a standard deviation of the prior along each direction; `determined`, how
    many directions are (singular value at least 3); `undetermined`, sentences: what can be scaled
    together unnoticed; `products` and ratios of parameters that are determined, with their relative
    standard errors; `quantities` by name, each with `value`, `unit`, `stderr` by data and prior,
    `prior_sd` by the prior alone, and whether it is `determined` (at most a tenth of the prior's
    variance is left); `gained`, those that become determined; `failed`, why the design is
    impossible, or None. An impossible design adds nothing: its numbers are those of the present
    data.
    """

    name: str
    singular_values: Float[np.ndarray, " free"]
    determined: int
    undetermined: Names
    products: dict[str, float]
    quantities: dict[str, Known]
    gained: Names
    separate: Names = ()
    masses_open: bool = False
    failed: str | None = None

    @property
    def log_left(self) -> float:
        """Sum over all quantities of the logarithm of what is left of the prior's error: the lower,
        the more is known."""
        return float(sum(np.log(known.left) for known in self.quantities.values()))

    def __str__(self) -> str:
        if self.failed is not None:
            return f"{self.name} is impossible: {self.failed}"
        gained = [name for name in names_to_show(self.quantities) if name in self.gained]
        gained.sort(key=lambda name: self.quantities[name].left)
        if not gained:
            return f"{self.name} would determine no further quantity"
        *most, last = (f"{name} to {self.quantities[name].percent}" for name in gained)
        return f"{self.name} would determine {' and '.join(filter(None, (', '.join(most), last)))}"

    def to_dict(self) -> dict[str, Any]:
        """As nested tables of numbers and strings."""
        rows = {name: known.row() for name, known in self.quantities.items()}
        return nulled(dataclasses.asdict(self)) | {"quantities": rows}


UNDESCRIBED = "the fit does not describe its data"


class IdentifiabilityReport(Printed, Result, eqx.Module):
    """What the data of a fit determine (`present`), and what they would with each of further
    `designs`.

    `target` and `free` name the data and the fitted parameters; `notices` of the fit; `mean_force`
    [N] of the fitted muscle where the data have no newtons: print states values per newton of it,
    as the fit does, and `to_dict` in newtons; `open_in_fit`, what is determined here and was not in
    the fit, which is stricter; `masses` [kg] that are taken as known.
    """

    target: str
    free: Names
    present: Outlook
    designs: tuple[Outlook, ...]
    notices: Names
    mean_force: float | None = None
    open_in_fit: Names = ()
    masses: dict[str, float] = eqx.field(default_factory=dict)

    threshold: ClassVar[float] = DETERMINED

    @staticmethod
    def letter(number: int) -> str:
        """What tables and figures call the design of that number: A, B, …"""
        return letter(number)

    @property
    def doubt(self) -> str:
        """What stands in red above the figure: nothing, or that the fit misses its data."""
        undescribed = any(notice.startswith(UNDESCRIBED) for notice in self.notices)
        return "The fit does not describe its data" * undescribed

    @property
    def names(self) -> list[str]:
        """Names of the quantities that tables and figures show."""
        return names_to_show(self.present.quantities)

    def to_dict(self) -> dict[str, Any]:
        """As nested tables of numbers and strings."""
        return {
            "format": 1,
            "target": self.target,
            "free": list(self.free),
            "threshold": DETERMINED,
            "present": self.present.to_dict(),
            "designs": [d.to_dict() for d in self.designs],
            "notices": list(self.notices),
            "not_determined_in_fit": list(self.open_in_fit),
            "masses": self.masses,
        }

    def to_dataframe(self) -> "pandas.DataFrame":
        """A row for each design ("" is the present data) and quantity.

        Columns: `design`, `quantity`, `value`, `unit`, `stderr`, `prior_sd`, `determined`, and
        `left`, the share of the prior's standard deviation that is left.
        """
        known = [("", self.present), *((o.name, o) for o in self.designs)]
        return frame(
            [
                {"design": design, "quantity": name, **quantity.row()}
                for design, outlook in known
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
        return "\n".join([*_present(self), *_next(self), *_table(self)])


def names_to_show(quantities: dict[str, Known]) -> list[str]:
    """The quantities to be told of: K_j0 and C_j0 stand for the k_j and c_j to which they are
    proportional.

    What has two names, as the tremor's frequency, is told by the one that people use.
    """
    left = {name: known.left for name, known in quantities.items()}
    twins = {k: base for k, base in (BASE | ALIASES).items() if k in left and base in left}
    doubled = {k for k, base in twins.items() if abs(left[k] - left[base]) < SAME}
    return [name for name in quantities if name not in doubled]


def letter(number: int) -> str:
    """A, B, ... Z, A1, B1, ..."""
    again, place = divmod(number, 26)
    return chr(ord("A") + place) + (str(again) if again else "")


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


def _item(text: str) -> list[str]:
    """A sentence of the report, two columns further in than its heading."""
    return _wrapped(text, 4, "  ")


def _present(report: IdentifiabilityReport) -> list[str]:
    now, count = report.present, report.present.determined
    lines = _wrapped(WORDS["heading"].format(target=report.target), 2, "")
    for notice in report.notices:
        lines += _wrapped(notice, 4, "  note: ")
    about = {"count": count, "free": len(report.free), "threshold": DETERMINED}
    lines += _item(WORDS["combinations"].format(**about))
    values = [f"{v:.3g}" for v in now.singular_values]
    lines += _wrapped("  ".join([*values[:count], "|", *values[count:]]), 4)
    if now.products:
        products = ", ".join(
            f"{_as_people_say(name)} (± {100 * error:.2g} %)"
            for name, error in now.products.items()
        )
        lines += _item(WORDS["products"].format(products=products))
    if doubted := [name for name in names_to_show(now.quantities) if name in report.open_in_fit]:
        lines += _item(WORDS["doubted"].format(names=", ".join(doubted)))
    if now.undetermined:
        lines += ["  the data leave open:"]
        for sentence in now.undetermined:
            lines += _wrapped(sentence, 6, "    - ")
    return lines


def _as_people_say(product: str) -> str:
    """A product of parameters by the names of the table above it."""
    return re.sub(r"\w+", lambda word: in_use(word[0]) or word[0], spelt(product))


def _next(report: IdentifiabilityReport) -> list[str]:
    """The answer before its details: what each measurement would tell, and which one tells most."""
    if not report.designs:
        return []
    free = len(report.free)
    lines = ["  what to measure next:"]
    if (number := _most(report.designs)) is not None:
        best = report.designs[number]
        count = free - best.determined
        rest = WORDS["open" if count else "closed"].format(count=count, free=free)
        about = {"letter": letter(number), "name": best.name, "rest": rest}
        lines += _wrapped(WORDS["most"].format(**about), 4)
    for number, design in enumerate(report.designs):
        words = "{design}" if design.failed else WORDS["design"]
        about = {"design": design, "count": design.determined, "free": free}
        line = words.format(**about)
        if design.separate:
            line += WORDS["separate"].format(names=", ".join(design.separate))
        lines += _wrapped(line, 8, f"    {letter(number):<2}  ")
    return lines + _wrapped(WORDS["tiring"], 4)


def _table(report: IdentifiabilityReport) -> list[str]:
    """Standard errors of every quantity by the prior, now, and with each design; those of open
    quantities in brackets."""
    possible = [(letter(i), d) for i, d in enumerate(report.designs) if d.failed is None]
    doubted = WORDS["also doubted"] * bool(report.open_in_fit)
    added = WORDS["added"] * bool(possible)
    lines = _item(WORDS["errors"].format(doubted=doubted, far=FAR, added=added))
    if report.mean_force is not None:
        lines += _item(WORDS["per newton"])
    elif report.masses:
        masses = ", ".join(f"{name} = {value:.3g} kg" for name, value in report.masses.items())
        opened = WORDS["opened"] * any(design.masses_open for design in report.designs)
        lines += _item(WORDS["masses"].format(masses=masses, opened=opened))
    wide = max(24, *(1 + len(name) for name in report.names))
    # two more stand before them
    across = min(COLUMNS, (WIDTH - wide - 17) // CELL - 2)
    for start in range(0, max(len(possible), 1), across):
        block = possible[start : start + across]
        heads = ["prior", "now", *(label for label, _ in block)]
        rows = [["", "value", "unit", *heads]]
        for name in report.names:
            if name == MEAN and report.mean_force is not None:
                continue  # it is 1 N per newton
            now = report.present.quantities[name]
            value, unit = _stated(now, report.mean_force)
            sure = now.determined and name not in report.open_in_fit
            cells = [_cell(now, now.prior_sd, False), _cell(now, now.stderr, sure)]
            later = [outlook.quantities[name] for _, outlook in block]
            cells += [_cell(known, known.stderr, known.determined) for known in later]
            rows.append([name, f"{value:.3g}", unit, *cells])
        lines += [
            f"  {name:<{wide}}{value:>9} {unit:<5}" + "".join(f"{cell:>6}" for cell in cells)
            for name, value, unit, *cells in rows
        ]
    return lines


def _stated(known: Known, mean_force: float | None) -> tuple[float, str]:
    """Value and unit as the fit prints them."""
    value, unit = known.value, known.unit
    if mean_force is not None and unit in RELATIVE:
        value, unit = value / mean_force, RELATIVE[unit]
    return value, "" if unit == "1" else unit


def _cell(known: Known, error: float, determined: bool) -> str:
    share = 100 * error / abs(known.value) if known.value else np.inf
    cell = f"{share:.2g}" if share < 99.5 else f"{share:.0f}" if share < FAR else ">>"
    return cell if determined else f"({cell})"


def _most(designs: tuple[Outlook, ...]) -> int | None:
    """Number of the design that determines most; among equals that with the smaller errors."""
    ranks = {
        number: (design.determined, len(design.gained), -design.log_left)
        for number, design in enumerate(designs)
        if design.failed is None
    }
    return max(ranks, key=lambda number: ranks[number], default=None)
