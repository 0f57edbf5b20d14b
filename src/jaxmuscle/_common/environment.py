"""Where and how results are computed: versions, the cache of compiled programs, precision and
threads of a fit."""

import contextlib
import functools
import logging
import os
import stat
import sys
import threading
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import platformdirs

LOG = logging.getLogger("jaxmuscle")


def program_folder() -> Path | None:
    """Where compiled programs are kept, None for nowhere: beside those of JAX's own cache where one
    was set, else in the user's cache folder.

    `$JAXMUSCLE_CACHE=off` switches keeping off. Programs are code: a folder in which somebody else
    could have put one is done without, with a notice, and so is one that cannot be made.
    """
    import jax

    if os.environ.get("JAXMUSCLE_CACHE", "").lower() == "off":
        return None
    known = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    if known and "://" in known:  # of a remote store, which JAX can write to
        return None
    folder = (
        Path(known) / "jaxmuscle-programs"
        if known
        else platformdirs.user_cache_path("jaxmuscle") / "programs"
    )
    try:
        folder = folder.parent.resolve() / folder.name
        for place in (*reversed(folder.parents), folder):
            place.mkdir(mode=0o700, exist_ok=True)  # also those above it, whatever the umask
        fault = None if sys.platform == "win32" else _fault(folder)
    except (OSError, RuntimeError) as error:  # RuntimeError: links in a circle
        fault = str(error)
    if fault is None:
        return folder
    _notice(f"{folder} is not used, compiled programs are not kept: {fault}")
    return None


def _fault(folder: Path) -> str | None:
    """Why somebody else could put files into a folder, or another folder in its place.

    None of the folders above it may be a link: each is looked at as it is.
    """
    for place in (folder, *folder.parents):
        state = place.lstat()
        if state.st_uid not in (0, os.geteuid()):
            return f"{place} belongs to another user"
        if place == folder and (not stat.S_ISDIR(state.st_mode) or state.st_mode & 0o077):
            return "it is no folder that only you can open; remove it"
        # in a sticky folder, such as /tmp, nobody can replace what is another's
        if not state.st_mode & stat.S_ISVTX and _is_writable_by_others(state):
            return f"others can write to {place}; `chmod go-w` it"
    return None


def _is_writable_by_others(state: os.stat_result) -> bool:
    """By all, or by a group; not by the group of the user's name that many systems make for each
    user."""
    import grp
    import pwd

    if not state.st_mode & 0o022:
        return False
    try:
        name = pwd.getpwuid(os.geteuid()).pw_name
        group = grp.getgrgid(state.st_gid)
    except KeyError:
        return True
    alone = group.gr_name == name and set(group.gr_mem) <= {name}
    return bool(state.st_mode & 0o002) or not alone


@functools.cache
def _notice(text: str) -> None:
    """Say it once."""
    LOG.warning("notice: %s", text)


def usable_cores() -> int:
    """How many cores of the CPU this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@functools.cache
def versions() -> dict[str, str]:
    """Versions of what computed a result."""
    return {
        name: version(name)
        for name in ("jaxmuscle", "jax", "diffrax", "optimistix", "equinox", "numpy")
    }


class _OneThread:
    """NumPy's linear algebra on one thread from the first that enters until the last has left."""

    def __init__(self) -> None:
        self.lock, self.inside = threading.Lock(), 0
        self.limits: Any = None

    def __enter__(self) -> None:
        with self.lock:
            if not self.inside:
                self.limits = _linear_algebra().limit(limits=1, user_api="blas")
            self.inside += 1

    def __exit__(self, *_: object) -> None:
        with self.lock:
            self.inside -= 1
            if not self.inside:
                self.limits.restore_original_limits()


@functools.cache
def _linear_algebra() -> Any:
    """The libraries of NumPy and SciPy. To look for them takes a hundred times longer than to set
    their threads."""
    import scipy.linalg  # noqa: F401  # brings a library of its own
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


one_thread = _OneThread()


@contextlib.contextmanager
def fitting() -> Iterator[None]:
    """Double precision in JAX, and one thread in NumPy's linear algebra.

    The matrices of a fit are small. OpenBLAS's other threads would spin between them, a fifth of
    the processor time.
    """
    import jax

    with one_thread, jax.enable_x64(True):
        yield
