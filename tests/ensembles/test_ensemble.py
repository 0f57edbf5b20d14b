"""Ensembles at scale: reduced, stored, swept, on threads and several devices, killed and
resumed."""

import contextlib
import json
import random
import shutil
import subprocess
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
import xarray
from processes import command, ended, python
from test_simulate import Integral
from typer.testing import CliRunner

import jaxmuscle as jm
from jaxmuscle.commands.main import app
from jaxmuscle.ensembles import _chunks, _settings
from jaxmuscle.ensembles import _run as _ensemble_run
from jaxmuscle.ensembles._running_moments import (
    CELLS,
    add,
    count_cells,
    edges_of,
    empty,
    moments,
    quantiles,
)
from jaxmuscle.ensembles._store import differences
from jaxmuscle.simulation import _batch
from jaxmuscle.simulation._simulate import schedule

KEY = jax.random.key(5)
TASK = jm.Isometric()
SHORT = {"duration": 1.0, "chunk": 8}  # the force begins to rise at 0.5 s


class Brittle(Integral):
    """`y' = ΔK_w - y`, which breaks for good where ΔK_w exceeds a limit."""

    def vector_field(self, t, y, u):
        return jnp.where(u[:1] > 3.3, jnp.inf, u[:1]) - y


BRITTLE = Brittle(
    noise=jm.OrnsteinUhlenbeckNoise(1.0, 0.01, relative=False), harmonic=jm.Harmonic(0.0)
)


def close(a, b, rtol=1e-6):
    """Within `rtol` of the largest value."""
    np.testing.assert_allclose(a, b, rtol=0, atol=rtol * np.abs(np.asarray(b)).max())


# Tallies


@pytest.mark.parametrize(("seeds", "count"), [(1, 1), (128, 1), (1024, 1), (1025, 2), (4096, 4)])
def test_seeds_fit_into_so_many_blocks(seeds, count):
    assert _batch.blocks(seeds, 1024) == count


@pytest.mark.parametrize("pieces", [1, 3, 40])
def test_moments_of_pieces_are_those_of_the_whole(pieces):
    """Also far from zero, where sums of squares would have lost all digits."""
    rows = 1e6 + np.random.default_rng(0).normal(size=(400, 5)) * [1, 2, 3, 1e-3, 0]
    whole = empty(1, 5, 5, 1, whole=True)
    for part in np.array_split(rows, pieces):
        add(whole, 0, moments(part))
    assert whole.seeds.tolist() == [400]
    np.testing.assert_allclose(whole.mean[0], rows.mean(axis=0), rtol=1e-14)
    np.testing.assert_allclose(
        whole.squares[0] / 399, rows.var(axis=0, ddof=1), rtol=1e-6, atol=1e-12
    )


def test_counted_quantiles_are_within_a_cell_of_the_exact_ones():
    rng = np.random.default_rng(1)
    output = np.stack(
        [
            rng.normal(3, 0.1, 5000),
            rng.exponential(size=5000),
            np.full(5000, 7.0),
            rng.uniform(size=5000),
        ],
        1,
    )
    levels = (0.01, 0.3, 0.5, 0.95, 0.999)
    tally = empty(1, 4, 4, len(levels), whole=False)
    tally.low[0], tally.high[0] = edges_of(output[:256])
    for part in np.array_split(output, 7):
        add(tally, 0, moments(part))
        tally.cells[0] += count_cells(tally.low[0], tally.high[0], part)
    found = quantiles(tally, levels)[0]
    exact = np.quantile(output, levels, axis=0, method="inverted_cdf")
    assert np.all(np.abs(found - exact) <= (tally.high - tally.low)[0] / CELLS)


def test_a_quantile_beyond_the_cells_is_not_made_up():
    tally = empty(1, 1, 1, 2, whole=False)
    tally.low[0], tally.high[0] = edges_of(np.random.default_rng(0).normal(size=(100, 1)))
    output = np.concatenate([np.random.default_rng(1).normal(size=(80, 1)), np.full((20, 1), 1e3)])
    add(tally, 0, moments(output))
    tally.cells[0] += count_cells(tally.low[0], tally.high[0], output)
    middle, far = quantiles(tally, (0.4, 0.9))[0, :, 0]
    assert np.isfinite(middle) and np.isnan(far)


# Reduced ensembles


