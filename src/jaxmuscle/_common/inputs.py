"""Files that are read: looked at before they are opened, and no larger than is allowed."""

import os
import stat
from pathlib import Path

from .files import text_of

# the environment variable that says how many GiB, and what holds without it
ALLOWED, USUAL = "JAXMUSCLE_MAX_FILE", 2.0
OTHERS = {
    stat.S_IFDIR: "folder",
    stat.S_IFIFO: "named pipe",
    stat.S_IFSOCK: "socket",
    stat.S_IFCHR: "device",
    stat.S_IFBLK: "device",
}
BEYOND = f"; if you trust the file, set the environment variable {ALLOWED} to more GiB"


def most() -> int:
    """How many bytes a file may have, also when it is unpacked: 2 GiB, or `$JAXMUSCLE_MAX_FILE`
    GiB."""
    given = os.environ.get(ALLOWED) or str(USUAL)
    try:
        size = float(given)
    except ValueError:
        size = 0.0
    if not 0 < size < 1e6:
        raise ValueError(
            f"{ALLOWED}={given}: give the size of the largest file that may be read in GiB, 4 say"
        )
    return int(size * 2**30)


def looked_at(
    path: Path, error: type[ValueError] = ValueError, *, instead: str = "a file", hint: str = ""
) -> int:
    """The size of the file at `path` [bytes], which is not opened: a pipe would wait for ever, a
    device act.

    **Raises:** `error`, naming the file, where there is none (`hint` ends the message), where it is
    something else (`instead` says what to give), and where it is larger than `most`.
    """
    try:
        found = path.stat()
    except FileNotFoundError:
        folder = "" if path.is_absolute() else f" in {path.parent.absolute()}"
        raise error(f"{path}: no such file{folder}{hint}") from None
    except (OSError, ValueError) as reason:
        raise error(_unreadable(path, reason)) from None
    if not stat.S_ISREG(found.st_mode):
        raise error(
            f"{path}: is a {OTHERS.get(stat.S_IFMT(found.st_mode), 'special file')}; give {instead}"
        )
    if found.st_size > most():
        size, allowed = found.st_size / 2**30, most() / 2**30
        raise error(
            f"{path}: has {size:.3g} GiB, more than the {allowed:.3g} GiB that may be read{BEYOND}"
        )
    return found.st_size


def read_bytes(
    path: Path, error: type[ValueError] = ValueError, *, instead: str = "a file", hint: str = ""
) -> bytes:
    """What is in the file at `path`. **Raises:** as `looked_at`, and `error` for one that cannot be
    read."""
    looked_at(path, error, instead=instead, hint=hint)
    try:
        with path.open("rb") as stream:
            return stream.read()
    except OSError as reason:
        raise error(_unreadable(path, reason)) from None


def read_text(
    path: Path, error: type[ValueError] = ValueError, *, instead: str = "a file", hint: str = ""
) -> str:
    """The UTF-8 text in the file at `path`. **Raises:** as `read_bytes`, and `error` where it is
    empty or something else."""
    return text_of(read_bytes(path, error, instead=instead, hint=hint), str(path), error)


def _unreadable(path: Path, reason: Exception) -> str:
    return f"{path}: cannot be read: {getattr(reason, 'strerror', None) or reason}"
