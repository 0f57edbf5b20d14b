"""Work on executors: one order, few items under way, the caller's precision, losses in a
sentence."""

import collections
import functools
import gc
import inspect
import logging
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
import uuid
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor

import jax
import pytest

from jaxmuscle._common import executors
from jaxmuscle._common.errors import WorkersLostError
from jaxmuscle._common.executors import pool_of, results_of


def slow_at_even(number):
    time.sleep(0.02 * (number % 2 == 0))
    return number**2


def unique(_):
    return uuid.uuid4().hex


def in_double(_):
    return bool(jax.config.jax_enable_x64)


def broken_at_three(number):
    if number == 3:
        raise ValueError("three is wrong")
    return number


def dies_once(place, number):
    """The first time that 2 is at work its process is killed."""
    if number == 2:
        try:
            os.close(os.open(place, os.O_CREAT | os.O_EXCL))
            os.kill(os.getpid(), signal.SIGKILL)
        except FileExistsError:
            pass
    return number


def soon(holds):
    """Whether something holds within some seconds."""
    until = time.monotonic() + 10
    while not holds() and time.monotonic() < until:
        time.sleep(0.01)
    return holds()


@pytest.fixture
def threads():
    with ThreadPoolExecutor(3) as pool:
        yield pool


class Counted(Executor):
    """Threads that count what was asked for and has not been taken."""

    def __init__(self, pool):
        self.pool, self.most, self.taken, self.asked = pool, 0, 0, 0

    def submit(self, fn, /, *args, **kwargs):
        self.asked += 1
        self.most = max(self.most, self.asked - self.taken)
        return self.pool.submit(fn, *args, **kwargs)


def test_results_come_in_the_order_of_the_items_and_few_are_under_way(threads, monkeypatch):
    monkeypatch.setattr(executors, "WINDOW", 4)
    pool, found = Counted(threads), []
    for item, made in results_of(pool, slow_at_even, iter(range(30))):
        pool.taken += 1
        found.append((item, made))
    assert found == [(n, n**2) for n in range(30)]
    assert pool.asked == 30 and pool.most <= 4


def test_nothing_to_do(threads):
    assert list(results_of(threads, abs, [])) == []


def test_an_error_of_the_work_is_the_callers_and_what_waits_is_given_up(threads, monkeypatch):
    monkeypatch.setattr(executors, "WINDOW", 2)
    pool = Counted(threads)
    with pytest.raises(ValueError, match="three is wrong"):
        for _ in results_of(pool, broken_at_three, range(1000)):
            pool.taken += 1
    assert pool.asked < 10


def test_whoever_stops_gives_up_what_waits():
    pending = Future()

    class Never(Executor):
        def submit(self, fn, /, *args, **kwargs):
            return first if not args[0] else pending

    first = Future()
    first.set_result(0)
    results = results_of(Never(), abs, [0, 1])
    assert next(results) == (0, 0)
    results.close()
    assert pending.cancelled()


def test_precision_travels_with_the_block(threads):
    for double in (True, False):
        with jax.enable_x64(double):
            found = {made for _, made in results_of(threads, in_double, range(4))}
        assert found == {double}


def test_a_fork_and_what_is_no_executor_are_refused():
    with (
        ProcessPoolExecutor(1, multiprocessing.get_context("fork")) as pool,
        pytest.raises(ValueError, match=r"forked.*get_context\(\"spawn\"\)"),
    ):
        next(results_of(pool, abs, [1]))
    with pytest.raises(ValueError, match="executor = 4: give an executor of concurrent"):
        inspect.unwrap(pool_of)(4)


def test_a_pool_that_loses_its_process_says_so_and_what_to_do():
    with (
        ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool,
        pytest.raises(WorkersLostError, match=r"are lost \(BrokenProcessPool\).*--resume"),
    ):
        list(results_of(pool, os._exit, [1, 1]))


class Quiet:
    """A Dask client whose workers are gone for a while."""

    def __init__(self, pool):
        self.pool = pool

    def get_executor(self, *, pure):
        assert not pure
        return self.pool

    def scheduler_info(self):
        return {"workers": {}}


def test_a_scheduler_without_workers_is_noticed(threads, monkeypatch, caplog):
    monkeypatch.setattr(executors, "PATIENCE", 0.05)
    come = threading.Event()
    threading.Timer(0.3, come.set).start()
    with caplog.at_level(logging.WARNING, "jaxmuscle"):
        assert list(results_of(Quiet(threads), come.wait, [10])) == [(10, True)]
    assert "the scheduler has no workers now" in caplog.text


# --- Dask


def test_equal_calls_are_two_and_no_result_stays_with_the_workers(client):
    gc.disable()  # what is home is given up by itself
    try:
        results = results_of(client, unique, [0] * 8)
        made = [next(results)[1] for _ in range(7)]
        assert soon(lambda: len(client.futures) <= 1), len(client.futures)
        made += [each for _, each in results]
        assert soon(lambda: not client.futures)
    finally:
        gc.enable()
    assert len(set(made)) == 8


def test_precision_travels_to_other_processes(client):
    for double in (True, False):
        with jax.enable_x64(double):
            assert [made for _, made in results_of(client, in_double, [0])] == [double]


def test_a_worker_that_is_killed_costs_its_block_alone(client, tmp_path):
    work = functools.partial(dies_once, tmp_path / "died")
    assert list(results_of(client, work, range(6))) == [(n, n) for n in range(6)]
    assert (tmp_path / "died").exists()


def test_a_scheduler_that_is_killed_is_a_sentence_within_a_minute(tmp_path):
    pytest.importorskip("distributed")
    from jaxmuscle.commands.cluster import workers_of

    file = tmp_path / "scheduler.json"
    command = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--scheduler-file", file]
    where = ["--host", "127.0.0.1", "--port", "0", "--dashboard-address", "127.0.0.1:0"]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    with subprocess.Popen([*command, *where], **quiet) as scheduler:
        try:
            while not file.exists():
                time.sleep(0.05)
            with workers_of(None, str(file)) as other:
                threading.Timer(0.5, scheduler.kill).start()
                begun = time.monotonic()
                with pytest.raises(WorkersLostError, match="or their scheduler, are lost"):
                    next(results_of(other, abs, range(3)))
                assert time.monotonic() - begun < 60
        finally:
            scheduler.kill()


def test_the_order_is_one_whoever_is_first(client):
    counts = collections.Counter(made for _, made in results_of(client, slow_at_even, range(20)))
    assert list(counts) == [n**2 for n in range(20)]
