"""Ensembles on the workers of an executor: the same numbers to the last bit, whoever works, comes
and goes."""

import json
import multiprocessing
import os
import pickle
import random
import signal
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial
from typing import Any

import jax
import numpy as np
import pytest
from test_ensemble import BRITTLE, KEY, RUNNER, SHORT, TASK, Stop, close, stopped_after

import jaxmuscle as jm
from jaxmuscle.commands import ensemble as command
from jaxmuscle.commands.main import app
from jaxmuscle.ensembles import _chunks
from jaxmuscle.ensembles import _run as _ensemble_run
from jaxmuscle.ensembles._chunks import blocks_of
from jaxmuscle.ensembles._layout import PIECES, Cut, cut_of, plan_of

KINDS = pytest.mark.parametrize("kept", [{}, {"reduce": True}], ids=["trajectories", "reduced"])
PLAN = plan_of(TASK, 1.0, 1e-3, None, None, None)


def equal(found, whole, kept):
    """To the last bit."""
    if kept:
        for name, (_, values, _) in whole.arrays().items():
            np.testing.assert_array_equal(found.arrays()[name][1], values)
        np.testing.assert_array_equal(found.failed, whole.failed)
    else:
        np.testing.assert_array_equal(found["F_ext"], whole.output)


def whole_of(kept, client=None, task=TASK, **changes):
    """One process with one thread, in memory: this one, or another one that compiles as workers do,
    which is not as quickly as the tests do."""
    given = {"seeds": 60, "threads": 1, **SHORT, **kept, **({} if kept else {"control": False})}
    if client is None:
        return jm.ensemble(task, KEY, **given | changes)
    return client.submit(partial(jm.ensemble, task, KEY, **given | changes), pure=False).result()


# The cut


