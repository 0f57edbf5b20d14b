"""Posterior and profile: against known densities, one another, and what must be refused."""

import dataclasses
import functools
import importlib.util
import json
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
import scipy.integrate
import scipy.stats
import xarray
from compiled import at_once
from refits import without_intervals
from typer.testing import CliRunner

import jaxmuscle as jm
from jaxmuscle.commands.main import app
from jaxmuscle.fits._reopened import reopened
from jaxmuscle.model._parameters import PARAMETERS
from jaxmuscle.objective._likelihood import Likelihood
from jaxmuscle.response._expected import noise_variance
from jaxmuscle.response._linearised import linearise
from jaxmuscle.response._transfer import harmonic_system
from jaxmuscle.uncertainty._chains import Chains, sample
from jaxmuscle.uncertainty._posterior_checks import diagnose, modes_of, verdict
from jaxmuscle.uncertainty._posterior_density import density_about
from jaxmuscle.uncertainty._profile import _in_words

FREE = ("c_w", "noise_K_z", "harmonic_amplitude", "harmonic_frequency")


class Gaussian(eqx.Module):
    """A density to sample: mixture of two normals `apart` standard deviations from one another."""

    centre: np.ndarray
    scale: np.ndarray
    apart: float

    @property
    def size(self):
        return 3

    def log_density(self, white):
        x = jnp.asarray(self.centre) + jnp.asarray(self.scale) @ white
        shift = self.apart * jnp.array([1.0, 0.0, 0.0])
        sd = jnp.array([1.0, 0.1, 10.0])
        heights = [-0.5 * jnp.sum(((x - side * shift) / sd) ** 2) for side in (-0.5, 0.5)]
        return jax.nn.logsumexp(jnp.stack(heights))


def silent(text, share):
    pass


def chains_of(apart, key=0, draws=500):
    with jax.enable_x64(True):
        density = Gaussian(np.zeros(3), np.eye(3), apart)
        return next(sample(density, jax.random.key(key), 4, (draws,), 400, silent))[0]


def test_chains_of_a_normal_density():
    """R-hat of the spread is above 1.01 in one of some ten runs of 500 draws, and in none of
    4000."""
    found = chains_of(0.0, draws=4000)
    draws = found.s.reshape(-1, 3)
    for i, sd in enumerate((1.0, 0.1, 10.0)):
        _, bulk, _ = diagnose(found.s[:, :, i])
        assert abs(draws[:, i].mean()) < 4 * sd / np.sqrt(bulk)
        assert draws[:, i].std() == pytest.approx(sd, rel=4 / np.sqrt(2 * bulk) + 0.02)
    assert verdict(found, {str(i): diagnose(found.s[:, :, i]) for i in range(3)}, ("0",))[0]


def test_chains_that_do_not_mix_are_found_out():
    found = chains_of(40.0, key=1)
    # with other keys all starts may lie on one side
    assert len(set(np.sign(found.s[:, -1, 0]))) == 2
    success, message = verdict(found, {"x": diagnose(found.s[:, :, 0])}, ("x",))
    assert not success and "did not mix" in message and "longer chains" in message


def test_chains_go_on_where_they_ended():
    with jax.enable_x64(True):
        density = Gaussian(np.zeros(3), np.eye(3), 0.0)
        told = []
        short, longer = (
            found
            for found, _ in sample(
                density, jax.random.key(0), 4, (500, 600), 400, lambda *x: told.append(x)
            )
        )
    whole = chains_of(0.0)
    assert np.array_equal(short.s, whole.s) and np.array_equal(longer.s[:, :500], whole.s)
    assert longer.s.shape[1] == 600 and len(np.unique(longer.s[:, :, 0])) > 4 * 500
    assert told[-1] == ("the chains have not mixed yet, drawing, block 12 of 12", 1.0)


