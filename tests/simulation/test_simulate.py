"""The integrator against scipy's, and what surrounds it: seeds, chunks, sub-steps, sampling,
errors, exports."""

import inspect
import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import references
import scipy.signal
from compiled import at_once, drawing, kept_jit
from noise_paths import respond

import jaxmuscle as jm
from jaxmuscle._common.arrays import as_arrays, is_concrete
from jaxmuscle._common.types import Scalar
from jaxmuscle.model import Decay, RampHold, Sampled, SmoothStep
from jaxmuscle.model._stream import Draws, Stream
from jaxmuscle.simulation import _simulate
from jaxmuscle.simulation._batch import streams_of
from jaxmuscle.simulation._grid import Grid
from jaxmuscle.simulation._simulate import schedule, stable_substeps

KEY = jax.random.key(11)
HARMONIC = jm.Harmonic(0.1, 4.25, 0.3)


def numbers(task):
    return {name: float(value) for name, value in task.parameters.items()}


def motion_by_scipy(task, times):
    p = numbers(task)

    def velocity(t, x_w):
        x_z = references.smooth_step_derivatives(t, p["x_z"])
        return references.contraction(
            p, x_w, x_z, references.smooth_step(t, p["F_ext"]), references.harmonic(p, t)
        )

    x = references.solve_ode(lambda t, y: np.array([velocity(t, y[0])]), [0.0], times)[:, 0]
    v, h = velocity(times, x), 1e-6
    a_w = (velocity(times + h, x + h * v) - velocity(times - h, x - h * v)) / (2 * h)
    K_w, _, C_w, _ = references.coefficients(p, x, v, 0.0, 0.0, references.harmonic(p, times))
    a_z = references.smooth_step_derivatives(times, p["x_z"])[2]
    P_w = (
        p["m_w"] * a_w
        + C_w * v
        + K_w * x
        + p["m_z"] * a_z
        + references.smooth_step(times, p["F_ext"])
    )
    return x[:, None], P_w


def force_by_scipy(task, times):
    p = numbers(task)

    def rhs(t, y):
        inputs = references.smooth_step(t, p["P_w"]), references.smooth_step(t, p["F_ext"])
        a_w, a_z = references.accelerations(p, y, *inputs, references.harmonic(p, t))
        return [y[1], a_w, y[3], a_z]

    states = references.solve_ode(rhs, np.zeros(4), times)
    return states, states[:, 2]


def isometric_by_scipy(task, times, method="DOP853"):
    p = numbers(task)

    def rhs(t, y):
        u = references.harmonic(p, t)
        return [
            y[1],
            references.accelerations(
                p, [*y, p["x_z"], 0.0], references.smooth_step(t, p["P_w"]), 0.0, u
            )[0],
        ]

    states = references.solve_ode(rhs, np.zeros(2), times, method)
    u = references.harmonic(p, times)
    _, K_z, _, C_z = references.coefficients(p, states[:, 0], states[:, 1], p["x_z"], 0.0, u)
    return states, C_z * states[:, 1] + K_z * (states[:, 0] - p["x_z"])


DETERMINISTIC = [
    (jm.PrescribedMotion(0.01, 6.0), motion_by_scipy),
    (jm.PrescribedForce(5.0, 1.5), force_by_scipy),
    (jm.Isometric(5.0, 0.003), isometric_by_scipy),
]


@pytest.mark.parametrize("task, reference", DETERMINISTIC)
def test_without_noise_the_result_is_scipys_to_second_order(x64, task, reference):
    task = references.quiet(task.with_parts(harmonic=HARMONIC), k_w=4e5, c_w=50.0)
    states, output = reference(task, np.arange(301) / 100)
    scale, errors = (np.abs(states).max(axis=0), np.abs(output).max()), []
    # 3 s of the usual 15 s, whose program there is
    for dt, duration in ((2e-3, 3.0), (1e-3, 15.0)):
        run = jm.simulate(task, KEY, duration=duration, dt=dt, substeps=1)
        found = np.asarray(run.states)[:301], np.asarray(run.output)[:301]
        off = [
            np.abs(x - exact).max(axis=0) / size
            for x, exact, size in zip(found, (states, output), scale, strict=True)
        ]
        errors.append([*off[0], off[1]])
    errors = np.array(errors)
    assert errors[1].max() < 1e-3  # (|λ| dt)² / 6 = 3e-3 at most, |λ| = 130/s
    for column in errors.T:
        # Second order; the next term of the error is of relative size |λ| dt, at most a quarter at
        # the largest step.
        assert 1.85 < references.observed_order([2e-3, 1e-3], column) < 2.2, errors


