"""Where results are computed: versions, and the cache of compiled programs."""

import functools
import os
from importlib.metadata import version
from pathlib import Path

import platformdirs


def keep_compiled_programs() -> Path | None:
    """Switch JAX's persistent compilation cache on; returns its folder.

    `$JAX_COMPILATION_CACHE_DIR`, else the user's cache folder; a folder that cannot be written is done without (None).
    """
    import jax

    folder = Path(os.environ.get("JAX_COMPILATION_CACHE_DIR") or platformdirs.user_cache_path("jaxmuscle") / "jax")
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


@functools.cache
def versions() -> dict[str, str]:
    """Versions of what computed a result."""
    return {name: version(name) for name in ("jaxmuscle", "jax", "diffrax", "optimistix", "equinox", "numpy")}
