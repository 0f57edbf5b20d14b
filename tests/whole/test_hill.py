"""A muscle from outside the package, docs/hill_muscle.py: its curves, its mechanics, and all that
jaxmuscle does with it."""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pages
import pytest
import references
import scipy.optimize
from compiled import at_once, kept_jit
from refits import without_intervals

import jaxmuscle as jm
from jaxmuscle.model import SmoothStep

DOCS = Path(__file__).parents[2] / "docs"
KEY = jax.random.key(7)
STILL = np.zeros(5)


hill = pages.module(DOCS / "hill_muscle.py")
HillMuscle = hill.HillMuscle


# --- the same muscle in NumPy, from the equations of docs/own-muscle.md with angles instead of
# cosines


def numpy_values(muscle):
    return {name: float(value) for name, value in jm.Isometric(muscle=muscle).parameters.items()}


def numpy_velocity(v):
    """Hill's (f + A) (A - v) = A (1 + A) for shortening; f = 1 + 0.4 e w / (1 + e w), e = 12.5, w =
    v + 16.5 v²."""
    w = 12.5 * (v + 16.5 * v**2)
    return np.where(v < 0, 0.25 * 1.25 / (0.25 - v) - 0.25, 1 + 0.4 * w / (1 + w))


def numpy_belly(p, x_w, v_w, surge=0.0):
    height, along = (
        p["optimal_length"] * np.sin(p["pennation"]),
        p["optimal_length"] * np.cos(p["pennation"]) - x_w,
    )
    angle, length = np.arctan2(height, along), np.hypot(height, along) / p["optimal_length"]
    velocity = numpy_velocity(-v_w * np.cos(angle) / (p["velocity_max"] * p["optimal_length"]))
    active = (1 + surge) * p["activation"] * np.exp(-((length - 1) ** 2) / 0.45) * velocity
    passive = (np.exp(5 * (length - 1) / 0.6) - 1) / (np.exp(5) - 1)
    return p["force_max"] * (active + passive) * np.cos(angle)


SLOPE, TOE = 1.712, 0.09
WEIGHT = scipy.optimize.brentq(
    lambda q: SLOPE * TOE * np.log((1 + q * np.exp(1 / TOE)) / (1 + q)) - 1, 1e-6, 1.0, xtol=1e-15
)


def numpy_tendon(p, stretch):
    eta = stretch / (p["tendon_strain"] * p["slack_length"])
    return p["force_max"] * SLOPE * TOE * np.log((1 + WEIGHT * np.exp(eta / TOE)) / (1 + WEIGHT))


def numpy_forces(p, x_w, v_w, x_z, v_z, u=STILL):
    """Active and passive force."""
    held = p["activation"] * p["force_max"] * np.cos(p["pennation"])
    active = held - numpy_belly(p, x_w, v_w, u[4]) + u[0] * x_w + u[2] * v_w
    passive = (
        (p["tendon_damping"] + u[3]) * (v_z - v_w) + u[1] * (x_z - x_w) - numpy_tendon(p, x_w - x_z)
    )
    return active, passive


OTHERS = {
    "default": {},
    "parallel": {"pennation": 0.0},
    "large": {"pennation": 0.4, "activation": 0.6, "slack_length": 0.1},
}


@pytest.fixture(params=OTHERS.values(), ids=list(OTHERS))
def muscle(request, x64):
    return HillMuscle(**request.param)


# --- curves


def test_shortening_is_hills_hyperbola(x64):
    v = np.linspace(-1, 0, 101)
    f = np.asarray(hill.force_velocity(v))
    np.testing.assert_allclose((f + 0.25) * (0.25 - v), 0.25 * 1.25, rtol=1e-14)
    assert abs(f[0]) < 1e-15 and f[-1] == 1.0
    # Hill's maximum of power for A = 0.25 is at √(A² + A) - A of the fastest shortening.
    fine = np.linspace(-1, 0, 100001)
    best = fine[np.argmax(-fine * np.asarray(hill.force_velocity(fine)))]
    assert best == pytest.approx(0.25 - np.sqrt(0.25**2 + 0.25), abs=1e-5)


def test_lengthening_rises_to_its_plateau(x64):
    v = np.linspace(-2, 5, 2001)
    f = np.asarray(hill.force_velocity(v))
    assert np.all(np.diff(f) > 0) and f[-1] < 1.4
    # 1.4 - f = 0.4 / (1 + e w), w = ν + 16.5 ν²
    np.testing.assert_allclose(
        hill.force_velocity(100.0), 1.4 - 0.4 / (1 + 12.5 * (100 + 16.5e4)), rtol=1e-12
    )
    np.testing.assert_allclose(f, numpy_velocity(v), rtol=1e-12, atol=1e-15)