def test_a_reduced_ensemble_has_the_moments_of_the_whole_one():
    runs = jm.ensemble(TASK, KEY, seeds=30, chunk=8)
    output = np.asarray(runs.output, float)
    for chunk in (8, 64):  # seeds of the point in pieces, or together
        found = jm.ensemble(TASK, KEY, seeds=30, reduce=(0.1, 0.5), chunk=chunk)
        assert found.success and found.seeds == 30 and found.mean.shape == (1501,)
        close(found.mean, output.mean(axis=0))
        # single precision: sd / mean is 1e-2
        close(found.variance, output.var(axis=0, ddof=1), 1e-4)
        estimate = runs.mean_spectrum()
        close(found.spectrum.power, estimate.power, 1e-5)
        close(found.spectrum.stderr, estimate.stderr, 1e-3)
        close(found.spectrum.plain_power, estimate.plain_power, 1e-5)
        held = scipy.signal.sosfilt(TASK.settings.sections, output)[:, 500:1500]
        variation = held.std(axis=1) / held.mean(axis=1)
        close(
            found.coefficient_of_variation,
            [variation.mean(), variation.std(ddof=1) / np.sqrt(30)],
            1e-5,
        )
        exact = np.quantile(
            output, (0.1, 0.5), axis=0, method="inverted_cdf" if chunk == 8 else "linear"
        )
        width = 20 * output[:8].std(axis=0).max() / CELLS if chunk == 8 else 1e-6
        assert np.abs(found.quantile - exact).max() < width
    dataset = found.to_xarray()
    assert dataset["mean"].attrs["units"] == "N" and dataset["power"].dims == ("frequency",)
    assert "30 seeds" in str(found)
    ax = found.plot()
    assert ax.get_ylabel().endswith("(N)") and len(ax.collections) == 1


def test_a_stored_summary_is_the_one_in_memory(tmp_path):
    options: Any = {"seeds": 4, "duration": 15.0, "reduce": True}
    found = jm.ensemble(TASK, KEY, **options)
    stored = jm.ensemble(TASK, KEY, store=tmp_path / "a.zarr", **options)
    assert stored.spectrum.seeds == found.spectrum.seeds == 4
    jax.tree.map(np.testing.assert_array_equal, stored.spectrum, found.spectrum)
    assert str(stored) == str(found)


def test_a_run_too_short_for_a_spectrum_has_none():
    found = jm.ensemble(TASK, KEY, seeds=3, reduce=True, **SHORT)
    assert found.spectra == () and found.mean.shape == (101,)
    with pytest.raises(ValueError, match="does not cover 5 s to 15 s"):
        _ = found.spectrum


def test_what_breaks_is_left_out_and_named():
    runs = jm.ensemble(BRITTLE, KEY, seeds=40, reduce=True, **SHORT)
    assert 3 < len(runs.failed) < 37  # else the test shows nothing
    broken = runs.failed[:, 1]
    with pytest.raises(
        jm.errors.SimulationError, match=f"{len(broken)} seed.*{broken[0]}, {broken[1]}"
    ):
        jm.ensemble(BRITTLE, KEY, seeds=40, **SHORT)
    kept = np.setdiff1d(np.arange(40), broken)
    whole = jm.ensemble(BRITTLE, KEY, seeds=kept, **SHORT)
    close(runs.mean, np.asarray(whole.output).mean(axis=0))
    assert not runs.success and f"{len(broken)} seed(s) did not stay finite" in runs.message


def test_where_nothing_is_left_nothing_is_said():
    broken = Brittle(
        noise=jm.OrnsteinUhlenbeckNoise(50.0, 0.01, relative=False), harmonic=jm.Harmonic(0.0)
    )
    with pytest.raises(
        jm.errors.SimulationError, match="none of the first seeds of point 0 stayed finite"
    ):
        jm.ensemble(broken, KEY, seeds=40, reduce=True, **SHORT)
    whole = jm.ensemble(broken, KEY, seeds=8, reduce=True, **SHORT)
    assert len(whole.failed) == 8 and np.isnan(whole.mean).all() and np.isnan(whole.quantile).all()
    single = jm.ensemble(TASK, KEY, seeds=1, reduce=True, **SHORT)
    assert np.isfinite(single.mean).all() and np.isnan(single.variance).all()


# Sweeps


def test_points_of_a_sweep_are_single_ensembles():
    sweep = jm.ensembles.Sweep.grid(TASK, k_w=[4e5, 6e5], noise_K_w=[0.1, 0.2, 0.3])
    assert len(sweep) == 6 and sweep[1]["noise_K_w"] == 0.2 and sweep[5]["k_w"] == 6e5
    runs = jm.ensemble(sweep, KEY, seeds=3, duration=1.0)
    single = jm.ensemble(sweep[4], KEY, seeds=3, duration=1.0)
    close(runs[4].output, single.output)
    assert runs[4].task == sweep[4]
    dataset = runs.to_xarray()
    assert dict(dataset.sizes) == {"point": 6, "seed": 3, "time": 101}
    np.testing.assert_array_equal(dataset["k_w"], [4e5] * 3 + [6e5] * 3)


