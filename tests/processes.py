"""Processes that run a program or a command, without the seconds that importing JAX and the package
takes each time.

One process for all tests of a worker imports them once, and starts no device. Each process that a
test asks for is a fork of it: with its own environment, folder and pipes it runs as `python -c
PROGRAM` or `python -m jaxmuscle` would, and ends as they end. On other systems than Linux it is
exactly these, and also where the imports start a thread, which a fork would not have.

What the imports themselves do is tested with true processes: the installed package
(test_package.py), the console script and the listings (test_cli.py), signals during imports
(test_signals.py), processes that fail together (test_ensemble.py).
"""

import atexit
import contextlib
import functools
import gc
import importlib
import json
import os
import runpy
import select
import signal
import socket
import subprocess
import sys
import threading
import types
from pathlib import Path
from typing import Any

SRC = Path(__file__).parents[1] / "src"
IMPORTED = (
    "diffrax",
    "jax.experimental.serialize_executable",
    "jax.scipy.linalg",
    "jaxmuscle.commands.main",
    "jaxmuscle.simulation._integrator",
    "matplotlib.pyplot",
    "optimistix",
    "pydantic",
    "pydantic.type_adapter",
    "pydantic.types",
    "rich.progress",
    "scipy.optimize",
    "scipy.signal",
    "scipy.stats",
    "xarray",
    "zarr",
)
# with all their public names
LAZY = ("jaxmuscle", "jaxmuscle.ensembles", "jaxmuscle.fits", "jaxmuscle.simulation")
LONGEST = 2**17  # bytes of a request
FORKS = sys.platform == "linux"


def environment(**changes: str) -> dict[str, str]:
    """That of the tests, with the package of this checkout."""
    return os.environ | {"PYTHONPATH": str(SRC)} | changes


def python(
    program: str, *arguments: str, cwd: Any = None, merged: bool = False, **changes: str
) -> Any:
    """`python -c program arguments`, begun, with changes of the environment; `merged`: its errors
    among its output."""
    return _begun(program, arguments, cwd, merged, changes)


def command(*arguments: str, cwd: Any = None, merged: bool = False, **changes: str) -> Any:
    """`jaxmuscle arguments`, as `python`."""
    return _begun(None, arguments, cwd, merged, changes)


def true_python(
    program: str, *arguments: str, cwd: Any = None, merged: bool = False, **changes: str
) -> Any:
    """As `python`; no fork, but a process that imports what it needs itself."""
    return _true(program, arguments, cwd, merged, changes)


def true_command(*arguments: str, cwd: Any = None, merged: bool = False, **changes: str) -> Any:
    """As `command`; no fork."""
    return _true(None, arguments, cwd, merged, changes)


def ended(process: Any, code: int = 0, seconds: float = 300) -> tuple[str, str]:
    """What a process said, which had to end with that exit code."""
    told = process.communicate(timeout=seconds)
    assert process.returncode == code, (process.returncode, *told)
    return told


KILLS = f"""
import json, sys
sys.path.append({str(SRC.parent / "benchmarks")!r})
import kills
kills.run(*json.loads(sys.argv[1]))
"""


class Run:
    """What `begun` of benchmarks/kills.py gives, as a fork."""

    def __init__(self, store: Path, reduce: bool, key: int, given: dict[str, Any]) -> None:
        self.process = python(KILLS, json.dumps([str(store), reduce, key, given]))
        self.kill = self.process.kill

    @property
    def exitcode(self) -> int | None:
        return self.process.poll()

    def join(self, timeout: float | None = None) -> None:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(timeout)
            self.process.close()


def _begun(
    program: str | None, arguments: tuple[str, ...], cwd: Any, merged: bool, changes: dict[str, str]
) -> Any:
    if FORKS and (line := _server()) is not None:
        request = {
            "program": program,
            "arguments": arguments,
            "cwd": str(cwd or Path.cwd()),
            "env": environment(**changes),
        }
        return Process(line, request, merged)
    return _true(program, arguments, cwd, merged, changes)


def _true(
    program: str | None, arguments: tuple[str, ...], cwd: Any, merged: bool, changes: dict[str, str]
) -> Any:
    begin = [sys.executable, *(("-m", "jaxmuscle") if program is None else ("-c", program))]
    return subprocess.Popen(
        [*begin, *arguments],
        cwd=cwd,
        env=environment(**changes),
        text=True,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT if merged else subprocess.PIPE,
    )


# Of the tests


