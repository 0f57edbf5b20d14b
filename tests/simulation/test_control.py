"""Control variates: ensembles beside their linear response, against plain Monte Carlo and the
closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import references
from compiled import at_once
from noise_paths import coarsen, draw_normals, respond

import jaxmuscle as jm
from jaxmuscle._common.arrays import as_arrays
from jaxmuscle.response._expected_moments import linear_spectrum
from jaxmuscle.response._linear_task import LinearTask
from jaxmuscle.response._linearised import linearised
from jaxmuscle.simulation._grid import Grid
from jaxmuscle.simulation._simulate import companion

KEY = jax.random.key(41)
WINDOW = (5.0, 15.0)

PAPER, HUMAN = (
    {"K_w": 0.0016, "K_z": 0.0016, "C_w": 1e-4, "C_z": 1e-4},
    {"K_w": 0.15, "K_z": 0.005, "C_w": 1e-4, "C_z": 1e-4},
)
LEVELS = {"paper": (PAPER, jm.Harmonic(0.0007592)), "human": (HUMAN, jm.Harmonic())}
COLOURS = {
    "band-limited": jm.BandLimitedNoise,
    "OU": jm.OrnsteinUhlenbeckNoise,
    "white": jm.WhiteNoise,
}
INPUTS = {
    jm.Isometric: (5.0, 0.003),
    jm.PrescribedForce: (5.0, 1.0),
    jm.PrescribedMotion: (0.004, 6.0),
}
# Where the output contains a noise directly, or its derivative, it must have one.
ROUGH = {
    (jm.Isometric, "white"): ("K_w", "C_w"),
    (jm.PrescribedMotion, "OU"): ("K_w", "C_w"),
    (jm.PrescribedMotion, "white"): (),
}


def made(kind, colour, level):
    amplitude, harmonic = LEVELS[level]
    channels = ROUGH.get((kind, colour), tuple(amplitude))
    return kind(
        *INPUTS[kind], noise=COLOURS[colour]({c: amplitude[c] for c in channels}), harmonic=harmonic
    )


GRID = [(k, c, v) for v in LEVELS for k in INPUTS for c in COLOURS if ROUGH.get((k, c), ("K_w",))]
PRESET = jm.load_preset("zagrodny-slifkin")
VASTUS = jm.Isometric().replace(
    k_w=4.558e5,
    k_z=7.836e5,
    c_w=111.5,
    c_z=1.777,
    noise_K_w=0.2672,
    noise_K_z=0.00204,
    harmonic_amplitude=0.003256,
    harmonic_frequency=3.92,
)


def deviations(power, expected):
    """Of the mean over seeds from what is expected, in standard errors."""
    return (power.mean(axis=0) - expected) / (power.std(axis=0, ddof=1) / np.sqrt(len(power)))


@pytest.mark.slow
def test_plain_monte_carlo_of_500_seeds_agrees(x64):
    """Every task, noise colour and level: the bound over all bins of all, χ² over Hann bins three
    apart."""
    # a settled task only has to forget that it starts without fluctuations, by 1 s to e^-7
    window, z = (1.0, 6.12), []
    for i, case in enumerate(GRID):
        task = made(*case).settled()
        # Three segments of 500 seeds leave 3 %: the step's bias is below 0.2 of it (see the test of
        # the step).
        options = {"duration": window[1], "dt": 1.25e-3, "substeps": 1, "control": False}
        runs = jm.ensemble(task, jax.random.fold_in(KEY, i), seeds=500, **options)
        power = np.asarray(runs.spectrum(window=window).power)
        z.append(deviations(power, np.asarray(linear_spectrum(task, task.settings, window).power)))
        print(
            case[0].__name__,
            case[1:],
            f"largest {np.abs(z[-1]).max():.2f}, mean square {np.mean(z[-1] ** 2):.2f}",
        )
    assert len(z) == 16
    references.assert_standard_normal(z, every=3)


# One compiled program for all ensembles of a settled task that are carried beside;
# test_second_order.py has it, too.
TOGETHER = {"chunk": 32}


@pytest.mark.slow
@pytest.mark.parametrize("kind", INPUTS)
def test_linear_trajectories_have_the_expected_spectrum(x64, kind):
    """`E l` is exact: the mean over 128 seeds, one path each beside the nonlinear task."""
    runs = jm.ensemble(made(kind, "band-limited", "human").settled(), KEY, seeds=128, **TOGETHER)
    power = np.asarray(runs.beside().spectrum().power)
    expected = np.asarray(jm.expected_spectrum(runs.task).power)
    references.assert_standard_normal(deviations(power, expected), every=3)
    estimate = runs.mean_spectrum()
    np.testing.assert_array_equal(estimate.expected, expected)
    np.testing.assert_allclose(
        estimate.power,
        expected + (np.asarray(runs.spectrum().power) - power).mean(axis=0),
        rtol=1e-12,
    )


AT_PAPER_LEVEL = {
    "preset": PRESET,
    "isometric": made(jm.Isometric, "band-limited", "paper"),
    "force": made(jm.PrescribedForce, "band-limited", "paper"),
}


@pytest.mark.parametrize("name", AT_PAPER_LEVEL)
def test_at_the_papers_amplitudes_the_response_is_linear(x64, name):
    estimate = jm.ensemble(
        AT_PAPER_LEVEL[name].settled(), KEY, seeds=32, **TOGETHER
    ).mean_spectrum()
    # Below 0.2 % of every bin by more than three of its standard errors.
    assert np.all(np.abs(estimate.nonlinearity) + 3 * estimate.stderr / estimate.expected < 2e-3)
    assert np.median(estimate.variance_reduction) >= 10_000


def test_at_human_amplitudes_most_of_the_variance_goes(x64):
    estimate = jm.ensemble(VASTUS.settled(), KEY, seeds=32, **TOGETHER).mean_spectrum()
    assert np.median(estimate.variance_reduction) >= 200


def test_the_nonlinear_part_of_large_noise_is_seen(x64):
    """Stiffness noise of 15 % that lasts 0.1 s: a percent or two of each bin, which plain 256 seeds
    cannot tell."""
    estimate = jm.ensemble(
        made(jm.PrescribedForce, "OU", "human"), KEY, seeds=256, dt=2e-3
    ).mean_spectrum()
    z = (estimate.power - estimate.expected) / estimate.stderr
    with pytest.raises(AssertionError, match="largest deviation"):
        references.assert_standard_normal(z)
    references.assert_standard_normal(
        (estimate.plain_power - estimate.expected) / estimate.plain_stderr, every=3
    )
    assert np.all(np.abs(estimate.nonlinearity) < 0.05)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [jm.Isometric, jm.PrescribedForce])
def test_the_controlled_estimate_has_no_linear_time_step_error(x64, kind):
    """Steps of 5 and 2.5 ms on the same paths, which band-limited noise has exactly on each
    grid."""
    task = as_arrays(made(kind, "band-limited", "human"))
    linear, steps, seeds = linearised(task), 6000, 64

    def spectra(normals):
        steps = len(normals[0]) - 1
        grid = Grid(15.0 / steps, steps, steps // 1500)
        outputs = (respond(part, normals, grid)[1] for part in (task, linear))
        return [jm.spectra.spectrum_of(output, task.settings, WINDOW).power for output in outputs]

    def both(key):
        fine = draw_normals(task.noise, key, steps)
        return spectra(coarsen(task.noise, fine, 15.0 / steps, 2)), spectra(fine)

    coarse, fine = at_once(jax.vmap(both), jax.random.split(KEY, seeds))
    mean = np.asarray(jm.expected_spectrum(task).power)
    plain, controlled = (
        (np.asarray(c) - np.asarray(f)) / mean
        for c, f in ((coarse[0], fine[0]), (coarse[0] - coarse[1], fine[0] - fine[1]))
    )
    error = plain.std(axis=0, ddof=1) / np.sqrt(seeds)
    plain, controlled = np.abs(plain.mean(axis=0)), np.abs(controlled.mean(axis=0))
    assert (plain / error).max() > 3.6  # 1 % over 30 bins
    # What is left is that of the nonlinear part of a seed's power, 1 / √(variance reduction) = 2 to
    # 4 % of it here.
    assert np.median(controlled) < 0.04 * np.median(plain) and controlled.max() < 0.04 * plain.max()
    # Of second order: 4/3 of the difference at 5 ms, 1/12 at the 1.25 ms of the 500 seeds, which
    # have half the segments.
    many = np.std(fine[0], axis=0, ddof=1) / np.sqrt(500 / 2) / mean
    assert np.all(plain / 12 < 0.22 * many)


def test_control_changes_no_trajectory_and_comes_in_chunks(x64):
    options = {"seeds": np.array([3, 0, 7, 5, 1, 4, 2, 6, 9, 8]), "dt": 2.5e-3, "chunk": 8}
    task = jm.Isometric()
    runs, plain = (
        jm.ensemble(task, KEY, **options),
        jm.ensemble(task, KEY, **options, control=False),
    )
    assert runs.linear.shape == runs.output.shape == (10, 1501) and plain.linear is None
    # XLA fuses two integrations otherwise than one: rounding.
    np.testing.assert_allclose(plain.output, runs.output, rtol=1e-11)
    one = jm.ensemble(task, KEY, seeds=np.array([9]), dt=2.5e-3)
    np.testing.assert_allclose(one.linear[0], runs.linear[8], rtol=1e-11)
    beside = runs.beside()
    np.testing.assert_array_equal(beside.output, runs.linear)
    np.testing.assert_array_equal(
        runs.mean_spectrum(control=False).power, runs.mean_spectrum().plain_power
    )
    np.testing.assert_allclose(
        runs.mean_spectrum(control=False).power, plain.mean_spectrum().power, rtol=1e-9
    )


def test_what_an_estimate_holds(x64):
    runs = jm.ensemble(jm.Isometric(), KEY, seeds=8, dt=2.5e-3, control=True)
    settings = jm.SpectrumSettings(first_bin=2, last_bin=20, detrend="linear")
    estimate = runs.mean_spectrum(settings, (4.0, 14.0))
    rows = np.asarray(runs.spectrum(settings, (4.0, 14.0)).power)
    np.testing.assert_allclose(estimate.plain_power, rows.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(
        estimate.plain_stderr, rows.std(axis=0, ddof=1) / np.sqrt(8), rtol=1e-12
    )
    np.testing.assert_array_equal(
        estimate.expected, jm.expected_spectrum(runs.task, settings, (4.0, 14.0)).power
    )
    np.testing.assert_allclose(estimate.nonlinearity, estimate.power / estimate.expected - 1)
    np.testing.assert_allclose(
        estimate.variance_reduction, (estimate.plain_stderr / estimate.stderr) ** 2
    )
    np.testing.assert_allclose(estimate.proportional, estimate.spectrum.proportional, rtol=1e-12)
    np.testing.assert_array_equal(estimate.frequency, settings.frequency)
    assert (estimate.seeds, estimate.unit, estimate.settings) == (8, "N", settings)


def test_one_seed_has_a_spectrum_but_no_error(x64):
    estimate = jm.simulate(jm.Isometric(), KEY).mean_spectrum()
    assert estimate.seeds == 1 and estimate.expected is None
    assert np.all(estimate.power > 0) and np.all(np.isnan(estimate.stderr))


SLOW = jm.Isometric().replace(m_w=100.0)  # it comes to rest by C / 2 m = 0.3/s
UNDAMPED = jm.Isometric(5.0, 0.003).replace(x_ref_w=0.0, x_ref_z=0.0, v_ref_w=0.0, v_ref_z=0.0)
IMPOSSIBLE = {
    "short": (
        jm.Isometric(),
        {"duration": 14.0},
        r"control = True: duration = 14\.0 s must reach 15\.0 s",
    ),
    "slow": (
        SLOW,
        {},
        (
            r"by 5\.0 s the slowest motion must have decayed to 0\.001 of its start, but 0\.2 is"
            r" left: .*settled"
        ),
    ),
    "undamped": (UNDAMPED, {}, "the equilibrium of this Isometric is undamped"),
    "no equilibrium": (
        jm.PrescribedForce().replace(k_w=0.0),
        {},
        "PrescribedForce has no equilibrium",
    ),
}


@pytest.mark.parametrize("name", IMPOSSIBLE)
def test_where_control_cannot_be(name):
    task, options, message = IMPOSSIBLE[name]
    with pytest.raises(ValueError, match=message):
        jm.ensemble(task, KEY, seeds=2, control=True, **options)


def test_slow_beside_fast_motion_is_damped_also_in_single_precision():
    # In single precision the slow rate would be lost in the rounding of the fast one, which is
    # 30,000 times as large.
    c, m, k, ref = 3000.0, 0.5, 5e5, 0.02
    found = companion(jm.Isometric(5.0, 0.0).replace(c_w=c).settled(), 15.0, required=True)
    # P_w = 5 N against k (x_ref² + x²) x and, at x_z = 0, k x_ref² x
    x = np.roots([k, 0.0, 2 * k * ref**2, -5.0])
    stretch = x[np.abs(x.imag) < 1e-12].real[0]
    stiffness, damping = k * (2 * ref**2 + 3 * stretch**2), c + 5.0
    expected = np.roots([m, damping, stiffness]).real  # of m x'' + C x' + K x = 0
    assert found is not None
    np.testing.assert_allclose(
        np.sort(np.linalg.eigvals(found.system.A).real), np.sort(expected), rtol=1e-9
    )


def test_control_by_default_where_it_pays(x64):
    assert jm.ensemble(jm.Isometric(), KEY, seeds=8, dt=2.5e-3).linear is not None
    for task in (SLOW, UNDAMPED):
        assert jm.ensemble(task, KEY, seeds=8, dt=2.5e-3).linear is None
    assert jm.ensemble(jm.Isometric(), KEY, seeds=2, duration=1.0).linear is None


def test_a_settled_task_has_no_transient_however_slow(x64):
    assert jm.ensemble(SLOW.settled(), KEY, seeds=32, **TOGETHER).linear is not None


def test_without_what_a_controlled_mean_needs(x64):
    plain = jm.ensemble(jm.Isometric(), KEY, seeds=8, dt=2.5e-3, control=False)
    with pytest.raises(
        ValueError, match="control = True needs a trajectory simulated with control"
    ):
        plain.mean_spectrum(control=True)
    with pytest.raises(
        ValueError, match="no linear response beside it: simulate with control=True"
    ):
        plain.beside()
    assert plain.mean_spectrum().expected is None
    with pytest.raises(
        ValueError, match="no control variate to compare with: simulate with control=True"
    ):
        _ = plain.mean_spectrum().nonlinearity
    runs, average = (
        jm.ensemble(jm.Isometric(), KEY, seeds=8, dt=2.5e-3),
        jm.SpectrumSettings(sampling="average"),
    )
    with pytest.raises(ValueError, match="with the rate and sampling of the spectrum's settings"):
        runs.mean_spectrum(average, control=True)
    assert runs.mean_spectrum(average).expected is None


def test_under_a_transformation(x64):
    def linear(k_w):
        options = {"seeds": 2, "duration": 0.5, "dt": 5e-3, "control": True}
        return jm.ensemble(
            jm.Isometric(jm.model.Constant(5.0)).replace(k_w=k_w), KEY, **options
        ).linear

    output = np.asarray(jax.jit(linear)(5e5))
    assert output.shape == (2, 51) and np.all(np.isfinite(output)) and output.std() > 0


def test_single_precision_estimates_the_same():
    def estimate():
        task = made(jm.Isometric, "band-limited", "paper").settled()
        return jm.ensemble(task, KEY, seeds=32, **TOGETHER).mean_spectrum()

    single = estimate()
    with jax.enable_x64(True):
        double = estimate()
    assert single.expected.dtype == np.float32
    # The same paths: a force is rounded to 6e-8 of its level, which is 6e-5 of fluctuations of 0.1
    # %.
    np.testing.assert_allclose(single.power, double.power, rtol=2e-4)
    assert np.median(single.variance_reduction) >= 10_000


@pytest.mark.parametrize("kind", INPUTS)
def test_the_linear_task_is_the_tangent(x64, kind):
    """What is left of vector field and output falls with the square of the distance."""
    task, rng = as_arrays(kind(*INPUTS[kind])), np.random.default_rng(0)
    linear = linearised(task)
    point, t = linear.initial_state(), jnp.asarray(15.0)
    dy = jnp.asarray(1e-3 * rng.normal(size=point.size))
    u, du = (jnp.asarray(size * rng.normal(size=5)) for size in (1.0, 100.0))

    def left(h):
        y = point + h * dy
        field = [part.vector_field(t, y, h * u) for part in (task, linear)]
        output = [part.output(t, y, h * u, h * du) for part in (task, linear)]
        return np.array([np.linalg.norm(np.subtract(*field)), abs(np.subtract(*output))])

    assert isinstance(linear, LinearTask)
    coarse = left(1e-1)
    assert coarse[0] > 1e-6
    # Cubic laws: what is of third order is a hundredth of these small distances; x_z of
    # PrescribedForce is linear itself.
    np.testing.assert_allclose(left(1e-2), coarse / 100, rtol=0.03, atol=1e-14)