@pytest.mark.parametrize("seeds, chunk", [(2, 8), (20, 8)])
def test_a_reduced_sweep_has_the_moments_of_every_point(seeds, chunk):
    """With few seeds of many points at once, and with many seeds of a point in pieces."""
    sweep = jm.ensembles.Sweep.design(TASK, {"k_w": [4e5, 5e5, 6e5, 7e5, 8e5]})
    found = jm.ensemble(sweep, KEY, seeds=seeds, reduce=True, duration=1.0, chunk=chunk)
    assert found.mean.shape == (5, 101) and found.quantile.shape == (5, 5, 101)
    for point in (0, 4):
        output = np.asarray(jm.ensemble(sweep[point], KEY, seeds=seeds, **SHORT).output, float)
        close(found.mean[point], output.mean(axis=0))
    np.testing.assert_array_equal(found.to_xarray()["k_w"], sweep.labels["k_w"])
    table = found.to_dataframe()
    one = table[(table["k_w"] == 8e5) & (table["time"] == 0.5)]
    assert len(table) == 5 * 101 and one["mean"].item() == found.mean[4, 50]
    assert one["quantile_0.5"].item() == found.quantile[4, found.levels.index(0.5), 50]


def test_persons_differ_in_numbers_only():
    persons = jm.ensembles.Sweep.of(
        [TASK, TASK.replace(m_w=0.3, c_w=90.0)], names=["first", "second"]
    )
    assert set(persons.labels) == {"name", "m_w", "c_w"}
    stiff = [TASK, TASK.replace(c_w=400.0)]  # the faster one asks for sub-steps
    runs = jm.ensemble(stiff, KEY, seeds=2, duration=1.0)
    assert (
        runs[0].substeps
        == runs[1].substeps
        == schedule(stiff[1], 1.0, 1e-3, None, None, None).grid.substeps
        > 1
    )
    with pytest.raises(
        ValueError, match=r"task 1 of the sweep differs from task 0 in more than numbers.*PinkNoise"
    ):
        jm.ensembles.Sweep.of([TASK, jm.Isometric(noise=jm.PinkNoise())])


def test_draws_of_any_shape_make_a_design():
    draws = {"k_w": np.full((2, 3), 4e5), "c_z": np.arange(1.0, 7.0).reshape(2, 3)}
    sweep = jm.ensembles.Sweep.design(TASK, draws)
    assert (
        len(sweep) == 6
        and sweep[3]["c_z"] == 4.0
        and [t["c_z"] for t in sweep] == [1, 2, 3, 4, 5, 6]
    )


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: jm.ensembles.Sweep.of([]), "at least one task"),
        (lambda: jm.ensembles.Sweep.design(TASK, {}), "columns of one length"),
        (
            lambda: jm.ensembles.Sweep.design(TASK, {"k_w": [1e5, 2e5], "c_w": [1.0]}),
            "columns of one length",
        ),
        (
            lambda: jm.ensembles.Sweep.design(TASK, {"k_w": [4e5, -1.0]}),
            "k_w = -1 at point 1 is outside its range, 0 or more",
        ),
        (lambda: jm.ensembles.Sweep.design(TASK, {"k_v": [4e5]}), "unknown parameter 'k_v'"),
        (
            lambda: jm.ensembles.Sweep.of([TASK], names=["a", "b"]),
            "names has 2 entries for 1 tasks",
        ),
        (lambda: jm.ensemble(TASK, KEY, seeds=0), "seeds = 0"),
        (lambda: jm.ensemble(TASK, KEY, seeds=-3), "seeds = -3: give at least one seed"),
        (lambda: jm.ensemble(TASK, KEY, seeds=1, chunk=0), "chunk = 0"),
        (lambda: jm.ensemble(TASK, KEY, seeds=1, resume=True), "resume = True belongs to a store"),
        (lambda: jm.ensemble(TASK, KEY, seeds=1, reduce=(0.5, 1.0)), "between 0 and 1"),
        (lambda: jm.ensemble(TASK, KEY, seeds=1, store="s3://a/b"), "give the path of a folder"),
        (lambda: jm.ensemble(TASK, KEY, seeds=1, executor=2), "executor = 2: give an executor"),
        (
            lambda: jm.ensemble(TASK, KEY, seeds=1, threads=1, executor=ThreadPoolExecutor()),
            "threads = 1 belongs to one process",
        ),
    ],
)
def test_bad_input_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


# Stores


