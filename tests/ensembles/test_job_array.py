"""Parts of one store, made by processes that do not know of each other, and stores at URLs."""

import json
import random
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import hypothesis
import hypothesis.strategies as st
import jax
import numpy as np
import pytest
import xarray
from processes import Run, command, ended, python
from test_ensemble import BRITTLE, KEY, RUNNER, SHORT, TASK, Stop, close, stopped_after

import jaxmuscle as jm
from jaxmuscle.commands.main import app
from jaxmuscle.ensembles import _run as _ensemble_run
from jaxmuscle.ensembles import _store
from jaxmuscle.ensembles._layout import cut_of, plan_of
from jaxmuscle.ensembles._parts import Part
from jaxmuscle.ensembles._places import place_of

KINDS = pytest.mark.parametrize("kept", [{}, {"reduce": True}], ids=["trajectories", "reduced"])


@pytest.fixture(params=["folder", "url"])
def anywhere(request, tmp_path):
    """A name for a store that is not there yet; the object store lives in this process."""
    return tmp_path / "a.zarr" if request.param == "folder" else f"memory://{tmp_path}/a.zarr"


def same_as_one_run(found, seeds, kept):
    """Paths bit by bit, moments to 1e-6 of the largest value."""
    whole = jm.ensemble(TASK, KEY, seeds=seeds, **({"control": False} | SHORT | kept))
    if not kept:
        np.testing.assert_array_equal(found["F_ext"], whole.output)
        return
    close(found["mean"], whole.mean)
    close(found["variance"], whole.variance)
    close(found["quantiles"], whole.quantile)


# Who does what


@hypothesis.given(st.integers(0, 500), st.integers(1, 40))
def test_every_chunk_is_in_one_part(chunks, count):
    shares = [Part(number, count).chunks(chunks) for number in range(1, count + 1)]
    assert [chunk for share in shares for chunk in share] == list(range(chunks))
    assert max(map(len, shares)) - min(map(len, shares)) <= 1


