"""Compiled programs that outlive the process: traced and compiled once, then loaded from the user's
cache folder."""

import contextlib
import functools
import hashlib
import logging
import os
import pickle
import platform
import re
import secrets
import threading
import time
import weakref
from collections.abc import Callable, Iterator, Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple, ParamSpec, TypeVar

import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer
from jax.experimental.xla_metadata import set_xla_metadata

from .environment import program_folder
from .files import replacing

P = ParamSpec("P")
R = TypeVar("R")
# What a program may be made of: code whose version is part of the key. Another's class may change
# without a sign.
OTHERS = (
    "jax",
    "jaxlib",
    "numpy",
    "equinox",
    "diffrax",
    "optimistix",
    "lineax",
    "jaxtyping",
    "scipy",
    "blackjax",
)
KNOWN = ("jaxmuscle", "builtins", "collections", *OTHERS)
ADDRESS = re.compile(r" at 0x[0-9a-f]+")
UNKNOWN = re.compile(r"_[0-9a-f]{16}_kept\b")
CONFIG = (
    "jax_enable_x64",
    "jax_numpy_dtype_promotion",
    "jax_default_matmul_precision",
    "jax_default_prng_impl",
    "jax_threefry_partitionable",
    "jax_debug_nans",
    "jax_disable_most_optimizations",
)
# XLA's older way to make code of loops: compiled in half the time, loaded in three quarters, and
# run as fast.
OPTIONS = {"xla_cpu_use_fusion_emitters": False}
# Of AVX-512's registers LLVM uses half as a rule, since old processors slowed down when it used
# them whole.
WIDE = {"xla_cpu_prefer_vector_width": 512}
# How XLA marks a loop that it makes one piece of machine code, without any call between its steps.
IN_ONE_PIECE = {"inlineable": "false", "xla_cpu_small_call": "true"}
UNUSED = 60 * 86400.0  # seconds
LARGEST = 2**30  # bytes of the folder
# jaxlib 0.10 cuts a batch of LAPACK's calls into pieces for its own threads and blocks one of them
# until they are done: as many programs at once as there are threads would wait for ever.
LAPACK = threading.Lock()
LOG = logging.getLogger("jaxmuscle")


class _Slot(NamedTuple):
    """Where the number of an output stands in what a program returns."""

    number: int


class _Program(NamedTuple):
    """A compiled program of arrays, the tree of what it returns, a `_Slot` for each array, and
    whether it calls LAPACK."""

    call: Callable[..., Any]
    shape: Any
    calls_lapack: bool

    def __call__(self, arrays: list[Any]) -> Any:
        if self.calls_lapack and _version("jaxlib").startswith("0.10."):
            with LAPACK:
                found = jax.block_until_ready(self.call(*arrays))
        else:
            found = self.call(*arrays)
        return jax.tree.map(
            lambda x: found[x.number] if isinstance(x, _Slot) else x, self.shape, is_leaf=_is_slot
        )


def _is_slot(leaf: Any) -> bool:
    return isinstance(leaf, _Slot)


_ALL: "weakref.WeakSet[Kept]" = weakref.WeakSet()
MOST = 48  # programs of one function in memory; those that have to go come back from the folder