def test_a_store_holds_what_memory_would(tmp_path):
    path = tmp_path / "runs.zarr"
    dataset = jm.ensemble(TASK, KEY, seeds=20, store=path, chunk=8, states=True)
    runs = jm.ensemble(TASK, KEY, seeds=20, chunk=8)
    assert dict(dataset.sizes) == {"seed": 20, "time": 1501, "frequency": 30}
    close(dataset["F_ext"], runs.output)
    close(dataset["x_w"], runs.state("x_w"))
    close(dataset["power"], runs.spectrum().power, 1e-5)
    assert dataset["F_ext"].attrs["units"] == "N" and dataset["power"].attrs["units"] == "N^2/Hz"
    assert dataset.attrs["complete"] is True and json.loads(dataset.attrs["failed"]) == []
    assert json.loads(dataset.attrs["parameters"])["k_w"] == {"value": TASK["k_w"], "unit": "N/m^3"}
    assert sorted(p.name for p in path.iterdir()) == [
        "F_ext",
        "frequency",
        "power",
        "seed",
        "time",
        "v_w",
        "x_w",
        "zarr.json",
    ]
    assert sorted(p.name for p in tmp_path.iterdir()) == [".runs.zarr.lock", "runs.zarr"]


def test_a_store_of_a_sweep_has_points(tmp_path):
    sweep = jm.ensembles.Sweep.grid(TASK, k_w=[4e5, 5e5, 6e5])
    for name, seeds in (("few", 2), ("many", 20)):
        dataset = jm.ensemble(sweep, KEY, seeds=seeds, store=tmp_path / name, **SHORT)
        assert dict(dataset.sizes) == {"point": 3, "seed": seeds, "time": 101}
        close(dataset["F_ext"][1], jm.ensemble(sweep[1], KEY, seeds=seeds, **SHORT).output)
        np.testing.assert_array_equal(dataset.coords["k_w"], [4e5, 5e5, 6e5])


def test_failed_seeds_are_marked_in_a_store(tmp_path):
    dataset = jm.ensemble(BRITTLE, KEY, seeds=40, store=tmp_path / "a", **SHORT)
    reduced = jm.ensemble(BRITTLE, KEY, seeds=40, reduce=True, store=tmp_path / "b", **SHORT)
    failed = json.loads(dataset.attrs["failed"])
    assert failed == reduced.failed.tolist() != []
    assert not np.isfinite(dataset["y"][[seed for _, seed in failed]]).all(axis=1).any()


class Stop(Exception):
    """Ends a run in its middle."""


def stopped_after(chunks):
    """A progress function that ends the run after so many chunks."""
    seen = []

    def tell(text, share):
        seen.append(share)
        if len(seen) == chunks:
            raise Stop

    return tell


@pytest.mark.parametrize("reduce", [False, True], ids=["trajectories", "reduced"])
def test_an_interrupted_store_is_resumed(tmp_path, monkeypatch, reduce):
    monkeypatch.setattr(_ensemble_run, "KEEP_EVERY", 0.0)
    monkeypatch.setattr(_ensemble_run, "KEEP_SHARE", 0)
    kept = {"reduce": True} if reduce else {}
    path = tmp_path / "runs.zarr"
    for chunks in (2, 1):
        with pytest.raises(Stop):
            jm.ensemble(
                TASK,
                KEY,
                seeds=45,
                store=path,
                resume=True,
                progress=stopped_after(chunks),
                **kept,
                **SHORT,
            )
        assert xarray.open_zarr(path).attrs["complete"] is False
    with pytest.raises(ValueError, match="exists already; resume it"):
        jm.ensemble(TASK, KEY, seeds=45, store=path, **kept, **SHORT)
    there = 3 if reduce else len(list((path / "F_ext" / "c").iterdir()))
    left = []
    found = jm.ensemble(
        TASK,
        KEY,
        seeds=45,
        store=path,
        resume=True,
        progress=lambda *told: left.append(told),
        **kept,
        **SHORT,
    )
    # The last chunks before an interruption are done but were not told of: they are not repeated.
    assert len(left) == 6 - there and there >= 3
    whole = jm.ensemble(TASK, KEY, seeds=45, **kept, **SHORT)
    close(found.mean if reduce else found["F_ext"], whole.mean if reduce else whole.output)
    if reduce:
        close(found.variance, whole.variance, 1e-12)
        np.testing.assert_allclose(found.quantile, whole.quantile, rtol=1e-12)
    again = jm.ensemble(
        TASK,
        KEY,
        seeds=45,
        store=path,
        resume=True,
        progress=lambda *told: left.append(told),
        **kept,
        **SHORT,
    )
    assert len(left) == 6 - there, "a complete store is not run again"
    assert type(again) is type(found)
    assert not (path / "progress").exists()


