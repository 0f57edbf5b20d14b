"""Results as tables of pandas, which comes with xarray and is imported when one is asked for; and
as CSV."""

import contextlib
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas

FORMULAS = ("=", "+", "-", "@", "\t", "\r", "\n")  # how such a text begins


def frame(rows: Sequence[Mapping[str, Any]] | Mapping[str, Any]) -> "pandas.DataFrame":
    """Tidy rows, or columns by name, as a table; None among numbers becomes NaN."""
    import pandas

    table = pandas.DataFrame(rows)
    return table.astype(dict.fromkeys(table.columns[table.isna().all()], float))


def csv_of(table: "pandas.DataFrame") -> str:
    """A table as CSV, numbers with twelve digits."""
    shown = table.map(harmless)
    return shown.to_csv(index=False, float_format="%.12g", lineterminator="\n")


def harmless(cell: Any) -> Any:
    """A cell of a CSV; a text that a spreadsheet would compute gets an apostrophe in front."""
    if isinstance(cell, str) and cell.startswith(FORMULAS):
        with contextlib.suppress(ValueError):
            float(cell)
            return cell
        return f"'{cell}"
    return cell