class Kept:
    """A function that is compiled for the arrays among its arguments (trees), the rest fixed, and
    kept between processes.

    As `eqx.filter_jit`; a program is loaded if its code, its versions, the machine and the
    structure of its arguments are the same. One with an own class among its arguments is traced in
    every process, and loaded if that gives the same program. Anything that stands against it (no
    folder, several devices, a damaged file) means that it is traced and compiled as usual.
    `JAXMUSCLE_CACHE=off` switches keeping off.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        options: Mapping[str, Any] | None = None,
        *,
        simulates: bool = False,
    ):
        functools.update_wrapper(self, function)
        self.function = function
        self.options = OPTIONS if options is None else options
        self.simulates = simulates
        self.jitted = eqx.filter_jit(function)
        self.programs: dict[Any, _Program] = {}
        self.traces = 0
        _ALL.add(self)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        # Of our own arrays, whatever the caller has set; NaN is a sign here (no equilibrium, an
        # unstable start of a fit), which our own code looks for.
        with jax.numpy_rank_promotion("allow"), jax.debug_nans(False):
            return self._called(*args, **kwargs)

    def _called(self, *args: Any, **kwargs: Any) -> Any:
        leaves, structure = jax.tree.flatten((args, kwargs))
        which = tuple(_is_array(leaf) for leaf in leaves)
        arrays = [leaf for leaf, own in zip(leaves, which, strict=True) if own]
        if any(isinstance(x, Tracer) for x in arrays) or jax.config.jax_disable_jit:  # pyright: ignore
            return self.jitted(*args, **kwargs)
        fixed = tuple(leaf for leaf, own in zip(leaves, which, strict=True) if not own)
        # With their types: 1, 1.0 and True are equal, and not the same program.
        signature = (
            structure,
            which,
            tuple((type(x), x) for x in fixed),
            tuple(map(_kind, arrays)),
            _config(),
        )
        program = self.programs.get(signature)
        if program is None:
            # Every program takes memory maps, of which Linux allows a process 65530.
            for oldest in list(self.programs)[: max(0, len(self.programs) + 1 - MOST)]:
                self.programs.pop(oldest, None)
            program = self.programs[signature] = self._made(
                structure, which, fixed, arrays, signature
            )
        return program(arrays)

    def _made(
        self,
        structure: Any,
        which: tuple[bool, ...],
        fixed: tuple,
        arrays: list[Any],
        signature: Any,
    ) -> _Program:
        """From the folder, or traced, compiled and put there."""
        folder = program_folder() if len(jax.devices()) == 1 else None
        place = None if folder is None else _place(folder, self.function, signature)
        if place is not None and (found := _kept_program(place)) is not None:
            return found
        shape: list[Any] = []

        def flat(*arrays: Any) -> tuple[Any, ...]:
            self.traces += 1
            some, rest = iter(arrays), iter(fixed)
            args, kwargs = jax.tree.unflatten(
                structure, [next(some if own else rest) for own in which]
            )
            leaves, tree = jax.tree.flatten(self.function(*args, **kwargs))
            number = iter(range(len(leaves)))
            shape[:] = [
                jax.tree.unflatten(
                    tree, [_Slot(next(number)) if _is_array(x) else x for x in leaves]
                )
            ]
            return tuple(x for x in leaves if _is_array(x))

        name = getattr(self.function, "__name__", "program")
        name = name if folder is None else _unknown(name)

        def program(options: Mapping[str, Any]) -> _Program:
            traced = functools.partial(flat)  # new, so that JAX traces it anew
            traced.__name__ = name  # pyright: ignore[reportAttributeAccessIssue]
            # Unused arguments stay: programs that say the same take the same arguments.
            lowered = jax.jit(traced, keep_unused=True).lower(*arrays)
            return _compiled(lowered, options, folder, place, shape[0])

        if not self.simulates or jax.default_backend() != "cpu":
            return program(self.options)
        wide = {**self.options, **WIDE} if " avx512f " in _machine() else self.options
        try:
            with _whole_loops():
                return program(wide)
        except jax.errors.JaxRuntimeError as error:
            # A muscle of the user's own may call what such a loop cannot hold (LAPACK, a sort).
            LOG.debug("%s: not in one piece: %s", name, error)
            return program(wide)


def _machine_code(lowered: Any, options: Mapping[str, Any]) -> Any:
    """A lowered program, compiled with options; without them by a version of XLA that does not know
    them."""
    try:
        return lowered.compile(dict(options))
    except jax.errors.JaxRuntimeError as error:
        if "No such compile option" not in str(error):
            raise
        return lowered.compile()


def _compiled(
    lowered: Any, options: Mapping[str, Any], folder: Path | None, place: Path | None, shape: Any
) -> _Program:
    """A lowered program, compiled or from the folder if other code gave the same one; put there,
    and its name into its place, if it has one."""
    text = UNKNOWN.sub("", lowered.as_text())
    calls_lapack = "lapack_" in text
    if folder is None:
        return _Program(_machine_code(lowered, options), shape, calls_lapack)
    key = (text, _versions(), _machine(), os.environ.get("XLA_FLAGS", ""), options)
    name = hashlib.sha256(repr(key).encode()).hexdigest()
    program = folder / name
    compiled = _load(program)
    is_new = compiled is None
    if is_new:
        compiled = _machine_code(lowered, options)
        _write(program, lambda: _serialized(compiled))
    if place is not None and program.exists():
        _write(place, lambda: (name, shape, calls_lapack))
    if is_new:
        _tidied(folder)
    return _Program(compiled, shape, calls_lapack)


def _unknown(name: str) -> str:
    """The name of a program that JAX's own cache, where one is set, cannot know: what it gives back
    cannot be written, since XLA would leave its functions out."""
    return f"{name}_{secrets.token_hex(8)}_kept"


def kept(function: Callable[P, R]) -> Callable[P, R]:
    """Decorates a function that is to be compiled, and kept."""
    return Kept(function)


def kept_to_run_long(function: Callable[P, R]) -> Callable[P, R]:
    """As `kept`, for a program that runs longer than it compiles: XLA's newer emitters make it a
    tenth faster."""
    return Kept(function, {})


def kept_simulation(function: Callable[P, R]) -> Callable[P, R]:
    """As `kept`, for a program of many steps: with wide vectors where the processor has them, and
    with what is `in_one_piece`."""
    return Kept(function, simulates=True)


_WHOLE = threading.local()


@contextlib.contextmanager
def _whole_loops() -> Iterator[None]:
    _WHOLE.wanted = True
    try:
        yield
    finally:
        _WHOLE.wanted = False


def in_one_piece(function: Callable[[], R]) -> R:
    """Call a function whose loops become one piece of machine code in a kept simulation.

    Else XLA calls the runtime at every step of a loop, several times, and splits what is inside
    among all cores, although these are busy with other seeds.
    """
    if not getattr(_WHOLE, "wanted", False):
        return function()
    arrays, rest = eqx.partition(eqx.filter_closure_convert(function), eqx.is_array)

    @jax.jit
    def piece(arrays: Any) -> Any:
        # What goes in comes out again: XLA ends the process at an input that nothing in the piece
        # uses, as when it has found out that it makes no difference.
        return eqx.combine(arrays, rest)(), arrays

    return jax.lax.optimization_barrier(set_xla_metadata(piece(arrays), **IN_ONE_PIECE))[0]


def forget() -> None:
    """Drop all programs from memory, as `jax.clear_caches` does with JAX's own."""
    for function in list(_ALL):
        function.programs.clear()


