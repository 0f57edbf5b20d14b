"""Several processes, on one machine or many, that share the work on one store: JAX's distributed
runtime."""

import atexit
import contextlib
import os
import signal
import socket
import sys
import threading
import time
from typing import NoReturn

import jax
import numpy as np

from jaxmuscle._common.errors import ProcessLostError

TEXT = 4096
LAST_WORDS = 2.0  # seconds
PATIENCE = 10.0


def join(coordinator: str | None, processes: int | None, process_id: int | None) -> None:
    """Become one of several processes; with None for all arguments as the launcher says (SLURM,
    Open MPI, ...).

    **Arguments:**

    - `coordinator`: "host:port" of process 0
    - `processes`: how many
    - `process_id` of this one, from 0

    **Raises:** `ValueError` for arguments that do not go together, or if nobody answers.
    """
    given = (coordinator, processes, process_id)
    if any(g is None for g in given) and any(g is not None for g in given):
        raise ValueError(
            "--coordinator, --processes and --process-id belong together: give all three, or none"
            " of them under a launcher that JAX knows (SLURM, Open MPI)"
        )
    if processes is not None and process_id is not None and not 0 <= process_id < processes:
        raise ValueError(
            f"--process-id = {process_id} must be from 0 to --processes - 1 = {processes - 1}"
        )
    try:
        jax.distributed.initialize(coordinator, processes, process_id)
    except (RuntimeError, ValueError) as error:
        raise ValueError(
            f"the processes did not find each other at {coordinator}: {error}"
        ) from None
    if (handler := signal.getsignal(signal.SIGTERM)) is not None:
        # JAX has put one of its own there, which only takes a note
        signal.signal(signal.SIGTERM, handler)
    if coordinator is not None and process_id:
        _follow(coordinator)


def _follow(coordinator: str) -> None:
    """End this process in one sentence once process 0 has died: XLA would end it with a stack of
    C++."""
    host, _, port = coordinator.rpartition(":")
    ended = threading.Event()
    atexit.register(ended.set)  # before JAX says goodbye to process 0

    def follow() -> None:
        while True:
            try:
                with socket.create_connection((host.strip("[]"), int(port)), PATIENCE) as line:
                    line.settimeout(None)
                    with contextlib.suppress(ConnectionError):
                        while line.recv(TEXT):
                            pass
            except OSError:
                break
        if not ended.is_set():
            os.write(
                2,
                b"failed: process 0 of this run died or stopped. What is complete stays: start all"
                b" processes again with --resume\n",
            )
            os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


def launched() -> bool:
    """Whether a launcher that JAX knows started this process as one of several."""
    counts = ("SLURM_STEP_NUM_TASKS", "OMPI_COMM_WORLD_SIZE")
    return any(os.environ.get(name, "1") not in ("", "1") for name in counts)


def rank_and_count() -> tuple[int, int]:
    """Number of this process, and of all."""
    return jax.process_index(), jax.process_count()


def agreed(text: str) -> str:
    """What process 0 says (up to 4096 bytes), once all have asked. Raises `ProcessLostError`."""
    from jax.experimental import multihost_utils

    if jax.process_count() == 1:
        return text
    said = np.frombuffer(text.encode()[:TEXT].ljust(TEXT, b"\0"), np.uint8).astype(np.int32)
    try:
        heard = multihost_utils.broadcast_one_to_all(said)
    except Exception as error:
        raise ProcessLostError(
            f"another process of this run died or stopped ({_first_line(error)})"
        ) from error
    return bytes(np.asarray(heard).astype(np.uint8)).rstrip(b"\0").decode(errors="replace")


def meet() -> None:
    """Wait for all processes. Raises `ProcessLostError`."""
    agreed("")


def _first_line(error: Exception) -> str:
    return str(error).partition("\n")[0][:200]


def leave(code: int) -> NoReturn:
    """End this process with the exit `code`: JAX's own end would wait for processes that will not
    come.

    Process 0 waits two seconds before it ends: the others end when it does, and have messages to
    print.
    """
    if jax.process_count() > 1 and jax.process_index() == 0:
        time.sleep(LAST_WORDS)
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)