def test_a_stiff_task_gets_sub_steps_and_the_right_answer(x64):
    # C_w0 / m_w = 4000/s
    task = references.quiet(jm.Isometric(5.0, 0.003, harmonic=HARMONIC), c_w=2000.0)
    run = jm.simulate(task, KEY, duration=3.0)
    assert run.substeps == 16  # the power of two above 4010/s * 1 ms / 0.5 = 8.02
    states, output = isometric_by_scipy(task, run.time, "Radau")
    # Heun with |λ| h = 0.25 follows what is slower than λ (the harmonic: ω = 27/s) to (ω h)² =
    # 3e-6.
    np.testing.assert_allclose(
        run.states[:, 0], states[:, 0], atol=1e-5 * np.abs(states[:, 0]).max()
    )
    np.testing.assert_allclose(run.output, output, atol=1e-5 * np.abs(output).max())
    with pytest.raises(jm.errors.SimulationError, match="did not stay finite"):
        jm.simulate(task, KEY, duration=3.0, substeps=1)


@pytest.mark.parametrize(
    ("rate", "substeps"), [(1.0, 1), (500.0, 1), (501.0, 2), (1000.0, 2), (127_900.0, 256)]
)
def test_so_many_substeps_that_an_eigenvalue_times_a_step_is_half_at_most(
    monkeypatch, rate, substeps
):
    """Of 1 ms, in powers of two up to 256."""
    monkeypatch.setattr(_simulate, "fastest_rate", lambda *_: rate)
    assert stable_substeps(jm.Isometric(), 1e-3) == substeps
    assert rate * 1e-3 / substeps <= 0.5


def test_more_substeps_than_256_are_refused(monkeypatch):
    monkeypatch.setattr(_simulate, "fastest_rate", lambda *_: 128_100.0)
    with pytest.raises(
        ValueError, match=r"eigenvalue of 1.28e\+05/s, which asks for 512 sub-steps of dt = 0.001 s"
    ):
        stable_substeps(jm.Isometric(), 1e-3)


def test_an_eigenvalue_beyond_all_sub_steps_is_an_error():
    with pytest.raises(ValueError, match=r"eigenvalue of .*/s, which asks for \d+ sub-steps"):
        jm.simulate(jm.Isometric().replace(c_w=1e6), KEY)


class Integral(jm.model.AbstractTask):
    """`y' = ΔK_w`: what the integrator makes of a noise path is its trapezoidal sum."""

    state_names = ("y",)
    state_units = ("N s/m",)
    output_name = "y"
    output_unit = "N s/m"
    smoothness_needed = (0, 0, 0, 0)

    def vector_field(self, t, y, u):
        return u[:1]

    def output(self, t, y, u, du):
        return y[0]


@pytest.mark.parametrize(
    "steps, every, substeps, precision",
    [
        (1500, 1, 1, "float64"),
        (15_000, 10, 1, "float32"),
        (15_000, 10, 4, "float32"),
        (1500, 1, 3, "float64"),
        (150, 3, 49, "float64"),
    ],
)
def test_every_step_gets_its_own_noise(steps, every, substeps, precision):
    """diffrax rounds the times of steps: none may find its neighbour's noise."""
    with jax.enable_x64(precision == "float64"):
        noise = np.random.default_rng(0).normal(size=(steps + 1, 4)).astype(precision)
        # values of the numbers themselves, as it forgets at once; and increments of them
        kinds = (
            jm.OrnsteinUhlenbeckNoise(1.0, 1e-9, relative=False),
            jm.WhiteNoise(1.0, rate=1e-3, relative=False),
        )
        tasks = [as_arrays(Integral(noise=kind, harmonic=jm.Harmonic(0.0))) for kind in kinds]
        grid = Grid(1e-3, steps, every, substeps)

        def integrals(tasks, noise):
            return [respond(task, (noise,), grid)[0][:, 0] for task in tasks]

        smooth, rough = at_once(integrals, tasks, noise)
        sums = (
            np.cumsum(0.5e-3 * (noise[1:, 0] + noise[:-1, 0]).astype(float)),
            np.cumsum(noise[1:, 0].astype(float)),
        )
        for seen, expected, size in ((smooth, sums[0], 1e-3), (rough, sums[1], 1.0)):
            # One wrong value is an error of order `size`, at a thousand of the steps.
            np.testing.assert_allclose(seen[1:], expected[every - 1 :: every], atol=0.02 * size)