def _is_array(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array | np.ndarray | np.generic)


def _kind(array: Any) -> tuple[Any, ...]:
    return np.shape(array), array.dtype, getattr(array, "weak_type", False)


def _config() -> tuple[Any, ...]:
    return tuple(getattr(jax.config, name, None) for name in CONFIG)


def _place(folder: Path, function: Any, signature: Any) -> Path | None:
    """The file of a program; None if it is made of what may change without a sign."""
    structure, which, fixed, kinds, config = signature
    told = _told(structure)
    rest = repr((which, fixed, kinds, config))
    if told is None or ADDRESS.search(rest) or not all(_known(kind) for kind, _ in fixed):
        return None
    key = (
        function.__module__,
        function.__qualname__,
        told,
        rest,
        _machine(),
        os.environ.get("XLA_FLAGS", ""),
    )
    return folder / _code()[:16] / hashlib.sha256(repr(key).encode()).hexdigest()


def _known(kind: type) -> bool:
    return kind.__module__.partition(".")[0] in KNOWN


def _told(structure: Any) -> str | None:
    """A tree's structure as text that says the same in every process."""
    node = structure.node_data()
    if node is None:
        return "*"
    kind, data = node
    name, text = f"{kind.__module__}.{kind.__qualname__}", _text(data)
    if not _known(kind) or text is None or ADDRESS.search(text):
        return None
    children = [_told(child) for child in structure.children()]
    return None if None in children else f"{name}|{text}({','.join(map(str, children))})"


def _text(data: Any) -> str | None:
    """As `repr`; but that of a module leaves out what *is* its default, which the same number read
    from a file is not."""
    if isinstance(data, eqx.Module):
        leaves, structure = jax.tree.flatten(data)
        told = _told(structure)
        return None if told is None else f"{told}{leaves}"
    if isinstance(data, tuple):
        parts = [_text(part) for part in data]
        return None if None in parts else f"({','.join(map(str, parts))})"
    return repr(data)


