"""Signals end a command soon, with their exit code and no traceback, and what was reached is
kept."""

import signal
import sys
import time

import jax
import processes
import pytest
from processes import python, true_python

import jaxmuscle as jm
from jaxmuscle.ensembles._run import _read_tally

BEGIN = """
import os, signal, socket, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # and what `nohup` started that one
from jaxmuscle.commands import signals
from jaxmuscle.__main__ import main
def send(number):
    os.kill(os.getpid(), number)
"""
pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="has no such signals")


def begun(code, *arguments, cwd=None, begin=python):
    """A process of that program, which can say when it wants a signal."""
    return begin(BEGIN + code, *arguments, cwd=cwd)


def ended(process, code):
    """What a process said, which ended with that exit code and in order."""
    out, errors = processes.ended(process, code, 120)
    assert "Traceback" not in errors and "Exception ignored" not in errors
    return out + errors


ALONE = {
    "between two instructions": ("send(signal.SIGTERM); time.sleep(60)", 143),
    "the terminal is gone": ("send(signal.SIGHUP); time.sleep(60)", 129),
    "where Python drops exceptions": (
        """
class Dropped:
    def __del__(self):
        send(signal.SIGINT)
        time.sleep(1)
Dropped()
time.sleep(60)""",
        130,
    ),
    "a signal that was dropped, and a second one": (
        """
signals.PATIENCE = 0.1
for _ in range(2):
    try:
        send(signal.SIGINT)
        time.sleep(1)
    except KeyboardInterrupt:
        time.sleep(0.5)
time.sleep(60)""",
        130,
    ),
    "at the end": ("send(signal.SIGTERM); raise ValueError", 143),
    "a child's, which is not its parent's": (
        """
child = os.fork()
if child == 0:
    send(signal.SIGTERM)
assert os.waitpid(child, 0)[1] == signal.SIGTERM
time.sleep(0.3)
send(signal.SIGINT)
time.sleep(60)""",
        130,
    ),
    "somebody else's pipe is closed": (
        """
ours, theirs = socket.socketpair()
theirs.close()
try:
    ours.send(b"x")
except BrokenPipeError:
    send(signal.SIGTERM)
time.sleep(60)""",
        143,
    ),
}


@pytest.mark.parametrize("case", ALONE)
def test_without_a_command(case):
    text, code = ALONE[case]
    process = begun(
        "with signals.heard():\n" + "\n".join("    " + line for line in text.splitlines())
    )
    assert "interrupted" in ended(process, code) or case == "at the end"


def test_what_is_ignored_on_purpose_stays_so():
    """As with nohup."""
    code = (
        "signal.signal(signal.SIGHUP, signal.SIG_IGN)\nwith signals.heard(): send(signal.SIGHUP);"
        " print('goes on')"
    )
    assert "goes on" in ended(begun(code), 0)


def test_what_ends_in_silence_is_told_all_the_same():
    """Typer makes an exit code of an interruption that comes while it reads the options."""
    code = """
with signals.heard():
    try:
        send(signal.SIGINT)
        time.sleep(60)
    except KeyboardInterrupt:
        sys.exit(130)"""
    assert ended(begun(code), 130).strip() == "interrupted"


@pytest.mark.parametrize("module", ["typer", pytest.param("jax", marks=pytest.mark.slow)])
def test_while_a_module_is_imported(module, tmp_path):
    """Of the command, and of what a fit needs."""
    code = f"""
class Now:
    def find_spec(self, name, path=None, target=None):
        if name == {module!r}:
            sys.meta_path.remove(self)
            send(signal.SIGINT)
sys.meta_path.insert(0, Now())
main()"""
    process = begun(
        code, "fit", "vastus-lateralis-26mvc", "--out", "out", cwd=tmp_path, begin=true_python
    )
    assert ended(process, 130).strip().startswith("interrupted")
    assert not list(tmp_path.rglob("*.*"))


def test_while_a_compiled_program_runs():
    """It never ends, and Python gets no turn."""
    code = """
import jax
signals.LIMIT = 0.5
with signals.heard():
    signals.stays("nothing was written")
    endless = jax.jit(lambda x: jax.lax.while_loop(lambda x: x < 2, jax.numpy.cos, x))
    program = endless.lower(0.0).compile()
    print("begun", flush=True)
    program(0.0).block_until_ready()"""
    process = begun(code)
    assert process.stdout is not None and process.stdout.readline() == "begun\n"
    time.sleep(0.5)
    process.send_signal(signal.SIGTERM)
    assert ended(process, 143) == "interrupted: nothing was written\n"


def test_in_the_middle_of_an_ensemble(tmp_path):
    arguments = [
        "ensemble",
        "zagrodny-slifkin",
        "--seeds",
        "400000",
        "--duration",
        "1",
        "--chunk",
        "64",
        "--out",
        "runs.zarr",
    ]
    process = begun("main()", *arguments, cwd=tmp_path)
    chunks = tmp_path / "runs.zarr" / "P_w" / "c"
    while process.poll() is None and not chunks.exists():
        time.sleep(0.05)
    process.send_signal(signal.SIGTERM)
    assert "--resume" in ended(process, 143)
    attributes = jm.ensembles.attributes_of(tmp_path / "runs.zarr")
    assert attributes is not None and not attributes["complete"]


def test_an_interrupted_reduction_keeps_every_chunk(tmp_path):
    """And not what the last copy on disk had, ten seconds before."""
    chunks = []

    def stop(pace):
        chunks.append(pace)
        if len(chunks) == 3:
            raise KeyboardInterrupt

    task, key, options = (
        jm.Isometric(),
        jax.random.key(5),
        {"seeds": 40, "duration": 0.2, "chunk": 8},
    )
    path = tmp_path / "moments.zarr"
    with pytest.raises(KeyboardInterrupt):
        jm.ensemble(
            task, key, store=path, reduce=True, progress=jm.ensembles.Watch(stop), **options
        )
    kept = _read_tally(path)
    assert kept is not None and kept.chunks == 3
    resumed = jm.ensemble(task, key, store=path, reduce=True, resume=True, **options)
    whole = jm.ensemble(task, key, reduce=True, **options)
    assert abs(resumed.mean - whole.mean).max() <= 1e-12 * abs(whole.mean).max()