@pytest.mark.slow
def test_force_velocity_is_smooth_at_rest(x64):
    h = 1e-5
    f = np.asarray(at_once(jax.vmap(hill.force_velocity), h * np.arange(-2.0, 3.0)))
    slopes, bends = np.diff(f)[1:3] / h, np.diff(f, 2)[[0, 2]] / h**2
    # One-sided differences miss curvature · h / 2 and third derivative (480 and -7690) · h;
    # rounding 4e-16 / h².
    np.testing.assert_allclose(slopes, 5.0, atol=25 * h)
    np.testing.assert_allclose(bends, 40.0, atol=8e3 * h)
    slope = jax.grad(hill.force_velocity)
    slopes, bends = at_once(
        jax.vmap(lambda v: (slope(v), jax.grad(slope)(v))), np.array([0.0, -1e-13, 1e-13])
    )
    np.testing.assert_allclose(slopes, 5.0, rtol=1e-10)
    np.testing.assert_allclose(bends, 40.0, rtol=1e-8)


@pytest.mark.slow
def test_force_length_passive_and_tendon_pass_through_what_is_published(x64):
    eta, force = np.linspace(-0.3, 1.5, 1801), np.linspace(0.0, 1.2, 25)

    def curves(length, stretched, eta, force):
        pulled = (
            hill.tendon(eta),
            hill.tendon(hill.tendon_strain(force)),
            jax.grad(hill.tendon)(3.0),
        )
        return hill.force_length(length), hill.passive_length(stretched), *pulled

    given = np.array([0.5, 1.0, 1.5]), np.array([1.0, 1.6]), np.r_[0.0, 1.0, -10.0, eta], force
    active, passive, tendon, again, slope = map(np.asarray, at_once(curves, *given))
    np.testing.assert_allclose(active, np.exp([-0.25 / 0.45, 0, -0.25 / 0.45]))
    np.testing.assert_allclose(passive, [0.0, 1.0], atol=1e-15)
    np.testing.assert_allclose(tendon[:2], [0.0, 1.0], atol=1e-14)
    assert slope == pytest.approx(1.712, rel=1e-6)
    assert 0.02 < np.abs(tendon[3:] - hill.thelen_tendon(eta)).max() < 0.023
    assert np.all(np.diff(tendon[3:]) > 0) and tendon[2] > -0.0016
    np.testing.assert_allclose(again, force, atol=1e-12)


@pytest.mark.slow
def test_the_passive_curves_are_smooth(x64):
    h, q, curves = (
        1e-5,
        np.linspace(-0.2, 1.6, 19),
        (hill.force_length, hill.passive_length, hill.tendon),
    )

    def of_all(around, q):
        return [
            (curve(around), jax.vmap(jax.grad(curve))(q), jax.vmap(jax.grad(jax.grad(curve)))(q))
            for curve in curves
        ]

    for values, slopes, bends in at_once(of_all, np.stack([q - h, q, q + h]), q):
        before, here, after = np.asarray(values)
        # Central differences: fourth derivatives are below 4e3 (the toe: 1.7/0.09³), rounding 1e-15
        # / h².
        np.testing.assert_allclose(slopes, (after - before) / (2 * h), rtol=1e-7, atol=1e-7)
        np.testing.assert_allclose(bends, (after - 2 * here + before) / h**2, rtol=1e-5, atol=1e-4)


# --- mechanics


def test_forces_are_the_equations(muscle):
    p, rng = numpy_values(muscle), np.random.default_rng(2)
    for _ in range(20):
        y, u = (
            rng.normal(size=4) * [0.006, 0.05, 0.005, 0.05],
            rng.normal(size=5) * [40, 40, 5, 1, 0.2],
        )
        active, passive = numpy_forces(p, *y, u)
        np.testing.assert_allclose(
            muscle.active_force(y[0], y[1], u), active, rtol=1e-10, atol=1e-12
        )
        np.testing.assert_allclose(muscle.passive_force(*y, u), passive, rtol=1e-10, atol=1e-12)
        assert muscle.active_force(y[0], y[1], u[:4]) == muscle.active_force(
            y[0], y[1], u * [1, 1, 1, 1, 0]
        )
        assert muscle.drive(4.0, u) == 4.0
        v_w = muscle.contraction_velocity(y[0], y[2], y[3], 3.0 * y[1], u)
        np.testing.assert_allclose(
            muscle.passive_force(y[0], v_w, y[2], y[3], u), 3.0 * y[1], rtol=1e-10, atol=1e-10
        )