def test_a_store_is_overwritten_once_nothing_else_is_wrong(tmp_path):
    path, kept = tmp_path / "a.zarr", tmp_path / "mine"
    given: Any = {"seeds": 8, **SHORT}
    jm.ensemble(TASK, KEY, store=path, **given)
    with pytest.raises(ValueError, match="seeds = 0"):
        jm.ensemble(TASK, KEY, store=path, overwrite=True, **given | {"seeds": 0})
    assert xarray.open_zarr(path).attrs["complete"] is True
    other = jm.ensemble(TASK, jax.random.key(6), store=path, overwrite=True, **given)
    np.testing.assert_array_equal(
        other["F_ext"], jm.ensemble(TASK, jax.random.key(6), **given).output
    )
    kept.mkdir()
    (kept / "notes.txt").write_text("not an ensemble")
    with pytest.raises(ValueError, match="is not a store that jaxmuscle wrote"):
        jm.ensemble(TASK, KEY, store=kept, overwrite=True, **given)
    assert (kept / "notes.txt").exists()


@pytest.mark.parametrize(
    "change, message",
    [
        ({"seeds": 21}, r'seeds = "0 to 19" there, "0 to 20" here'),
        ({"key": jax.random.key(6)}, r"key = \[0, 5\] there, \[0, 6\] here"),
        ({"task": TASK.replace(k_w=4.5e5)}, "parameters.k_w = .* there, 450000.0 here"),
        ({"task": jm.PrescribedForce()}, 'task = "Isometric" there, "PrescribedForce" here'),
        ({"duration": 1.1}, "duration = 1.0 there, 1.1 here"),
        ({"chunk": 16}, "chunk = 8 there, 16 here"),
        ({"reduce": True}, 'kind = "trajectories" there, "reduced" here'),
        (
            {"task": TASK.with_parts(P_w=jm.model.RampHold(5.0, 0.1, 0.2, 0.1))},
            "inputs and everything else",
        ),
    ],
    ids=lambda value: "" if isinstance(value, str) else next(iter(value)),
)
def test_a_store_of_other_settings_is_not_resumed(tmp_path, change, message):
    given = {"task": TASK, "key": KEY, "seeds": 20, "store": tmp_path / "a.zarr"} | SHORT
    with pytest.raises(Stop):
        jm.ensemble(**given, progress=stopped_after(1))
    before = {p: p.read_bytes() for p in (tmp_path / "a.zarr").rglob("*") if p.is_file()}
    with pytest.raises(ValueError, match=message):
        jm.ensemble(**given | change, resume=True)
    assert before == {p: p.read_bytes() for p in (tmp_path / "a.zarr").rglob("*") if p.is_file()}


def test_a_store_of_another_version_is_not_resumed(tmp_path, monkeypatch):
    given = {"seeds": 20, "store": tmp_path / "a.zarr"} | SHORT
    with pytest.raises(Stop):
        jm.ensemble(TASK, KEY, **given, progress=stopped_after(1))
    monkeypatch.setattr(_settings, "versions", lambda: {"jaxmuscle": "9.9", "jax": jax.__version__})
    with pytest.raises(ValueError, match=r'versions.jaxmuscle = ".*" there, "9.9" here'):
        jm.ensemble(TASK, KEY, **given, resume=True)


def test_differences_are_told_by_name():
    there, here = (
        {"a": 1, "b": {"c": [1, 2], "d": 0}, "e": 5},
        {"a": 1, "b": {"c": [1, 3], "d": 0}, "f": 6},
    )
    assert differences(there, here) == [
        "b.c = [1, 2] there, [1, 3] here",
        "e = 5 there, null here",
        "f = null there, 6 here",
    ]


@pytest.mark.parametrize("what", ["a file", "another folder", "another store"])
def test_something_else_is_not_taken_for_a_store(tmp_path, what):
    path = tmp_path / "x.zarr"
    if what == "a file":
        path.write_text("not a store")
    elif what == "another folder":
        path.mkdir()
    else:
        xarray.Dataset({"a": ("b", np.arange(3))}).to_zarr(path, consolidated=False)
    with pytest.raises(
        ValueError, match=r"x.zarr: (is not a store that jaxmuscle wrote|is not an ensemble)"
    ):
        jm.ensemble(TASK, KEY, seeds=8, store=path, resume=True, **SHORT)


@pytest.fixture
def small_disk(tmp_path):
    """A file system of half a megabyte."""
    yield from mounted(tmp_path / "disk", "size=512k")


@pytest.fixture
def read_only(tmp_path):
    """A file system that cannot be written."""
    yield from mounted(tmp_path / "read-only", "ro,size=64k")


