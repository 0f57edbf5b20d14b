"""Signals: Ctrl-C, SIGTERM and SIGHUP end a command within ten seconds, whatever it does, and what
was reached is kept.

A signal raises `KeyboardInterrupt` in the main thread. Python can do that between two of its own
instructions only, not while XLA compiles or a compiled program runs. So a thread beside it ends the
process if the main thread does not come back. Nothing is half written then: files are renamed into
place.
"""

import atexit
import contextlib
import io
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator
from types import FrameType
from typing import Any, NoReturn

BAD_INPUT = 2  # exit code, also where nothing can be printed
LIMIT = 7.0  # seconds from the first signal to the end
PATIENCE = 1.0  # a second signal so many seconds later ends the process at once
SOON = 0.05
ENDING = [
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
]
LATER = getattr(signal, "SIGALRM", None)
OURS = [number for number in (*ENDING, LATER) if number is not None]
IMPORTS = "<frozen importlib"
STAYS = "what had been written before stays"
SHOW_CURSOR = "\x1b[?25h"  # a bar of rich has hidden it
OUTPUT = "the output"  # what the error calls a stdout that cannot be written


class Ear:
    """Handler of the signals that end a command; `code` is 128 and the number of the first that
    came, until then 0."""

    def __init__(self) -> None:
        self.code = 0
        self.stays = STAYS
        self.raised = False
        self.told = False
        self.working = True
        self.wakes, self.woken = socket.socketpair()
        self.wakes.setblocking(False)

    def listen(self) -> None:
        """Hear what is not ignored on purpose, as by `nohup`."""
        for number in ENDING:
            if signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, self)
        if LATER is not None:
            signal.signal(LATER, self)
        signal.set_wakeup_fd(self.wakes.fileno(), warn_on_full_buffer=False)
        sys.unraisablehook = self.unraisable
        if hasattr(os, "register_at_fork"):
            os.register_at_fork(after_in_child=deaf)
        threading.Thread(target=self.watch, daemon=True).start()
        # called last, since it is registered first: then Python takes its handlers down
        atexit.register(ignore)

    def __call__(self, number: int, frame: FrameType | None) -> None:
        if number != LATER:
            if self.raised:
                return  # it is ending; `watch` sees to a second signal
            # `watch` may have heard it before
            self.raised, self.code = True, self.code or 128 + number
        if not self.working:
            leave(self.code)  # all is written: Python's own end can take long
        if importing(frame) and LATER is not None:
            # a module that is loaded in part is an error somewhere else
            signal.setitimer(signal.ITIMER_REAL, SOON)
        else:
            raise KeyboardInterrupt

    def unraisable(self, told: Any) -> None:
        """An interruption that hit where Python drops exceptions (while it collects garbage, say)
        comes again."""
        if isinstance(told.exc_value, KeyboardInterrupt) and LATER is not None:
            signal.setitimer(signal.ITIMER_REAL, SOON)
        else:
            sys.__unraisablehook__(told)

    def watch(self) -> None:
        """End the process `LIMIT` after the first signal, or at a second one."""
        begun = None
        while True:
            self.woken.settimeout(
                None if begun is None else max(SOON, begun + LIMIT - time.monotonic())
            )
            try:
                ending = [number for number in self.woken.recv(64) if number in ENDING]
            except TimeoutError:
                break
            if ending and begun is None:
                begun, self.code = time.monotonic(), self.code or 128 + ending[0]
            elif ending and begun is not None and time.monotonic() > begun + PATIENCE:
                break
        with contextlib.suppress(OSError):
            cursor = SHOW_CURSOR if os.isatty(2) else ""
            os.write(2, f"{cursor}interrupted: {self.stays}\n".encode(errors="backslashreplace"))
        leave(self.code)


def deaf() -> None:
    """Take signals as Python does: in a fork, which would wake its parent."""
    signal.set_wakeup_fd(-1)
    for number in OURS:
        if isinstance(signal.getsignal(number), Ear):
            signal.signal(
                number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
            )


