"""What an object says of itself: as text where it is printed, as a table in a notebook."""

import abc
import dataclasses
import html
import textwrap
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from .arrays import is_concrete
from .text import WIDTH, folded

LEAST = 24  # columns that are left to words
FEW = 10  # numbers that are shown each


class Card(NamedTuple):
    """What an object says of itself.

    `text` is the whole of it. A notebook shows `heading`, the table of `columns` and `rows`, and
    `remarks`; the text where there is no table.
    """

    text: str
    heading: str = ""
    columns: tuple[str, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()
    remarks: tuple[str, ...] = ()

    def __str__(self) -> str:
        return self.text

    def __repr__(self) -> str:
        return self.text

    def _repr_html_(self) -> str:
        """As HTML: names and remarks may come from files, so that everything is escaped."""
        if not self.columns:
            return f"<pre>{html.escape(self.text)}</pre>"
        head = _row("th", self.columns)
        body = "\n".join(_row("td", row) for row in self.rows)
        said = "".join(f"<p>{html.escape(remark)}</p>\n" for remark in self.remarks)
        return (
            f'<div class="jaxmuscle">\n<p><b>{html.escape(self.heading)}</b></p>\n'
            f"<table>\n<thead>{head}</thead>\n"
            f"<tbody>\n{body}\n</tbody>\n</table>\n{said}</div>"
        )


def _row(tag: str, cells: Iterable[str]) -> str:
    return (
        "<tr>"
        + "".join(f'<{tag} style="text-align: left">{html.escape(cell)}</{tag}>' for cell in cells)
        + "</tr>"
    )


class Shown(abc.ABC):
    """Shows itself as its card: the text where it is printed, with or without `print`, the table in
    a notebook."""

    @abc.abstractmethod
    def _card(self) -> Card:
        """What it says of itself."""

    def __repr__(self) -> str:
        return self._card().text

    def _repr_html_(self) -> str:
        return self._card()._repr_html_()


class Spelled:
    """Shows itself as the call that makes it, with all fields and their numbers."""

    def __repr__(self) -> str:
        names = [field.name for field in dataclasses.fields(self)]  # pyright: ignore[reportArgumentType]
        fields = ", ".join(f"{name}={_spelled(getattr(self, name))}" for name in names)
        return f"{type(self).__name__}({fields})"


def _spelled(value: Any) -> str:
    if (
        isinstance(value, float | np.ndarray | np.generic | jax.Array)
        and is_concrete(value)
        and np.size(value) <= FEW
    ):
        return repr(np.asarray(value).tolist())
    if isinstance(value, Spelled | tuple):
        return repr(value)
    plain = jax.tree.map(lambda x: float(x) if isinstance(x, np.floating) else x, value)
    return eqx.tree_pformat(plain)


class Printed(Shown):
    """Shows itself as the text of its `__str__`."""

    @abc.abstractmethod
    def __str__(self) -> str: ...

    def _card(self) -> Card:
        return Card(str(self))


class Result(Shown):
    """What is computed, with a `summary()`."""

    def summary(self) -> Card:
        """What it prints, as an object; a notebook shows it as a table where there is one."""
        return self._card()


def facts(heading: str, rows: Sequence[tuple[str, str]], width: int = 8) -> Card:
    """A card of a heading and named facts, a line for each; names are filled up to `width`."""
    return Card(
        folded([heading, *(f"  {name:<{width}}  {value}" for name, value in rows)]),
        heading,
        ("", ""),
        tuple(rows),
    )


def in_columns(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """A table as lines of at most 80 columns; words of the last column that find no room go on
    below."""
    widths = [max(len(row[i]) for row in [columns, *rows]) + 2 for i in range(len(columns) - 1)]
    room = max(WIDTH - 2 - sum(widths), LEAST)
    lines = []
    for row in [columns, *rows]:
        words = textwrap.wrap(row[-1], room) or [""]
        lines.append(
            "  "
            + "".join(f"{cell:<{wide}}" for cell, wide in zip(row, widths, strict=False))
            + words[0]
        )
        lines += [" " * (2 + sum(widths)) + more for more in words[1:]]
    return [line.rstrip() for line in lines]