@pytest.mark.slow
@pytest.mark.parametrize("task", ["motion", "force", "isometric"])
def test_tables_of_inputs_and_harmonic_change_nothing(x64, task):
    """A traced call, which may be differentiated in reverse, evaluates them in the loop; a plain
    one looks them up."""
    rhythm = jm.Harmonic(0.02, 3.0, 0.4, Decay(1.0, 0.2, 0.3, 0.2))
    task = {
        "motion": jm.PrescribedMotion(RampHold(0.005, 0.1, 0.3, 0.1), 5.0, harmonic=rhythm),
        "force": jm.PrescribedForce(
            SmoothStep(5.0, 0.1, 0.3), Decay(1.0, 0.0, 0.2, 0.3), harmonic=rhythm
        ),
        "isometric": jm.Isometric(
            Sampled.through(np.linspace(0, 1, 9), np.sin(np.arange(9.0)) + 3), harmonic=rhythm
        ),
    }[task]
    options = {"duration": 0.8, "rate": 500.0, "substeps": 3}
    plain = jm.simulate(task, KEY, **options)
    traced = drawing(lambda key: jm.simulate(task, key, **options).output)(KEY)
    np.testing.assert_allclose(
        plain.output, traced, rtol=1e-9, atol=1e-9 * np.abs(plain.output).max()
    )


TASKS = [
    jm.PrescribedMotion(0.005, 5.0),
    jm.PrescribedForce(5.0, 1.0, noise=jm.WhiteNoise()),
    jm.Isometric(noise=jm.OrnsteinUhlenbeckNoise(0.05), x_z=0.002),
]


@pytest.mark.parametrize(
    "task, precision", list(zip(TASKS, ("float32", "float64", "float32"), strict=True))
)
def test_a_seed_is_the_same_whatever_the_batch(task, precision):
    with jax.enable_x64(precision == "float64"):
        # a full chunk and a padded one
        reference = jm.ensemble(task, KEY, seeds=10, duration=1.0, chunk=8)
        assert reference.output.dtype == precision and reference.states.dtype == precision
        np.testing.assert_array_equal(reference.seeds, np.arange(10))
        assert np.unique(np.asarray(reference.output)[:, -1]).size == 10  # and no seed is another's
        bound = 1e-6 * np.abs(reference.output).max()
        chosen = jm.ensemble(task, KEY, seeds=np.array([9, 2]), duration=1.0)
        np.testing.assert_allclose(
            chosen.output, np.asarray(reference.output)[[9, 2]], rtol=1e-6, atol=bound
        )
        if task is not TASKS[0]:  # each further size is a program of its own: of one task
            return
        others = jm.ensemble(task, KEY, seeds=10, duration=1.0, chunk=3)
        np.testing.assert_allclose(others.output, reference.output, rtol=1e-6, atol=bound)
        for seed in (0, 9):
            single = jm.simulate(task, KEY, seed=seed, duration=1.0)
            np.testing.assert_allclose(single.output, reference.output[seed], rtol=1e-6, atol=bound)
            np.testing.assert_allclose(
                single.states,
                reference.states[seed],
                rtol=1e-6,
                atol=1e-6 * np.abs(reference.states).max(),
            )


@pytest.mark.parametrize("samples", [131_200, 150_001])
def test_long_runs_in_single_precision_reach_their_end(samples):
    """A hundred units in the last place of so many steps are more than one step."""
    run = jm.simulate(jm.Isometric().settled(), KEY, duration=samples / 1000, rate=1000.0)
    assert run.output.dtype == np.float32 and len(run.output) == samples + 1
    assert np.all(np.isfinite(run.output))


def test_single_precision_follows_double():
    task = references.quiet(jm.PrescribedForce(5.0, 1.0))
    single = jm.simulate(task, KEY)
    with jax.enable_x64(True):
        double = jm.simulate(task, KEY)
    np.testing.assert_allclose(
        single.output, double.output, atol=1e-4 * np.abs(double.output).max()
    )