def test_divergences_are_a_failure():
    shape = (4, 1000)
    rng = np.random.default_rng(0)
    draws = rng.normal(size=(*shape, 1))
    diverging = np.zeros(shape, dtype=bool)
    diverging[0, :9] = True
    made = Chains(draws, np.zeros(shape), np.ones(shape), np.ones(shape, dtype=int), diverging, 0.5)
    success, message = verdict(made, {"x": diagnose(draws[:, :, 0])}, ("x",))
    assert not success and message.startswith("9 of 4000 draws diverged")


def test_modes_are_told_apart():
    rng = np.random.default_rng(1)
    frequency = np.exp(
        np.concatenate(
            [np.log(2.0) + 0.05 * rng.normal(size=3000), np.log(8.0) + 0.05 * rng.normal(size=1000)]
        )
    )
    first, second = modes_of(frequency)
    assert first[1] == pytest.approx(2.0, rel=0.02) and second[1] == pytest.approx(8.0, rel=0.02)
    assert (first[3], second[3]) == (0.75, 0.25)
    assert len(modes_of(np.exp(rng.normal(size=4000)))) == 1


@functools.cache
def well_known():
    """Sixty recordings averaged: a strong rhythm, three more parameters, the rest fixed at the
    truth."""
    truth = jm.Isometric().replace(
        c_w=80.0, harmonic_frequency=4.0, harmonic_amplitude=0.01, noise_K_z=0.008
    )
    runs = jm.ensemble(truth.settled(), jax.random.key(2), seeds=60, control=False)
    power = np.asarray(runs.spectrum().proportional).mean(axis=0)
    target = jm.Target("well known", power, segments=(6,) * 60)
    with without_intervals():
        return truth, jm.fit(jm.Isometric(), target, free=FREE, starts=8, check_seeds=0)


