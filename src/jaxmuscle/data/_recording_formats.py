"""Recordings in files that are not text: MATLAB (.mat, also v7.3), NumPy (.npy, .npz), C3D, and by
the libraries for them Excel, EDF, TDMS, AcqKnowledge and Spike2. Run by `_apart_child` alone."""

import importlib
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from ._recording_channels import Channel, TooLarge, numbers
from .dialects._dialect import upright
from .dialects._dialects import DIALECTS
from .dialects._variables import stated

REFERENCES = 16  # how often a cell may hold another one alone
CELLS = 10_000  # of a variable
ABROAD = "takes its numbers from another file, which is not followed; save them in the file itself"


def read_npy(path: str, most: int) -> list[Channel]:
    """One array: its columns are 0, 1, ...; one dimension is one column."""
    return _channels({"": np.load(path, allow_pickle=False)})


def read_npz(path: str, most: int) -> list[Channel]:
    """Several arrays by name, `NAME:0`, `NAME:1`, ... if they have columns; a scalar `fs` or `rate`
    is the rate."""
    unpacked(path, most)
    with np.load(path, allow_pickle=False) as arrays:
        return _channels(dict(arrays))


def unpacked(path: str, most: int) -> None:
    """Raise `TooLarge` for a zip archive whose files together say that they are larger than `most`
    bytes."""
    with zipfile.ZipFile(path) as archive:
        if sum(entry.file_size for entry in archive.infolist()) > most:
            raise TooLarge


def read_mat(path: str, most: int) -> list[Channel]:
    """MATLAB's variables by name; fields of structs as `trial.force`, columns as `Data:74`
    (MATLAB's Data(:, 75)); or what the programs of `dialects` write."""
    import scipy.io

    try:
        content = scipy.io.loadmat(path, simplify_cells=True, mat_dtype=True)
    except NotImplementedError:
        content = _hdf5(path, most)
    content = {key: _alone(value) for key, value in content.items() if not key.startswith("__")}
    for dialect in DIALECTS:
        found = dialect.mat and dialect.mat(content)
        if found:
            channels, understood = found
            rest = {key: value for key, value in content.items() if key not in understood}
            return [*channels, *_channels(rest, channels)]
    return _channels(content)


def _alone(value: Any) -> Any:
    """What is in a cell that holds nothing else; in structs, too."""
    for _ in range(REFERENCES):
        cell = value.reshape(-1) if isinstance(value, np.ndarray) else value
        if isinstance(cell, np.ndarray) and cell.dtype == bool:
            return value.astype(np.uint8)
        single = isinstance(cell, list) or (isinstance(cell, np.ndarray) and cell.dtype == object)
        if not single or len(cell) != 1:
            break
        value = cell[0]
    if isinstance(value, Mapping):
        return {key: _alone(each) for key, each in value.items()}
    return value


def _flat(content: Mapping[str, Any], stem: str = "") -> Iterable[tuple[str, Any]]:
    """What nested structs hold."""
    for key, value in content.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{stem}{key}.")
        else:
            yield f"{stem}{key}", value


def _hdf5(path: str, most: int) -> dict[str, Any]:
    """MATLAB v7.3: its arrays lie transposed, its cells as references, its texts as numbers."""
    import h5py

    known: dict[Any, Any] = {}  # by the place in the file, so that a circle comes to an end
    left = most

    def value(item: Any) -> Any:
        nonlocal left
        place = h5py.h5o.get_info(item.id).addr  # pyright: ignore[reportAttributeAccessIssue]
        if place in known:
            return known[place]
        known[place] = None
        if isinstance(item, h5py.Group):
            known[place] = {name: value(item[name]) for name in _inside(item)}
        elif isinstance(item, h5py.Dataset) and "MATLAB_empty" not in item.attrs:
            if item.external or item.is_virtual:
                raise ValueError(ABROAD)
            left -= item.nbytes
            if left < 0:
                raise TooLarge
            cells = item.dtype == h5py.ref_dtype and np.prod(item.shape) <= CELLS
            known[place] = (
                [value(file[each]) if each else None for each in np.asarray(item).reshape(-1)]
                if cells
                else _matlab(item)
            )
        return known[place]

    with h5py.File(path, "r", locking=False) as file:
        return value(file)


def _inside(group: Any) -> list[str]:
    """The names of what a group holds itself."""
    import h5py

    links = {name: group.get(name, getlink=True) for name in group if not name.startswith("#")}
    if any(isinstance(link, h5py.ExternalLink) for link in links.values()):
        raise ValueError(ABROAD)
    return [name for name, link in links.items() if isinstance(link, h5py.HardLink)]


def _matlab(item: Any) -> Any:
    """Numbers, or the lines of a text."""
    if item.dtype.kind not in "iuf":
        return None
    array = np.asarray(item).T
    if item.attrs.get("MATLAB_class") != b"char":
        return array.squeeze() if array.ndim < 3 else array
    lines = ["".join(map(chr, line)) for line in np.atleast_2d(array)]
    return lines[0] if len(lines) == 1 else lines