@functools.cache
def _code() -> str:
    """Digest of the package's code and of the versions of what it calls."""
    digest = hashlib.sha256(repr(_versions()).encode())
    root = Path(__file__).resolve().parents[1]
    for path in sorted(root.rglob("*.py")):
        digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


def _versions() -> tuple[str, ...]:
    return tuple(map(_version, OTHERS))


@functools.cache
def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:  # of an extra
        return ""


@functools.cache
def _machine() -> str:
    """What machine code depends on."""
    device = jax.devices()[0]
    try:
        flags = next(
            line
            for line in Path("/proc/cpuinfo").read_text().splitlines()
            if line.startswith("flags")
        )
    except (OSError, StopIteration):
        flags = platform.processor()
    return repr((platform.system(), platform.machine(), device.platform, device.device_kind, flags))


def _serialized(compiled: Any) -> Any:
    from jax.experimental.serialize_executable import serialize

    return serialize(compiled)


def _write(place: Path, content: Callable[[], Any]) -> None:
    """Write what can be pickled, a digest before it; what cannot be written is done without."""
    try:
        whole = pickle.dumps(content())
        place.parent.mkdir(mode=0o700, exist_ok=True)  # also where the user has just removed it
        with replacing(place) as temporary:
            temporary.write_bytes(_digest(place, whole) + whole)
    except Exception as error:  # a cache: the program is there, it is only not kept
        LOG.debug("not kept: %s: %s", place.name, error)


def _digest(place: Path, whole: bytes) -> bytes:
    """Of a file's content under its name: a copy with another name is damaged."""
    return hashlib.sha256(place.name.encode() + whole).digest()


def _tidied(folder: Path) -> None:
    """Remove what nobody has used for two months, and then what was used longest ago, until the
    folder is small enough."""
    found, now, whole = [], time.time(), 0
    for path in folder.rglob("*"):
        with contextlib.suppress(OSError):
            if path.is_file():
                state = path.stat()
                found.append((state.st_mtime, state.st_size, path))
    for used, size, path in sorted(found, reverse=True):
        whole += size
        if now - used > UNUSED or whole > LARGEST:
            with contextlib.suppress(OSError):
                path.unlink()


def _read(place: Path) -> Any:
    """What `_write` wrote; None if there is nothing, or something damaged."""
    try:
        whole = place.read_bytes()
        with contextlib.suppress(OSError):
            os.utime(place)  # it is in use, see `_tidied`
        if _digest(place, whole[32:]) == whole[:32]:
            return pickle.loads(whole[32:])
        LOG.debug("damaged: %s", place.name)
    except OSError:
        pass
    except Exception as error:  # of another version, perhaps
        LOG.debug("not read: %s: %s", place.name, error)
    return None


@functools.cache
def _prepare() -> None:
    """Make JAX's linear algebra ready to be called.

    jaxlib finds LAPACK when it lowers the first program that needs it; one that is loaded would
    call into nothing.
    """
    jax.jit(jax.lax.linalg.lu).lower(np.eye(1))


def _kept_program(place: Path) -> _Program | None:
    """What was put there as the program of that file; None if there is none, or something else."""
    match _read(place):
        case (str(name), shape, bool(calls_lapack)):
            compiled = _load(place.parent.parent / name)
            slots = [
                leaf.number for leaf in jax.tree.leaves(shape, is_leaf=_is_slot) if _is_slot(leaf)
            ]
            if compiled is not None and slots == list(range(compiled.out_tree.num_leaves)):
                return _Program(compiled, shape, calls_lapack)
    return None


def _load(place: Path) -> Any:
    """A compiled program that was kept; None if there is none, or a damaged one."""
    made = _read(place)
    if made is None:
        return None
    _prepare()
    try:
        from jax.experimental.serialize_executable import deserialize_and_load

        return deserialize_and_load(*made)
    except Exception as error:  # a cache: it is made again
        LOG.debug("not loaded: %s: %s", place.name, error)
        return None