@pytest.mark.slow
def test_at_rest_nothing_pulls_and_shortening_lowers_the_force(muscle):
    zero = jnp.zeros(())
    assert abs(muscle.active_force(zero, zero, STILL)) < 1e-14 * muscle.force_max
    assert abs(muscle.passive_force(zero, zero, zero, zero, STILL)) < 1e-14 * muscle.force_max
    x, v = np.linspace(0.0, 0.01, 21), np.linspace(-0.2, 0.2, 21)

    def forces(x, v):
        active = muscle.active_force(x, 0.0, STILL), muscle.active_force(0.0, v, STILL)
        return *active, muscle.passive_force(x, 0.0, 0.0, 0.0, STILL)

    shorter, faster, passive = (np.diff(force) for force in at_once(forces, x, v))
    assert np.all(shorter > 0)  # the ascending limb: shorter is weaker
    assert np.all(faster > 0)  # faster is weaker
    assert np.all(passive < 0)  # the belly's shortening stretches the tendon


@pytest.mark.slow
def test_the_base_coefficients_are_those_of_small_motions(muscle):
    task = hill.at_activation(jm.Isometric(muscle=muscle), muscle.activation)
    x = float(jm.response.equilibrium(task)[0])

    def small_motions(y):
        motion = jax.jacfwd(lambda y: task.vector_field(15.0, y, jnp.zeros(4)))(y)
        return muscle.base(), muscle.shortening(), motion, muscle.fibre(y[0])

    base, shortening, A, (length, cosine) = jax.tree.map(
        np.asarray, at_once(small_motions, np.array([x, 0.0]))
    )
    K_w, K_z, C_w, C_z = base
    assert float(shortening) == pytest.approx(x, rel=1e-10)
    np.testing.assert_allclose(A[1] * muscle.m_w, [-(K_w + K_z), -(C_w + C_z)], rtol=1e-9)
    p, h = numpy_values(muscle), 1e-6
    ahead, behind = (numpy_forces(p, x + s, 0.0, 0.0, 0.0) for s in (h, -h))
    np.testing.assert_allclose([K_w, -K_z], (np.array(ahead) - behind) / (2 * h), rtol=1e-5)
    # C_w0 = a F_max f_L cos² α (1 + 1/A) / (v_max ℓ₀)
    share = 5 * muscle.activation * np.exp(-((length - 1) ** 2) / 0.45) * cosine**2
    np.testing.assert_allclose(
        C_w, share * muscle.force_max / (muscle.velocity_max * muscle.optimal_length), rtol=1e-10
    )
    assert C_z == muscle.tendon_damping and min(K_w, K_z, C_w) > 0


@pytest.mark.parametrize("x_z", [-0.003, 0.0, 0.005, 0.008])
@pytest.mark.slow
def test_held_the_belly_and_the_tendon_balance(muscle, x_z):
    task = hill.at_activation(jm.Isometric(muscle=muscle, x_z=x_z), muscle.activation)
    p = numpy_values(muscle)
    root = scipy.optimize.root(
        lambda x: numpy_tendon(p, x - x_z) - numpy_belly(p, x, 0.0), x_z + 1e-3, tol=1e-10
    )
    assert root.success and abs(root.fun[0]) < 1e-9 * p["force_max"]
    y = jm.response.equilibrium(task)
    np.testing.assert_allclose(y, [root.x[0], 0.0], rtol=1e-8, atol=1e-12)
    force = task.output(15.0, y, jnp.zeros(4), jnp.zeros(4))
    np.testing.assert_allclose(force, numpy_tendon(p, root.x[0] - x_z), rtol=1e-8)


def test_a_muscle_that_cannot_be_is_refused():
    for name in (
        "force_max",
        "optimal_length",
        "slack_length",
        "velocity_max",
        "tendon_strain",
        "m_w",
        "m_z",
    ):
        with pytest.raises(ValueError, match=rf"{name} = 0\.0 must be positive"):
            HillMuscle(**{name: 0.0})
    for name in ("activation", "pennation", "tendon_damping"):
        with pytest.raises(ValueError, match=rf"{name} = -0\.1 must not be negative"):
            HillMuscle(**{name: -0.1})
    with pytest.raises(ValueError, match=r"pennation = 9\.2 rad must be below"):
        jm.Isometric(muscle=HillMuscle()).replace(pennation=9.2)


