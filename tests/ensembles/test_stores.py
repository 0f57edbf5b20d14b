"""What stores promise: one writer at a time, nothing lost or changed unnoticed, what is damaged
made again."""

import json
import os
import random
import shutil
import socket
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray
from processes import Run
from test_ensemble import KEY, SHORT, TASK, Brittle, Stop, stopped_after

import jaxmuscle as jm
from jaxmuscle.commands.main import app
from jaxmuscle.ensembles import _places, _store
from jaxmuscle.ensembles import _run as _ensemble_run
from jaxmuscle.ensembles._locks import Holder
from jaxmuscle.ensembles._places import place_of
from jaxmuscle.ensembles._tallies import read_tallies, tally_keys

KINDS = pytest.mark.parametrize("kept", [{}, {"reduce": True}], ids=["trajectories", "reduced"])
WAYS = pytest.mark.parametrize(
    "kept, parts",
    [({}, 0), ({"reduce": True}, 0), ({"reduce": True}, 3)],
    ids=["trajectories", "reduced", "merged"],
)


def made(path, kept, parts=0, seeds=45):
    """A complete store, and the arguments that resume it."""
    given: Any = {"seeds": seeds, "store": path, **SHORT, **kept}
    for number in range(1, parts + 1):
        jm.ensemble(TASK, KEY, part=(number, parts), **given)
    if parts:
        jm.ensembles.merge(path)
    else:
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


@WAYS
def test_a_damaged_store_is_mended_bit_by_bit(tmp_path, kept, parts, caplog):
    path, rng = tmp_path / "a.zarr", random.Random(2)
    given = made(path, kept, parts)
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
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.zarr"]


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
    merged = test_ensemble.RUNNER.invoke(app, ["merge", str(path)])
    assert (
        merged.exit_code == 2
        and "1 damaged or missing (P_w/c/1/0). Resume" in merged.stderr.replace("\n", " ")
    )
    assert test_ensemble.RUNNER.invoke(app, [*arguments, "--resume"]).exit_code == 0
    assert files_of(path) == before


@pytest.mark.parametrize("what", ["chunk", "log"])
def test_what_is_damaged_before_the_end_is_computed_again(tmp_path, caplog, what):
    path = tmp_path / "a.zarr"
    given: Any = {"seeds": 45, "store": path, **SHORT}
    with pytest.raises(Stop):
        jm.ensemble(TASK, KEY, progress=stopped_after(4), **given)
    file = path / {"chunk": "F_ext/c/1/0", "log": "progress/chunk-00000001.json"}[what]
    file.write_bytes(flipped(file.read_bytes(), 5))
    told = []
    found = jm.ensemble(TASK, KEY, resume=True, progress=lambda *pace: told.append(pace), **given)
    assert len(told) == 6 - 4 + 1
    assert (
        what == "log" or "1 damaged or missing (F_ext/c/1/0): to be computed again" in caplog.text
    )
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
    (key,) = tally_keys(place_of(path))
    data = (path / key).read_bytes()
    for _ in range(100):
        (path / key).write_bytes(flipped(data, rng.randrange(8 * len(data))))
        assert read_tallies(place_of(path)) is None and not (path / key).exists()
    (path / key).write_bytes(flipped(data, 7))
    caplog.clear()
    found = jm.ensemble(TASK, KEY, store=path, resume=True, **given)
    assert f"{key} is damaged; what it held is computed again" in caplog.text
    np.testing.assert_array_equal(found.mean, whole.mean)
    np.testing.assert_array_equal(found.quantile, whole.quantile)


def test_a_damaged_part_is_not_merged(tmp_path, caplog):
    path = tmp_path / "a.zarr"
    given: Any = {"seeds": 40, "store": path, **SHORT}
    for number in (1, 2):
        jm.ensemble(TASK, KEY, part=(number, 2), **given)
    (path / "F_ext" / "c" / "3" / "0").unlink()
    with pytest.raises(
        jm.errors.StoreError, match="1 of 5 chunks are missing: parts 2 of 2 are not done"
    ):
        jm.ensembles.merge(path)
    (path / "time" / "c" / "0").unlink()
    jm.ensemble(TASK, KEY, part=(2, 2), **given)
    assert "time/c/0): written again" in caplog.text
    whole = jm.ensemble(TASK, KEY, seeds=40, control=False, **SHORT)
    np.testing.assert_array_equal(jm.ensembles.merge(path)["F_ext"], whole.output)


# What is said to be done is on disk, and nothing else stays


