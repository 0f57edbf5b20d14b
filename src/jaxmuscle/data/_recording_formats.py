"""Recordings in binary files: MATLAB (.mat, also v7.3), NumPy (.npy, .npz) and C3D."""

import functools
import io
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from ._recording_table import AXES, Table

RATES = ("samplingfrequency", "samplingrate", "samplerate", "sampling_rate", "fs", "rate", "srate")


def read_npy(data: bytes, file: str) -> Table:
    """One array: its columns are 0, 1, ...; one dimension is one column."""
    array = np.load(io.BytesIO(data), allow_pickle=False)
    return _table(file, {"": array}, named=False)


def read_npz(data: bytes, file: str) -> Table:
    """Several arrays by name, `NAME:0`, `NAME:1`, ... if they have columns; a scalar `fs` or `rate` is the rate."""
    with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
        return _table(file, dict(arrays))


def read_mat(data: bytes, file: str) -> Table:
    """MATLAB's variables by name; fields of structs as `trial.force`, columns as `Data:74` (MATLAB's Data(:, 75))."""
    import scipy.io

    try:
        content = scipy.io.loadmat(io.BytesIO(data), simplify_cells=True)
    except NotImplementedError:
        return _table(file, _hdf5(data))
    return _table(file, dict(_flat({key: value for key, value in content.items() if not key.startswith("__")})))


def _flat(content: Mapping[str, Any], stem: str = "") -> Iterable[tuple[str, Any]]:
    """Numbers in nested structs, and those in a cell that holds nothing else."""
    for key, value in content.items():
        while isinstance(value, np.ndarray | list) and np.size(value) == 1 and np.asarray(value).dtype == object:
            value = np.asarray(value).item()
        if isinstance(value, Mapping):
            yield from _flat(value, f"{stem}{key}.")
        else:
            yield f"{stem}{key}", np.asarray(value)


def _hdf5(data: bytes) -> dict[str, np.ndarray]:
    """MATLAB v7.3: its arrays lie transposed, its cells as references."""
    import h5py

    arrays: dict[str, np.ndarray] = {}
    with h5py.File(io.BytesIO(data), "r") as file:

        def visit(name: str, item: Any) -> None:
            while isinstance(item, h5py.Dataset) and item.dtype == h5py.ref_dtype and item.size == 1:
                item = file[np.asarray(item).item()]
            if not isinstance(item, h5py.Dataset) or name.startswith("#") or "MATLAB_empty" in item.attrs:
                return
            if item.dtype.kind in "iuf" and item.attrs.get("MATLAB_class") != b"char":
                arrays[name.replace("/", ".")] = np.asarray(item).T

        file.visititems(visit)
    return arrays


def _table(file: str, arrays: Mapping[str, Any], *, named: bool = True) -> Table:
    """Columns of all numeric arrays with one or two dimensions; a two-dimensional one has its samples along the longer."""
    columns, rate = {}, None
    for name, value in arrays.items():
        array = np.asarray(value)
        if array.dtype.kind not in "iuf":
            continue
        if array.size == 1 and name.rpartition(".")[2].casefold() in RATES:
            rate = float(array.item())
        array = array.reshape(-1, 1) if array.ndim < 2 or array.shape in ((1, array.size), (array.size, 1)) else array
        if array.ndim != 2 or array.shape[0] < 2:
            continue
        array = array.T if array.shape[0] < array.shape[1] else array
        for index, column in enumerate(array.T.astype(float)):
            label = name if array.shape[1] == 1 and name else f"{name}:{index}" if name else str(index)
            columns[label] = functools.partial(np.asarray, column)
    if not columns:
        raise ValueError("holds no numbers in one or two dimensions")
    return Table(file, columns, named, {} if rate is None else dict.fromkeys(columns, rate))


def read_c3d(path: str) -> Table:
    """Points as `NAME_x`, `NAME_y`, `NAME_z` and analog channels by name; a negative residual is a gap.

    **Raises:** `ImportError` that says what to install.
    """
    try:
        import ezc3d  # pyright: ignore
    except ImportError:
        raise ImportError(f"{path}: reading C3D needs ezc3d: pip install jaxmuscle[c3d]") from None
    content: Any = ezc3d.c3d(path)
    columns, rates, units = {}, {}, {}

    def add(name: str, values: np.ndarray, group: Mapping[str, Any], unit: str) -> None:
        columns[name] = functools.partial(np.array, values, dtype=float)
        rates[name], units[name] = float(group["RATE"]["value"][0]), unit

    point, analog = content["parameters"]["POINT"], content["parameters"]["ANALOG"]
    xyz = np.array(content["data"]["points"][:3], dtype=float)
    lost = np.asarray(content["data"]["meta_points"]["residuals"])[0] < 0
    xyz[:, lost] = np.nan
    unit = _first(point, "UNITS", 0)
    for i, label in enumerate(_labels(point, xyz.shape[1])):
        for axis, values in zip(AXES, xyz[:, i], strict=True):
            add(f"{label}_{axis}", values, point, unit)
    channels = np.asarray(content["data"]["analogs"])[0]
    for i, label in enumerate(_labels(analog, len(channels))):
        add(label, channels[i], analog, _first(analog, "UNITS", i))
    if not columns:
        raise ValueError("holds neither points nor analog channels")
    return Table(path, columns, True, rates, {name: unit for name, unit in units.items() if unit})


def _labels(group: Mapping[str, Any], count: int) -> list[str]:
    given = [str(label).strip() for label in group.get("LABELS", {"value": []})["value"]]
    return [given[i] if i < len(given) and given[i] else f"channel {i}" for i in range(count)]


def _first(group: Mapping[str, Any], key: str, index: int) -> str:
    entries = group.get(key, {"value": []})["value"]
    return str(entries[index]).strip() if index < len(entries) else ""
