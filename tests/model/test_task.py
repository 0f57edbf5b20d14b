"""The tasks: which noise and inputs each allows, the inverse problem's output, static
equilibria."""

import json
import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import references

import jaxmuscle as jm
from jaxmuscle._common.errors import OperatingPointError
from jaxmuscle.model import Constant, Decay, RampHold, Sampled, SmoothStep

KEY = jax.random.key(3)
TASKS = (jm.PrescribedMotion, jm.PrescribedForce, jm.Isometric)
CHANNELS = ("K_w", "K_z", "C_w", "C_z")
ALLOWED = {
    jm.PrescribedMotion: {
        jm.WhiteNoise: "",
        jm.OrnsteinUhlenbeckNoise: "K_w C_w",
        jm.BandLimitedNoise: "K_w K_z C_w C_z",
    },
    jm.PrescribedForce: {
        jm.WhiteNoise: "K_w K_z C_w C_z",
        jm.OrnsteinUhlenbeckNoise: "K_w K_z C_w C_z",
        jm.BandLimitedNoise: "K_w K_z C_w C_z",
    },
    jm.Isometric: {
        jm.WhiteNoise: "K_w C_w",
        jm.OrnsteinUhlenbeckNoise: "K_w K_z C_w C_z",
        jm.BandLimitedNoise: "K_w K_z C_w C_z",
    },
}


@pytest.mark.parametrize("kind", [jm.WhiteNoise, jm.OrnsteinUhlenbeckNoise, jm.BandLimitedNoise])
@pytest.mark.parametrize("task", TASKS)
def test_each_task_takes_the_noise_it_can_sample(task, kind):
    allowed = ALLOWED[task][kind].split()
    for channel in CHANNELS:
        if channel in allowed:
            assert task(noise=kind({channel: 0.01}))[f"noise_{channel}"] == 0.01
            continue
        reason = (
            "differentiable in time"
            if task is jm.PrescribedMotion and channel[1:] == "_z"
            else "directly in the out"
        )
        pattern = (
            rf"{kind.__name__} on {channel} .*{task.__name__}.*{reason}.*BandLimitedNoise, or set"
            rf" noise_{channel} = 0"
        )
        with pytest.raises(ValueError, match=pattern):
            task(noise=kind({channel: 0.01}))
        silent = task(noise=kind(0.0))
        with pytest.raises(ValueError, match=pattern):
            silent.replace(**{f"noise_{channel}": 0.01})


def test_white_noise_in_the_output_is_refused_by_default():
    with pytest.raises(ValueError, match="WhiteNoise on K_z"):
        jm.Isometric(noise=jm.WhiteNoise())
    jm.PrescribedForce(noise=jm.WhiteNoise())


def test_the_acceleration_contains_the_noise_of_the_passive_tissue():
    """White noise on K_z and C_z has no value at an instant; that on K_w, C_w and the drive is
    smoothed on its way."""
    for channel in ("K_z", "C_z"):
        with pytest.raises(
            ValueError, match=rf"WhiteNoise on {channel} .* directly in the output a_z.*BandLimited"
        ):
            jm.PrescribedForce(noise=jm.WhiteNoise({channel: 0.01}), observe="acceleration")
        jm.PrescribedForce(noise=jm.OrnsteinUhlenbeckNoise({channel: 0.01}), observe="acceleration")
    jm.PrescribedForce(noise=jm.WhiteNoise((0.01, 0.0, 0.01, 0.0, 0.01)), observe="acceleration")


def test_what_is_observed_of_a_motion():
    moved, felt = jm.PrescribedForce(), jm.PrescribedForce(observe="acceleration")
    assert (moved.output_name, moved.output_unit, moved.quantity) == ("x_z", "m", "displacement")
    assert (felt.output_name, felt.output_unit, felt.quantity) == ("a_z", "m/s^2", "acceleration")
    assert jm.Isometric().quantity == jm.PrescribedMotion().quantity == "force"
    assert felt.replace(k_w=4e5).observe == "acceleration"
    assert felt.with_parts(observe="displacement") == moved
    assert (
        jm.Isometric().as_task(jm.PrescribedForce, observe="acceleration").quantity
        == "acceleration"
    )
    # Here jaxtyping's check of the type is first.
    with pytest.raises((ValueError, TypeError), match="'velocity'"):
        jm.PrescribedForce(observe="velocity")  # pyright: ignore[reportArgumentType]