@pytest.mark.parametrize("seeds", [1, 7, 8, 100, 512, 1000, 5000, 100_000, 10**9])
def test_a_small_ensemble_has_several_chunks_and_a_large_one_large_chunks(seeds, monkeypatch):
    cut = cut_of(TASK, seeds, PLAN, None)
    chunks = -(-seeds // cut.width)
    assert cut.together == 1 and cut.width % 8 == 0 and 8 <= cut.width <= 4096
    assert chunks >= min(PIECES, -(-seeds // 32)) and (cut.width == 4096 or chunks <= 2 * PIECES)
    assert cut.whole == (seeds <= 4096)  # as they fit into one chunk of the largest size
    monkeypatch.setattr(jax, "local_device_count", lambda: 16)
    assert cut_of(TASK, seeds, PLAN, None) == cut


def test_points_of_few_seeds_come_together_in_several_chunks():
    sweep = jm.ensembles.Sweep.design(TASK, {"k_w": np.linspace(4e5, 5e5, 200)})
    assert cut_of(sweep, 8, PLAN, None) == Cut(8, 8, True)
    assert cut_of(sweep, 8, PLAN, 400) == Cut(50, 8, True)
    assert cut_of(sweep, 5000, PLAN, None) == Cut(1, 4096, False)


@pytest.mark.parametrize("count", [0, 1, 16, 255, 256, 5000, 10**6])
def test_every_chunk_is_in_one_block(count):
    blocks = blocks_of(range(count), object())
    assert [number for block in blocks for number in block] == list(range(count))
    assert len(blocks) <= 8000 and len(blocks) >= min(count, 256)
    assert max(map(len, blocks), default=1) <= max(8, -(-count // 8000))


# The same numbers


@KINDS
@pytest.mark.parametrize("size", [8, 200], ids=["cells", "exact"])
def test_threads_processes_and_dask_are_one_process(tmp_path, client, kept, size):
    """One to three workers; blocks of several chunks."""
    here, apart = (whole_of(kept, each, chunk=size) for each in (None, client))
    given: Any = {"seeds": 60, "duration": 1.0, "chunk": size, **kept}
    given |= {} if kept else {"control": False}
    with (
        ThreadPoolExecutor(3) as threads,
        ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as spawned,
    ):
        for name, executor in {"threads": threads, "spawned": spawned, "dask": client}.items():
            in_memory = jm.ensemble(TASK, KEY, executor=executor, **given)
            stored = jm.ensemble(TASK, KEY, executor=executor, store=tmp_path / name, **given)
            whole = here if name == "threads" else apart
            equal(in_memory if kept else {"F_ext": in_memory.output}, whole, kept)
            equal(stored, whole, kept)


@KINDS
def test_blocks_of_several_chunks_are_one_process(tmp_path, monkeypatch, kept):
    monkeypatch.setattr(_chunks, "ENOUGH", 2)  # blocks of four of eight chunks
    given: Any = {"seeds": 60, "store": tmp_path / "a.zarr", **SHORT, **kept}
    told: list[Any] = []
    with ThreadPoolExecutor(1) as executor:
        watch = jm.ensembles.Watch(lambda pace: told.append((pace.done, pace.total)))
        found = jm.ensemble(TASK, KEY, executor=executor, progress=watch, **given)
    equal(found, whole_of(kept), kept)
    # the first chunk of a point says where the cells lie
    assert told == ([(8, 60), (32, 60), (56, 60), (60, 60)] if kept else [(32, 60), (60, 60)])


def test_a_sweep_on_workers(client):
    sweep = jm.ensembles.Sweep.grid(TASK, k_w=[4e5, 5e5, 6e5])
    for seeds, chunk in ((2, 4), (20, 8), (20, None)):  # together, in pieces, exact
        given: Any = {"seeds": seeds, "reduce": True, "duration": 1.0, "chunk": chunk}
        found = jm.ensemble(sweep, KEY, executor=client, **given)
        equal(found, whole_of({}, client, sweep, **given), given)


def test_the_precision_is_that_of_the_caller(client):
    with jax.enable_x64(True):
        found = jm.ensemble(TASK, KEY, seeds=16, executor=client, **SHORT)
        whole = jm.ensemble(TASK, KEY, seeds=16, threads=1, **SHORT)
    assert found.output.dtype == np.float64
    np.testing.assert_allclose(found.output, whole.output, rtol=0, atol=1e-12)  # of a few N


@KINDS
def test_what_fails_on_a_worker_is_named(tmp_path, kept):
    given: Any = {"seeds": 40, **SHORT, **kept, "store": tmp_path / "a.zarr"}
    with ThreadPoolExecutor(2) as executor:
        found = jm.ensemble(BRITTLE, KEY, executor=executor, **given)
        again = jm.ensemble(BRITTLE, KEY, executor=executor, resume=True, **given)
    failed = jm.ensemble(BRITTLE, KEY, seeds=40, reduce=True, **SHORT).failed.tolist()
    for store in (found, again):
        assert (store.failed.tolist() if kept else json.loads(store.attrs["failed"])) == failed


def test_a_block_is_small():
    """What a scheduler has to hand on."""
    seen: list[int] = []

    class Noting(ThreadPoolExecutor):
        def submit(self, fn, /, *given):
            seen.append(len(pickle.dumps((fn, given))))
            return super().submit(fn, *given)

    with Noting(1) as executor:
        jm.ensemble(TASK, KEY, seeds=24, reduce=True, executor=executor, **SHORT)
    assert len(seen) == 3 and max(seen) < 12_000


def test_a_forked_pool_is_refused():
    with (
        ProcessPoolExecutor(1, multiprocessing.get_context("fork")) as executor,
        pytest.raises(ValueError, match=r'executor: its processes are forked.*"spawn"'),
    ):
        jm.ensemble(TASK, KEY, seeds=8, executor=executor, **SHORT)


# Stores


@KINDS
def test_a_store_is_resumed_by_others(tmp_path, monkeypatch, client, kept):
    """Begun by threads of one process, gone on with by others and by workers, and the other way
    round."""
    monkeypatch.setattr(_ensemble_run, "KEEP_EVERY", 0.0)
    monkeypatch.setattr(_ensemble_run, "KEEP_SHARE", 0)
    threads = ThreadPoolExecutor(2)
    ways = {"a": (None, threads), "b": (threads, None), "c": (client, client)}
    for name, (first, second) in ways.items():
        given: Any = {"seeds": 60, "store": tmp_path / name, **SHORT, **kept}
        with pytest.raises(Stop):
            jm.ensemble(TASK, KEY, executor=first, progress=stopped_after(3), **given)
        told: list[Any] = []
        found = jm.ensemble(
            TASK,
            KEY,
            executor=second,
            resume=True,
            progress=lambda *pace, told=told: told.append(pace),
            **given,
        )
        equal(found, whole_of(kept, client if second is client else None), kept)
        # a worker ends what it had begun: there may be no chunk left
        assert len(told) == 5 if kept else len(told) <= 5


def test_damage_is_found_and_mended_by_workers(tmp_path, client, caplog):
    given: Any = {"seeds": 60, "store": tmp_path / "a.zarr", "executor": client, **SHORT}
    jm.ensemble(TASK, KEY, **given)
    file = tmp_path / "a.zarr" / "F_ext/c/3/0"
    before = file.read_bytes()
    file.write_bytes(before[:-9] + b"damaged!!")
    told: list[Any] = []
    jm.ensemble(TASK, KEY, resume=True, progress=lambda *pace: told.append(pace), **given)
    assert len(told) == 1 and file.read_bytes() == before
    assert "1 damaged or missing (F_ext/c/3/0): to be computed again" in caplog.text


def test_a_cut_off_worker_does_not_write_into_another_store(tmp_path, monkeypatch):
    """It goes on after the store was replaced by one of other settings."""
    path, late = tmp_path / "a.zarr", []
    given: Any = {"seeds": 24, "store": path, **SHORT}
    write = _ensemble_run.Home.write

    def slow(self, layout, simulated, known):
        late.append((self, layout, list(simulated), known))
        return write(self, layout, late[-1][2], known)

    monkeypatch.setattr(_ensemble_run.Home, "write", slow)
    jm.ensemble(TASK, KEY, **given)
    monkeypatch.undo()
    other = jm.ensemble(TASK, jax.random.key(6), overwrite=True, **given).load()
    for home, *rest in late:
        with pytest.raises(jm.errors.StoreError, match=r"made with other settings: key = \[0, 6\]"):
            home.write(*rest)
    np.testing.assert_array_equal(jm.ensembles.open_store(path)["F_ext"], other["F_ext"])


# Those who die


@KINDS
@pytest.mark.slow
def test_a_killed_worker_changes_nothing(tmp_path, client, kept):
    """Some of the trials of benchmarks/kills.py."""
    rng, whole = random.Random(1), whole_of(kept, client, seeds=800)
    for trial in range(3):
        killed: list[int] = []
        moment = rng.uniform(0.1, 0.8)

        def tell(text, share, killed=killed, when=moment):
            if share > when and not killed:
                killed.append(rng.choice(sorted(client.run(os.getpid).values())))
                os.kill(killed[0], signal.SIGKILL)

        given: Any = {"seeds": 800, **SHORT, **kept}
        store = tmp_path / f"{trial}.zarr"
        found = jm.ensemble(TASK, KEY, store=store, executor=client, progress=tell, **given)
        assert killed
        equal(found, whole, kept)


def test_a_pool_whose_worker_dies_says_how_to_go_on(tmp_path):
    given: Any = {"seeds": 400, "store": tmp_path / "a.zarr", **SHORT}
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as executor:

        def tell(text, share):
            os.kill(next(iter(executor._processes)), signal.SIGKILL)

        with pytest.raises(jm.errors.WorkersLostError, match=r"--resume"):
            jm.ensemble(TASK, KEY, executor=executor, progress=tell, **given)
    found = jm.ensemble(TASK, KEY, resume=True, **given)["F_ext"]
    whole = whole_of({}, seeds=400).output
    np.testing.assert_allclose(found, whole, rtol=0, atol=1e-6 * np.abs(whole).max())


# The command


def test_the_command_shares_work(tmp_path, monkeypatch, client):
    import contextlib

    @contextlib.contextmanager
    def workers_of(count, scheduler):
        assert scheduler is None and count in (None, 2)
        yield client if count else None

    monkeypatch.setattr(command, "workers_of", workers_of)
    arguments = ["ensemble", "zagrodny-slifkin", "--seeds", "60", "--duration", "1", "--chunk", "8"]
    alone = RUNNER.invoke(app, [*arguments, "--reduce", "--out", str(tmp_path / "a.zarr")])
    done = RUNNER.invoke(
        app, [*arguments, "--reduce", "--out", str(tmp_path / "b.zarr"), "--workers", "2"]
    )
    assert alone.exit_code == done.exit_code == 0, done.output
    a, b = (jm.ensembles.open_store(tmp_path / f"{name}.zarr").load() for name in "ab")
    close(b["mean"], a["mean"])
    assert {**a.attrs} == {**b.attrs}


def test_the_command_says_that_workers_are_lost(tmp_path, monkeypatch):
    def lost(*given, **more):
        raise jm.errors.WorkersLostError("the workers, or their scheduler, are lost")

    monkeypatch.setattr(jm, "ensemble", lost)
    out = str(tmp_path / "a.zarr")
    done = RUNNER.invoke(app, ["ensemble", "zagrodny-slifkin", "--seeds", "8", "--out", out])
    assert done.exit_code == 1 and "failed: the workers" in done.stderr
