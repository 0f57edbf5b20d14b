"""`--workers` and `--scheduler`: whose work it is, and what is said when nobody is there."""

import importlib.util
import json
import logging
import os
import signal
import socket

import pytest

from jaxmuscle.commands import cluster
from jaxmuscle.commands.cluster import workers_of

THREADS = "MALLOC_TRIM_THRESHOLD_", "OMP_NUM_THREADS", "PJRT_NPROC"

dask = pytest.importorskip("dask")


@pytest.fixture(autouse=True)
def as_loud_as_before():
    log = logging.getLogger("distributed")
    level = log.level
    yield
    log.setLevel(level)


def environment_of(_):
    return {name: os.environ.get(name) for name in THREADS}


def test_neither_is_this_process():
    with workers_of(None, None) as executor:
        assert executor is None


def test_workers_of_our_own_are_quick_lasting_and_out_of_reach(monkeypatch):
    monkeypatch.delenv("MALLOC_TRIM_THRESHOLD_")  # that of the tests
    # that of Dask, or of other workers of these tests
    pytest.importorskip("distributed")
    before = dask.config.get("distributed.deploy.lost-worker-timeout")
    # XLA cuts the spectra of seeds among its threads: with as many as here the bits are equal
    threads = os.environ.get("PJRT_NPROC")
    with workers_of(1, None) as client:
        assert list(client.nthreads().values()) == [1]
        assert all(address.startswith("tcp://127.0.0.1:") for address in client.nthreads())
        assert client.cluster.scheduler.address.startswith("tcp://127.0.0.1:")
        assert dask.config.get("distributed.deploy.lost-worker-timeout") == "10m"
        assert client.cluster.scheduler.allowed_failures == 100
        found = client.get_executor(pure=False).submit(environment_of, 0).result()
        assert found == dict(zip(THREADS, (None, "1", threads), strict=True))
        (pid,) = client.run(os.getpid).values()
        os.kill(pid, signal.SIGINT)  # as a terminal does at Ctrl-C; this process ends them
        assert client.run(os.getpid) == dict.fromkeys(client.nthreads(), pid)
    assert dask.config.get("distributed.deploy.lost-worker-timeout") == before
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_a_scheduler_file_and_an_address(client, tmp_path, capsys):
    address = client.scheduler.address
    (tmp_path / "scheduler.json").write_text(json.dumps({"address": address, "workers": {}}))
    for given in (str(tmp_path / "scheduler.json"), address.removeprefix("tcp://"), address):
        with workers_of(None, given) as other:
            assert set(other.nthreads()) == set(client.nthreads())
        assert f"{len(client.nthreads())} workers at {address}" in capsys.readouterr().err
    assert client.submit(abs, -1).result() == 1  # they stay


def test_nobody_answers(monkeypatch):
    assert cluster.ANSWER <= 60
    monkeypatch.setattr(cluster, "ANSWER", 1)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    with (
        pytest.raises(ValueError, match=f"--scheduler {address}: nobody answers at tcp://"),
        workers_of(None, address),
    ):
        pass


@pytest.mark.parametrize(
    ("count", "scheduler", "message"),
    [
        (2, "host:8786", "--workers 2 and --scheduler host:8786: give one"),
        (None, "scheduler.json", "there is no such file, and it is no HOST:PORT"),
        (None, __file__, "is no scheduler file"),
    ],
)
def test_mistakes(count, scheduler, message):
    with pytest.raises(ValueError, match=message), workers_of(count, scheduler):
        pass


def test_without_dask(monkeypatch):
    there = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *rest: None if name == "dask" else there(name)
    )
    with (
        pytest.raises(ImportError, match=r'needs dask: pip install "jaxmuscle\[dask\]"'),
        workers_of(2, None),
    ):
        pass
