"""What holds for every test: shapes are checked, dtypes are never mixed silently, figures need no
screen."""

import contextlib
import ctypes
import gc
import os
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import hypothesis
import jax
import jaxlib
import pytest
import scipy.linalg  # noqa: F401  # brings a library of its own, see `_keep_to_own_cores`
import shapes
import threadpoolctl
import timing
from compiled import OPTIMISATION, keep_own_classes

shapes.check("jaxmuscle")  # before anything of the package is imported

from jaxmuscle._common import figures  # noqa: E402

jax.config.update("jax_numpy_dtype_promotion", "strict")

os.environ["MPLBACKEND"] = "Agg"  # the environment reaches commands and notebooks, too

from matplotlib.figure import Figure  # noqa: E402

# antropy, a reference: compiled it takes seven seconds more than it saves
os.environ["NUMBA_DISABLE_JIT"] = "1"

# Compilation takes far longer than a deadline, and the outcome of a run should not depend on a
# draw.
hypothesis.settings.register_profile("jaxmuscle", deadline=None, derandomize=True)
hypothesis.settings.load_profile("jaxmuscle")

OUT = Path(__file__).parents[1] / ".test-out"

# Of the C library, for workers and commands: memory comes and goes in large pieces. Page by page it
# takes a twentieth more.
os.environ |= {
    "MALLOC_TOP_PAD_": f"{2**26}",
    "MALLOC_TRIM_THRESHOLD_": f"{2**30}",
    "MALLOC_MMAP_THRESHOLD_": f"{2**25}",
}
# Programs are made without the lines of Python that they come from, which nobody reads.
os.environ["JAX_TRACEBACK_IN_LOCATIONS_LIMIT"] = "0"
with contextlib.suppress(AttributeError):  # of a JAX that has no such option
    jax.config.update("jax_traceback_in_locations_limit", 0)


def _keep_compiled_programs(folder: Path) -> None:
    """Make repeated runs fast; without a writable folder they are only slower.

    All programs are kept, also the thousands of single operations: the second worker and the next
    run compile none again.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"


QUICK_COMPILER = (
    f"--{OPTIMISATION}=1 --xla_cpu_use_fusion_emitters=false"
    " --xla_cpu_parallel_codegen_split_count=1"
    " --xla_backend_extra_options=xla_cpu_disable_loop_unrolling,xla_cpu_disable_slp_vectorizer"
    " --xla_disable_hlo_passes=simplification"
)


def _compile_quickly(known: Path) -> None:
    """XLA's older emitters, LLVM at its first level, loops as they are, no rounds of simplification
    before it: compiled in less than half the time, run as fast, the same numbers to rounding; and
    each program in one piece, since a worker has one core.

    An XLA that no longer has them ends the process at the flag: tried once for every version, in a
    process of its own. One that ends for another reason is tried again the next time.
    """
    if os.environ.get("XLA_FLAGS"):
        return
    asked = f"{jaxlib.__version__} {QUICK_COMPILER}"
    answer = known.read_text(encoding="utf-8") if known.exists() else ""
    if not answer.startswith(asked):
        tried = subprocess.run(
            [sys.executable, "-c", "import jax; jax.devices()"],
            capture_output=True,
            env=os.environ | {"XLA_FLAGS": QUICK_COMPILER},
        )
        answer = f"{asked} {'understood' if tried.returncode == 0 else 'unknown'}"
        if tried.returncode == 0 or b"XLA_FLAGS" in tried.stderr:
            known.parent.mkdir(parents=True, exist_ok=True)
            known.write_text(answer, encoding="utf-8")
    if answer.endswith("understood"):
        os.environ["XLA_FLAGS"] = QUICK_COMPILER


# Kept programs that are computed often, or draw: where random numbers are rounded must not depend
# on who draws them. All others, and what a test compiles itself, are computed a few times: without
# optimisation they compile in half the time.
OPTIMISED = {
    "_noise_rows",
    "_line_tables",
    "_line_rows",
    "_operating_points",
    "_made",
    "_moments_and_slopes",
    "_step",
    "_start",
    "run_seeds",
    "run_points",
    "_driven",
    "filtered_power",
    "_lowpass",
    "decimated",
    "_normal",
    "_cells",
    "_key",
    "_folded",
    "_wrapped",
    "_frequencies",
}


class _AsCommands(dict):
    """Options with which a program is made here as a command makes it that has `QUICK_COMPILER`:
    each loads the other's."""

    def __init__(self, options: Any) -> None:
        super().__init__(options, **{OPTIMISATION: 1})
        self.said = repr(options)  # stands in the name of the program's file

    def __repr__(self) -> str:
        return self.said


def _optimise_only_what_runs_often() -> None:
    from jaxmuscle._common import programs

    def kept(function: Any) -> Any:
        options = programs.OPTIONS
        often = function.__name__ in OPTIMISED
        return programs.Kept(
            function, _AsCommands(options) if often else options | {OPTIMISATION: 0}
        )

    programs.kept = kept
    programs.kept_to_run_long = lambda function: programs.Kept(function, _AsCommands({}))
    machine_code = programs._machine_code

    def as_commands(lowered: Any, options: Any) -> Any:
        """Simulations, which say no level: each loads the other's, and where they are rounded does
        not depend on what else they give back."""
        return machine_code(lowered, {OPTIMISATION: 1} | dict(options))

    programs._machine_code = as_commands


DPI, SAVED = figures.DPI, Figure.savefig
DRAWN_WHOLE = 2  # of the figures with the same axes, in a process
_drawn: Counter[tuple] = Counter()