def test_the_acceleration_is_equation_1b(x64):
    task = jm.PrescribedForce(5.0, SmoothStep(6.0, 0.3, 1.2), observe="acceleration").replace(
        m_z=0.7, c_z=8.0
    )
    p = {name: float(value) for name, value in task.parameters.items()}
    rng = np.random.default_rng(5)
    for t in (0.1, 0.8, 3.0):
        y, u = rng.normal(size=4) * [0.03, 0.5, 0.03, 0.5], rng.normal(size=5) * [20, 20, 5, 1, 0.1]
        _, expected = references.accelerations(
            p, y, 0.0, references.smooth_step(t, 6.0, 0.3, 1.2), u
        )
        np.testing.assert_allclose(
            task.output(t, jnp.asarray(y), jnp.asarray(u), jnp.ones(5)), expected, rtol=1e-12
        )


def test_what_is_observed_is_saved(tmp_path):
    task = jm.PrescribedForce(5.0, 1.0, observe="acceleration")
    task.save(tmp_path / "task.toml")
    assert jm.load_preset(tmp_path / "task.toml") == task
    text = (tmp_path / "task.toml").read_text()
    (tmp_path / "less.toml").write_text(text.replace('observe = "acceleration"', ""))
    with pytest.raises(jm.errors.PresetError, match=r"less.toml: task has no key 'observe'"):
        jm.load_preset(tmp_path / "less.toml")
    (tmp_path / "wrong.toml").write_text(
        text.replace('observe = "acceleration"', 'observe = "velocity"')
    )
    with pytest.raises(jm.errors.PresetError, match=r'wrong.toml: task.observe = "velocity"'):
        jm.load_preset(tmp_path / "wrong.toml")


@pytest.mark.parametrize(
    "moved",
    [
        SmoothStep(-0.002, 1.0, 0.5),
        Sampled.through(np.linspace(0, 15, 31), 1e-3 * np.sin(np.arange(31.0))),
    ],
    ids=["step", "sampled"],
)
def test_a_moved_insertion_is_saved(tmp_path, moved):
    task = jm.PrescribedLength(x_z=moved, P_w=8.0).replace(m_z=0.62)
    task.save(tmp_path / "task.toml")
    loaded = jm.load_preset(tmp_path / "task.toml")
    assert eqx.tree_equal(loaded, task) and isinstance(loaded, jm.PrescribedLength)
    times = np.linspace(0.0, 15.0, 7)
    np.testing.assert_array_equal(jax.vmap(loaded.x_z)(times), jax.vmap(moved)(times))


def test_motion_needs_damping_of_the_passive_tissue():
    for values in ({"c_z": 0.0}, {"v_ref_z": 0.0}):
        with pytest.raises(ValueError, match="C_z0 = c_z v_ref_z\\^2 = 0: in PrescribedMotion"):
            jm.PrescribedMotion().replace(**values)
        assert jm.PrescribedForce().replace(**values)["k_z"] > 0


def test_motion_needs_smooth_inputs():
    with pytest.raises(
        ValueError, match="x_z is a Decay with 1 continuous derivatives; PrescribedMotion needs 3"
    ):
        jm.PrescribedMotion(Decay(0.01))
    jm.PrescribedMotion(RampHold(0.01), Decay(5.0))


