"""What stores promise: one writer at a time, nothing lost or changed unnoticed, what is damaged
made again."""

import json
import os
import random
import shutil
from pathlib import Path
from typing import Any

import filelock
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray
from processes import Run, python
from test_ensemble import KEY, SHORT, TASK, Brittle, Stop, stopped_after

import jaxmuscle as jm
from jaxmuscle.commands.main import app
from jaxmuscle.ensembles import _run as _ensemble_run
from jaxmuscle.ensembles import _store

KINDS = pytest.mark.parametrize("kept", [{}, {"reduce": True}], ids=["trajectories", "reduced"])


def made(path, kept, seeds=45):
    """A complete store, and the arguments that resume it."""
    given: Any = {"seeds": seeds, "store": path, **SHORT, **kept}
    jm.ensemble(TASK, KEY, **given)
    return given


def files_of(path):
    return {
        file.relative_to(path).as_posix(): file.read_bytes()
        for file in sorted(Path(path).rglob("*"))
        if file.is_file()
    }


def chunks_of(path):
    return sorted(
        file for file in Path(path).rglob("*") if file.is_file() and file.name != "zarr.json"
    )


def flipped(data, bit):
    changed = bytearray(data)
    changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)


# What is damaged is noticed


@KINDS
def test_a_hundred_flipped_bits_are_noticed(tmp_path, kept):
    """Of chunks, at random places: by the package, and by whoever reads the chunk through
    xarray."""
    path, rng, noticed = tmp_path / "a.zarr", random.Random(0), 0
    made(path, kept)
    whole = jm.ensembles.open_store(path).load()
    for turn in range(100):
        file = rng.choice(chunks_of(path))
        data = file.read_bytes()
        file.write_bytes(flipped(data, rng.randrange(8 * len(data))))
        with pytest.raises(
            jm.errors.StoreError,
            match=rf"1 damaged or missing \({file.relative_to(path)}\).*--resume",
        ):
            jm.ensembles.open_store(path)
        if turn < 10:
            with pytest.raises(ValueError, match="checksum"):
                xarray.open_zarr(path, chunks=None).load()
        file.write_bytes(data)
        noticed += 1
    assert noticed == 100
    xarray.testing.assert_identical(jm.ensembles.open_store(path).load(), whole)


def test_flipped_bits_of_the_description_are_noticed(tmp_path):
    path, rng = tmp_path / "a.zarr", random.Random(1)
    given = made(path, {}, seeds=8)
    for name in ("zarr.json", "F_ext/zarr.json"):
        data = (path / name).read_bytes()
        for _ in range(50):
            (path / name).write_bytes(flipped(data, rng.randrange(8 * len(data))))
            with pytest.raises(jm.errors.StoreError, match=r"damaged|is not a"):
                jm.ensembles.open_store(path)
        (path / name).write_bytes(data)
    (path / "zarr.json").write_bytes(
        data := (path / "zarr.json").read_bytes().replace(b'"duration', b'"durative', 1)
    )
    with pytest.raises(
        jm.errors.StoreError, match=r"its description \(zarr.json\) is damaged.*--force"
    ):
        jm.ensemble(TASK, KEY, resume=True, **given)
    with pytest.raises(jm.errors.StoreError, match="is damaged"):
        jm.ensembles.attributes_of(path)
    jm.ensemble(TASK, KEY, overwrite=True, **given)
    assert jm.ensembles.open_store(path).attrs["complete"] is True