def _channels(content: Mapping[str, Any], beside: Sequence[Channel] = ()) -> list[Channel]:
    """Columns of all numeric arrays with one or two dimensions; a two-dimensional one has its
    samples along the longer. Rates, names and units are those that stand beside an array.

    **Raises:** `ValueError` where there are none, not even `beside` these.
    """
    variables = dict(_flat(content))
    found: dict[str, list[Channel]] = {}
    for name, array in variables.items():
        if not isinstance(array, np.ndarray) or array.dtype.kind not in "iuf" or array.ndim > 2:
            continue
        columns = upright(array)
        if columns.shape[0] >= 2 and columns.shape[1]:
            labels = [f"{name}:{i}" if name else str(i) for i in range(columns.shape[1])]
            labels = [name] if len(labels) == 1 and name else labels
            found[name] = [Channel(*each) for each in zip(labels, columns.T, strict=True)]
    if not found and not beside:
        raise ValueError("holds no numbers in one or two dimensions")
    return stated(variables, found)


def read_c3d(path: str, most: int) -> list[Channel]:
    """Points as `NAME_x`, `NAME_y`, `NAME_z` and analog channels by name; a negative residual is a
    gap."""
    content = _library("ezc3d", "reading C3D").c3d(path)
    point, analog = content["parameters"]["POINT"], content["parameters"]["ANALOG"]
    xyz = np.array(content["data"]["points"][:3], dtype=float)
    lost = np.asarray(content["data"]["meta_points"]["residuals"])[0] < 0
    xyz[:, lost] = np.nan
    analogs = np.asarray(content["data"]["analogs"])[0]
    rate, unit = float(point["RATE"]["value"][0]), _entry(point, "UNITS", 0)
    found = [
        Channel(f"{_entry(point, 'LABELS', i) or f'channel {i}'}_{axis}", values, rate, unit)
        for i in range(xyz.shape[1])
        for axis, values in zip("xyz", xyz[:, i], strict=True)
    ]
    for i, values in enumerate(analogs):
        name, rate = _entry(analog, "LABELS", i), float(analog["RATE"]["value"][0])
        found.append(Channel(name or f"channel {i}", values, rate, _entry(analog, "UNITS", i)))
    if not found:
        raise ValueError("holds neither points nor analog channels")
    return found


def _entry(group: Mapping[str, Any], key: str, index: int) -> str:
    entries = group.get(key, {"value": []})["value"]
    return str(entries[index]).strip() if index < len(entries) else ""


def _library(name: str, what: str = "reading this file") -> Any:
    """The library for a format. **Raises:** `ImportError` that says what to install."""
    try:
        return importlib.import_module(name)
    except ImportError:
        package = name.partition(".")[0]
        raise ImportError(f"{what} needs {package}: pip install {package}") from None


def read_xlsx(path: str, most: int) -> dict[str, bytes]:
    """The sheets of a workbook as texts with tabs, in which rows keep their numbers."""
    _library("openpyxl")
    import pandas

    unpacked(path, most)
    with pandas.ExcelFile(path, engine="openpyxl") as book:
        names = [sheet.title for sheet in book.book.worksheets]  # there are sheets of charts, too
        sheets: dict[str, Any] = {name: book.parse(name, header=None) for name in names}
    if all(sheet.empty for sheet in sheets.values()):
        raise ValueError("it holds no sheet that is not empty")
    return {
        name: sheet.replace(r"\s+", " ", regex=True)
        .to_csv(sep="\t", header=False, index=False)
        .encode()
        for name, sheet in sheets.items()
    }


def read_edf(path: str, most: int) -> list[Channel]:
    """EDF and BDF: signals by their labels, with rates and units."""
    library = _library("edfio")
    with open(path, "rb") as file:
        read = library.read_bdf if file.read(1) == b"\xff" else library.read_edf
    signals = read(path, header_encoding="latin-1").signals  # though the format allows ASCII alone
    return [
        Channel(each.label, each.data, each.sampling_frequency, each.physical_dimension)
        for each in signals
    ]


def read_tdms(path: str, most: int) -> list[Channel]:
    """TDMS: channels by name, as `GROUP/NAME` where several groups have it; the rate is that of the
    waveform."""
    groups = _library("nptdms").TdmsFile.read(path).groups()
    found = [(group.name, channel) for group in groups for channel in group.channels()]
    names = [channel.name for _, channel in found]

    def read(group: str, channel: Any) -> Channel:
        name, step = channel.name, channel.properties.get("wf_increment")
        name = name if names.count(name) == 1 else f"{group}/{name}"
        unit = "s" if channel.dtype.kind == "M" else str(channel.properties.get("unit_string", ""))
        return Channel(name, numbers(channel[:]), 1 / step if step else None, unit)

    return [read(group, channel) for group, channel in found if channel.dtype.kind in "iufM"]


def read_acq(path: str, most: int) -> list[Channel]:
    """AcqKnowledge: channels by name, with rates and units."""
    file = _library("bioread").read_file(path)
    return [Channel(c.name, numbers(c.data), c.samples_per_second, c.units) for c in file.channels]


def read_smr(path: str, most: int) -> list[Channel]:
    """Spike2: waveform channels by name, with rates and units."""
    blocks = _library("neo.io").Spike2IO(filename=path).read_block(lazy=False).segments
    if len(blocks) != 1:
        raise ValueError(f"holds {len(blocks)} stretches with gaps between; save each on its own")
    channels: list[Channel] = []
    for group in blocks[0].analogsignals:
        names = group.array_annotations.get("channel_names", [group.name])
        rate, unit = (
            float(group.sampling_rate.rescale("Hz").magnitude),
            str(group.units.dimensionality),
        )
        channels += [
            Channel(str(name), group.magnitude[:, i], rate, unit) for i, name in enumerate(names)
        ]
    return channels
