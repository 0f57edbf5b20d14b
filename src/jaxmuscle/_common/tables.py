"""Results as tables of pandas, which comes with xarray and is imported when one is asked for."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas


def frame(rows: Sequence[Mapping[str, Any]] | Mapping[str, Any]) -> "pandas.DataFrame":
    """Tidy rows, or columns by name, as a table; None among numbers becomes NaN."""
    import pandas

    table = pandas.DataFrame(rows)
    return table.astype(dict.fromkeys(table.columns[table.isna().all()], float))
