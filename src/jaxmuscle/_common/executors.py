"""Work that any executor of `concurrent.futures`, or a Dask client, does in blocks: results in one
order, whoever works and however many."""

import contextlib
import itertools
import logging
import queue
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, Protocol, TypeVar, runtime_checkable

import jax

from .errors import WorkersLostError

LOG = logging.getLogger("jaxmuscle")
Item = TypeVar("Item")
Made = TypeVar("Made")
# Blocks under way or waiting for an earlier one. More keep more workers busy; what they return
# waits in memory, up to 4 MB each.
WINDOW = 512
PATIENCE = 60.0  # seconds without a result, after which a scheduler is asked for its workers
AGAIN = (
    "Give the same call or command again; one that writes a store goes on with `resume=True`"
    " (--resume)"
)


@runtime_checkable
class DaskClient(Protocol):
    """What is needed of a `distributed.Client`."""

    def get_executor(self, **options: Any) -> Executor: ...

    def scheduler_info(self) -> dict[str, Any]: ...


if TYPE_CHECKING:
    AnyExecutor = Executor | DaskClient
else:
    AnyExecutor = Any  # checked by `pool_of`, with a sentence


class Block(NamedTuple, Generic[Item, Made]):
    """Work on one item in a worker, in the precision of the caller, which is a setting of each
    process."""

    work: Callable[[Item], Made]
    double: bool

    def __call__(self, item: Item) -> Made:
        with jax.enable_x64(self.double):
            return self.work(item)


def pool_of(executor: AnyExecutor) -> Executor:
    """The executor to submit to.

    **Raises:** `ValueError` for what is no executor, and for processes that are forked: a fork of
    a process in which JAX has begun waits for ever.
    """
    if isinstance(executor, DaskClient):
        # pure: Dask would take two calls with equal arguments for one
        return executor.get_executor(pure=False)
    if not isinstance(executor, Executor):
        raise ValueError(
            f"executor = {executor!r}: give an executor of concurrent.futures or a Dask client"
        )
    context = getattr(executor, "_mp_context", None)
    if context is not None and context.get_start_method() == "fork":
        raise ValueError(
            "executor: its processes are forked, and JAX does not run in a fork. Make it with"
            ' ProcessPoolExecutor(mp_context=multiprocessing.get_context("spawn"))'
        )
    return executor


def results_of(
    executor: AnyExecutor,
    work: Callable[[Item], Made],
    items: Iterable[Item],
    window: int | None = None,
) -> Generator[tuple[Item, Made], None, None]:
    """Every item and `work(item)`, in the order of the items.

    At most `window` items are under way, by default `WINDOW`. `work` may be done twice for an item,
    where a worker is lost, so it must do no harm. A result is given up as soon as it is here: Dask
    computes again what a lost worker had and somebody still wants.

    **Raises:** what `work` raises; `WorkersLostError` if the workers, or their scheduler, are lost.
    """
    pool, call = pool_of(executor), Block(work, bool(jax.config.jax_enable_x64))  # pyright: ignore[reportAttributeAccessIssue]
    rest, ended = enumerate(items), queue.SimpleQueue()
    under_way: dict[Future[Any], tuple[int, Any]] = {}
    waiting: dict[int, tuple[Any, Any]] = {}
    wanted = 0
    try:
        while True:
            room = (window or WINDOW) - len(under_way) - len(waiting)
            for number, item in itertools.islice(rest, room):
                with _losses():
                    future = pool.submit(call, item)
                under_way[future] = number, item
                future.add_done_callback(ended.put)
            if not under_way:
                return
            future = _next_ended(ended, executor)
            number, item = under_way.pop(future)
            with _losses():
                waiting[number] = item, future.result()
            del future
            while wanted in waiting:
                yield waiting.pop(wanted)
                wanted += 1
    finally:
        for future in under_way:
            future.cancel()


def _next_ended(ended: "queue.SimpleQueue[Future[Any]]", executor: AnyExecutor) -> Future[Any]:
    while True:
        try:
            return ended.get(timeout=PATIENCE)
        except queue.Empty:
            if isinstance(executor, Executor):
                continue
            if not executor.scheduler_info().get("workers"):
                LOG.warning("notice: the scheduler has no workers now; waiting for some to come")


@contextlib.contextmanager
def _losses() -> Iterator[None]:
    """What an executor says that lost its workers, and Dask of its own, as one error."""
    try:
        yield
    except Exception as error:
        if isinstance(error, CancelledError | BrokenExecutor):
            why = f"the workers, or their scheduler, are lost ({type(error).__name__})"
        elif type(error).__module__.partition(".")[0] == "distributed":
            why = str(error)
        else:
            raise
        raise WorkersLostError(f"{why}. {AGAIN}") from error