def test_a_task_with_an_own_muscle_is_saved_and_read(tmp_path):
    task = jm.Isometric(5.0, muscle=HillMuscle(pennation=0.2))
    task.save(tmp_path / "hill.toml")
    assert jm.load_preset(tmp_path / "hill.toml") == task
    with pytest.raises(ValueError, match="a class of your own must be imported first"):
        text = (tmp_path / "hill.toml").read_text().replace("HillMuscle", "NowhereMuscle")
        (tmp_path / "other.toml").write_text(text)
        jm.load_preset(tmp_path / "other.toml")


@pytest.mark.slow
def test_activation_and_drive_go_together():
    task = hill.at_activation(jm.Isometric(muscle=HillMuscle(pennation=0.0)), 0.4)
    assert task["activation"] == 0.4 and task["P_w"] == pytest.approx(0.4 * 33.75)
    # the defaults agree
    assert jm.Isometric()["P_w"] == pytest.approx(float(HillMuscle().held_force), rel=1e-3)
    motion = hill.at_activation(jm.PrescribedMotion(muscle=HillMuscle()), 0.4)
    assert motion["activation"] == 0.4 and "P_w" not in motion.parameter_names


# --- simulation


def quiet(task, **values):
    return references.quiet(task, **values)


def input_at(t, level):
    return references.smooth_step(t, level, 0.2, 0.5)


def rhythm(task, t):
    """u of the harmonic, the base coefficients by differences of the NumPy forces about the NumPy
    equilibrium."""
    p, h = {name: float(value) for name, value in task.parameters.items()}, 1e-6
    x = scipy.optimize.brentq(
        lambda x: numpy_tendon(p, x) - numpy_belly(p, x, 0.0), 0.0, 0.01, xtol=1e-16
    )
    ahead, behind = (np.array(numpy_forces(p, x + s, 0.0, 0.0, 0.0)) for s in (h, -h))
    K = (ahead - behind) / (2 * h) * [1, -1]
    sine = p["harmonic_amplitude"] * np.sin(2 * np.pi * p["harmonic_frequency"] * t)
    return np.array([K[0] * sine, K[1] * sine, 0.0, 0.0, 0.0])


TASKS = {
    "isometric": lambda **parts: jm.Isometric(SmoothStep(5.0, 0.2, 0.5), 0.002, **parts),
    "force": lambda **parts: jm.PrescribedForce(
        SmoothStep(5.0, 0.2, 0.5), SmoothStep(4.5, 0.2, 0.5), **parts
    ),
    "motion": lambda **parts: jm.PrescribedMotion(
        SmoothStep(-0.002, 0.2, 0.5), SmoothStep(4.5, 0.2, 0.5), **parts
    ),
}


SHORT = {"seeds": 8, "duration": 0.8, "dt": 2e-3, "chunk": 8}


def numpy_field(name, p):
    """Right-hand side of the equations of motion, u a function of time."""

    def field(t, y, u):
        if name == "isometric":
            active, passive = numpy_forces(p, y[0], y[1], 0.002, 0.0, u)
            return [y[1], (input_at(t, 5.0) - active + passive) / p["m_w"]]
        active, passive = numpy_forces(p, *y, u)
        return [
            y[1],
            (input_at(t, 5.0) - active + passive) / p["m_w"],
            y[3],
            -(input_at(t, 4.5) + passive) / p["m_z"],
        ]

    return field


@pytest.mark.slow
@pytest.mark.parametrize("amplitude", [0.0, 0.05])
@pytest.mark.parametrize("name", ["isometric", "force"])
def test_simulation_is_the_solution_of_the_equations(x64, name, amplitude):
    task = quiet(TASKS[name](muscle=HillMuscle()), harmonic_amplitude=amplitude)
    p = {key: float(value) for key, value in task.parameters.items()}
    times, field, unit = (
        np.linspace(0.0, 1.2, 121),
        numpy_field(name, p),
        rhythm(task, 1 / (4 * 4.25)),
    )

    def rhs(t, y):
        return field(t, y, unit * np.sin(2 * np.pi * 4.25 * t))

    exact = references.solve_ode(rhs, np.zeros(len(task.state_names)), times)
    runs = [jm.simulate(task, KEY, duration=1.2, substeps=n) for n in (8, 16)]
    errors = [np.abs(np.asarray(run.states) - exact).max(axis=0) for run in runs]
    # Heun's method: second order, and at 16 sub-steps, λ h = 0.09, an error of about (λ h)²/6 of
    # what moves at that rate.
    scale = np.abs(exact).max(axis=0)
    assert np.all(errors[1] < 2e-3 * scale)
    assert np.all(errors[0] / errors[1] > 3.0)