def mounted(folder, options):
    folder.mkdir()
    mount = shutil.which("mount")
    if (
        mount is None
        or subprocess.run(
            [mount, "-t", "tmpfs", "-o", options, "tmpfs", str(folder)], capture_output=True
        ).returncode
    ):
        pytest.skip("a tmpfs cannot be mounted here")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


@pytest.mark.parametrize("reduce", [False, True], ids=["trajectories", "reduced"])
@pytest.mark.slow
def test_a_full_disk(small_disk, monkeypatch, reduce):
    monkeypatch.setattr(_ensemble_run, "KEEP_EVERY", 0.0)
    given = {"seeds": 200, "store": small_disk / "a.zarr", "duration": 5.0, "chunk": 16} | (
        {"reduce": True} if reduce else {}
    )
    ballast = small_disk / "ballast"
    ballast.write_bytes(bytes(400_000 if reduce else 300_000))
    with pytest.raises(
        OSError, match=r"No space left on device; what is complete stays: make room.*resume"
    ):
        jm.ensemble(TASK, KEY, **given)
    if (small_disk / "a.zarr").exists():
        assert xarray.open_zarr(small_disk / "a.zarr").attrs["complete"] is False
    ballast.unlink()
    subprocess.run(["mount", "-o", "remount,size=64m", str(small_disk)], check=True)
    found = jm.ensemble(TASK, KEY, **given, resume=True)
    whole = np.asarray(
        jm.ensemble(TASK, KEY, seeds=200, duration=5.0, chunk=16, control=False).output, float
    )
    close(found.mean if reduce else found["F_ext"], whole.mean(axis=0) if reduce else whole)


def test_a_folder_that_cannot_be_written(read_only):
    with pytest.raises(OSError, match="Read-only file system"):
        jm.ensemble(TASK, KEY, seeds=8, store=read_only / "a.zarr", **SHORT)


# Threads and devices


class Slow:
    """Chunks of which the earlier ones take longer, so that on several threads they end in another
    order than they began."""

    def __init__(self, monkeypatch, chunks):
        self.simulate, self.left, self.busy, self.most, self.lock = (
            _chunks._finish,
            chunks,
            0,
            0,
            threading.Lock(),
        )
        monkeypatch.setattr(_chunks, "_finish", self)

    def __call__(self, chunk, found):
        with self.lock:
            self.busy += 1
            self.most = max(self.most, self.busy)
        time.sleep(0.02 * max(0, self.left - chunk.number))
        with self.lock:
            self.busy -= 1
        return self.simulate(chunk, found)


@pytest.mark.parametrize("threads", [1, 3])
def test_threads_change_nothing(tmp_path, monkeypatch, threads):
    """To the last bit, in whatever order they end: in memory, reduced, stored, swept, with cells
    and in double precision."""
    given = {"seeds": 45, **SHORT}
    sweep = {"seeds": 11, "duration": 1.0, "chunk": 8}
    points = jm.ensembles.Sweep.grid(TASK, k_w=[4e5, 5e5])
    whole, alone = (
        jm.ensemble(TASK, KEY, threads=1, **given),
        jm.ensemble(TASK, KEY, reduce=True, threads=1, **given),
    )
    swept = jm.ensemble(points, KEY, reduce=True, threads=1, **sweep)
    slow = Slow(monkeypatch, 6 if threads > 1 else 0)
    np.testing.assert_array_equal(
        jm.ensemble(TASK, KEY, threads=threads, **given).output, whole.output
    )
    assert slow.most == threads or jax.__version__ in _batch.WAITING  # where they may be fewer
    for given_store in ({}, {"store": tmp_path / "a.zarr"}):
        found = jm.ensemble(TASK, KEY, reduce=True, threads=threads, **given, **given_store)
        for name, (_, values, _) in found.arrays().items():
            np.testing.assert_array_equal(values, alone.arrays()[name][1])
    stored = jm.ensemble(TASK, KEY, store=tmp_path / "b.zarr", threads=threads, **given)
    np.testing.assert_array_equal(stored["F_ext"], whole.output)
    np.testing.assert_array_equal(
        jm.ensemble(points, KEY, reduce=True, threads=threads, **sweep).quantile, swept.quantile
    )
    with jax.enable_x64(True):
        assert jm.ensemble(TASK, KEY, threads=threads, **given).output.dtype == np.float64


def test_what_a_thread_raises_ends_the_ensemble(monkeypatch):
    def broken(chunk, found):
        raise MemoryError("no room")

    monkeypatch.setattr(_chunks, "_finish", broken)
    with pytest.raises(MemoryError, match="no room"):
        jm.ensemble(TASK, KEY, seeds=45, threads=3, **SHORT)


