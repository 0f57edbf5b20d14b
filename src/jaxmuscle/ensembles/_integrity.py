"""Whether a store holds what was written: checksums of its description, its progress and every
chunk of its arrays."""

import hashlib
import itertools
import json
import math
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import google_crc32c

from jaxmuscle._common.errors import StoreError

ROOT = "zarr.json"  # a store is there once it has this file
CHECKSUM = "checksum"
SIZE = hashlib.sha256().digest_size
CRC = 4  # bytes that zarr's codec crc32c adds to a chunk

Document = dict[str, Any]


def read(file: Path) -> bytes | None:
    """The bytes of a file, None if there is none."""
    try:
        return file.read_bytes()
    except FileNotFoundError:
        return None


def sealed(data: bytes) -> bytes:
    """With a checksum behind it."""
    return data + hashlib.sha256(data).digest()


def unsealed(data: bytes) -> bytes | None:
    """What was sealed; None if it is damaged."""
    content = data[:-SIZE]
    return content if hashlib.sha256(content).digest() == data[-SIZE:] else None


def stamped(document: Document) -> Document:
    """The description of a store with a checksum of it; attributes that users add later do not
    count."""
    names = sorted(document["attributes"].keys() - {CHECKSUM})
    made = {"of": names, "sha256": _digest(document, names)}
    return document | {"attributes": document["attributes"] | {CHECKSUM: json.dumps(made)}}


def _digest(document: Document, names: list[str]) -> str:
    kept = {name: document["attributes"].get(name) for name in names}
    text = json.dumps(document | {"attributes": kept}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def require_intact(path: Path, document: Document) -> None:
    """**Raises:** `StoreError` if the description of a store is not what was written."""
    try:
        made = json.loads(document["attributes"][CHECKSUM])
        intact = made["sha256"] == _digest(document, made["of"])
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        intact = False
    if not intact:
        raise StoreError(
            f"{path}: its description ({ROOT}) is damaged, or of an earlier version of"
            " jaxmuscle: its checksum is missing or wrong. Take a copy, or begin anew (--force,"
            " overwrite=True)"
        )


def described(document: Document) -> dict[str, Document]:
    """Descriptions of a store's arrays, by name."""
    return document["consolidated_metadata"]["metadata"]


def _grid(about: Document) -> list[range]:
    sizes = about["chunk_grid"]["configuration"]["chunk_shape"]
    return [range(math.ceil(n / size)) for n, size in zip(about["shape"], sizes, strict=True)]


def _key(name: str, place: Iterable[int]) -> str:
    return "/".join([name, "c", *map(str, place)])


def keys_of_array(document: Document, name: str) -> Iterator[str]:
    """Keys of all chunks of an array."""
    return (_key(name, place) for place in itertools.product(*_grid(described(document)[name])))


def _of_seeds(document: Document) -> dict[str, list[range]]:
    """The arrays that have a chunk for each chunk of the ensemble, and their grids."""
    found = described(document).items()
    return {
        name: _grid(about)
        for name, about in found
        if "seed" in about.get("dimension_names", ())[:-1]
    }


def keys_of_chunk(document: Document, number: int) -> list[str]:
    """Keys that a chunk of the ensemble fills in a store of trajectories: chunks go through the
    seeds, then the points."""
    keys = []
    for name, (*lead, _) in _of_seeds(document).items():
        row, column = divmod(number, len(lead[-1]))
        keys.append(_key(name, (*([row] if len(lead) > 1 else []), column, 0)))
    return keys


def damaged(path: Path, keys: Iterable[str]) -> list[str]:
    """Those of these keys whose chunk is missing, or not what was written."""
    wanted = list(keys)
    with ThreadPoolExecutor() as pool:
        good = pool.map(lambda key: _good(read(path / key)), wanted)
        return [key for key, fine in zip(wanted, good, strict=True) if not fine]


def _good(chunk: bytes | None) -> bool:
    return chunk is not None and google_crc32c.value(chunk[:-CRC]) == int.from_bytes(
        chunk[-CRC:], "little"
    )


def misdescribed(path: Path, document: Document) -> list[str]:
    """Keys of descriptions of single arrays that are not the ones in the store's own
    description."""
    return [
        key
        for name, about in described(document).items()
        if _parsed(read(path / (key := f"{name}/{ROOT}"))) != about
    ]


def _parsed(data: bytes | None) -> Any:
    try:
        return json.loads(data or b"")
    except (ValueError, RecursionError):
        return None


def computed_keys(document: Document) -> Iterator[str]:
    """Keys of all chunks of the arrays that have one for each chunk of the ensemble."""
    return (key for name in _of_seeds(document) for key in keys_of_array(document, name))


def wrong(path: Path, document: Document, names: Iterable[str] | None = None) -> list[str]:
    """Keys of a store that are missing or damaged: of all arrays, or of these; descriptions
    always."""
    arrays = described(document) if names is None else names
    return misdescribed(path, document) + damaged(
        path, itertools.chain.from_iterable(keys_of_array(document, name) for name in arrays)
    )


def in_words(keys: list[str]) -> str:
    """How many keys are wrong, and the first of them."""
    return (
        f"{len(keys)} damaged or missing ({', '.join(keys[:3])}{', ...' if len(keys) > 3 else ''})"
    )
