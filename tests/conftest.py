"""What holds for every test: shapes are checked, dtypes are never mixed silently, figures need no screen."""

import gc
import os
from pathlib import Path

import hypothesis
import jax
import pytest
from jaxtyping import install_import_hook

install_import_hook("jaxmuscle", "beartype.beartype")  # before the first test module imports the package

jax.config.update("jax_numpy_dtype_promotion", "strict")

os.environ["MPLBACKEND"] = "Agg"  # the environment reaches commands and notebooks, too

# Compilation takes far longer than a deadline, and the outcome of a run should not depend on a draw.
hypothesis.settings.register_profile("jaxmuscle", deadline=None, derandomize=True)
hypothesis.settings.load_profile("jaxmuscle")


def _keep_compiled_programs(folder: Path) -> None:
    """Make repeated runs fast; without a writable folder they are only slower."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)


MOST_MAPS = 15_000

_keep_compiled_programs(Path(__file__).parents[1] / ".test-out" / "jax-cache")


def pytest_runtest_setup(item: pytest.Item) -> None:
    if item.get_closest_marker("gpu") and jax.default_backend() != "gpu":
        pytest.skip("needs a GPU")


@pytest.fixture(scope="module", autouse=True)
def _forget_compiled_programs():
    """Every compiled program takes memory maps, of which Linux allows a process 65530: thousands of tests use them up."""
    yield
    maps = Path("/proc/self/maps")
    if not maps.exists() or len(maps.read_text().splitlines()) > MOST_MAPS:
        jax.clear_caches()
        gc.collect()


@pytest.fixture
def x64():
    """Run the test in float64."""
    with jax.enable_x64(True):
        yield