@hypothesis.given(st.integers(1, 200_000), st.integers(1, 64))
def test_no_part_has_much_more_than_its_share(seeds, count):
    """At most seven seeds more in each of its chunks, and as few chunks as without parts."""
    most = cut_of(TASK, 10**7, PLAN, None, shared=False, parts=1).width
    width = cut_of(TASK, seeds, PLAN, None, shared=False, parts=count).width
    fair = -(-seeds // count)
    ends = np.minimum(width * np.arange(1 + -(-seeds // width)), seeds)
    shares = [Part(number, count).chunks(len(ends) - 1) for number in range(1, count + 1)]
    assert width % 8 == 0 and width <= most
    assert max(ends[share.stop] - ends[share.start] for share in shares) <= fair + 8 * -(
        -fair // most
    )
    assert max(map(len, shares)) <= -(-fair // most)


PLAN = plan_of(TASK, 1.0, 1e-3, None, None, None)


def test_a_part_does_not_depend_on_the_devices(monkeypatch):
    one = cut_of(TASK, 10**6, PLAN, None, shared=False, parts=4)
    monkeypatch.setattr(jax, "local_device_count", lambda: 16)
    assert cut_of(TASK, 10**6, PLAN, None, shared=False, parts=4) == one


# Parts and their merging


@KINDS
def test_parts_in_any_order_are_one_run(anywhere, kept):
    given: Any = {"seeds": 45, "store": anywhere, **SHORT, **kept}
    told = []
    reports = [jm.ensemble(TASK, KEY, part=(number, 4), **given) for number in (3, 1)]
    assert jm.ensembles.attributes_of(anywhere)["complete"] is False
    with pytest.raises(
        ValueError, match=r"4 of 6 chunks are missing: parts 2,4 of 4 are not done.* --part 2/4"
    ):
        jm.ensembles.merge(anywhere)
    assert jm.ensembles.attributes_of(anywhere)["complete"] is False
    again = jm.ensemble(TASK, KEY, part=(3, 4), progress=lambda *pace: told.append(pace), **given)
    assert not told and again == reports[0]._replace(failed=again.failed), (
        "a part that is repeated computes nothing"
    )
    reports += [jm.ensemble(TASK, KEY, part=(number, 4), resume=True, **given) for number in (2, 4)]
    assert sum(report.seeds for report in reports) == 45
    assert all(report.success and not report.complete for report in reports)
    found = jm.ensembles.merge(anywhere)
    assert found.attrs["complete"] is True and json.loads(found.attrs["failed"]) == []
    same_as_one_run(found, 45, kept)
    assert jm.ensembles.merge(anywhere).equals(found)
    late = jm.ensemble(TASK, KEY, part=(2, 4), progress=lambda *pace: told.append(pace), **given)
    assert late.complete and not told
    opened = jm.ensemble(TASK, KEY, resume=True, **given)  # the way to an `EnsembleSummary`
    np.testing.assert_array_equal(
        opened.mean if kept else opened["F_ext"], found["mean"] if kept else found["F_ext"]
    )
    assert not place_of(anywhere).progress()


def test_merged_spectra_are_those_of_one_run(tmp_path):
    """With the control variate, whose expectation the store knows."""
    given: Any = {"seeds": 24, "reduce": True, "chunk": 8}
    for number in (1, 2):
        jm.ensemble(TASK, KEY, store=tmp_path / "a.zarr", part=(number, 2), **given)
    merged, whole = jm.ensembles.merge(tmp_path / "a.zarr"), jm.ensemble(TASK, KEY, **given)
    close(merged["power"], whole.spectrum.power)
    close(merged["power_stderr"], whole.spectrum.stderr)
    close(merged["plain_power"], whole.spectrum.plain_power)
    close(merged["plain_stderr"], whole.spectrum.plain_stderr)
    np.testing.assert_allclose(
        [merged["coefficient_of_variation"], merged["coefficient_of_variation_stderr"]],
        whole.coefficient_of_variation,
        1e-6,
    )
    opened = jm.ensemble(TASK, KEY, store=tmp_path / "a.zarr", resume=True, **given)
    np.testing.assert_array_equal(opened.spectrum.power, merged["power"])


@pytest.mark.parametrize("seeds", [2, 20], ids=["points together", "points in pieces"])
def test_parts_of_a_sweep(tmp_path, seeds):
    sweep = jm.ensembles.Sweep.grid(TASK, k_w=[4e5, 5e5, 6e5, 7e5, 8e5])
    given: Any = {"seeds": seeds, "reduce": True, **SHORT}
    for number in (2, 3, 1):
        jm.ensemble(sweep, KEY, store=tmp_path / "a.zarr", part=(number, 3), **given)
    merged, whole = jm.ensembles.merge(tmp_path / "a.zarr"), jm.ensemble(sweep, KEY, **given)
    close(merged["mean"], whole.mean)
    close(merged["quantiles"], whole.quantile)
    np.testing.assert_array_equal(merged.coords["k_w"], sweep.labels["k_w"])


@KINDS
def test_what_fails_in_a_part_is_named_by_it_and_in_the_end(tmp_path, kept):
    given: Any = {"seeds": 40, "store": tmp_path / "a.zarr", **SHORT, **kept}
    reports = [jm.ensemble(BRITTLE, KEY, part=(number, 2), **given) for number in (1, 2)]
    failed = np.concatenate([report.failed for report in reports])
    assert len(failed) > 3 and not all(report.success for report in reports)
    assert np.all(reports[0].failed[:, 1] < reports[1].failed[:, 1].min())
    merged = jm.ensembles.merge(tmp_path / "a.zarr")
    assert json.loads(merged.attrs["failed"]) == failed.tolist()
    whole = jm.ensemble(BRITTLE, KEY, seeds=40, reduce=True, **SHORT)
    np.testing.assert_array_equal(whole.failed, failed)


@KINDS
def test_a_part_that_was_stopped_goes_on(anywhere, monkeypatch, kept):
    monkeypatch.setattr(_ensemble_run, "KEEP_EVERY", 0.0)
    monkeypatch.setattr(_ensemble_run, "KEEP_SHARE", 0)
    given: Any = {"seeds": 96, "store": anywhere, **SHORT, **kept}
    with pytest.raises(Stop):
        jm.ensemble(TASK, KEY, part=(2, 2), progress=stopped_after(4), **given)
    told = []
    jm.ensemble(TASK, KEY, part=(2, 2), progress=lambda *pace: told.append(pace), **given)
    assert len(told) == 2
    with pytest.raises(ValueError, match="6 of 12 chunks are missing: parts 1 of 2"):
        jm.ensembles.merge(anywhere)
    jm.ensemble(TASK, KEY, part=(1, 2), **given)
    same_as_one_run(jm.ensembles.merge(anywhere), 96, kept)


@KINDS
@pytest.mark.parametrize("change", [{}, {"seeds": 17}], ids=["same settings", "other settings"])
def test_two_parts_begin_at_the_same_moment(anywhere, monkeypatch, kept, change):
    """The other one comes between looking whether there is a store and making it."""
    given: Any = {"seeds": 16, "store": anywhere, **SHORT, **kept}
    build = _store._build

    def late(*arguments):
        monkeypatch.setattr(_store, "_build", build)
        jm.ensemble(TASK, KEY, part=(2, 2), **given)
        build(*arguments)

    if change and isinstance(anywhere, str):
        late = lambda *arguments: None  # noqa: E731  # an object store knows it before anything is built
        place_of(anywhere).claim(json.dumps({"seeds": "0 to 15", "random numbers": {}}))
    monkeypatch.setattr(_store, "_build", late)
    if change:
        with pytest.raises(ValueError, match='seeds = "0 to 15" there, "0 to 16" here'):
            jm.ensemble(TASK, KEY, part=(1, 2), **given | change)
        return
    jm.ensemble(TASK, KEY, part=(1, 2), **given)
    same_as_one_run(jm.ensembles.merge(anywhere), 16, kept)


def test_a_run_without_parts_does_not_share_a_store_by_chance(tmp_path, monkeypatch):
    given: Any = {"seeds": 16, "store": tmp_path / "a.zarr", **SHORT}
    build = _store._build

    def late(*arguments):
        monkeypatch.setattr(_store, "_build", build)
        with pytest.raises(ValueError, match="is writing it: wait"):
            jm.ensemble(TASK, KEY, **given)
        build(*arguments)

    monkeypatch.setattr(_store, "_build", late)
    same_as_one_run(jm.ensemble(TASK, KEY, **given), 16, {})


@pytest.mark.parametrize(
    "change, message",
    [
        ({"seeds": 21}, r'seeds = "0 to 19" there, "0 to 20" here'),
        ({"chunk": 16}, "chunk = 8 there, 16 here"),
        ({"part": (1, 5)}, r"is being made in 2 parts: run each with --part I/2"),
        ({"part": None, "resume": True}, r"is being made in 2 parts: run each with --part I/2"),
        ({"part": None}, "exists already"),
        ({"part": (1, 2), "overwrite": True}, "it cannot overwrite it: remove the store first"),
        ({"part": (0, 2)}, "part = 0/2: parts are numbered from 1"),
        ({"part": (3, 2)}, "part = 3/2: parts are numbered from 1"),
        ({"part": (1, 0)}, "part = 1/0: parts are numbered from 1"),
        ({"store": None}, "a part of an ensemble belongs to a store"),
    ],
    ids=str,
)
def test_what_a_part_refuses(tmp_path, change, message):
    given: Any = {"seeds": 20, "store": tmp_path / "a.zarr", **SHORT}
    jm.ensemble(TASK, KEY, part=(2, 2), **given)
    before = {p: p.read_bytes() for p in (tmp_path / "a.zarr").rglob("*") if p.is_file()}
    with pytest.raises(ValueError, match=message):
        jm.ensemble(TASK, KEY, **{"part": (1, 2)} | given | change)
    assert before == {p: p.read_bytes() for p in (tmp_path / "a.zarr").rglob("*") if p.is_file()}


def test_what_cannot_be_merged(tmp_path):
    with pytest.raises(ValueError, match="there is no store"):
        jm.ensembles.merge(tmp_path / "a.zarr")
    with pytest.raises(Stop):
        jm.ensemble(
            TASK, KEY, seeds=24, store=tmp_path / "b.zarr", progress=stopped_after(1), **SHORT
        )
    with pytest.raises(ValueError, match="is not made in parts; resume it"):
        jm.ensembles.merge(tmp_path / "b.zarr")
    with pytest.raises(ValueError, match="is being made without parts: resume it without --part"):
        jm.ensemble(TASK, KEY, seeds=24, store=tmp_path / "b.zarr", part=(1, 2), **SHORT)
    xarray.Dataset({"a": ("b", np.arange(3))}).to_zarr(tmp_path / "c.zarr", consolidated=False)
    with pytest.raises(ValueError, match="is not an ensemble"):
        jm.ensembles.merge(tmp_path / "c.zarr")


# Processes


@pytest.mark.slow
@pytest.mark.parametrize("reduce", [False, True], ids=["trajectories", "reduced"])
def test_parts_killed_at_random_end_as_one_run(tmp_path, monkeypatch, reduce):
    """Two of the trials of benchmarks/kills.py, which has twenty, of more seeds. Killed before one
    part alone would end.

    How long that takes changes with the load of the machine. If both ended before they were killed,
    more trials follow.
    """
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    import kills

    monkeypatch.setattr(
        kills,
        "begun",
        lambda store, reduce, key=5, **given: Run(store, reduce, key, kills.OPTIONS | given),
    )
    monkeypatch.setitem(kills.OPTIONS, "seeds", 1600)
    monkeypatch.setattr(kills, "PARTS", 3)
    one, rng = kills.whole(reduce), random.Random(int(reduce))  # compiles what the parts load
    ended(python("pass"))  # the first process of all waits for imports
    start = time.monotonic()
    kills.ended([kills.begun(tmp_path / "a.zarr", reduce, part=(1, kills.PARTS))])
    longest = 0.6 * (time.monotonic() - start)
    early: list[bool] = []
    while len(early) < 2 or (not any(early) and len(early) < 12):
        found, killed = kills.parts(tmp_path / f"{len(early)}.zarr", reduce, rng, longest)
        assert kills.equal(found, one, reduce)
        early.append(killed)
    assert any(early), "nothing was interrupted: the test shows nothing"


def started(part, out):
    arguments = [
        "--seeds",
        "60",
        "--duration",
        "1",
        "--chunk",
        "8",
        "--threads",
        "1",
        "--out",
        out,
        "--part",
        part,
    ]
    return command("ensemble", "zagrodny-slifkin", *arguments, merged=True)


@pytest.mark.slow
def test_commands_that_begin_together(tmp_path):
    """In a folder all at once; in what plays an object store, whose files are not replaced in one
    step, after the first."""
    whole = jm.ensemble(
        jm.load_preset("zagrodny-slifkin"), jax.random.key(0), seeds=60, control=False, **SHORT
    )
    for out, first in ((str(tmp_path / "a.zarr"), []), (f"local://{tmp_path}/b.zarr", ["2/3"])):
        told = [ended(started(part, out)) for part in first]
        told += map(
            ended, [started(part, out) for part in ("1/3", "2/3", "3/3") if part not in first]
        )
        assert all(f"jaxmuscle merge {out}" in text for text, _ in told)
        done = RUNNER.invoke(app, ["merge", out])
        assert done.exit_code == 0 and f"Merged: {out}" in done.stdout, done.output
        np.testing.assert_array_equal(jm.ensembles.merge(out)["P_w"], whole.output)
        again = RUNNER.invoke(app, ["merge", out])
        assert again.exit_code == 0 and "was complete, nothing to do" in again.stdout


# The command


def test_the_command_makes_a_part_and_merges(tmp_path):
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
        "--reduce",
        "--out",
        str(path),
    ]
    first = RUNNER.invoke(app, [*arguments, "--part", "2/2", "--json"])
    assert first.exit_code == 0, first.output
    told = json.loads(first.stdout)
    assert (told["number"], told["parts"], told["seeds"], told["failed"], told["complete"]) == (
        2,
        2,
        8,
        [],
        False,
    )
    early = RUNNER.invoke(app, ["merge", str(path)])
    assert (
        early.exit_code == 2
        and "parts 1 of 2 are not done" in early.stderr
        and "--part 1/2" in early.stderr
    )
    alone = RUNNER.invoke(app, [*arguments, "--resume"])
    assert alone.exit_code == 2 and "is being made in 2 parts" in alone.stderr
    RUNNER.invoke(app, [*arguments, "--part", "1/2", "--resume"])
    merged = RUNNER.invoke(app, ["merge", str(path), "--json"])
    assert merged.exit_code == 0 and json.loads(merged.stdout) == {
        "event": "done",
        "out": str(path),
        "failed": [],
    }
    after = RUNNER.invoke(app, [*arguments, "--part", "1/2"])
    assert after.exit_code == 0 and "was complete, nothing to do" in after.stdout
    opened = RUNNER.invoke(app, [*arguments, "--resume"])
    assert (
        opened.exit_code == 0
        and "16 seeds" in opened.stdout
        and "was complete, nothing to do" in opened.stdout
    )


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--part", "5/4"], "part = 5/4: parts are numbered from 1"),
        (["--part", "0/4"], "part = 0/4: parts are numbered from 1"),
        (["--part", "2"], "--part 2: write I/N with whole numbers"),
        (["--part", "-1/4"], "--part -1/4: write I/N with whole numbers"),
        (["--part", "1/2", "--force"], "it cannot overwrite it: remove the store first"),
        (
            ["--part", "1/2", "--processes", "2"],
            "a part is a process of its own: leave out --coordinator",
        ),
    ],
)
def test_the_command_refuses(tmp_path, arguments, message):
    common = [
        "ensemble",
        "zagrodny-slifkin",
        "--seeds",
        "8",
        "--duration",
        "1",
        "--out",
        str(tmp_path / "a.zarr"),
    ]
    done = RUNNER.invoke(app, [*common, *arguments])
    assert done.exit_code == 2 and message in done.stderr.replace("\n", " ")
    assert list(tmp_path.iterdir()) == []


def test_a_merged_store_with_failed_seeds_ends_with_1(tmp_path):
    jm.ensemble(BRITTLE, KEY, seeds=40, store=tmp_path / "a.zarr", part=(1, 1), **SHORT)
    done = RUNNER.invoke(app, ["merge", str(tmp_path / "a.zarr")])
    assert done.exit_code == 1 and "did not stay finite" in done.stderr and "Merged" in done.stdout


# URLs


@KINDS
def test_a_store_at_a_url_is_resumed_and_overwritten(tmp_path, monkeypatch, kept):
    monkeypatch.setattr(_ensemble_run, "KEEP_EVERY", 0.0)
    monkeypatch.setattr(_ensemble_run, "KEEP_SHARE", 0)
    url = f"memory://{tmp_path}/a.zarr"
    given: Any = {"seeds": 45, "store": url, **SHORT, **kept}
    with pytest.raises(Stop):
        jm.ensemble(TASK, KEY, progress=stopped_after(3), **given)
    assert xarray.open_zarr(url).attrs["complete"] is False
    with pytest.raises(ValueError, match="exists already; resume it"):
        jm.ensemble(TASK, KEY, **given)
    told = []
    jm.ensemble(TASK, KEY, resume=True, progress=lambda *pace: told.append(pace), **given)
    assert len(told) == 6 - 3
    same_as_one_run(xarray.open_zarr(url), 45, kept)
    jm.ensemble(TASK, jax.random.key(6), overwrite=True, **given | {"seeds": 20})
    found = xarray.open_zarr(url)
    assert (
        found.attrs["complete"] is True
        and json.loads(found.attrs["settings"])["seeds"] == "0 to 19"
    )
    assert not place_of(url).progress()
    assert not (tmp_path / "a.zarr").exists()


def test_parts_begin_together_at_a_url(tmp_path):
    """Several times: it depends on the moment."""
    for turn in range(5):
        url = f"memory://{tmp_path}/{turn}.zarr"

        def part(number, url=url):
            return jm.ensemble(TASK, KEY, seeds=32, store=url, part=(number, 4), **SHORT)

        with ThreadPoolExecutor(4) as pool:
            assert [report.seeds for report in pool.map(part, range(1, 5))] == [8] * 4
        same_as_one_run(jm.ensembles.merge(url), 32, {})


def test_an_interrupted_creation_at_a_url_is_repeated(tmp_path, monkeypatch):
    """The root key comes last, so nothing is taken for a store before it is whole."""
    url = f"memory://{tmp_path}/a.zarr"
    place = type(place_of(url))
    create = place._create

    def interrupted(self, key, data):
        if key.endswith("/zarr.json"):
            raise Stop
        return create(self, key, data)

    monkeypatch.setattr(place, "_create", interrupted)
    with pytest.raises(Stop):
        jm.ensemble(TASK, KEY, seeds=8, store=url, **SHORT)
    assert jm.ensembles.attributes_of(url) is None
    monkeypatch.setattr(place, "_create", create)
    same_as_one_run(jm.ensemble(TASK, KEY, seeds=8, store=url, **SHORT), 8, {})


def test_something_else_at_a_url_is_left_alone(tmp_path):
    url = f"memory://{tmp_path}/mine"
    place_of(url).write({"notes.txt": b"not an ensemble"})
    for begin in ({}, {"resume": True}, {"overwrite": True}, {"part": (1, 2)}):
        with pytest.raises(ValueError, match=r"exists already|is not a store that jaxmuscle wrote"):
            jm.ensemble(TASK, KEY, seeds=8, store=url, **begin, **SHORT)
    assert (
        place_of(url).read("notes.txt") == b"not an ensemble"
        and place_of(url).read("zarr.json") is None
    )


def test_a_file_url_is_a_folder(tmp_path):
    jm.ensemble(TASK, KEY, seeds=8, store=f"file://{tmp_path}/a.zarr", **SHORT)
    assert xarray.open_zarr(tmp_path / "a.zarr").attrs["complete"] is True


def test_urls_that_cannot_be_used(tmp_path, monkeypatch):
    given: Any = {"seeds": 8, **SHORT}
    with pytest.raises(ValueError, match="nosuch://a: Protocol not known"):
        jm.ensemble(TASK, KEY, store="nosuch://a", **given)

    def unreachable(self, path, **_):
        raise RuntimeError("no credentials")

    with monkeypatch.context() as patch:
        patch.setattr(type(place_of("memory://a").files), "exists", unreachable)
        with pytest.raises(
            ValueError,
            match=r"memory://a: cannot be reached \(RuntimeError: no credentials\); check",
        ):
            jm.ensemble(TASK, KEY, store="memory://a", **given)
    monkeypatch.setitem(sys.modules, "fsspec.core", None)
    with pytest.raises(ValueError, match=r"memory://a: a URL needs fsspec: pip install fsspec"):
        jm.ensemble(TASK, KEY, store="memory://a", **given)
    done = RUNNER.invoke(
        app, ["ensemble", "zagrodny-slifkin", "--seeds", "8", "--out", "memory://a"]
    )
    assert done.exit_code == 2 and "a URL needs fsspec" in done.stderr