def test_other_keys_and_seeds_are_other_noise():
    task = TASKS[2]
    a, b = (jm.simulate(task, jax.random.key(k), duration=2.0).output for k in (0, 1))
    c = jm.simulate(task, jax.random.key(0), seed=1, duration=2.0).output
    assert np.abs(a - b).max() > 1e-3 and np.abs(a - c).max() > 1e-3


def test_seed_i_folds_i_into_the_key():
    found = streams_of(KEY, jnp.array([3, 70]), Draws())
    for i, words in zip((3, 70), found.words, strict=True):
        np.testing.assert_array_equal(words, Stream.of(jax.random.fold_in(KEY, i)).words)


def test_what_does_not_stay_finite_is_named():
    task = jm.Isometric(noise=jm.OrnsteinUhlenbeckNoise({"C_w": 30.0}))
    with pytest.raises(jm.errors.SimulationError) as error:
        jm.ensemble(task, KEY, seeds=3, duration=1.0)
    for part in (
        "3 seed(s)",
        "(0, 1, 2)",
        "Isometric",
        "dt = 0.001 s",
        "noise_C_w = 30",
        "k_w = 500000",
    ):
        assert part in str(error.value), part
    with pytest.raises(jm.errors.SimulationError, match=r"1 seed\(s\) did not stay finite \(7\)"):
        jm.simulate(task, KEY, seed=7, duration=2.0)
    traced = kept_jit(lambda a: jm.simulate(task.replace(noise_C_w=a), KEY, duration=2.0).output)
    assert not np.isfinite(traced(30.0)).all()
    assert np.isfinite(traced(0.1)).all()


@pytest.mark.parametrize(
    "settings, message",
    [
        (
            {"dt": 3e-3},
            (
                r"dt = 0.003 s does not divide the sampling interval 0.01 s: use one of 0.0025,"
                r" 0.002, 0.001, 0.0005 s"
            ),
        ),
        ({"dt": 0.02}, "too coarse"),
        (
            {"dt": 0.0045},
            (
                "does not divide the sampling interval 0.01 s: use one of 0.00333333333, 0.0025,"
                " 0.002, 0.001 s"
            ),
        ),
        ({"dt": 0.01}, r"noise_cutoff = 50.0 Hz: use dt <= 0.25 / noise_cutoff = 0.005 s"),
        ({"dt": 0.0}, "dt = 0.0: give a finite number above 0"),
        ({"duration": -1.0}, "duration = -1.0: give a finite number above 0"),
        ({"duration": 1.005}, "duration = 1.005 s is not a whole number of sampling intervals"),
        # 32 bits count them
        ({"duration": 2.2e6}, "makes 2200000000 steps, at most 2147483647 are possible"),
        ({"sampling": "mean"}, "sampling = 'mean' must be one of instant, average, filtered"),
    ],
)
def test_impossible_grids_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        jm.simulate(jm.Isometric(), KEY, **settings)


def test_a_step_that_leaves_nothing_to_be_low_passed_is_refused():
    slow = jm.Isometric(noise_cutoff=20.0)
    with pytest.raises(
        ValueError, match=r"dt = 0\.01 s is a whole sampling interval, .*: use half of it or less"
    ):
        jm.simulate(slow, KEY, sampling="filtered", dt=0.01)


@pytest.mark.parametrize(
    "rate, sampling",
    [(None, "filtered"), (100.0, "filtered"), (50.0, "filtered"), (1000.0, "instant")],
)
def test_only_a_finer_run_of_filtered_settings_is_seen_at_instants(rate, sampling):
    """Its spectrum is low-passed when it is made. At the rate of the settings and below, the run
    itself is."""
    settings = jm.SpectrumSettings(rate=100.0, sampling="filtered")
    assert (
        schedule(jm.Isometric(settings=settings), 1.0, 1e-3, rate, None, None).sampling == sampling
    )


def test_a_traced_duration_says_that_it_is_traced():
    plan = inspect.unwrap(schedule)  # without the tests' type checker
    with pytest.raises(ValueError, match=r"duration is traced by JAX.*static_argnames"):
        jax.jit(lambda duration: plan(jm.Isometric(), duration, 1e-3, None, None, None))(1.0)