@pytest.mark.slow
def test_prescribed_motion_is_the_inverse_problem(x64):
    task = TASKS["motion"](muscle=HillMuscle())
    p = {key: float(value) for key, value in task.parameters.items()}
    rng, h = np.random.default_rng(4), 1e-7

    def motion(t):
        return references.smooth_step_derivatives(t, -0.002, 0.2, 0.5)

    def velocity(t, x_w, u):
        x_z, v_z, a_z = motion(t)
        pull = input_at(t, 4.5) + p["m_z"] * a_z
        elastic = numpy_tendon(p, x_w - x_z) + u[1] * (x_w - x_z)
        return v_z + (pull - elastic) / (p["tendon_damping"] + u[3])

    fields = kept_jit(lambda t, y, u, du: (task.vector_field(t, y, u), task.output(t, y, u, du)))
    for t in (0.3, 0.45, 3.0):
        u, du = rng.normal(size=5) * [20, 90, 5, 1, 0.2], rng.normal(size=5) * [99, 99, 9, 9, 2]
        x_w = -0.001 + 1e-3 * rng.normal()
        v_w = velocity(t, x_w, u)
        ahead, behind = (velocity(t + s, x_w + s * v_w, u + s * du) for s in (h, -h))
        active, _ = numpy_forces(p, x_w, v_w, 0.0, 0.0, u)
        P_w = (
            p["m_w"] * (ahead - behind) / (2 * h)
            + active
            + p["m_z"] * motion(t)[2]
            + input_at(t, 4.5)
        )
        moved, asked = fields(t, np.array([x_w]), u, du)
        np.testing.assert_allclose(moved, [v_w], rtol=1e-9)
        np.testing.assert_allclose(asked, P_w, rtol=1e-6)  # differences: h² and 1e-16 v / h


@pytest.mark.slow
def test_own_muscles_run_at_scale(tmp_path):
    """A reduced, stored sweep over a parameter that only this muscle has."""
    sweep = jm.ensembles.Sweep.grid(
        TASKS["isometric"](muscle=HillMuscle()), velocity_max=[3.6, 4.2]
    )
    options = SHORT | {"seeds": 12}
    found = jm.ensemble(sweep, KEY, reduce=True, store=tmp_path / "hill.zarr", **options)
    for point, task in enumerate(sweep):
        output = np.asarray(jm.ensemble(task, KEY, **options).output, float)
        np.testing.assert_allclose(found.mean[point], output.mean(axis=0), atol=1e-6 * output.max())
    np.testing.assert_array_equal(found.to_xarray()["velocity_max"], [3.6, 4.2])


# --- spectra, gradients, fits


def derivatives(function, at, h):
    """By the forward mode, by the reverse mode, and by differences: one program for values and
    slopes, near and at `at`."""
    n, steps = len(at), h * np.diag(np.asarray(at))
    points, along = at + np.concatenate([0 * steps, steps, -steps]), np.concatenate([np.eye(n)] * 3)
    values, slopes = at_once(
        lambda *x: jax.lax.map(lambda x: jax.jvp(function, x[:1], x[1:]), x), points, along
    )
    _, ahead, behind = np.split(np.asarray(values), 3)
    reverse = at_once(jax.grad(function), at)
    return np.asarray(slopes)[:n], reverse, (ahead - behind) / (2 * steps.sum(axis=1))


@pytest.mark.slow
def test_gradients_of_the_spectrum(x64):
    names, h = ("velocity_max", "tendon_strain", "activation", "pennation", "noise_K_z"), 1e-4
    task = hill.held_task()
    at = jnp.array([float(task[name]) for name in names])

    def power(values):
        return jm.expected_spectrum(task.replace(**dict(zip(names, values, strict=True)))).power[10]

    forward, reverse, difference = derivatives(power, at, h)
    np.testing.assert_allclose(forward, reverse, rtol=1e-8)
    # h² = 1e-8 times third derivatives of order one; equilibrium to 1e-12.
    np.testing.assert_allclose(forward, difference, rtol=1e-5)


