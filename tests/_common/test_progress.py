"""Progress: a function, silence, or lines every so often where there is no terminal, also while nothing is told."""

import logging
import time

import pytest

from jaxmuscle._common import progress
from jaxmuscle._common.progress import nothing, told


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(progress, "EVERY", 0.02)


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
        time.sleep(0.2)
    lines = capfd.readouterr().err.splitlines()
    assert 3 <= len(lines) <= 10 and all(line.startswith("fitting x: 25 %, compiling (") for line in lines)


def test_lines_go_through_logging_where_it_is_set_up(quick, caplog, capfd):
    with caplog.at_level(logging.INFO, "jaxmuscle"), told(True, "fitting x"):
        time.sleep(0.1)
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