@functools.cache
def drawn():
    """A hundred draws of a chain are too few, so it goes on to five hundred; if rounded otherwise,
    perhaps to more."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("jaxmuscle.uncertainty._posterior.DRAWS", (100, 500, 900))
        return jm.posterior(well_known()[1], key=3, warmup=300)


@pytest.mark.slow
def test_curvature_profile_and_posterior_agree_where_the_data_determine_all():
    truth, result = well_known()
    found = drawn()
    assert found.success, found.message
    summary = found.summary()
    for name in FREE:
        row, told = summary[name], jm.profile(result, name)
        assert told.low is not None and told.high is not None
        sd, scale = result[name].stderr, result[name].value / result.parameters[name].value
        assert sd is not None and (scale == 1.0) is (name != "c_w")  # that is per newton
        # the fit weighs bins alike, the likelihood by their correlation: its errors are smaller,
        # never by more than a third
        assert 0.67 * sd < row["sd"] < 1.15 * sd, name
        assert told.stderr == pytest.approx(row["sd"], rel=0.15), name
        assert (told.high - told.low) / 3.92 == pytest.approx(row["sd"], rel=0.15), name
        assert abs(told.value - row["mean"]) < 0.3 * row["sd"], name
        assert abs(row["mean"] - scale * float(truth[name])) < 3.5 * row["sd"], name
        points = told.to_dataframe()
        np.testing.assert_array_equal(
            points[["value", "rise"]], np.stack([told.values, told.rise], axis=1)
        )


def test_posterior_as_files_and_figures(tmp_path):
    found = drawn()
    count = found.samples["c_w"].shape[1]
    assert count in (500, 900)
    found.save(tmp_path / "p.nc")
    with xarray.open_datatree(tmp_path / "p.nc", engine="h5netcdf") as tree:
        assert set(tree.children) == {
            "posterior",
            "posterior_predictive",
            "sample_stats",
            "observed_data",
        }
        assert dict(tree["posterior"].sizes) == {"chain": 4, "draw": count, "frequency": 30}
        np.testing.assert_array_equal(tree["posterior"]["c_w"].values, found.samples["c_w"])
        assert tree["posterior"]["c_w"].attrs["units"] == "N s^3/m^3"
    found.save(tmp_path / "p.json")
    table = json.loads((tmp_path / "p.json").read_text())
    assert table["success"] and table["summary"]["c_w"]["r_hat"] == found.diagnostics["c_w"][0]
    draws, rows = found.to_dataframe(), found.summary().to_dataframe()
    assert list(draws.columns) == ["chain", "draw", *found.quantities]
    # no mean force in newtons was given: the summary is per newton of that of the model
    assert list(rows["quantity"]) == [n for n in found.quantities if n != "model_mean"]
    per_newton = np.median(found.quantities["K_w0"] / found.quantities["model_mean"])
    shown = rows.set_index("quantity").loc["K_w0"]
    assert (shown["median"], shown["unit"]) == (pytest.approx(per_newton, rel=1e-12), "1/m")
    last = draws[(draws["chain"] == 3) & (draws["draw"] == 7)]
    assert last["c_w"].item() == found.samples["c_w"][3, 7]
    assert rows.set_index("quantity")["r_hat"]["c_w"] == found.diagnostics["c_w"][0]
    for figure in (found.plot(), found.plot_chains(), found.plot_predictive().figure):
        figure.canvas.draw()
        plt.close(figure)
    assert "95" not in str(found) and f"4 chains of {count} draws" in str(found)
    # replicates scatter about the model as the target does: p-values are not extreme where the
    # model is true
    assert 0.01 < found.replicates.p_value < 0.99


def of_few_draws():
    return jm.posterior(
        well_known()[1],
        key=5,
        draws=100,
        warmup=50,
        bounds={"c_w": (1.0, 1e4), "noise_K_z": (1e-5, np.inf)},
    )


@functools.cache
def short():
    return of_few_draws()


def test_the_same_key_gives_the_same_draws():
    np.testing.assert_array_equal(of_few_draws().samples["c_w"], short().samples["c_w"])


def test_the_bounds_that_held_are_kept():
    assert short().settings["bounds"] == {"c_w": [1.0, 1e4], "noise_K_z": [1e-5, None]}
    assert drawn().settings["bounds"] == well_known()[1].settings["bounds"]


def test_chains_without_a_summary():
    assert not short().success  # 100 correlated draws of a chain count for less than 100
    with pytest.raises(jm.errors.NotMixedError, match="longer chains"):
        short().summary()
    with pytest.raises(jm.errors.NotMixedError):
        short().plot()
    assert str(short()).startswith("NO POSTERIOR")


@functools.cache
def sloppy():
    target = jm.load_target("vastus-lateralis-26mvc")
    with without_intervals():
        return jm.fit(target.task(), target, starts=8, check_seeds=0, rungs=0)


@pytest.mark.parametrize(
    ("ends", "words"),
    [
        ((None, 2.0), "below 2 N (open downwards)"),
        ((1.0, None), "above 1 N (open upwards)"),
        ((1.0, 2.0), "1 to 2 N"),
    ],
)
def test_an_interval_says_which_end_is_open(ends, words):
    assert _in_words(*ends, " N") == words


@pytest.mark.slow
def test_what_the_data_leave_open_has_an_open_profile():
    told = jm.profile(sloppy(), "K_z0")
    assert told.low is None or told.high is None
    assert "open" in str(told) or "no limits" in str(told)
    corner = jm.profile(sloppy(), "corner_frequency")
    assert corner.low is not None and corner.high is not None
    assert corner.low < corner.value < corner.high
    assert corner.rise.min() >= 0 and np.all(np.diff(corner.values) > 0)
    plt.close(corner.plot().figure)


def test_density_is_summed_over_the_frequency():
    """Against fine quadrature of the likelihood over the frequency at a point of the other
    coordinates."""
    with jax.enable_x64(True):
        problem = reopened(sloppy())
        likelihood = Likelihood.of(problem)
        density, _, _ = density_about(problem, likelihood, problem.theta_of((sloppy().task,)))

        (band,) = density.bands
        point = np.full(density.size, 0.2)

        def summed(white):
            s, offset = density.split(white)
            return s, offset, jax.nn.logsumexp(density.heights(band, s, offset, {}))

        s, offset, found = at_once(summed, point)
        column = problem.coordinates.names.index("harmonic_frequency")
        # Smooth on the scale of a bin, of which there are 30: 2049 points err by far less than what
        # is compared.
        f = np.geomspace(band.frequency[0], band.frequency[-1], 2049)
        theta = np.tile(problem.coordinates.theta(np.asarray(s)), (len(f), 1))
        theta[:, column] = problem.coordinates.theta_of("harmonic_frequency", f)
        (part,) = likelihood.objective.parts
        height = at_once(
            lambda theta: jax.lax.map(
                lambda row: likelihood.at((part.moments(row),), offset), theta, batch_size=64
            ),
            theta,
        )
        # over ln f
        integrand = np.exp(np.asarray(height) - 0.5 * theta[:, column] ** 2 - float(found))
        assert scipy.integrate.simpson(integrand, np.log(f)) == pytest.approx(1.0, abs=0.02)
        # The cells of the grid are of single precision: slopes are those of differences of the same
        # in double precision.
        whole = tuple(table._replace(level=table.level.astype(float)) for table in band.tables)
        double = dataclasses.replace(density, bands=(dataclasses.replace(band, tables=whole),))
        value, slope = at_once(jax.value_and_grad(density.log_density), point)
        step = 1e-5
        steps = step * np.eye(density.size)
        points = np.concatenate([[point], point + steps, point - steps])
        here, *beside = np.asarray(
            at_once(lambda points: jax.lax.map(double.log_density, points), points)
        )
        assert float(value) == pytest.approx(here, abs=1e-3)
        ahead, behind = np.split(np.array(beside), 2)
        np.testing.assert_allclose(slope, (ahead - behind) / (2 * step), rtol=1e-4, atol=1e-4)


def test_the_common_scale_is_counted_from_the_coefficient_of_variation():
    """The density of the amplitudes as they are, up to a constant; the coordinate alone moves the
    model's variation."""
    with jax.enable_x64(True):
        problem = reopened(sloppy())
        density, _, _ = density_about(
            problem, Likelihood.of(problem), problem.theta_of((sloppy().task,))
        )
        (level,) = density.levels
        plain = dataclasses.replace(density, levels=())
        columns = list(density.columns)

        def both(white):
            s, offset = density.split(white)
            sampled = jnp.append(s[jnp.asarray(columns)], offset)
            same = jnp.linalg.solve(plain.scale, sampled - plain.centre)
            return density.log_density(white), plain.log_density(same)

        points = 0.5 * np.random.default_rng(0).normal(size=(12, density.size))
        ours, theirs = map(np.asarray, at_once(lambda points: jax.lax.map(both, points), points))
        assert np.ptp(ours) > 3  # else there is nothing to compare
        np.testing.assert_allclose(np.diff(ours), np.diff(theirs), atol=1e-6)

        def variation(s):
            return density.log_variation(density.from_levels(s)[0], 0, level.weight)[0]

        places = np.tile(np.asarray(density.point), (2, 1))
        places[1, level.column] += 0.1
        here, moved = np.asarray(at_once(lambda places: jax.lax.map(variation, places), places))
        # noise on damping is fixed, but tiny
        assert moved - here == pytest.approx(0.1 * level.sd, rel=1e-3)

        # The square of that variation: of the noise, and half that of the amplitude the harmonic
        # has in the output.
        strong = places[0].copy()
        strong[problem.coordinates.names.index("harmonic_amplitude")] += 3.0

        def parts(s):
            task = density.task(s, 0)
            system = linearise(task)
            told = (
                tuple(harmonic_system(task, system)),
                noise_variance(task, system),
                system.rest,
                task.harmonic.amplitude,
            )
            return *told, density.log_variation(s, 0, level.weight)[0]

        (A, b, c, d, e), noise, rest, amplitude, log = jax.tree.map(
            np.asarray, at_once(parts, strong)
        )
        s = 2j * np.pi * density.bands[0].frequency
        swing = amplitude * np.abs(
            [c @ np.linalg.solve(one * np.eye(len(A)) - A, b) + d + one * e for one in s]
        )
        line = 0.5 * float(level.weight @ swing**2)
        assert line > 0.2 * noise
        np.testing.assert_allclose(np.exp(2 * log), (noise + line) / rest**2, rtol=1e-9)


