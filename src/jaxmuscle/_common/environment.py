"""Where and how results are computed: versions, the cache of compiled programs, precision and
threads of a fit."""

import contextlib
import functools
import os
import threading
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import platformdirs

# For the environment variable XLA_FLAGS: a loop of less than a megabyte becomes one piece of
# machine code. Else XLA splits what is inside it among all cores, although these are busy with
# other seeds.
UNDIVIDED_LOOPS = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1000000"


def keep_compiled_programs() -> Path | None:
    """Switch JAX's persistent compilation cache on; returns its folder.

    `$JAX_COMPILATION_CACHE_DIR`, else the user's cache folder; a folder that cannot be written is
    done without (None), and so is any with `$JAXMUSCLE_CACHE=off`.
    """
    import jax

    if _off():
        return _without(jax)
    folder = Path(
        os.environ.get("JAX_COMPILATION_CACHE_DIR")
        or platformdirs.user_cache_path("jaxmuscle") / "jax"
    )
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return _without(jax)
    if not os.access(folder, os.W_OK | os.X_OK):
        return _without(jax)
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
    return folder


def _without(jax) -> None:
    jax.config.update("jax_compilation_cache_dir", None)


def _off() -> bool:
    return os.environ.get("JAXMUSCLE_CACHE", "").lower() == "off"


def program_folder() -> Path | None:
    """Where compiled programs are kept, None for nowhere; switches JAX's own cache on as well,
    unless it was set.

    `$JAXMUSCLE_CACHE=off` switches both off; the folder is that of JAX's cache where one was set,
    else the user's.
    """
    import jax

    if _off():
        return None
    folder = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    if folder and "://" in folder:  # of a remote store, which JAX can write to
        return None
    known = Path(folder) if folder else keep_compiled_programs()
    return None if known is None else known / "jaxmuscle"


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