class Process:
    """A fork; what tests use of `subprocess.Popen`."""

    def __init__(self, line: socket.socket, request: dict[str, Any], merged: bool) -> None:
        (said, out), (failed, errors), (told, tell) = pipes = [os.pipe() for _ in range(3)]
        try:
            socket.send_fds(
                line, [json.dumps(request).encode()], [out, out if merged else errors, tell]
            )
        finally:
            for _, end in pipes:
                os.close(end)
        # They stay open for as long as the process runs.
        opened = (open(pipe, encoding="utf-8") for pipe in (said, failed, told))  # noqa: SIM115
        self.stdout, self.stderr, self._told = opened
        self.pid, self.returncode = int(self._told.readline()), None

    def poll(self) -> int | None:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.wait(0)
        return self.returncode

    def wait(self, timeout: float | None = None) -> int | None:
        if self.returncode is None:
            if not select.select([self._told], [], [], timeout)[0]:
                raise subprocess.TimeoutExpired("a fork", timeout or 0.0)
            code, seconds = self._told.readline().split()
            self.returncode = int(code)
            TAKEN.append(float(seconds))
        return self.returncode

    def communicate(self, timeout: float | None = None) -> tuple[str, str]:
        """Output and errors until the end; a process that takes longer is killed."""
        clock = threading.Timer(timeout or 1e6, self.kill)
        clock.start()
        said: list[str] = []
        other = threading.Thread(target=lambda: said.append(self.stderr.read()))
        other.start()
        try:
            out = self.stdout.read()
            other.join()
            self.wait()
        finally:
            clock.cancel()
        self.close()
        return out, said[0]

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)

    def close(self) -> None:
        for stream in (self.stdout, self.stderr, self._told):
            stream.close()

    def __enter__(self) -> "Process":
        return self

    def __exit__(self, *_: object) -> None:
        self.wait()
        self.close()


TAKEN: list[float] = []  # seconds of the processor, of each fork that has ended


@functools.cache
def _server() -> socket.socket | None:
    """A line to the process that forks, which ends when the line does; None where it cannot."""
    mine, its = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with its:
        # Its imports are those of a command, which sets this before them.
        server = subprocess.Popen(
            [sys.executable, __file__, str(its.fileno())],
            pass_fds=[its.fileno()],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            env=environment(OPENBLAS_NUM_THREADS="1"),
        )

    def end() -> None:
        mine.close()
        server.wait()

    atexit.register(end)
    return mine if mine.recv(1) else None


# Of the process that forks


def imported() -> bool:
    """What programs and commands need; no device. Whether there is no thread, which a fork would
    not have."""
    for name in IMPORTED:
        importlib.import_module(name)
    for name in LAZY:
        module = importlib.import_module(name)
        for public in module.__all__:
            getattr(module, public)
    gc.freeze()
    return len(os.listdir("/proc/self/task")) == 1


def forked(line: socket.socket) -> dict[str, Any]:
    """Forks for every request until the tests end; what a fork has to do, in the fork."""
    running: dict[int, tuple[int, int]] = {}
    while True:
        for ready in select.select([line, *running], [], [])[0]:
            if ready is not line:
                pid, tell = running.pop(ready)
                _, status, usage = os.wait4(pid, 0)
                os.close(ready)
                code, seconds = os.waitstatus_to_exitcode(status), usage.ru_utime + usage.ru_stime
                with contextlib.suppress(BrokenPipeError):  # nobody waits for it
                    os.write(tell, f"{code} {seconds}\n".encode())
                os.close(tell)
                continue
            data, received, _, _ = socket.recv_fds(line, LONGEST, 3)
            if not data:
                os._exit(0)
            *streams, tell = received
            pid = os.fork()
            if pid == 0:
                for number, stream in enumerate(streams, 1):
                    os.dup2(stream, number)
                for unwanted in (*streams, tell, *running, *(tell for _, tell in running.values())):
                    os.close(unwanted)
                line.close()
                return json.loads(data)
            for stream in streams:
                os.close(stream)
            running[os.pidfd_open(pid)] = pid, tell
            os.write(tell, f"{pid}\n".encode())
    raise AssertionError


def become(request: dict[str, Any], begun: dict[str, str]) -> None:
    """The environment and folder of a request; JAX has read its variables in those of the process
    that forks."""
    import jax

    os.chdir(request["cwd"])
    os.environ.clear()
    os.environ.update(request["env"])
    for name in {name for name in {*begun, *request["env"]} if name.startswith("JAX_")}:
        option, value = name.lower(), request["env"][name]
        if value != begun.get(name):
            jax.config.update(option, type(getattr(jax.config, option) or "")(value))


def main(line: socket.socket) -> None:
    """Only forks return from here, and what cannot fork."""
    begun, interrupted = dict(os.environ), signal.getsignal(signal.SIGINT)
    if not imported():
        return
    line.send(b"1")
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the tests
    request = forked(line)
    signal.signal(signal.SIGINT, interrupted)
    become(request, begun)
    sys.path[0] = ""
    sys.argv[:] = ["-c", *request["arguments"]]
    if request["program"] is None:
        runpy.run_module("jaxmuscle", run_name="__main__", alter_sys=True)
        return
    program = types.ModuleType("__main__")
    sys.modules["__main__"] = program
    exec(compile(request["program"], "<string>", "exec"), program.__dict__)


if __name__ == "__main__":
    main(socket.socket(fileno=int(sys.argv[1])))