def bare():
    return jm.Target("bare", np.linspace(2, 1, 30))


def test_errors():
    result = sloppy()
    with pytest.raises(ValueError, match="neither segments nor sigma"):
        jm.posterior(result, bare())
    with pytest.raises(ValueError, match="neither segments nor sigma"):
        jm.profile(result, "corner_frequency", bare())
    with pytest.raises(ValueError, match="outside its bounds"):
        jm.posterior(result, bounds={"k_w": (1.0, 2.0)})
    with pytest.raises(ValueError, match="is not free"):
        jm.posterior(result, priors={"m_w": 0.1})
    with pytest.raises(ValueError, match="chains = 1"):
        jm.posterior(result, chains=1)
    with pytest.raises(ValueError, match="level = 2"):
        jm.profile(result, "k_w", level=2.0)
    with pytest.raises(ValueError, match="neither free nor derived"):
        jm.profile(result, "m_w")


def test_command(tmp_path):
    spectrum = tmp_path / "bare.csv"
    f = np.arange(1, 31) * 0.390625
    lines = [f"{x},{1 / (1 + x)}" for x in f]
    spectrum.write_text("frequency_hz,proportional_power\n" + "\n".join(lines))
    run = CliRunner().invoke(app, ["posterior", str(spectrum), "--out", str(tmp_path / "a")])
    assert run.exit_code == 2 and "--segments" in run.output
    result = well_known()[1]
    result.save(tmp_path / "fit.json")
    few = ["--draws", "100", "--warmup", "50"]
    run = CliRunner().invoke(
        app, ["posterior", str(tmp_path / "fit.json"), *few, "--out", str(tmp_path / "b")]
    )
    assert run.exit_code == 1 and "did not mix" in run.output
    assert {p.name for p in (tmp_path / "b").iterdir()} == {
        "fit.json",
        "posterior.nc",
        "posterior.json",
        "chains.png",
        "report.html",
    }
    assert json.loads((tmp_path / "b" / "posterior.json").read_text())["summary"] is None
    again = CliRunner().invoke(
        app,
        [
            "posterior",
            str(tmp_path / "b" / "fit.json"),
            *few,
            "--force",
            "--json",
            "--out",
            str(tmp_path / "b"),
        ],
    )
    assert again.exit_code == 1 and "did not mix" in again.stderr
    assert json.loads(again.stdout) == json.loads((tmp_path / "b" / "posterior.json").read_text())


def benchmark():
    path = Path(__file__).parents[2] / "benchmarks" / "calibration.py"
    spec = importlib.util.spec_from_file_location("calibration", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_calibration_draws_its_muscles_from_the_prior_of_the_fit():
    """The study itself takes hours: `benchmarks/calibration.py`, table in docs/uncertainty.md."""
    study = benchmark()
    base, truths = study.base(), [study.truth(number) for number in range(300)]
    for name in ("k_w", "c_z", "noise_K_z", "harmonic_amplitude"):
        theta = [
            np.log(float(task[name]) / float(base[name])) / PARAMETERS[name].prior_sd
            for task in truths
        ]
        # chance that one of four fails: 4 in 10 000 seeds
        assert scipy.stats.kstest(theta, "norm").pvalue > 1e-4, name
    frequency = np.array([float(task["harmonic_frequency"]) for task in truths])
    row = PARAMETERS["harmonic_frequency"]
    assert row.fit_lower < frequency.min() and frequency.max() < row.fit_upper
