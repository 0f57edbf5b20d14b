"""Progress: a function, silence, or lines every so often where there is no terminal, also while
nothing is told."""

import logging
import queue
import time

import pytest

from jaxmuscle._common import progress
from jaxmuscle._common.progress import nothing, told


@pytest.fixture
def quick(monkeypatch):
    """Lines come every 20 ms. Gives a function that waits for the next line, and returns it and
    when it was said."""
    said, say = queue.SimpleQueue(), progress._say

    def heard(line):
        say(line)
        said.put((line, time.monotonic()))

    monkeypatch.setattr(progress, "EVERY", 0.02)
    monkeypatch.setattr(progress, "_say", heard)
    return lambda: said.get(timeout=60)


def test_a_function_is_called_and_its_share_never_falls():
    seen = []
    with told(lambda *said: seen.append(said), "title") as tell:
        tell("text", 0.5)
        tell("more than was expected", 0.25)
    assert seen == [("text", 0.5), ("more than was expected", 0.5)]
    with told(False, "title") as tell:
        assert tell is nothing


def test_lines_go_on_while_nothing_is_told(quick, capfd, monkeypatch):
    monkeypatch.setattr(progress.LOG, "hasHandlers", lambda: False)
    with told(True, "fitting x") as tell:
        tell("compiling", 0.25)
        # where 20 ms had passed before anything was told
        while quick()[0].startswith("fitting x: 0 %, starting"):
            pass
        whole = [quick() for _ in range(3)]
    assert all(line.startswith("fitting x: 25 %, compiling (") for line, _ in whole)
    # twice 20 ms at least, however slow the machine is
    assert whole[-1][1] - whole[0][1] > 1.9 * 0.02
    assert {line for line, _ in whole} <= set(capfd.readouterr().err.splitlines())


def test_lines_go_through_logging_where_it_is_set_up(quick, caplog, capfd):
    with caplog.at_level(logging.INFO, "jaxmuscle"), told(True, "fitting x"):
        quick()
    assert "fitting x: 0 %, starting" in caplog.text and not capfd.readouterr().err


def test_quiet_is_quiet(quick, caplog, capfd):
    with caplog.at_level(logging.WARNING, "jaxmuscle"), told(True, "fitting x") as tell:
        assert tell is nothing
        time.sleep(0.05)
    assert not caplog.text and not capfd.readouterr().err


def test_an_error_ends_the_lines(quick, capfd, monkeypatch):
    monkeypatch.setattr(progress.LOG, "hasHandlers", lambda: False)
    with pytest.raises(ZeroDivisionError), told(True, "x"):
        raise ZeroDivisionError
    capfd.readouterr()
    time.sleep(0.1)
    assert not capfd.readouterr().err