def _draw_coarsely() -> None:
    """PNGs: at 300 dots per inch, as journals want them, each takes half a second more. Where axes
    of the same names were drawn before, placing and drawing them again takes another half: such a
    picture stays white, of the same size.
    """
    figures.DPI = 75
    Figure.savefig = _saved  # pyright: ignore[reportAttributeAccessIssue]


def _saved(figure: Figure, place: Any, *args: Any, **options: Any) -> None:
    kind = options.get("format") or str(getattr(place, "name", place)).rpartition(".")[2]
    if kind != "png":
        return SAVED(figure, place, *args, **options)
    axes = figure.get_axes()
    names = tuple(
        (ax.get_title("left"), ax.get_title(), ax.get_xlabel(), ax.get_ylabel()) for ax in axes
    )
    _drawn[names] += 1
    if _drawn[names] <= DRAWN_WHOLE:
        return SAVED(figure, place, *args, **options)
    SAVED(Figure(figure.get_size_inches(), figure.dpi), place, *args, **options)


@pytest.fixture
def as_fine_as_shipped(monkeypatch):
    """Figures as commands write them outside the tests."""
    monkeypatch.setattr(figures, "DPI", DPI)
    monkeypatch.setattr(Figure, "savefig", SAVED)


# Of a process: what it forgets, which takes seconds, it traces and loads again.
MOST_MAPS, MOST_MEMORY, SHARE = 45_000, 8 * 2**30, 0.34
# Tracing makes objects by the million, few of them in circles: looking for these at Python's own
# pace takes a tenth of it.
gc.set_threshold(50_000, 20, 10)

_keep_compiled_programs(OUT / "jax-cache")
_compile_quickly(OUT / "compiler.txt")
_optimise_only_what_runs_often()
keep_own_classes()
_draw_coarsely()


def pytest_configure(config: pytest.Config) -> None:
    config.pluginmanager.register(timing.Timing(config))
    _keep_to_own_cores(getattr(config, "workerinput", {}))
    _begin_without_optimisation()


def _keep_to_own_cores(worker: dict[str, Any]) -> None:
    """One of several workers keeps off the others' cores: threads of XLA that wait for one another
    cost a fifth more.

    So do those of NumPy's linear algebra, which counted the cores before.
    """
    if worker and hasattr(os, "sched_setaffinity"):
        cores, count = sorted(os.sched_getaffinity(0)), worker["workercount"]
        own = cores[int(worker["workerid"].removeprefix("gw")) % count :: count]
        if own:
            os.sched_setaffinity(0, own)
            threadpoolctl.threadpool_limits(len(own), user_api="blas")


def _begin_without_optimisation() -> None:
    """XLA reads its flags once. Commands that a test starts read theirs later: they have
    `QUICK_COMPILER` as it is."""
    flags = os.environ.get("XLA_FLAGS")
    if flags == QUICK_COMPILER:
        os.environ["XLA_FLAGS"] = flags.replace(f"{OPTIMISATION}=1", f"{OPTIMISATION}=0")
        jax.devices()
        os.environ["XLA_FLAGS"] = flags


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """The files that take longest first, so that no worker waits for the last one."""
    if hasattr(config, "workerinput"):
        items.sort(key=lambda item: timing.rank(item.path.stem))


def pytest_collection_finish() -> None:
    gc.freeze()  # what is imported stays: no later collection looks at it again


def pytest_runtest_setup(item: pytest.Item) -> None:
    shapes.begin_anew()
    # After `jaxmuscle speed`, which keeps nothing: all later tests would compile their own.
    os.environ.pop("JAXMUSCLE_CACHE", None)
    if item.get_closest_marker("gpu") and jax.default_backend() != "gpu":
        pytest.skip("needs a GPU")


@pytest.fixture(scope="module", autouse=True)
def _close_figures():
    """Those that a file leaves open count for the next one, and the twenty-first is an error
    there."""
    yield
    if "matplotlib.pyplot" in sys.modules:
        sys.modules["matplotlib.pyplot"].close("all")


def _is_full() -> bool:
    """Whether this process has too many compiled programs: by their memory maps, or by the memory
    of the process."""
    maps, pages = Path("/proc/self/maps"), Path("/proc/self/statm")
    if not maps.exists():
        return True
    resident, there = int(pages.read_text().split()[1]), os.sysconf("SC_PHYS_PAGES")
    most = min(MOST_MEMORY / os.sysconf("SC_PAGE_SIZE"), SHARE * there)
    return resident > most or len(maps.read_text().splitlines()) > MOST_MAPS


@pytest.fixture(scope="module", autouse=True)
def _forget_compiled_programs():
    """Every compiled program takes memory maps, of which Linux allows a process 65530: thousands of
    tests use them up. And programs of one piece take few maps, but as much memory: 9 GiB in the end
    if all were kept."""
    yield
    if _is_full():
        from jaxmuscle._common.programs import forget

        forget()
        jax.clear_caches()
        gc.collect()
        # What was freed stays with the process, which then would be full for ever: give it back to
        # the system.
        with contextlib.suppress(OSError, AttributeError):  # where the C library is another
            ctypes.CDLL(None).malloc_trim(0)


@pytest.fixture
def x64():
    """Run the test in float64."""
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="session")
def client():
    """Two workers of Dask, for all tests of a process."""
    pytest.importorskip("distributed")
    from jaxmuscle.commands.cluster import workers_of

    with workers_of(2, None) as client:
        yield client