@pytest.mark.parametrize("t", [0.2, 0.8, 1.2, 5.0])
def test_the_output_of_motion_is_equation_1a(x64, t):
    """P_w = m_w x_w'' + C_w x_w' + K_w x_w + m_z x_z'' + F_ext, x_w'' by differences of a NumPy
    x_w'(t, x_w, u)."""
    task = jm.PrescribedMotion(SmoothStep(0.01), SmoothStep(6.0, 0.3, 1.2)).replace(
        c_z=8.0, m_z=0.7, k_z=4e5
    )
    p = {name: float(value) for name, value in task.parameters.items()}
    rng = np.random.default_rng(5)

    def velocity(s, x_w, u):
        return references.contraction(
            p,
            x_w,
            references.smooth_step_derivatives(s, 0.01),
            references.smooth_step(s, 6.0, 0.3, 1.2),
            u,
        )

    for _ in range(5):
        x_w, u, du = (
            0.03 * rng.normal(),
            rng.normal(size=4) * [20, 20, 5, 1],
            rng.normal(size=4) * [900, 900, 99, 20],
        )
        v_w, h = velocity(t, x_w, u), 1e-6
        ahead, behind = (velocity(t + s, x_w + s * v_w, u + s * du) for s in (h, -h))
        K_w, _, C_w, _ = references.coefficients(p, x_w, v_w, 0.0, 0.0, u)
        a_z, pulled = (
            references.smooth_step_derivatives(t, 0.01)[2],
            references.smooth_step(t, 6.0, 0.3, 1.2),
        )
        P_w = (
            p["m_w"] * (ahead - behind) / (2 * h) + C_w * v_w + K_w * x_w + p["m_z"] * a_z + pulled
        )
        y, u, du = jnp.array([x_w]), jnp.asarray(u), jnp.asarray(du)
        np.testing.assert_allclose(task.vector_field(t, y, u), [v_w], rtol=1e-10)
        # Differences: h² relative to the times in which inputs change, and rounding 1e-16 / h of
        # velocities.
        np.testing.assert_allclose(task.output(t, y, u, du), P_w, rtol=1e-7, atol=1e-6)


def real_root(*polynomial):
    roots = np.roots(polynomial)
    (root,) = roots[np.abs(roots.imag) < 1e-12].real
    return root


def static_motion(p):
    x_w = p["x_z"] + p["F_ext"] / (p["k_z"] * (p["x_ref_z"] ** 2 + p["x_z"] ** 2))
    return [x_w], p["k_w"] * (p["x_ref_w"] ** 2 + x_w**2) * x_w + p["F_ext"]


def static_force(p):
    x_w = real_root(p["k_w"], 0, p["k_w"] * p["x_ref_w"] ** 2, p["F_ext"] - p["P_w"])
    # k_z (x_ref² + x_z²) (x_z - x_w) = -F_ext
    x_z = real_root(1, -x_w, p["x_ref_z"] ** 2, p["F_ext"] / p["k_z"] - x_w * p["x_ref_z"] ** 2)
    return [x_w, 0.0, x_z, 0.0], x_z


def static_isometric(p):
    K_z = p["k_z"] * (p["x_ref_z"] ** 2 + p["x_z"] ** 2)
    x_w = real_root(p["k_w"], 0, p["k_w"] * p["x_ref_w"] ** 2 + K_z, -p["P_w"] - K_z * p["x_z"])
    return [x_w, 0.0], K_z * (x_w - p["x_z"])


STATIC = [
    (jm.PrescribedMotion(0.004, 10.0), static_motion),
    (jm.PrescribedForce(5.0, 0.0), static_force),
    (jm.PrescribedForce(6.0, 2.0), static_force),
    (jm.Isometric(5.0, 0.0), static_isometric),
    (jm.Isometric(5.0, -0.006), static_isometric),
]


