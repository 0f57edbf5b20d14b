"""Recordings in binary files: MATLAB (.mat, also v7.3), NumPy (.npy, .npz) and C3D. Run by
`_apart_child` alone."""

import zipfile
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from ._recording_channels import Channel, TooLarge

RATES = ("samplingfrequency", "samplingrate", "samplerate", "sampling_rate", "fs", "rate", "srate")
REFERENCES = 16  # how often a reference of HDF5 may lead to another one
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
    (MATLAB's Data(:, 75))."""
    import scipy.io

    try:
        content = scipy.io.loadmat(path, simplify_cells=True)
    except NotImplementedError:
        return _channels(_hdf5(path, most))
    return _channels(
        dict(_flat({key: value for key, value in content.items() if not key.startswith("__")}))
    )


def _flat(content: Mapping[str, Any], stem: str = "") -> Iterable[tuple[str, Any]]:
    """Numbers in nested structs, and those in a cell that holds nothing else."""
    for key, value in content.items():
        while (
            isinstance(value, np.ndarray | list)
            and np.size(value) == 1
            and np.asarray(value).dtype == object
        ):
            value = np.asarray(value).item()
        if isinstance(value, Mapping):
            yield from _flat(value, f"{stem}{key}.")
        else:
            yield f"{stem}{key}", np.asarray(value)


def _hdf5(path: str, most: int) -> dict[str, np.ndarray]:
    """MATLAB v7.3: its arrays lie transposed, its cells as references."""
    import h5py

    arrays: dict[str, np.ndarray] = {}
    with h5py.File(path, "r", locking=False) as file:

        def visit(name: str, item: Any) -> None:
            if isinstance(item, h5py.Group) and _leads_out(item, h5py.ExternalLink):
                raise ValueError(ABROAD)
            for _ in range(REFERENCES):
                if (
                    not isinstance(item, h5py.Dataset)
                    or item.dtype != h5py.ref_dtype
                    or item.size != 1
                ):
                    break
                item = file[np.asarray(item).item()]
            if (
                not isinstance(item, h5py.Dataset)
                or name.startswith("#")
                or "MATLAB_empty" in item.attrs
            ):
                return
            if item.dtype.kind in "iuf" and item.attrs.get("MATLAB_class") != b"char":
                if item.external or item.is_virtual:
                    raise ValueError(ABROAD)
                if sum(array.nbytes for array in arrays.values()) + item.nbytes > most:
                    raise TooLarge
                arrays[name.replace("/", ".")] = np.asarray(item).T

        visit("#", file)
        file.visititems(visit)
    return arrays


def _leads_out(group: Any, kind: type) -> bool:
    return any(isinstance(group.get(name, getlink=True), kind) for name in group)


def _channels(arrays: Mapping[str, Any]) -> list[Channel]:
    """Columns of all numeric arrays with one or two dimensions; a two-dimensional one has its
    samples along the longer."""
    found: list[Channel] = []
    rate = None
    for name, value in arrays.items():
        array = np.asarray(value)
        if array.dtype.kind not in "iuf":
            continue
        if array.size == 1 and name.rpartition(".")[2].casefold() in RATES:
            rate = float(array.item())
        array = (
            array.reshape(-1, 1)
            if array.ndim < 2 or array.shape in ((1, array.size), (array.size, 1))
            else array
        )
        if array.ndim == 2 and array.shape[0] >= 2 and array.shape[1]:
            found += _columns(name, array.T if array.shape[0] < array.shape[1] else array)
    if not found:
        raise ValueError("holds no numbers in one or two dimensions")
    return [channel._replace(rate=rate) for channel in found]


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