def test_impossible_ensembles_are_refused():
    with pytest.raises(ValueError, match="seeds = 0"):
        jm.ensemble(jm.Isometric(), KEY, seeds=0)
    with pytest.raises(ValueError, match="chunk = 0"):
        jm.ensemble(jm.Isometric(), KEY, seeds=1, chunk=0)


def test_averages_are_those_of_a_fine_run(x64):
    task = jm.Isometric(noise=jm.BandLimitedNoise(0.1))
    fine = np.asarray(jm.simulate(task, KEY, duration=1.0, rate=1000.0).output)
    mean = jm.simulate(task, KEY, duration=1.0, sampling="average")
    expected = [np.trapezoid(fine[10 * i : 10 * i + 11]) / 10 for i in range(100)]
    # of newtons: at the start all cancels
    np.testing.assert_allclose(mean.output[1:], expected, rtol=1e-12, atol=1e-12)
    assert mean.sampling == "average" and mean.output[0] == fine[0]
    instant = jm.simulate(task, KEY, duration=1.0)
    np.testing.assert_allclose(instant.output, fine[::10], rtol=1e-12, atol=1e-12)
    assert np.abs(instant.output - mean.output).max() > 1e-3
    passed = jm.simulate(task, KEY, duration=1.0, sampling="filtered")
    np.testing.assert_allclose(
        passed.output, scipy.signal.resample_poly(fine, 1, 10, padtype="line"), atol=1e-14
    )
    np.testing.assert_array_equal(passed.states, mean.states)
    # what the call does not say
    asked = task.with_parts(settings=jm.SpectrumSettings(sampling="average"))
    assert schedule(asked, 1.0, 1e-3, None, None, None) == schedule(
        task, 1.0, 1e-3, None, None, "average"
    )


def test_sampling_and_window():
    run = jm.simulate(jm.Isometric(), KEY, duration=3.0, rate=200.0)
    assert run.output.shape == (601,) and run.states.shape == (601, 2)
    np.testing.assert_allclose(run.time, np.arange(601) / 200)
    np.testing.assert_array_equal(run.between((1.0, 2.5)), run.output[200:500])
    np.testing.assert_array_equal(run.state("v_w"), run.states[:, 1])
    with pytest.raises(ValueError, match=r"window \(1.0, 5.0\) s does not lie"):
        run.between((1.0, 5.0))
    with pytest.raises(ValueError, match="state 'x_z': Isometric has"):
        run.state("x_z")
    halved = run.spectrum(window=(0.0, 3.0))
    expected = jm.spectra.spectrum_of(run.output[::2], jm.SpectrumSettings(), (0.0, 3.0))
    np.testing.assert_array_equal(halved.power, expected.power)
    with pytest.raises(ValueError, match=r"a multiple of that rate, this has 200.0 Hz"):
        run.spectrum(jm.SpectrumSettings(rate=150.0), window=(0.0, 3.0))


def test_ensembles_under_vmap_and_jit(x64):
    task = jm.Isometric()
    stiffness = jnp.array([4e5, 6e5])

    def output(k_w):
        return jm.ensemble(task.replace(k_w=k_w), KEY, seeds=2, duration=1.0).output

    both = drawing(jax.vmap(output))(stiffness)
    assert both.shape == (2, 2, 101)
    for i, k_w in enumerate((4e5, 6e5)):
        np.testing.assert_allclose(both[i], output(k_w), rtol=1e-9, atol=1e-12)
    assert np.abs(both[0] - both[1]).max() > 1e-2


def test_other_values_do_not_compile_again():
    traces = []

    class Counted(jm.model.AbstractLaw):
        k: Scalar = 5e5

        def __call__(self, q):
            traces.append(not is_concrete(self.k))
            return self.k * (4e-4 + q**2)

    task = jm.PrescribedForce(muscle=jm.Muscle(stiffness_w=Counted()))

    def compilations(task, seed, seeds):
        before = sum(traces)
        jm.simulate(task, jax.random.key(seed), seed=seed, duration=0.5)
        jm.ensemble(task, jax.random.key(seed), seeds=seeds, duration=0.5)
        return sum(traces) - before

    assert compilations(task, 0, 5) > 0
    changed = task.replace(
        k_w=4e5, c_w=55.0, noise_K_w=0.1, P_w=4.0, harmonic_frequency=3.0, noise_cutoff=30.0
    )
    assert compilations(changed, 1, 7) == 0
    assert compilations(task.replace(k_w=jnp.asarray(3e5)), 2, 3) == 0


