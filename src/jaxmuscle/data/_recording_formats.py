"""Recordings in binary files: MATLAB (.mat, also v7.3), NumPy (.npy, .npz) and C3D. Run by
`_apart_child` alone."""

import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from ._recording_channels import Channel, TooLarge
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
    for name, value in variables.items():
        if not isinstance(value, np.ndarray) or value.dtype.kind not in "iuf":
            continue
        array = value
        array = (
            array.reshape(-1, 1)
            if array.ndim < 2 or array.shape in ((1, array.size), (array.size, 1))
            else array
        )
        if array.ndim == 2 and array.shape[0] >= 2 and array.shape[1]:
            upright = array.T if array.shape[0] < array.shape[1] else array
            found[name] = list(_columns(name, upright))
    if not found and not beside:
        raise ValueError("holds no numbers in one or two dimensions")
    return stated(variables, found)


def _columns(name: str, array: np.ndarray) -> Iterator[Channel]:
    for index, column in enumerate(array.T):
        label = name if array.shape[1] == 1 and name else f"{name}:{index}" if name else str(index)
        yield Channel(label, column)


def read_c3d(path: str, most: int) -> list[Channel]:
    """Points as `NAME_x`, `NAME_y`, `NAME_z` and analog channels by name; a negative residual is a
    gap.

    **Raises:** `ImportError` that says what to install.
    """
    try:
        import ezc3d  # pyright: ignore
    except ImportError:
        raise ImportError("reading C3D needs ezc3d: pip install ezc3d") from None
    content: Any = ezc3d.c3d(path)
    found: list[Channel] = []
    point, analog = content["parameters"]["POINT"], content["parameters"]["ANALOG"]
    xyz = np.array(content["data"]["points"][:3], dtype=float)
    lost = np.asarray(content["data"]["meta_points"]["residuals"])[0] < 0
    xyz[:, lost] = np.nan
    unit = _first(point, "UNITS", 0)
    for i, label in enumerate(_labels(point, xyz.shape[1])):
        found += [
            Channel(f"{label}_{axis}", values, _rate(point), unit)
            for axis, values in zip("xyz", xyz[:, i], strict=True)
        ]
    channels = np.asarray(content["data"]["analogs"])[0]
    for i, label in enumerate(_labels(analog, len(channels))):
        found.append(Channel(label, channels[i], _rate(analog), _first(analog, "UNITS", i)))
    if not found:
        raise ValueError("holds neither points nor analog channels")
    return found


def _rate(group: Mapping[str, Any]) -> float:
    return float(group["RATE"]["value"][0])


def _labels(group: Mapping[str, Any], count: int) -> list[str]:
    given = [str(label).strip() for label in group.get("LABELS", {"value": []})["value"]]
    return [given[i] if i < len(given) and given[i] else f"channel {i}" for i in range(count)]


def _first(group: Mapping[str, Any], key: str, index: int) -> str:
    entries = group.get(key, {"value": []})["value"]
    return str(entries[index]).strip() if index < len(entries) else ""