@pytest.mark.parametrize(
    ("version", "cores", "wanted", "threads"),
    [
        ("0.12.0", 4, None, 4),
        ("0.12.0", 4, 6, 6),
        ("0.11.2", 4, None, 3),
        ("0.11.2", 4, 6, 3),
        ("0.11.2", 4, 2, 2),
        ("0.11.1", 1, None, 1),
    ],
)
def test_one_core_stays_free_where_ffts_on_all_of_them_never_end(
    monkeypatch, version, cores, wanted, threads
):
    """Two threads that did nothing but FFTs stood still with jax 0.11.1 and 0.11.2, and did not
    with 0.11.0 and 0.12.0."""
    monkeypatch.setattr(jax, "__version__", version)
    monkeypatch.setattr(_batch, "usable_cores", lambda: cores)
    assert _batch.threads_of(wanted) == threads


def test_threads_must_be_a_number():
    with pytest.raises(ValueError, match="threads = 0"):
        jm.ensemble(TASK, KEY, seeds=8, threads=0, **SHORT)


@pytest.mark.slow
def test_seeds_are_shared_by_devices_and_need_not_divide(tmp_path):
    """Three devices: 20 seeds, 5 points, and a store begun with one device. As GPUs are, which are
    cores here."""
    program = f"""
import jax
jax.config.update("jax_num_cpu_devices", 3)
import numpy as np, jaxmuscle as jm
from jaxmuscle.simulation import _batch
_batch.THREADED = ()
key, task = jax.random.key(5), jm.Isometric()
assert _batch.local_mesh().size == 3
runs = jm.ensemble(task, key, seeds=20, duration=1.0)
sweep = jm.ensembles.Sweep.grid(task, k_w=[4e5, 5e5, 6e5, 7e5, 8e5])
sweep = jm.ensemble(sweep, key, seeds=2, duration=1.0)
path = {str(tmp_path / "a.zarr")!r}
store = jm.ensemble(task, key, seeds=45, store=path, resume=True, duration=1.0)
sweep = np.stack([m.output for m in sweep])
np.savez({str(tmp_path / "found.npz")!r}, runs=runs.output, sweep=sweep, store=store["F_ext"])
"""
    with pytest.raises(Stop):
        jm.ensemble(
            TASK, KEY, seeds=45, store=tmp_path / "a.zarr", progress=stopped_after(2), **SHORT
        )
    ended(python(program))
    found = np.load(tmp_path / "found.npz")
    whole = jm.ensemble(TASK, KEY, seeds=45, **SHORT).output
    close(found["runs"], whole[:20])
    close(found["store"], whole)
    sweep = [
        jm.ensemble(TASK.replace(k_w=k_w), KEY, seeds=2, **SHORT)
        for k_w in (4e5, 5e5, 6e5, 7e5, 8e5)
    ]
    close(found["sweep"], np.stack([np.asarray(member.output) for member in sweep]))


def wait_for(condition, seconds=120.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


RUN = """
import sys, jax, jaxmuscle as jm, jaxmuscle.ensembles._run as run
if sys.argv[3:] == ["to be killed"]:
    run.KEEP_EVERY = run.KEEP_SHARE = 0
how = {"reduce": True} if sys.argv[2] == "reduced" else {}
jm.ensemble(jm.Isometric(), jax.random.key(5), seeds=1600, duration=1.0, chunk=8,
            store=sys.argv[1], resume=True, **how)
"""


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["trajectories", "reduced"])
def test_kill_9_four_times(tmp_path, kind):
    """Each time at a random moment after it goes on; the end is that of an uninterrupted run."""
    path, rng, kills = tmp_path / "runs.zarr", random.Random(kind), 0
    while kills < 4:
        before, run = amount(path), python(RUN, str(path), kind, "to be killed")
        wait_for(lambda before=before: amount(path) != before)
        time.sleep(rng.uniform(0, 0.05))  # of chunks of a few milliseconds
        run.kill()
        run.communicate()
        if run.returncode == 0 or xarray.open_zarr(path).attrs["complete"]:
            break
        kills += 1
    assert kills >= 3, "too fast to be interrupted: the test shows nothing"
    ended(python(RUN, str(path), kind))
    found = xarray.open_zarr(path)
    assert found.attrs["complete"] is True
    if kind == "trajectories":
        output = jm.ensemble(TASK, KEY, seeds=1600, duration=1.0, chunk=8, control=False).output
        np.testing.assert_array_equal(found["F_ext"], output)
        return
    whole = jm.ensemble(TASK, KEY, seeds=1600, duration=1.0, chunk=8, reduce=True)
    np.testing.assert_allclose(found["mean"], whole.mean, rtol=1e-12)
    np.testing.assert_allclose(found["variance"], whole.variance, rtol=1e-9)
    np.testing.assert_array_equal(found["quantiles"], whole.quantile)