def test_chunks_are_on_disk_before_they_are_said_to_be_done(tmp_path, monkeypatch):
    path, synced, replace, to_disk = tmp_path / "a.zarr", set(), os.replace, _places.to_disk
    seen = []

    def noted(paths):
        found = list(paths)
        to_disk(found)
        synced.update(found)

    def checked(source, target):
        if Path(target).name.startswith("chunk-"):
            number = int(Path(target).name[6:14])
            chunk = path / "F_ext" / "c" / str(number) / "0"
            assert {chunk, *list(chunk.parents)[:4], Path(source)} <= synced
            seen.append(number)
        replace(source, target)

    monkeypatch.setattr(_places, "to_disk", noted)
    monkeypatch.setattr(os, "replace", checked)
    monkeypatch.setattr(_store, "LOG_EVERY", 0.0)
    jm.ensemble(TASK, KEY, seeds=20, store=path, **SHORT)
    assert seen == [0, 1, 2]
    assert tmp_path in synced and path / "progress" in synced


@KINDS
def test_leftovers_are_removed(tmp_path, kept):
    path = tmp_path / "a.zarr"
    given: Any = {"seeds": 24, "store": path, **SHORT, **kept}
    with pytest.raises(Stop):
        jm.ensemble(TASK, KEY, progress=stopped_after(1), **given)
    (tmp_path / ".a.zarr.new-abc").mkdir()  # killed while it began, or removed an older store
    (path / "time" / "c" / "0.123.partial").write_bytes(b"killed while writing")
    (tmp_path / ".a.zarr-backup").mkdir()  # somebody else's
    jm.ensemble(TASK, KEY, resume=True, **given)
    assert sorted(p.name for p in tmp_path.iterdir()) == [".a.zarr-backup", "a.zarr"]
    assert not list(path.rglob("*.partial")) and not (path / "progress").exists()
    (path / "progress").mkdir()  # killed after the store was complete
    (path / "progress" / "settings.json").write_bytes(b"{}")
    jm.ensemble(TASK, KEY, resume=True, **given)
    assert not (path / "progress").exists()


# One writer


@pytest.fixture(params=["folder", "url"])
def anywhere(request, tmp_path):
    """A name for a store, and what lists its locks."""
    if request.param == "folder":
        return tmp_path / "a.zarr", lambda: sorted(p.name for p in tmp_path.glob(".*"))
    place: Any = place_of(url := f"memory://{tmp_path}/a.zarr")
    return url, lambda: place._names(f"{place.path}.lock")


HERE = rf"process {os.getpid()} on {socket.gethostname()} \(since .*\) is writing it: wait"


@KINDS
def test_a_second_writer_is_refused(anywhere, kept):
    store, locks = anywhere
    given: Any = {"seeds": 24, "store": store, **SHORT, **kept}
    tried = []

    def meanwhile(text, share):
        for begin in ({"resume": True}, {"overwrite": True}) if not tried else ():
            with pytest.raises(jm.errors.StoreError, match=HERE):
                jm.ensemble(
                    TASK, jax.random.key(6 if "overwrite" in begin else 5), **begin, **given
                )
            tried.append(begin)

    found = jm.ensemble(TASK, KEY, progress=meanwhile, **given)
    assert len(tried) == 2 and locks() == []
    whole = jm.ensemble(TASK, KEY, seeds=24, **({"control": False} | SHORT | kept))
    np.testing.assert_array_equal(
        found.mean if kept else found["F_ext"], whole.mean if kept else whole.output
    )


def test_parts_write_together_and_nobody_else(anywhere):
    store, locks = anywhere
    given: Any = {"seeds": 32, "store": store, **SHORT}
    tried = []

    def meanwhile(text, share):
        if not tried:
            tried.append(jm.ensemble(TASK, KEY, part=(2, 2), **given))
            for write in (
                lambda: jm.ensembles.merge(store),
                lambda: jm.ensemble(TASK, KEY, part=(1, 2), **given),
                lambda: jm.ensemble(TASK, KEY, overwrite=True, **given),
            ):
                with pytest.raises(jm.errors.StoreError, match=HERE):
                    write()

    jm.ensemble(TASK, KEY, part=(1, 2), progress=meanwhile, **given)
    assert tried and locks() == []
    whole = jm.ensemble(TASK, KEY, seeds=32, control=False, **SHORT)
    np.testing.assert_array_equal(jm.ensembles.merge(store)["F_ext"], whole.output)
    assert locks() == []


@pytest.mark.parametrize("how", [KeyboardInterrupt, SystemExit, Stop])
def test_an_interrupted_writer_leaves_no_lock(anywhere, how):
    store, locks = anywhere

    def interrupted(text, share):
        assert len(locks()) == 1
        raise how

    with pytest.raises(how):
        jm.ensemble(TASK, KEY, seeds=24, store=store, progress=interrupted, **SHORT)
    assert locks() == []


