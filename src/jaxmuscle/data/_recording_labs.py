"""Recordings as laboratories save them: Excel, EDF, TDMS, AcqKnowledge and Spike2, through the libraries for them."""

import importlib
import io
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from ._recording_table import Table, units_of

Channel = tuple[str, Callable[[], Any], float | None, str]  # name, samples, rate [Hz], unit


def _library(name: str, file: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError:
        what = name.partition(".")[0]
        raise ImportError(f"{file}: reading this file needs {what}: pip install jaxmuscle[labs]") from None


def read_xlsx(data: bytes, file: str) -> bytes:
    """The first sheet of a workbook as text with tabs, in which rows keep their numbers."""
    _library("openpyxl", file)
    import pandas

    sheet = pandas.read_excel(io.BytesIO(data), header=None, engine="openpyxl")
    if sheet.empty:
        raise ValueError("its first sheet is empty")
    return sheet.replace(r"\s+", " ", regex=True).to_csv(sep="\t", header=False, index=False).encode()


def read_edf(path: str) -> Table:
    """EDF and BDF: signals by their labels, with rates and units."""
    with _library("pyedflib", path).EdfReader(path) as file:
        channels: list[Channel] = [
            (file.getLabel(i), _kept(file.readSignal(i)), file.getSampleFrequency(i), file.getPhysicalDimension(i))
            for i in range(file.signals_in_file)
        ]
    return _table(path, channels)


def read_tdms(path: str) -> Table:
    """TDMS: channels by name, as `GROUP/NAME` where several groups have it; the rate is that of the waveform."""
    groups = _library("nptdms", path).TdmsFile.read(path).groups()
    found = [(group.name, channel) for group in groups for channel in group.channels()]
    names = [channel.name for _, channel in found]

    def parts(group: str, channel: Any) -> Channel:
        name, step = channel.name, channel.properties.get("wf_increment")
        name = name if names.count(name) == 1 else f"{group}/{name}"
        unit = "s" if channel.dtype.kind == "M" else str(channel.properties.get("unit_string", ""))
        return name, lambda: channel[:], 1 / step if step else None, unit

    return _table(path, [parts(group, channel) for group, channel in found if channel.dtype.kind in "iufM"])


def read_acq(path: str) -> Table:
    """AcqKnowledge: channels by name, with rates and units."""
    file = _library("bioread", path).read_file(path)
    return _table(path, [(c.name, lambda c=c: c.data, c.samples_per_second, c.units) for c in file.channels])


def read_smr(path: str) -> Table:
    """Spike2: waveform channels by name, with rates and units."""
    blocks = _library("neo.io", path).Spike2IO(filename=path).read_block(lazy=False).segments
    if len(blocks) != 1:
        raise ValueError(f"holds {len(blocks)} stretches with gaps between; save each on its own")
    channels: list[Channel] = []
    for group in blocks[0].analogsignals:
        names = group.array_annotations.get("channel_names", [group.name])
        rate, unit = float(group.sampling_rate.rescale("Hz").magnitude), str(group.units.dimensionality)
        channels += [(str(name), _kept(group.magnitude[:, i]), rate, unit) for i, name in enumerate(names)]
    return _table(path, channels)


def frame_table(frame: Any) -> Table:
    """The columns of a pandas table, its index before them if that is more than a counter; times become seconds.

    **Raises:** `ValueError` if it is no such table.
    """
    if not hasattr(frame, "columns"):
        raise ValueError(f"frame={type(frame).__name__}: give a pandas DataFrame, a single column as frame.to_frame()")
    index = frame.index
    counter = index.dtype.kind not in "fmM" and index.name is None
    given = [] if counter else [(str(index.name or "time"), index)]
    given += [(" ".join(map(str, key)) if isinstance(key, tuple) else str(key), frame.iloc[:, i])
              for i, key in enumerate(frame.columns)]  # fmt: skip
    names = [name for name, _ in given]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None or frame.empty:
        raise ValueError("the table is empty" if frame.empty else f"the table has two columns {twice!r}; rename one")
    columns = {name: lambda column=column: numbers(column.to_numpy()) for name, column in given}
    kinds = {name: column.dtype.kind for name, column in given}
    units = units_of(names) | {name: "s" for name, kind in kinds.items() if kind in "mM"}
    words = frozenset(name for name, kind in kinds.items() if kind not in "iufbmM")
    return Table("the table", columns, True, {}, units, words, "row {}".format)


def _kept(samples: Any) -> Callable[[], Any]:
    return lambda: samples


def _table(path: str, channels: Iterable[Channel]) -> Table:
    columns, rates, units = {}, {}, {}
    for name, samples, rate, unit in channels:
        name = name.strip() or f"channel {len(columns)}"
        if name in columns:
            name = f"{name} {len(columns)}"
        columns[name] = lambda samples=samples: numbers(samples())
        if rate:
            rates[name] = float(rate)
        if unit.strip():
            units[name] = unit.strip()
    if not columns:
        raise ValueError("holds no channels with numbers")
    return Table(path, columns, True, rates, units)


def numbers(column: Any) -> np.ndarray:
    """A column as numbers: dates and times of day become seconds from the first one."""
    array = np.asarray(column)
    if array.dtype.kind in "mM":
        since = (array - array[0]) if array.size else array.astype("m8[ns]")
        return np.where(np.isnat(since), np.nan, since / np.timedelta64(1, "s"))
    try:
        return array.astype(float)
    except (TypeError, ValueError):
        raise ValueError("a column holds words, not numbers; choose another one with `column`") from None
