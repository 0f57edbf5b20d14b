"""Who writes a store: one process at a time, or one for each of its parts. The system's lock on a
file, and who has it."""

import contextlib
import datetime
import errno
import functools
import glob
import json
import logging
import os
import socket
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from jaxmuscle._common.errors import StoreError

LOG = logging.getLogger("jaxmuscle")
WITHOUT = (errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOLCK, errno.ENOSYS)
TRIES, PAUSE = 40, 0.05  # [s]
WHOLE = ""


class Holder(NamedTuple):
    """A process that writes: on which host, since which start of its system, its number, its start,
    and since when."""

    host: str
    boot: str
    pid: int
    started: str
    since: str

    @staticmethod
    def here() -> "Holder":
        """This process."""
        now = datetime.datetime.now().astimezone().isoformat(" ", "seconds")
        return Holder(socket.gethostname(), _boot(), os.getpid(), _started(os.getpid()), now)

    @staticmethod
    def of(data: bytes | None) -> "Holder | None":
        """Who wrote this, None if nobody did."""
        try:
            return Holder(**json.loads(data or b""))
        except (ValueError, TypeError, RecursionError):
            return None

    def to_bytes(self) -> bytes:
        """What `of` reads."""
        return json.dumps(self._asdict()).encode()

    @property
    def dead(self) -> bool:
        """Whether it was a process of this host that is no more; a number that was given again is
        told by its start."""
        return self.local and (
            self.boot != _boot() or not _runs(self.pid) or _started(self.pid) != self.started
        )

    @property
    def local(self) -> bool:
        """Whether it is of this host, so that `dead` is known."""
        return self.host == socket.gethostname()

    @property
    def near(self) -> bool:
        """Whether it is of this machine, perhaps in another container, so that the system knows of
        its locks."""
        return self.local or (self.boot != "" and self.boot == _boot())

    def __str__(self) -> str:
        return f"process {self.pid} on {self.host} (since {self.since})"


@functools.cache
def _boot() -> str:
    file = Path("/proc/sys/kernel/random/boot_id")
    return file.read_text().strip() if file.exists() else ""


def _started(pid: int) -> str:
    """When a process started, in ticks of the system; empty where that is not known."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19]
    except (OSError, IndexError):
        return ""


def _runs(pid: int) -> bool:
    if sys.platform == "win32":
        return True  # there, asking would end it
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def busy(store: str, who: object) -> StoreError:
    """Another process writes."""
    return StoreError(
        f"{store}: {who} is writing it: wait until that has ended, or end it, then repeat this"
        " command"
    )


def left(store: str, who: Holder, remedy: str) -> StoreError:
    """A lock of another host, from where nobody can tell whether its process lives."""
    return StoreError(
        f"{store}: {who} has a lock on it and may still write. If it has ended, {remedy}, then"
        " repeat this"
    )


def taken_over(store: str, who: Holder) -> None:
    """Say that a lock was left."""
    LOG.warning(
        "notice: %s: %s has ended without removing its lock. It is taken over; what was complete"
        " stays",
        store,
        who,
    )


@contextlib.contextmanager
def locked(store: Path, name: str, role: str) -> Iterator[None]:
    """Be the writer of the store in a folder.

    `role` is `WHOLE`, for a process that nobody may write beside; "part-3", for one beside which
    other parts write; or "process-2", for one of a distributed run whose process 0 has the whole.
    The lock is the system's, on a hidden file beside the store, and goes with the process. The file
    says who has it, and goes with the lock.

    **Raises:** `StoreError` that says who writes, and what to do.
    """
    store = store.resolve()
    store.parent.mkdir(parents=True, exist_ok=True)
    whole = store.parent / f".{store.name}.lock"
    with contextlib.ExitStack() as locks:
        if role.startswith("part"):
            locks.enter_context(_held(whole, name, shared=True))
        mine = whole.with_name(f"{whole.name}-{role}") if role else whole
        locks.enter_context(_held(mine, name, beside=not role, patient=role.startswith("part")))
        yield


def _beside(whole: Path) -> list[Path]:
    return [Path(file) for file in sorted(glob.glob(f"{glob.escape(str(whole))}-*"))]


@contextlib.contextmanager
def _held(
    file: Path, name: str, *, shared: bool = False, beside: bool = False, patient: bool = False
) -> Iterator[None]:
    """Hold one lock, for this process alone or `shared`; with `beside` nobody else may hold one of
    a part or process.

    With `patient`, a lock that was left on another host is taken over, too: a part that runs twice
    does no harm.
    """
    handle = _taken(file, name, shared=shared, patient=patient)
    try:
        for other in _beside(file) if beside else []:
            with _held(other, name):
                pass
        yield
    finally:
        # The last of those who share removes the file; whoever opened it meanwhile sees that, and
        # begins again.
        last = not shared or _lock(handle, shared=False)
        if sys.platform == "win32":  # which removes no open file
            os.close(handle)
        if last:
            file.unlink(missing_ok=True)
        if sys.platform != "win32":
            os.close(handle)


def _taken(file: Path, name: str, *, shared: bool, patient: bool) -> int:
    for _ in range(TRIES):
        handle = os.open(file, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            got, who = _lock(handle, shared=shared), Holder.of(os.read(handle, 4096))
            who_else = who or next(
                filter(None, (Holder.of(_bytes(other)) for other in _beside(file))), None
            )
            if got is False and who_else is not None:
                raise busy(name, who_else)
            if got is not False and _is(handle, file):
                _succeed(handle, file, name, who, known=got is True, shared=shared, patient=patient)
                handle, mine = -1, handle
                return mine
        finally:
            if handle >= 0:
                os.close(handle)
        time.sleep(PAUSE)  # somebody is about to write its name, or to remove the file
    raise busy(name, "another process")


def _succeed(
    handle: int,
    file: Path,
    name: str,
    who: Holder | None,
    *,
    known: bool,
    shared: bool,
    patient: bool,
) -> None:
    """Follow who held the lock before, if that is sure to have ended."""
    if not known:
        LOG.warning(
            "notice: %s: this file system has no locks. See to it that no other process writes",
            name,
        )
    if who is not None:
        if not (who.near if known else who.dead) and not patient:
            raise (
                busy(name, who) if who.local else left(name, who, f"remove the lock (rm '{file}')")
            )
        taken_over(name, who)
    os.ftruncate(handle, 0)
    if not shared:
        os.lseek(handle, 0, os.SEEK_SET)
        os.write(handle, Holder.here().to_bytes())


def _lock(handle: int, *, shared: bool) -> bool | None:
    """Whether the system gave the lock; None where it has none."""
    if sys.platform == "win32":
        return None
    import fcntl

    try:
        fcntl.flock(handle, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno not in WITHOUT:
            raise
        return None
    return True


def _is(handle: int, file: Path) -> bool:
    """Whether the open file still has this name."""
    try:
        return os.path.samestat(os.fstat(handle), os.stat(file))
    except FileNotFoundError:
        return False


def _bytes(file: Path) -> bytes | None:
    try:
        return file.read_bytes()
    except FileNotFoundError:
        return None