def ignore() -> None:
    """Hear nothing any more: the command has ended, and its exit code is known."""
    for number in ENDING:
        signal.signal(number, signal.SIG_IGN)


def importing(frame: FrameType | None) -> bool:
    """Whether a module is being loaded."""
    while frame is not None:
        if frame.f_code.co_filename.startswith(IMPORTS):
            return True
        frame = frame.f_back
    return False


def ears() -> list[Ear]:
    """Who listens now; the same one for several signals."""
    return [handler for number in ENDING if isinstance(handler := signal.getsignal(number), Ear)]


def interrupted() -> int:
    """Exit code of a command that was interrupted and has said so: 130, after a SIGTERM 143."""
    for ear in ears():
        ear.told = True
    return next((ear.code for ear in ears() if ear.code), 128 + signal.SIGINT)


def stays(said: str) -> None:
    """What is told from now on of what is written, should the process have to be ended."""
    for ear in ears():
        ear.stays = said


def leave(code: int) -> NoReturn:
    """End this process and its children now: Python's own end waits for threads and for programs
    that run on a device."""
    flushing = threading.Thread(target=flush, daemon=True)
    flushing.start()
    flushing.join(0.5)  # for ever if nobody reads
    # it may be imported in part
    children = getattr(sys.modules.get("multiprocessing"), "active_children", list)
    for child in children():
        child.kill()
    os._exit(code)


def flush() -> None:
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()


class Reader(io.RawIOBase):
    """What reads our output; if it has gone, the process ends by SIGPIPE, as commands of the shell
    do.

    The signal itself stays ignored: it would also end us when a server or a process that we have
    started closes its end. What else may hinder it, as a full disk, is an error once, if it is
    `needed`: Python would write what is left again at its end.
    """

    def __init__(self, number: int, *, needed: bool):
        self.number = number
        self.needed = needed

    def write(self, data: Any) -> int:
        try:
            return os.write(self.number, data)
        except BrokenPipeError:
            signal.signal(signal.SIGPIPE, signal.SIG_DFL)
            os.kill(os.getpid(), signal.SIGPIPE)
            raise
        except OSError as error:
            if self.needed:
                self.needed = False
                raise OSError(error.errno, error.strerror, OUTPUT) from None
            return len(data)

    def writable(self) -> bool:
        return True

    def fileno(self) -> int:
        return self.number

    def isatty(self) -> bool:
        return os.isatty(self.number)


def read_by(stream: Any, *, needed: bool) -> Any:
    """The same stream, to a `Reader`; letters that it does not know are written as escapes."""
    if not hasattr(signal, "SIGPIPE"):
        stream.reconfigure(errors="backslashreplace")
        return stream
    return io.TextIOWrapper(
        io.BufferedWriter(Reader(stream.fileno(), needed=needed)),
        stream.encoding,
        "backslashreplace",
        line_buffering=True,
    )


def open_closed() -> None:
    """Let the standard streams that whoever started us has closed lead nowhere, before a file takes
    the number of one of them and what is printed goes into it."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            number = os.open(os.devnull, os.O_RDWR)
            os.set_inheritable(number, True)
            setattr(sys, name, open(number, mode, closefd=False))  # noqa: SIM115 (it stays open)


@contextlib.contextmanager
def heard() -> Iterator[None]:
    """What runs in it ends at a signal, with the exit code of that signal and without a
    traceback."""
    open_closed()
    ear = Ear()
    ear.listen()
    sys.stdout, sys.stderr = read_by(sys.stdout, needed=True), read_by(sys.stderr, needed=False)
    try:
        yield
    except KeyboardInterrupt:
        ear.code = ear.code or 128 + signal.SIGINT
    except OSError as error:
        if error.filename != OUTPUT:
            raise
        print(f"error: {OUTPUT}: {error.strerror}", file=sys.stderr)
        ear.code, ear.told = BAD_INPUT, True
    finally:
        ear.working = False
        if ear.code:
            if (
                not ear.told
            ):  # typer ends in silence if it is interrupted while it reads the options
                print("interrupted", file=sys.stderr)
            leave(ear.code)