@KINDS
def test_a_missing_chunk_is_noticed(tmp_path, kept):
    """Plain zarr takes it for NaN, or 0."""
    path = tmp_path / "a.zarr"
    made(path, kept, seeds=20)
    for file in chunks_of(path):
        data = file.read_bytes()
        file.unlink()
        with pytest.raises(
            jm.errors.StoreError, match=rf"1 damaged or missing \({file.relative_to(path)}\)"
        ):
            jm.ensembles.open_store(path)
        file.write_bytes(data[: len(data) // 2])
        with pytest.raises(jm.errors.StoreError, match="1 damaged or missing"):
            jm.ensembles.open_store(path)
        file.write_bytes(data)
    jm.ensembles.open_store(path)


class Broken(Brittle):
    """Breaks with the first noise."""

    def vector_field(self, t, y, u):
        return jnp.where(jnp.abs(u[:1]) > 1e-6, jnp.inf, u[:1]) - y


def test_a_chunk_of_nothing_but_nan_is_there(tmp_path):
    task = Broken(
        noise=jm.OrnsteinUhlenbeckNoise(1.0, 0.01, relative=False), harmonic=jm.Harmonic(0.0)
    )
    found = jm.ensemble(task, KEY, seeds=10, store=tmp_path / "a.zarr", **SHORT)
    assert len(json.loads(found.attrs["failed"])) == 10
    assert np.isnan(jm.ensembles.open_store(tmp_path / "a.zarr")["y"][:, 1:]).all()


def test_attributes_of_users_are_no_damage(tmp_path):
    import zarr

    made(tmp_path / "a.zarr", {}, seeds=8)
    zarr.open_group(tmp_path / "a.zarr", mode="r+").attrs["note"] = "for the paper"
    assert jm.ensembles.open_store(tmp_path / "a.zarr").attrs["note"] == "for the paper"


def test_what_open_store_refuses(tmp_path):
    with pytest.raises(jm.errors.StoreError, match="there is no store"):
        jm.ensembles.open_store(tmp_path / "a.zarr")
    with pytest.raises(Stop):
        jm.ensemble(
            TASK, KEY, seeds=24, store=tmp_path / "a.zarr", progress=stopped_after(1), **SHORT
        )
    with pytest.raises(jm.errors.StoreError, match="is not complete: resume it"):
        jm.ensembles.open_store(tmp_path / "a.zarr")


# ... and made again


@KINDS
def test_a_damaged_store_is_mended_bit_by_bit(tmp_path, kept, caplog):
    path, rng = tmp_path / "a.zarr", random.Random(2)
    given = made(path, kept)
    before = files_of(path)
    computed = [
        file
        for file in before
        if file.split("/")[0] in ("F_ext", "mean", "quantiles") and "/c/" in file
    ]
    files = [rng.choice(computed), "time/c/0", f"{computed[0].split('/')[0]}/zarr.json"]
    (path / files[0]).write_bytes(flipped(before[files[0]], 99))
    (path / files[1]).unlink()
    (path / files[2]).write_bytes(b"{}")
    (path / "mine.txt").write_text("left alone")
    told = []
    jm.ensemble(TASK, KEY, resume=True, progress=lambda *pace: told.append(pace), **given)
    assert len(told) == (6 if kept else 1)
    assert (
        f"({files[0]}): to be computed again" in caplog.text
        and "time/c/0): written again" in caplog.text
    )
    assert files_of(path) == before | {"mine.txt": b"left alone"}
    assert sorted(p.name for p in tmp_path.iterdir()) == [".a.zarr.lock", "a.zarr"]


def test_the_command_mends(tmp_path, capfd):
    import test_ensemble

    path = tmp_path / "a.zarr"
    arguments = [
        "ensemble",
        "zagrodny-slifkin",
        "--seeds",
        "16",
        "--duration",
        "1",
        "--chunk",
        "8",
        "--out",
        str(path),
    ]
    assert test_ensemble.RUNNER.invoke(app, arguments).exit_code == 0
    before = files_of(path)
    (path / "P_w" / "c" / "1" / "0").unlink()
    with pytest.raises(jm.errors.StoreError, match=r"1 damaged or missing \(P_w/c/1/0\). Resume"):
        jm.ensembles.open_store(path)
    assert test_ensemble.RUNNER.invoke(app, [*arguments, "--resume"]).exit_code == 0
    assert files_of(path) == before


def test_what_is_damaged_before_the_end_is_computed_again(tmp_path, caplog):
    path = tmp_path / "a.zarr"
    given: Any = {"seeds": 45, "store": path, **SHORT}
    with pytest.raises(Stop):
        jm.ensemble(TASK, KEY, progress=stopped_after(4), **given)
    there = len(list((path / "F_ext" / "c").iterdir()))
    file = path / "F_ext/c/1/0"
    file.write_bytes(flipped(file.read_bytes(), 5))
    told = []
    found = jm.ensemble(TASK, KEY, resume=True, progress=lambda *pace: told.append(pace), **given)
    assert len(told) == 6 - there + 1
    assert "1 damaged or missing (F_ext/c/1/0): to be computed again" in caplog.text
    np.testing.assert_array_equal(
        found["F_ext"], jm.ensemble(TASK, KEY, seeds=45, control=False, **SHORT).output
    )


def test_a_damaged_tally_is_computed_again(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(_ensemble_run, "KEEP_EVERY", 0.0)
    monkeypatch.setattr(_ensemble_run, "KEEP_SHARE", 0)
    given: Any = {"seeds": 45, "reduce": True, **SHORT}
    path, rng, whole = tmp_path / "a.zarr", random.Random(3), jm.ensemble(TASK, KEY, **given)
    with pytest.raises(Stop):
        jm.ensemble(TASK, KEY, store=path, progress=stopped_after(3), **given)
    key = _ensemble_run.TALLY
    assert [file.name for file in (path / "progress").iterdir()] == [Path(key).name]
    data = (path / key).read_bytes()
    for _ in range(100):
        (path / key).write_bytes(flipped(data, rng.randrange(8 * len(data))))
        assert _ensemble_run._read_tally(path) is None
    (path / key).write_bytes(flipped(data, 7))
    caplog.clear()
    found = jm.ensemble(TASK, KEY, store=path, resume=True, **given)
    assert f"{key} is damaged; what it held is computed again" in caplog.text
    np.testing.assert_array_equal(found.mean, whole.mean)
    np.testing.assert_array_equal(found.quantile, whole.quantile)


# What is said to be done is on disk, and nothing else stays


@KINDS
def test_all_is_on_disk_before_it_is_called_complete(tmp_path, monkeypatch, kept):
    path, synced, replace, to_disk = tmp_path / "a.zarr", set(), os.replace, _store.to_disk
    seen = []

    def noted(paths):
        found = list(paths)
        to_disk(found)
        synced.update(found)

    def checked(source, target):
        if Path(target).name == "zarr.json" and b'"complete": true' in Path(source).read_bytes():
            computed = [file for file in chunks_of(path) if file.parts[-4:][0] != "progress"]
            whole = {file for file in computed if file.relative_to(path).parts[0] in names}
            assert {
                *whole,
                *(above for file in whole for above in list(file.parents)[:3]),
            } <= synced
            assert Path(source) in synced and whole
            seen.append(target)
        replace(source, target)

    names = ("mean", "quantiles") if kept else ("F_ext",)
    monkeypatch.setattr(_store, "to_disk", noted)
    monkeypatch.setattr(os, "replace", checked)
    jm.ensemble(TASK, KEY, seeds=20, store=path, **SHORT, **kept)
    assert len(seen) == 1 and tmp_path in synced


def test_a_chunk_that_nobody_sees_is_said(tmp_path, monkeypatch):
    """A worker that has another folder of the same name."""
    monkeypatch.setattr(_ensemble_run, "write_region", lambda *given: None)
    given: Any = {"seeds": 20, "store": tmp_path / "a.zarr", **SHORT}
    with pytest.raises(
        jm.errors.StoreError,
        match=r"3 damaged or missing \(F_ext/c/0/0.*same for all workers\? Res",
    ):
        jm.ensemble(TASK, KEY, **given)
    monkeypatch.undo()
    found = jm.ensemble(TASK, KEY, resume=True, **given)
    assert found.attrs["complete"] and np.isfinite(found["F_ext"]).all()


@KINDS
def test_leftovers_are_removed(tmp_path, kept):
    path = tmp_path / "a.zarr"
    given: Any = {"seeds": 24, "store": path, **SHORT, **kept}
    with pytest.raises(Stop):
        jm.ensemble(TASK, KEY, progress=stopped_after(1), **given)
    (tmp_path / ".a.zarr.new-abc").mkdir()  # killed while it began, or removed an older store
    (path / "time" / "c" / "0.123.partial").write_bytes(b"killed while writing")
    (path / ".zarr-0123456789ab.json").write_bytes(b"killed while it was called complete")
    (tmp_path / ".a.zarr-backup").mkdir()  # somebody else's
    jm.ensemble(TASK, KEY, resume=True, **given)
    left = [".a.zarr-backup", ".a.zarr.lock", "a.zarr"]
    assert sorted(p.name for p in tmp_path.iterdir()) == left
    assert (
        not list(path.rglob("*.partial"))
        and not list(path.glob(".*"))
        and not (path / "progress").exists()
    )
    (path / "progress").mkdir()  # killed after the store was complete
    (path / "progress" / "tally.npz").write_bytes(b"{}")
    jm.ensemble(TASK, KEY, resume=True, **given)
    assert not (path / "progress").exists()


# One writer


WRITES = "a.zarr: another process is writing it: wait until it has ended"


@KINDS
def test_a_second_writer_is_refused(tmp_path, kept):
    given: Any = {"seeds": 24, "store": tmp_path / "a.zarr", **SHORT, **kept}
    tried = []

    def meanwhile(text, share):
        for begin in ({"resume": True}, {"overwrite": True}) if not tried else ():
            with pytest.raises(jm.errors.StoreError, match=WRITES):
                jm.ensemble(
                    TASK, jax.random.key(6 if "overwrite" in begin else 5), **begin, **given
                )
            tried.append(begin)

    found = jm.ensemble(TASK, KEY, progress=meanwhile, **given)
    assert len(tried) == 2 and free(tmp_path)
    whole = jm.ensemble(TASK, KEY, seeds=24, **({"control": False} | SHORT | kept))
    np.testing.assert_array_equal(
        found.mean if kept else found["F_ext"], whole.mean if kept else whole.output
    )


def test_a_second_run_does_not_share_a_store_by_chance(tmp_path, monkeypatch):
    """It comes between looking whether there is a store and making it."""
    given: Any = {"seeds": 16, "store": tmp_path / "a.zarr", **SHORT}
    build = _store._build

    def late(*arguments):
        monkeypatch.setattr(_store, "_build", build)
        with pytest.raises(ValueError, match=WRITES):
            jm.ensemble(TASK, KEY, **given)
        build(*arguments)

    monkeypatch.setattr(_store, "_build", late)
    found = jm.ensemble(TASK, KEY, **given)
    whole = jm.ensemble(TASK, KEY, seeds=16, control=False, **SHORT)
    np.testing.assert_array_equal(found["F_ext"], whole.output)


def free(folder):
    """Whether somebody could write the store now."""
    with filelock.FileLock(folder / ".a.zarr.lock", timeout=0) as lock:
        return lock.is_locked


@pytest.mark.parametrize("how", [KeyboardInterrupt, SystemExit, Stop])
def test_an_interrupted_writer_leaves_no_lock(tmp_path, how):
    def interrupted(text, share):
        with pytest.raises(filelock.Timeout):
            free(tmp_path)
        raise how

    with pytest.raises(how):
        jm.ensemble(TASK, KEY, seeds=24, store=tmp_path / "a.zarr", progress=interrupted, **SHORT)
    assert free(tmp_path)


HOLD = """
import sys, filelock
with filelock.FileLock(sys.argv[1], timeout=0):
    print("held", flush=True)
    sys.stdin.read() or __import__("time").sleep(300)
"""


def test_the_lock_of_a_dead_process_goes_with_it(tmp_path):
    given: Any = {"seeds": 8, "store": tmp_path / "a.zarr", **SHORT}
    process = python(HOLD, str(tmp_path / ".a.zarr.lock"))
    assert process.stdout.readline() == "held\n"
    with pytest.raises(jm.errors.StoreError, match=WRITES):
        jm.ensemble(TASK, KEY, **given)
    process.kill()
    process.communicate()
    assert jm.ensemble(TASK, KEY, **given).attrs["complete"]


def test_a_file_system_without_locks(tmp_path, monkeypatch, caplog):
    """It is said."""
    import errno

    def without(*arguments):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(filelock.FileLock, "acquire", without)
    jm.ensemble(TASK, KEY, seeds=8, store=tmp_path / "a.zarr", **SHORT)
    assert "this file system has no locks. See to it that no other process writes" in caplog.text


@pytest.mark.slow
def test_two_writers_never_give_wrong_numbers(tmp_path, monkeypatch):
    """A few of the trials of benchmarks/kills.py, which has fifty of more seeds; the second comes
    within half a second."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    import kills

    monkeypatch.setattr(
        kills,
        "begun",
        lambda store, reduce, key=5, **given: Run(store, reduce, key, kills.OPTIONS | given),
    )
    monkeypatch.setitem(kills.OPTIONS, "seeds", 1600)
    ones, rng = {key: kills.whole(True, key) for key in (5, 6)}, random.Random(4)
    for number in range(4):
        found, key, _ = kills.writers(tmp_path / f"{number}.zarr", rng, 0.5)
        assert kills.equal(found, ones[key], True)


@pytest.mark.parametrize("kept", [{"reduce": True}, {}], ids=["reduced", "trajectories"])
def test_a_store_is_read_before_others_may_write_it(tmp_path, monkeypatch, kept):
    """A process that overwrites it could come in between: the first would find nothing, or an empty
    store."""
    locked = []

    def noting(call):
        def noted(*given, **more):
            with pytest.raises(filelock.Timeout):
                free(tmp_path)
            locked.append(True)
            return call(*given, **more)

        return noted

    monkeypatch.setattr(_ensemble_run, "_loaded", noting(_ensemble_run._loaded))
    monkeypatch.setattr(xarray, "open_zarr", noting(xarray.open_zarr))
    made(tmp_path / "a.zarr", kept)
    assert locked == [True] and free(tmp_path)


def test_a_store_may_be_copied(tmp_path):
    given = made(tmp_path / "a.zarr", {}, seeds=8)
    shutil.copytree(tmp_path / "a.zarr", tmp_path / "b.zarr")
    copy = jm.ensembles.open_store(tmp_path / "b.zarr").load()
    again = jm.ensemble(TASK, KEY, resume=True, **given | {"store": tmp_path / "b.zarr"})
    np.testing.assert_array_equal(copy["F_ext"], again["F_ext"])