def amount(path):
    """What is in a store that is not complete: its chunks, and when its tally was written."""
    found = set()
    for file in [*(path / "progress").glob("[!.]*"), *(path / "F_ext" / "c").glob("*/0")]:
        # the end of a run removes the tally
        with contextlib.suppress(FileNotFoundError):
            found.add((file, file.stat().st_mtime_ns))
    return found


MEMORY = """
import sys, jax, jaxmuscle as jm
from jaxmuscle.ensembles._speed import peak_memory
run = lambda seeds: jm.ensemble(jm.Isometric(), jax.random.key(5), seeds=seeds, duration=0.2,
                                chunk=512, reduce=True)
run(4096)
before = peak_memory()
run(65536)
print(before, peak_memory())
"""


def test_memory_does_not_grow_with_the_seeds():
    before, after = map(int, ended(python(MEMORY))[0].split())
    assert 0 < after < 1.1 * before  # 16 times as many seeds


# Commands

RUNNER = CliRunner()


def test_the_command_writes_resumes_and_refuses(tmp_path):
    path = tmp_path / "runs.zarr"
    arguments = [
        "ensemble",
        "zagrodny-slifkin",
        "--seeds",
        "10",
        "--duration",
        "1",
        "--out",
        str(path),
    ]
    first = RUNNER.invoke(app, [*arguments, "--task", "prescribed-force", "--resume"])
    assert first.exit_code == 0, first.output
    assert "there is no store yet, starting one" in first.stderr and "Written" in first.stdout
    again = RUNNER.invoke(app, [*arguments, "--task", "prescribed-force"])
    assert again.exit_code == 2 and "exists already" in again.stderr
    resumed = RUNNER.invoke(app, [*arguments, "--task", "prescribed-force", "--resume"])
    assert resumed.exit_code == 0 and "was complete, nothing to do" in resumed.stdout
    either = RUNNER.invoke(app, [*arguments, "--resume", "--force"])
    assert either.exit_code == 2 and "give one of the two" in either.stderr
    other = RUNNER.invoke(app, [*arguments, "--resume"])
    assert other.exit_code == 2 and '"PrescribedForce" there, "PrescribedMotion" here' in "".join(
        other.stderr.splitlines()
    )
    replaced = RUNNER.invoke(app, [*arguments, "--force"])
    assert replaced.exit_code == 0 and xarray.open_zarr(path).attrs["task"] == "PrescribedMotion"


def test_the_command_speaks_json(tmp_path):
    arguments = [
        "--seeds",
        "20",
        "--duration",
        "1",
        "--chunk",
        "8",
        "--reduce",
        "--json",
        "--out",
        str(tmp_path / "a"),
    ]
    done = RUNNER.invoke(
        app,
        ["ensemble", "zagrodny-slifkin", "--vary", "c_w=2,3", "--vary", "k_w=1e6,2e6", *arguments],
    )
    assert done.exit_code == 0, done.output
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert (
        len(lines) == 1
        and lines[0]["event"] == "done"
        and lines[0]["failed"] == []
        and lines[0]["seeds"] == 20
    )
    assert dict(xarray.open_zarr(tmp_path / "a").sizes) == {"point": 4, "time": 101, "quantile": 5}


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--seeds", "0"], "seeds = 0"),
        (["--seeds", "8", "--vary", "k_w=a"], "--vary k_w=a: give a name and numbers"),
        (
            ["--seeds", "8", "--reduce", "--states"],
            "--states keeps trajectories and --reduce throws them away",
        ),
        (["--seeds", "8", "--duration", "0.0031"], "duration = 0.0031 s is not a whole number"),
        # the rest is typer's
        (["--seeds", "8", "--threads", "0"], "Invalid value for '--threads'"),
    ],
)
def test_the_command_refuses_bad_input(tmp_path, arguments, message):
    done = RUNNER.invoke(
        app, ["ensemble", "zagrodny-slifkin", *arguments, "--out", str(tmp_path / "a.zarr")]
    )
    assert done.exit_code == 2 and message in done.stderr.replace("\n", " ")
    assert list(tmp_path.iterdir()) == []


def test_the_speed_of_this_machine():
    found = json.loads(ended(command("speed", "--seeds", "16", "--duration", "0.2", "--json"))[0])
    assert found["compile_s"] > 0 and found["seeds_per_s"] > 0
    assert found["million_steps_per_s"] == pytest.approx(
        found["seeds_per_s"] * 200 * found["substeps"] / 1e6
    )
    assert found["real_time_factor"] == pytest.approx(found["seeds_per_s"] * 0.2)