@pytest.mark.slow
def test_gradients_of_a_simulation(x64):
    task = TASKS["isometric"](muscle=HillMuscle())

    def moved(values):
        run = jm.simulate(
            task.replace(velocity_max=values[0], tendon_strain=values[1]),
            KEY,
            duration=0.6,
            substeps=4,
        )
        return jnp.sum(run.output[30:] ** 2)

    at = jnp.array([3.6, 0.04])
    forward, reverse, difference = derivatives(moved, at, 1e-5)
    np.testing.assert_allclose(forward, reverse, rtol=1e-9)
    np.testing.assert_allclose(forward, difference, rtol=1e-6)


@pytest.mark.slow
def test_the_mean_of_simulations_is_the_linear_response(x64):
    # started settled; by 0.5 s the slowest motion of the held belly is e^-40 of its start
    z, window = [], (0.5, 5.62)
    for i, noise in enumerate(
        (jm.BandLimitedNoise(), jm.OrnsteinUhlenbeckNoise({"K_w": 0.15, "K_z": 0.005}))
    ):
        task = hill.held_task(noise=noise)
        key = jax.random.fold_in(KEY, i)
        runs = jm.ensemble(
            task.settled(), key, seeds=320, duration=window[1], dt=1.25e-3, control=False
        )
        power = np.asarray(runs.spectrum(window=window).power)
        expected = np.asarray(jm.expected_spectrum(task.settled(), window=window).power)
        z.append(
            (power.mean(axis=0) - expected) / (power.std(axis=0, ddof=1) / np.sqrt(len(power)))
        )
    # 320 seeds: 3 % per bin, several times what second order adds (measured with the control
    # variate: below 1 %).
    references.assert_standard_normal(z, every=3)


@pytest.mark.slow
@pytest.mark.parametrize("time", [0.0, 0.05])
def test_a_noisy_drive_multiplies_the_activation(x64, time):
    """By differences of the NumPy forces: F_act n drives m x'' + (C_w + c_T) x' + (K_w + K_z) x,
    felt through the tendon."""
    activation = jm.Activation(time) if time else None
    task = hill.held_task(
        noise=jm.ResonantNoise(0.02, 6.0, 2.0), harmonic=jm.Harmonic(0.0), activation=activation
    )
    p, x_z, h = numpy_values(task.muscle), 0.005, 1e-6
    x = scipy.optimize.brentq(
        lambda x: numpy_tendon(p, x - x_z) - numpy_belly(p, x, 0.0), x_z, x_z + 0.01, xtol=1e-16
    )
    slope = lambda along: (along(h) - along(-h)) / (2 * h)  # noqa: E731
    K_w, C_w = slope(lambda d: -numpy_belly(p, x + d, 0.0)), slope(lambda d: -numpy_belly(p, x, d))
    K_z, pull = (
        slope(lambda d: numpy_tendon(p, x + d - x_z)),
        numpy_belly(p, x, 0.0, 1.0) - numpy_belly(p, x, 0.0),
    )

    def density(f):
        s = 2j * np.pi * f
        passive = (p["tendon_damping"] * s + K_z) / (
            p["m_w"] * s**2 + (C_w + p["tendon_damping"]) * s + K_w + K_z
        )
        tremor = 0.02**2 * 2.0 / np.pi * f**2 / ((36.0 - f**2) ** 2 + (2.0 * f) ** 2)
        return np.abs(pull * passive / (1 + s * time) ** 2) ** 2 * tremor

    # Differences: h² f''' / 6 and 1e-16 / h; aliases from beyond a thousand sampling rates.
    np.testing.assert_allclose(
        jm.expected_spectrum(task).power, references.expected_welch(density), rtol=1e-6
    )


@pytest.mark.slow
def test_the_page_runs_and_its_fit_finds_the_muscle(monkeypatch):
    """Every Python block of docs/own-muscle.md, in order, from the root of a checkout.

    Without the fit's nonlinear correction, simulated check and intervals: the notebook on own
    muscles has these.
    """
    monkeypatch.chdir(DOCS.parent)
    monkeypatch.setattr(sys, "path", [*sys.path])
    linear = {"starts=8\n": "starts=8, seeds=0, check_seeds=0\n"}
    with without_intervals():
        result = pages.run("docs/own-muscle.md", smaller=linear)["result"]
    assert result.success, result.message
    found = result.parameters["velocity_max"]
    assert found.identifiable and found.stderr is not None
    # One draw of a synthetic recording: within 3.3 standard errors with 99.9 %; and it moved from
    # its start, 3.6.
    assert abs(found.value - 2.0) < 3.3 * found.stderr
    assert found.stderr < 0.3
