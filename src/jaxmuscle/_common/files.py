"""Files: written whole or not at all (beside the target, then renamed), and text that is read."""

import contextlib
import json
import math
import os
import secrets
import sys
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

SYNCED_AT_ONCE = 32


@contextlib.contextmanager
def replacing(path: str | Path, *, room: int = 0) -> Iterator[Path]:
    """A temporary path in the same folder that takes the place of `path` when the block ends
    without an exception. An `OSError`, of a full disk say, names `path`.

    `room`: how many bytes the disk must have, for HDF5, which crashes where it has not.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem[:40]}-{secrets.token_hex(6)}{path.suffix}")
    try:
        # with the umask's mode; to ask for the umask means to set it, for all threads
        temporary.touch(exist_ok=False)
        if room and hasattr(os, "posix_fallocate"):
            with temporary.open("r+b") as file:
                os.posix_fallocate(file.fileno(), 0, room)
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), str(path)) from error
    finally:
        temporary.unlink(missing_ok=True)


def to_disk(paths: Iterable[Path]) -> None:
    """Wait until files and the entries of folders are on disk, where a power cut leaves them;
    together, which is faster."""
    with ThreadPoolExecutor(SYNCED_AT_ONCE) as pool:
        list(pool.map(_to_disk, set(paths)))


def _to_disk(path: Path) -> None:
    # its entries need no waiting for, and cannot be waited for
    if sys.platform == "win32" and path.is_dir():
        return
    handle = os.open(path, os.O_RDONLY if sys.platform != "win32" else os.O_RDWR)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def expanded(path: str | os.PathLike[str]) -> Path:
    """The path with ~ for the home folder, as far as there is one."""
    with contextlib.suppress(RuntimeError):
        return Path(path).expanduser()
    return Path(path)


def text_of(data: bytes, file: str, error: type[ValueError] = ValueError) -> str:
    """The UTF-8 text of a file's bytes. Raises `error`, naming the file, where there is none or it
    is something else."""
    if not data.strip():
        raise error(f"{file}: is empty")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = "\0"
    if "\0" in text:
        raise error(f"{file}: is not UTF-8 text (a binary file, or saved with another encoding)")
    return text


def write_text(path: str | Path, text: str) -> None:
    """Write a text file atomically."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def remove(folder: Path, *names: str) -> None:
    """Remove these files of an earlier result, as far as they are there."""
    for name in names:
        (folder / name).unlink(missing_ok=True)


def nulled(value: Any) -> Any:
    """Nested tables, lists and arrays with None for every number that is not finite: JSON has no
    word for it."""
    if hasattr(value, "tolist"):  # an array: commands that need none do not load numpy
        return nulled(value.tolist())
    if isinstance(value, dict):
        return {key: nulled(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [nulled(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_json(path: str | Path, value: Any) -> None:
    """Write JSON atomically; numbers that JSON has no word for are refused, not written as NaN."""
    write_text(path, json.dumps(value, indent=1, ensure_ascii=False, allow_nan=False) + "\n")