def test_xarray_says_what_it_holds(tmp_path):
    import xarray

    task = jm.Isometric(x_z=0.002).replace(k_w=4e5)
    runs = jm.ensemble(task, KEY, seeds=3, duration=1.0)
    runs.to_xarray().to_netcdf(tmp_path / "runs.nc", engine="h5netcdf")
    with xarray.open_dataset(tmp_path / "runs.nc", engine="h5netcdf") as data:
        assert data["F_ext"].dims == ("seed", "time") and data["F_ext"].shape == (3, 101)
        units = {name: data[name].attrs["units"] for name in ("F_ext", "x_w", "v_w", "time")}
        assert units == {"F_ext": "N", "x_w": "m", "v_w": "m/s", "time": "s"}
        np.testing.assert_array_equal(data["F_ext"], runs.output)
        np.testing.assert_array_equal(data["x_w"], np.asarray(runs.states)[..., 0])
        np.testing.assert_array_equal(data["seed"], [0, 1, 2])
        assert data.attrs["task"] == "Isometric" and data.attrs["noise"] == "BandLimitedNoise"
        assert (data.attrs["dt"], data.attrs["substeps"], data.attrs["sampling"]) == (
            1e-3,
            1,
            "instant",
        )
        parameters = json.loads(data.attrs["parameters"])
        assert (
            parameters["k_w"] == {"value": 4e5, "unit": "N/m^3"}
            and parameters["x_z"]["value"] == 0.002
        )
        assert set(parameters) == set(task.parameter_names)
        assert json.loads(data.attrs["spectrum_settings"]) == task.settings.to_dict()
        assert json.loads(data.attrs["versions"])["jaxmuscle"] == jm.__version__
    single = jm.simulate(jm.PrescribedForce(), KEY, seed=4, substeps=1).to_xarray()
    assert (
        single["x_z"].dims == ("time",)
        and single["x_z"].attrs["units"] == "m"
        and int(single["seed"]) == 4
    )


def test_a_trajectory_is_a_tree():
    run = jm.simulate(jm.Isometric(), KEY)
    doubled = eqx.tree_at(lambda r: r.output, run, 2 * run.output)
    assert float(doubled.output[-1]) == 2 * float(run.output[-1])
    assert bool(run.finite)


def test_a_task_whose_equations_are_not_finite_is_refused():
    broken = eqx.tree_at(lambda task: task.muscle.stiffness_w.k, jm.Isometric(), float("nan"))
    for task in (broken, jm.Isometric(initial=(np.nan, 0.0))):
        with pytest.raises(
            jm.errors.OperatingPointError,
            match="not finite where it starts: one of its numbers is NaN",
        ):
            jm.simulate(task, jax.random.key(0))


def test_the_runs_of_an_ensemble_are_taken_by_their_place():
    runs = jm.ensemble(jm.Isometric(), KEY, seeds=3)
    assert len(runs) == 3 and [int(run.seeds) for run in runs] == [0, 1, 2]
    for place in (0, 2, -1):
        for name in ("states", "output", "seeds", "linear"):
            np.testing.assert_array_equal(getattr(runs[place], name), getattr(runs, name)[place])
    alone = jm.simulate(jm.Isometric(), KEY, seed=1)  # computed alone, so rounded otherwise
    np.testing.assert_allclose(runs[1].output, alone.output, rtol=1e-6, atol=1e-6)
    np.testing.assert_array_equal(runs[1:].output, runs.output[1:])
    with pytest.raises(IndexError, match=r"\[3\]: there are 3 seeds, 0 to 2"):
        runs[3]
    with pytest.raises(TypeError, match="this trajectory is one run"):
        runs[0][0]
    # What `vmap` makes of runs, whose every number gets an axis; that runs can be mapped: the test
    # of ensembles under vmap.
    mapped = jax.vmap(lambda output: eqx.tree_at(lambda run: run.output, alone, output))(
        runs.output[:2]
    )
    assert mapped[1].task["m_w"] == 0.5 and mapped[1].output.shape == runs[0].output.shape
