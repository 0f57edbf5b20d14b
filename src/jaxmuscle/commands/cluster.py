"""`--workers` and `--scheduler`: other processes, here or elsewhere, that do a command's work."""

import contextlib
import importlib.util
import json
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

from .console import err, plain

ANSWER = 30  # seconds in which a scheduler has to answer
SETTINGS = {
    # A worker that takes longer to begin again would be given up for good, and a run without
    # workers waits for ever.
    "distributed.deploy.lost-worker-timeout": "10m",
    # workers that may die with a block before Dask gives the block up; by default 3
    "distributed.scheduler.allowed-failures": 100,
    # looks at the stack a hundred times a second, for a tenth of the processor time
    "distributed.worker.profile.enabled": False,
    "distributed.worker.multiprocessing-method": "spawn",  # JAX does not run in a fork
}
# Ctrl-C reaches all processes of a terminal; it is this one that ends the others, without a word.
DEAF = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"
BEGINS_WITH = "distributed.nanny.pre-spawn-environ"
TRIM = "MALLOC_TRIM_THRESHOLD_"

Workers = Annotated[
    int | None,
    typer.Option(
        "--workers",
        min=1,
        max=1024,
        help=(
            "Share the work among so many processes on this machine, each with one core. Needs"
            " jaxmuscle[dask]. By default this process does it all."
        ),
    ),
]
Scheduler = Annotated[
    str | None,
    typer.Option(
        "--scheduler",
        metavar="FILE|HOST:PORT",
        help=(
            "Share the work among the workers of a Dask scheduler, on any machines: its scheduler"
            " file or its address. Needs jaxmuscle[dask]."
        ),
    ),
]


@contextlib.contextmanager
def workers_of(count: int | None, scheduler: str | None) -> Iterator[Any]:
    """A Dask client of so many workers here, or of a scheduler that runs; None for neither.

    Workers here are gone afterwards; those of a scheduler stay.

    **Raises:** `ImportError` without dask; `ValueError` for both, for a scheduler file that is not
    there or says no address, and for a scheduler that does not answer.
    """
    if count is None and scheduler is None:
        yield None
        return
    if count is not None and scheduler is not None:
        raise ValueError(
            f"--workers {count} and --scheduler {scheduler}: give one; a scheduler has its own"
            " workers"
        )
    from jaxmuscle._common.arguments import require_extra  # and numpy, which --help does without

    require_extra("dask")
    import distributed  # noqa: F401  # sets its own levels

    for name in ("distributed", "distributed.client"):  # what goes wrong is said in one sentence
        logging.getLogger(name).setLevel(logging.CRITICAL)
    with _client_here(count) if scheduler is None else _client_of(scheduler) as client:
        yield client


@contextlib.contextmanager
def _client_here(count: int | None) -> Iterator[Any]:
    """Workers that only this machine can reach."""
    from dask import config
    from distributed import Client, LocalCluster

    # With it Dask's workers give memory back after every step, for a third of the processor time.
    begins = {n: v for n, v in config.get(BEGINS_WITH).items() if n != TRIM}
    drawn = importlib.util.find_spec("bokeh") is not None
    with (
        config.set({**SETTINGS, BEGINS_WITH: begins}),
        LocalCluster(
            n_workers=count,
            threads_per_worker=1,
            host="127.0.0.1",
            protocol="tcp",
            dashboard_address="127.0.0.1:0",
            memory_limit=0,  # as this process, which has none
            preload=DEAF,
            silence_logs=logging.CRITICAL,
        ) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        if drawn:
            _say_dashboard(client)
        yield client


@contextlib.contextmanager
def _client_of(scheduler: str) -> Iterator[Any]:
    from distributed import Client

    client: Any
    address = _address_of(scheduler)
    try:
        client = Client(address, timeout=ANSWER, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ValueError(
            f"--scheduler {scheduler}: nobody answers at {address} ({error}). Start it with"
            " `dask scheduler`, or give the address that it prints"
        ) from None
    with client:
        err.print(f"{len(client.nthreads())} workers at {plain(address)}", highlight=False)
        if importlib.util.find_spec("bokeh") is not None:
            _say_dashboard(client)
        yield client


def _address_of(scheduler: str) -> str:
    """Of a scheduler file, or of HOST:PORT."""
    path = Path(scheduler)
    if path.is_file():
        try:
            return str(json.loads(path.read_text(encoding="utf-8"))["address"])
        except (ValueError, KeyError, TypeError):
            raise ValueError(
                f"--scheduler {scheduler}: is no scheduler file; `dask scheduler --scheduler-file"
                " FILE` writes one"
            ) from None
    host, _, port = scheduler.rpartition(":")
    if not host or not port.isdigit():
        raise ValueError(
            f"--scheduler {scheduler}: there is no such file, and it is no HOST:PORT; start the"
            " scheduler first (`dask scheduler --scheduler-file FILE`)"
        )
    return scheduler if "://" in scheduler else f"tcp://{scheduler}"


def _say_dashboard(client: Any) -> None:
    with contextlib.suppress(KeyError):  # a scheduler without one
        err.print(f"dashboard: {plain(client.dashboard_link)}", highlight=False)