def left_by(store, name, **changes):
    """A lock that a killed process left."""
    data = Holder.here()._replace(**changes).to_bytes()
    if isinstance(store, Path):
        (store.parent / f".{store.name}.lock{'' if name == 'whole' else '-' + name}").write_bytes(
            data
        )
    else:
        place: Any = place_of(store)
        place.files.pipe_file(f"{place.path}.lock/{name}", data)


@pytest.mark.parametrize(
    "changes", [{"pid": 2**22 + 1}, {"started": "7"}, {"boot": "another"}], ids=str
)
def test_the_lock_of_a_dead_process_is_taken_over(anywhere, caplog, changes):
    """Also where its number was given again, or the machine started anew."""
    store, locks = anywhere
    left_by(store, "whole", **changes)
    left_by(store, "part-3", **changes)
    jm.ensemble(TASK, KEY, seeds=8, store=store, **SHORT)
    assert caplog.text.count("has ended without removing its lock. It is taken over") == 2
    assert locks() == []


def test_the_lock_of_another_host_is_not_taken_over(anywhere):
    store, locks = anywhere
    given: Any = {"seeds": 8, "store": store, **SHORT}
    left_by(store, "whole", host="node17", boot="another", pid=4711)
    for part in ({}, {"part": (1, 1)}):
        with pytest.raises(
            jm.errors.StoreError,
            match=r"process 4711 on node17 .*may still write. If it has ended, remove",
        ):
            jm.ensemble(TASK, KEY, **part, **given)
    if isinstance(store, Path):
        (store.parent / ".a.zarr.lock").unlink()  # as it says
    else:
        place: Any = place_of(store)
        place.files.rm_file(f"{place.path}.lock/whole")
    left_by(store, "part-1", host="node17", boot="another", pid=4711)
    # queued again on another node: a part that runs twice does no harm
    jm.ensemble(TASK, KEY, part=(1, 1), **given)
    assert locks() == []
    left_by(store, "part-1", host="node17", boot="another", pid=4711)
    with pytest.raises(jm.errors.StoreError, match="process 4711 on node17"):
        jm.ensembles.merge(store)


def test_a_file_system_without_locks(tmp_path, monkeypatch, caplog):
    """It is said; a living process is still told by its text."""
    import errno
    import fcntl

    def without(*arguments):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", without)
    given: Any = {"seeds": 8, "store": tmp_path / "a.zarr", **SHORT}
    left_by(tmp_path / "a.zarr", "whole", pid=1, started="")
    monkeypatch.setattr("jaxmuscle.ensembles._locks._started", lambda pid: "")
    with pytest.raises(jm.errors.StoreError, match=r"process 1 on .* is writing it"):
        jm.ensemble(TASK, KEY, **given)
    left_by(tmp_path / "a.zarr", "whole", pid=2**22 + 1)
    jm.ensemble(TASK, KEY, **given)
    assert "this file system has no locks. See to it that no other process writes" in caplog.text
    assert [p.name for p in tmp_path.iterdir()] == ["a.zarr"]


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
        assert kills.equal(found, ones[key], True, 0.0)


@pytest.mark.parametrize("kept", [{"reduce": True}, {}], ids=["reduced", "trajectories"])
def test_a_store_is_read_before_others_may_write_it(tmp_path, monkeypatch, kept):
    """A process that overwrites it could come in between: the first would find nothing, or an empty
    store."""
    locked = []

    def noting(call):
        def noted(*given, **more):
            locked.append((tmp_path / ".a.zarr.lock").exists())
            return call(*given, **more)

        return noted

    monkeypatch.setattr(_ensemble_run, "_loaded", noting(_ensemble_run._loaded))
    monkeypatch.setattr(xarray, "open_zarr", noting(xarray.open_zarr))
    made(tmp_path / "a.zarr", kept)
    assert locked == [True] and not (tmp_path / ".a.zarr.lock").exists()


def test_a_store_may_be_copied(tmp_path):
    given = made(tmp_path / "a.zarr", {}, seeds=8)
    shutil.copytree(tmp_path / "a.zarr", tmp_path / "b.zarr")
    copy = jm.ensembles.open_store(tmp_path / "b.zarr").load()
    again = jm.ensemble(TASK, KEY, resume=True, **given | {"store": tmp_path / "b.zarr"})
    np.testing.assert_array_equal(copy["F_ext"], again["F_ext"])