@pytest.mark.parametrize("task, static", STATIC)
def test_without_noise_everything_settles_at_the_roots_of_the_statics(x64, task, static):
    task = references.quiet(task, harmonic_amplitude=0.0, k_w=4e5, k_z=6e5, x_ref_z=0.015)
    states, output = static({name: float(value) for name, value in task.parameters.items()})
    run = jm.simulate(task, KEY, duration=15.0)
    # The slowest mode decays as e^{-3 t} or faster: over 13 s by 1e-17.
    np.testing.assert_allclose(run.states[-1], states, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(run.output[-1], output, rtol=1e-6)
    np.testing.assert_allclose(jm.response.equilibrium(task), states, rtol=1e-9, atol=1e-12)


def test_without_external_force_both_tissues_move_together(x64):
    task = references.quiet(jm.PrescribedForce(5.0), harmonic_amplitude=0.0)
    # k (x_ref² + x²) x = P
    expected = real_root(5e5, 0.0, 5e5 * 0.02**2, -5.0)
    np.testing.assert_allclose(jm.simulate(task, KEY).state("x_z")[-1], expected, rtol=1e-6)


def test_an_operating_point_that_does_not_exist_is_an_error():
    task = jm.PrescribedForce(5.0).replace(k_w=0.0)
    with pytest.raises(
        OperatingPointError, match=r"PrescribedForce has no equilibrium at t = 15.0 s"
    ):
        jm.response.linearise(task)


def test_eigenvalues_at_rest_are_those_of_the_linear_chain(x64):
    task = jm.PrescribedForce(Constant(0.0))
    p = {name: float(value) for name, value in task.parameters.items()}
    K, C = 200.0, np.array([60.0, 5.0])
    stiffness, damping = (
        np.array([[2 * K, -K], [-K, K]]),
        np.array([[C[0] + C[1], -C[1]], [-C[1], C[1]]]),
    )
    inverse = np.diag([1 / p["m_w"], 1 / p["m_z"]])
    chain = np.block([[np.zeros((2, 2)), np.eye(2)], [-inverse @ stiffness, -inverse @ damping]])
    eigenvalues = np.linalg.eigvals(jm.response.linearise(task).A)
    np.testing.assert_allclose(
        np.sort_complex(eigenvalues), np.sort_complex(np.linalg.eigvals(chain)), rtol=1e-8
    )


def test_displacement_at_constant_force_oscillates_about_the_equilibrium(x64):
    task = jm.PrescribedForce(5.0, noise=jm.BandLimitedNoise(0.0016), harmonic=jm.Harmonic(4e-4))
    runs = jm.ensemble(task, KEY, seeds=64)
    expected = real_root(5e5, 0.0, 5e5 * 0.02**2, -5.0)
    # 34 whole periods of the harmonic, after the inputs' transients e^{-3 t}. What multiplicative
    # noise adds to the mean is of second order, here (5e-8 of the displacement) a fiftieth of a
    # standard error.
    displacement = np.asarray(runs.between((7.0, 15.0)))
    means = displacement.mean(axis=1)
    error = means.std(ddof=1) / np.sqrt(len(means))
    assert error < 1e-5 * expected
    assert abs(means.mean() - expected) < 3.3 * error
    crossings = np.sum(np.diff(np.sign(displacement - expected), axis=1) != 0, axis=1)
    assert np.all(crossings > 8)  # more than one per second: it oscillates
    assert np.all(displacement.std(axis=1) > 1e-5 * expected)


WRONG_PARTS = {
    "jm.Isometric(noise=jm.PinkNoise)": "noise = the class PinkNoise: give an object",
    "jm.Isometric(noise=0.1)": "noise = 0.1: give an object, as jaxmuscle.PinkNoise",
    "jm.Isometric(noise='purple')": "noise = 'purple': known are white",
    "jm.Isometric().replace(noise='pink')": "use task.with_parts(noise=...)",
    "jm.Isometric(harmonic=3.0)": "harmonic = 3.0: give an object, as jaxmuscle.Harmonic",
    "jm.Isometric(activation=0.06)": "activation = 0.06: give an object, as jaxmuscle.Activation",
    "jm.Isometric(settings='slow')": (
        "settings = 'slow': give an object, as jaxmuscle.SpectrumSettings.named('slow')"
    ),
    "jm.Isometric(muscle='hill')": "muscle = 'hill': give an object",
    "jm.Isometric(k_w=1 + 2j)": "k_w = (1+2j): give a number",
    "jm.PrescribedLength(x_z=np.zeros(9))": "array of shape (9,): give a number or a signal",
    "jm.Isometric(P_w=lambda t: 5.0)": "an input is a function: give a number or a signal",
    "jm.Isometric(x_z=jm.model.SmoothStep(0.01))": (
        "Isometric holds the insertion, so this is a number; PrescribedLength"
    ),
    "jm.simulate(jm.Isometric(), 0, seed=[1, 2])": (
        "For several use jaxmuscle.ensemble(task, key, seeds=...)"
    ),
    "jm.expected_spectrum(jm.Isometric(), window=(9.0, 5.0))": (
        "window = (9.0, 5.0): give its start"
    ),
    "jm.expected_spectrum(jm.Isometric(), 'slow')": "as SpectrumSettings.named('slow')",
    "jax.jit(lambda n: jm.simulate(jm.Isometric(), 0, substeps=n).output)(2)": (
        "substeps is traced by JAX"
    ),
}
TRIED = """
import json, sys
import jax, numpy as np, jaxmuscle as jm
for expression in json.load(sys.stdin):
    try:
        eval(expression)
        print("nothing was raised")
    except ValueError as error:
        print(str(error).replace("\\n", " "))
"""


def test_what_cannot_be_a_part_of_a_task_or_its_call_is_named():
    """In a process without the type checks of the tests, which would come first."""
    ran = subprocess.run(
        [sys.executable, "-c", TRIED],
        input=json.dumps([*WRONG_PARTS]),
        capture_output=True,
        text=True,
        check=True,
    )
    for (expression, message), said in zip(
        WRONG_PARTS.items(), ran.stdout.splitlines(), strict=True
    ):
        assert message in said, expression


@pytest.mark.parametrize(
    ("kind", "name", "value"),
    [
        (jm.Isometric, "m_w", 0.0),
        (jm.PrescribedForce, "m_z", 0.0),
        (jm.Isometric, "harmonic_frequency", 0.0),
        (jm.Isometric, "noise_cutoff", 0.0),
        (jm.Isometric, "k_w", np.inf),
        (jm.Isometric, "P_w", np.nan),
        (jm.Isometric, "x_z", np.inf),
        (jm.PrescribedForce, "F_ext", np.nan),
    ],
)
def test_a_constructor_refuses_what_replace_refuses(kind, name, value):
    for make in (lambda: kind(**{name: value}), lambda: kind().replace(**{name: value})):
        with pytest.raises(
            ValueError, match=f"{name} = {value}.*(must be positive|give a finite number)"
        ):
            make()


def test_a_class_of_tasks_says_what_it_gives():
    class Own(jm.model.AbstractTask):
        def vector_field(self, t, y, u):
            return y

        def output(self, t, y, u, du):
            return y[0]

    with pytest.raises(
        ValueError,
        match=r"Own does not say its state_names, state_units, output_name, .* as class variables",
    ):
        Own()


def test_several_tasks_in_one_are_refused_by_name():
    """As `jax.vmap` returns them; inside it each is one."""
    several = jax.vmap(lambda k: jm.Isometric().replace(k_w=k))(jnp.array([4e5, 5e5]))
    for call in (
        lambda t: jm.simulate(t, KEY),
        lambda t: jm.ensemble(t, KEY, seeds=2),
        jm.expected_spectrum,
    ):
        with pytest.raises(
            ValueError,
            match=r"task: these are several tasks in one, .* jaxmuscle\.ensembles\.Sweep",
        ):
            call(several)
    assert jax.vmap(lambda t: t.replace(c_w=1.0)["k_w"])(several).tolist() == [4e5, 5e5]


def test_a_tree_of_other_things_in_the_shape_of_a_task_prints():
    shapes = jax.tree.map(np.shape, jm.Isometric())
    assert repr(shapes).startswith("Isometric(") and repr(shapes.noise).startswith(
        "BandLimitedNoise(amplitude=(4,)"
    )
