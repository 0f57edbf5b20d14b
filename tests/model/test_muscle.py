"""The muscle against equations (1) and (2) written out in NumPy; laws, names and checks."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import references
from compiled import at_once
from jaxtyping import Array, Float

import jaxmuscle as jm
from jaxmuscle._common.types import Scalar
from jaxmuscle.model._parameters import DEFAULT_FREE, PARAMETERS, default

MUSCLE = {name: PARAMETERS[name].default for name in list(PARAMETERS)[:10]}
TASKS = (jm.PrescribedMotion, jm.PrescribedForce, jm.Isometric)
STILL = np.zeros(4)


class Tendon(jm.model.AbstractLaw):
    """Exponential toe region: `K(x) = stiff exp(toe x)`."""

    stiff: Scalar = 200.0
    toe: Scalar = 30.0

    def __call__(self, q):
        return self.stiff * jnp.exp(self.toe * q)


class Own(jm.model.AbstractMuscle):
    """A linear muscle without the method that only `PrescribedMotion` needs."""

    m_w: Scalar = 0.5
    m_z: Scalar = 0.4

    def base(self):
        return jnp.array([150.0, 150.0, 20.0, 10.0])

    def active_force(self, x_w, v_w, u):
        return (150.0 + u[0]) * x_w + (20.0 + u[2]) * v_w

    def passive_force(self, x_w, v_w, x_z, v_z, u):
        return (150.0 + u[1]) * (x_z - x_w) + (10.0 + u[3]) * (v_z - v_w)


@pytest.mark.parametrize(
    "method, wrong, message",
    [
        (
            "active_force",
            lambda self, x, v, u: jnp.stack([x, v]),
            r"force\(x_w, v_w, u\) returns float32 of shape \(2,\)",
        ),
        (
            "active_force",
            lambda self, x, v, u: None,
            "returns a NoneType; it must return one floating-point number",
        ),
        (
            "active_force",
            lambda self, x, v, u: x if x > 0 else v,
            r"decides .* by values.*jnp\.where",
        ),
        ("active_force", lambda self, x, v, u: np.sin(x), "with `if`, float\\(\\) or numpy"),
        (
            "active_force",
            lambda self, x, v: x,
            r"cannot be computed: TypeError: .*calls it with one number for each",
        ),
        (
            "passive_force",
            lambda self, x, v, z, w, u: self.stifness * x,
            "AttributeError: 'Wrong' object has no .*stifness",
        ),
        (
            "base",
            lambda self: [150.0, 150.0, 20.0, 10.0],
            r"base\(\) returns a list; it must return an array of four",
        ),
        ("base", lambda self: jnp.ones(3), r"base\(\) returns float32 of shape \(3,\)"),
        (
            "contraction_velocity",
            lambda self, x, z, w, F, u: w + (F - 150.0 * (z - x)) / 10.0,
            "is not the inverse of",
        ),
    ],
)
def test_a_muscle_of_ones_own_is_looked_at(method, wrong, message):
    """And once found good it is taken; a class without the fourth method by every task but one."""
    with pytest.raises(ValueError, match=message):
        jm.Isometric(muscle=type("Wrong", (Own,), {method: wrong})())
    assert (
        jm.Isometric(muscle=Own()).muscle == Own()
        and jm.PrescribedForce(muscle=Own())["m_z"] == 0.4
    )
    with pytest.raises(
        ValueError, match="Own has no method contraction_velocity, which PrescribedMotion needs"
    ):
        jm.PrescribedMotion(muscle=Own())
    assert jax.jit(lambda m: jm.Isometric(muscle=Own(m))["m_w"])(0.3) == pytest.approx(0.3)


@pytest.mark.parametrize(
    "wrong, message",
    [
        (lambda self: 1.0, r"Law\.__call__\(q\) cannot be computed: TypeError"),
        (
            lambda self, q: 100,
            r"Law\.__call__\(q\) returns int32 of shape \(\); it must return .* \[N/m or N s/m\]",
        ),
        (lambda self, q: jnp.ones(2) * q, r"Law\.__call__\(q\) returns float32 of shape \(2,\)"),
        (lambda self, q: q if q > 0 else 0.0, r"decides .* by values.*jnp\.where"),
    ],
)
def test_a_law_of_ones_own_is_looked_at(wrong, message):
    law = type("Law", (jm.model.AbstractLaw,), {"__call__": wrong})()
    with pytest.raises(ValueError, match=message):
        jm.Isometric(muscle=jm.Muscle(stiffness_w=law))


@pytest.mark.parametrize(
    "name", ["P_w", "noise", "noise_K_w", "harmonic_frequency", "activation_time"]
)
def test_a_field_of_an_own_muscle_hides_nothing(name):
    named = type("Named", (Own,), {"__annotations__": {name: float}, name: 1.0})
    with pytest.raises(
        ValueError, match=rf"Named\.{name}: a task has something of this name itself"
    ):
        jm.Isometric(muscle=named())


def random_states(count=20):
    rng = np.random.default_rng(1)
    states = rng.normal(size=(count, 4)) * [0.03, 0.5, 0.03, 0.5]
    return zip(states, rng.normal(size=(count, 4)) * [50, 50, 5, 1], strict=True)


@pytest.mark.parametrize("argument", ["literal", "elongation"])
def test_equations_1_and_2(x64, argument):
    task = jm.PrescribedForce(
        jm.model.Constant(3.0), jm.model.Constant(-0.7), muscle=jm.Muscle(argument=argument)
    )
    for y, u in random_states():
        a_w, a_z = references.accelerations(MUSCLE, y, 3.0, -0.7, u, argument)
        field = task.vector_field(0.3, jnp.asarray(y), jnp.asarray(u))
        np.testing.assert_allclose(field, [y[1], a_w, y[3], a_z], rtol=1e-12)
        assert task.output(0.3, jnp.asarray(y), jnp.asarray(u), jnp.asarray(u)) == y[2]


def test_the_arguments_differ(x64):
    y = jnp.array([0.02, 0.1, 0.01, 0.5])
    literal, elongation = (
        jm.Muscle(argument=a).passive_force(y[0], y[1], y[2], y[3], jnp.zeros(4))
        for a in ("literal", "elongation")
    )
    assert abs(literal - elongation) > 0.1


def test_isometric_is_the_same_muscle_with_its_insertion_held(x64):
    held = 0.004
    task = jm.Isometric(jm.model.Constant(3.0), held)
    for y, u in random_states():
        state = np.array([y[0], y[1], held, 0.0])
        # Held means x_z'' = 0, so that (1b) gives the force at the sensor.
        a_w, pulled = references.accelerations(MUSCLE, state, 3.0, 0.0, u)
        field = task.vector_field(0.3, jnp.asarray(y[:2]), jnp.asarray(u))
        np.testing.assert_allclose(field, [y[1], a_w], rtol=1e-12)
        force = task.output(0.3, jnp.asarray(y[:2]), jnp.asarray(u), jnp.zeros(4))
        np.testing.assert_allclose(force, MUSCLE["m_z"] * pulled, rtol=1e-12)


@pytest.mark.parametrize("argument", ["literal", "elongation"])
@pytest.mark.parametrize("c_z, v_ref_z", [(5.0, 1.0), (500.0, 0.1)])
def test_contraction_velocity_inverts_passive_force(x64, argument, c_z, v_ref_z):
    damping = jm.model.QuadraticDamping(c_z, v_ref_z)
    muscle = jm.Muscle(damping_z=damping, argument=argument)

    def passed(y, force, u):
        x_w, _, x_z, v_z = y
        return muscle.passive_force(
            x_w, muscle.contraction_velocity(x_w, x_z, v_z, force, u), x_z, v_z, u
        )

    y, u = map(np.array, zip(*random_states(), strict=True))
    # Noise far below the damping: with a negative damping there is no velocity to find.
    u, force = u * [1.0, 1.0, 1.0, 0.01], 12.0 * y[:, 1]
    np.testing.assert_allclose(at_once(jax.vmap(passed), y, force, u), force, rtol=1e-9, atol=1e-9)


def test_a_custom_law_is_a_parameter_in_replace_and_simulate(x64):
    muscle = jm.Muscle(stiffness_z=Tendon())
    task = jm.PrescribedForce(2.0, 1.0, muscle=muscle)
    assert {"stiff_z", "toe_z", "k_w"} <= set(task.parameter_names)
    assert not {"k_z", "x_ref_z"} & set(task.parameter_names)
    changed = task.replace(stiff_z=150.0, toe_z=20.0)
    assert (changed["stiff_z"], changed["toe_z"]) == (150.0, 20.0)
    np.testing.assert_allclose(changed.muscle.base()[1], 150.0)
    quiet = changed.replace(
        **{f"noise_{c}": 0.0 for c in ("K_w", "K_z", "C_w", "C_z")}, harmonic_amplitude=0.0
    )
    end = np.asarray(jm.simulate(quiet, jax.random.key(0), duration=12.0).states[-1])
    # Statics of (1): K_z(x_z) (x_z - x_w) = -F_ext and K_w(x_w) x_w = P_w - F_ext.
    x_w, x_z = end[0], end[2]
    np.testing.assert_allclose(150.0 * np.exp(20.0 * x_z) * (x_z - x_w), -1.0, rtol=1e-6)
    np.testing.assert_allclose(5e5 * (0.02**2 + x_w**2) * x_w, 1.0, rtol=1e-6)


def test_a_custom_law_may_reuse_a_table_name():
    class Toe(jm.model.AbstractLaw):
        k: Scalar = default("k_z")

        def __call__(self, q):
            return self.k * 4e-4 * jnp.exp(20.0 * q)

    task = jm.Isometric(muscle=jm.Muscle(stiffness_z=Toe())).replace(k_z=1e6)
    assert task["k_z"] == 1e6
    np.testing.assert_allclose(task.muscle.base()[1], 400.0, rtol=1e-6)


class Linear(jm.model.AbstractMuscle):
    """A whole muscle; here, and not in the test, so that its programs are kept."""

    m_w: Scalar = 0.5
    m_z: Scalar = 0.4
    stiff: Scalar = 150.0

    def base(self) -> Float[Array, "4"]:
        return jnp.stack([jnp.asarray(v) for v in (self.stiff, self.stiff, 20.0, 10.0)])

    def active_force(self, x_w, v_w, u):
        return (self.stiff + u[0]) * x_w + (20.0 + u[2]) * v_w

    def passive_force(self, x_w, v_w, x_z, v_z, u):
        return (self.stiff + u[1]) * (x_z - x_w) + (10.0 + u[3]) * (v_z - v_w)

    def contraction_velocity(self, x_w, x_z, v_z, force, u):
        return v_z - (force - (self.stiff + u[1]) * (x_z - x_w)) / (10.0 + u[3])


def test_a_whole_own_muscle_runs_in_every_task():
    for kind in TASKS:
        task = kind(muscle=Linear()).replace(stiff=120.0)
        assert task["stiff"] == 120.0
        states, zero = np.full(len(task.state_names), 0.01, np.float32), np.zeros(4, np.float32)
        assert np.isfinite(
            at_once(
                lambda states, zero, task=task: task.output(0.8, states, zero, zero), states, zero
            )
        )
    run = jm.simulate(jm.Isometric(muscle=Linear()), jax.random.key(0), duration=0.8)
    assert run.finite and run.output[-1] != 0


def clipped(q):
    return jnp.where(q < 0, 3 * jnp.clip(q, None, 0.0), 3 * jnp.clip(q, 0.0, None))


def chosen(q):
    return jnp.where(q < 0, 3 * jnp.where(q < 0, q, 0.0), 3 * jnp.where(q < 0, 0.0, q))


def sharp(q):
    return jnp.where(q < 0, 6 * q, 3 * q)


def bent(curve, place):
    """A muscle of one curve, through 0 with the slope 3, in one of its arguments."""

    class Bent(jm.model.AbstractMuscle):
        m_w: float = 0.5
        m_z: float = 0.4

        def base(self):
            return jnp.array([200.0, 200.0, 20.0, 10.0])

        def drive(self, force, u):
            return force * (1 + (curve(u[4]) if place == "drive" else u[4]))

        def active_force(self, x_w, v_w, u):
            damped = curve(v_w) if place == "active" else 20 * v_w
            return (200 + (curve(u[0]) if place == "u" else u[0])) * x_w + damped

        def passive_force(self, x_w, v_w, x_z, v_z, u):
            held = curve(x_z) if place == "x_z" else 200 * x_z
            damped = curve(v_z) - curve(v_w) if place == "passive" else 10 * (v_z - v_w)
            return held - 200 * x_w + damped

    return Bent()


PLACES = {
    "active": "active_force: at rest its slope with v_w",
    "passive": "passive_force: at rest its slope with v_w",
    "u": r"active_force: at rest its slope with u\[0\]",
    "drive": r"drive: at rest its slope with u\[4\]",
    "x_z": "passive_force: at rest its slope with x_z",
}


@pytest.mark.parametrize("place", PLACES)
def test_a_derivative_that_is_no_slope_at_rest_is_refused(place):
    """`jnp.clip` halves it; a curve that is chosen with `jnp.where` has it."""
    with pytest.raises(ValueError, match=f"{PLACES[place]}.*JAX's derivative.*jnp.where"):
        jm.Isometric(muscle=bent(clipped, place))
    jm.Isometric(muscle=bent(chosen, place))


def test_the_side_of_a_sharp_bend_that_counts_is_told():
    told = r"6 to the left and 3 to the right\. .* to the right;"
    with pytest.warns(jm.errors.FirstOrderWarning, match=told):
        task = jm.Isometric(muscle=bent(sharp, "active"))
    assert float(jax.jacfwd(task.muscle.active_force, 1)(1e-3, 0.0, np.zeros(5))) == 3.0


def test_a_law_without_a_slope_at_rest_is_refused():
    class Creeping(jm.model.AbstractLaw):
        c: Scalar = 10.0

        def __call__(self, q):
            return self.c * (1 + jnp.sqrt(jnp.abs(q)))

    with pytest.raises(ValueError, match=r"active_force: at rest its slope .* is nan"):
        jm.Isometric(muscle=jm.Muscle(damping_w=Creeping()))


@pytest.mark.parametrize("field", ["m_w", "m_z"])
@pytest.mark.parametrize("value", [0.0, -0.1])
def test_a_mass_must_be_positive(field, value):
    with pytest.raises(ValueError, match=f"{field} = {value} kg must be positive"):
        jm.Muscle(**{field: value})


def test_factors_must_not_be_negative():
    for law, name in (
        (jm.model.QuadraticStiffness, "k = -1"),
        (jm.model.QuadraticDamping, "c = -1"),
    ):
        with pytest.raises(ValueError, match=name):
            law(-1.0)
        with pytest.raises(ValueError, match="_ref = -2"):
            law(1.0, -2.0)
    with pytest.raises(ValueError, match=r"harmonic_amplitude = -0.1"):
        jm.Harmonic(-0.1)
    with pytest.raises(ValueError, match=r"harmonic_frequency = 0.0"):
        jm.Harmonic(frequency=0.0)


def test_an_unknown_parameter_names_the_nearest():
    task = jm.Isometric()
    for use in (lambda: task["k_ww"], lambda: task.replace(k_ww=1.0)):
        with pytest.raises(
            ValueError, match=r"unknown parameter 'k_ww' of Isometric: did you mean 'k_w'\?"
        ):
            use()
    with pytest.raises(ValueError, match="did you mean 'harmonic_frequency'"):
        task.replace(harmonic_freq=4.0)
    with pytest.raises(ValueError, match="F_ext"):  # it is no input of this task
        task.replace(F_ext=1.0)


@pytest.mark.parametrize(
    "name", [name for name, row in PARAMETERS.items() if np.isfinite(row.lower)]
)
def test_a_value_outside_the_tables_bounds_is_refused(name):
    for task in _tasks():
        if name in task.parameter_names:
            for value in (PARAMETERS[name].lower - 0.5, np.nan, np.inf):
                with pytest.raises(ValueError, match=name):
                    task.replace(**{name: value})
            return
    raise AssertionError(f"no task has a parameter {name}")


def test_checks_let_traced_values_through():
    level = jax.jit(lambda m: jm.Isometric().replace(m_w=m)["m_w"] * 2)(-1.0)
    assert level == -2.0


def _tasks():
    noises = (jm.BandLimitedNoise(), jm.OrnsteinUhlenbeckNoise())
    smooth = jm.OrnsteinUhlenbeckNoise({"K_w": 0.1})
    white = jm.WhiteNoise({"K_w": 0.1, "C_w": 0.01})
    return [
        *(jm.Isometric(noise=noise) for noise in (*noises, white)),
        *(jm.PrescribedForce(noise=noise) for noise in (*noises, jm.WhiteNoise())),
        *(jm.PrescribedMotion(noise=noise) for noise in (noises[0], smooth)),
        _with_everything(),
        jm.PrescribedLength(reflex=jm.model.Reflex()),
    ]


def _with_everything():
    """Also what is off by default, at the table's values."""
    second = (
        PARAMETERS[f"resonance_2_{what}"].default for what in ("amplitude", "frequency", "width")
    )
    noise = jm.BandLimitedNoise() + jm.ResonantNoise() + jm.ResonantNoise(*second)
    return jm.Isometric(noise=noise, activation=jm.Activation()).replace(
        noise_P_w=PARAMETERS["noise_P_w"].default
    )


@pytest.mark.parametrize(
    "task", _tasks(), ids=lambda t: f"{type(t).__name__}-{type(t.noise).__name__}"
)
def test_replace_sets_the_named_parameter_and_nothing_else(task):
    before = {name: float(value) for name, value in task.parameters.items()}
    for name, value in before.items():
        # noise that the task would refuse
        rough = name in ("noise_K_z", "noise_C_z", "noise_C_w") and value == 0.0
        new = 0.0 if rough else 1.25 * value + (0.001 if value == 0 else 0.0)
        after = {key: float(v) for key, v in task.replace(**{name: new}).parameters.items()}
        assert after == before | {name: new}, name
    assert {name: float(v) for name, v in task.replace(**before).parameters.items()} == before


def test_every_row_of_the_table_is_a_parameter_with_that_default():
    seen = {}
    for task in _tasks():
        for name, value in task.parameters.items():
            seen.setdefault(name, float(value))
    # F_ext of the first task that has one is PrescribedForce's; noise_rate is a convention, not a
    # parameter to fit.
    assert set(seen) - {"noise_rate"} == set(PARAMETERS)
    for name, row in PARAMETERS.items():
        expected = row.default
        assert seen[name] == expected, name


def test_the_table_is_consistent():
    for name, row in PARAMETERS.items():
        assert row.name == name and row.symbol and row.meaning and row.source
        assert row.lower <= row.fit_lower <= row.default <= row.fit_upper <= row.upper, name
        assert row.prior_sd > 0
        if row.positive:
            assert row.fit_lower >= 0 and row.default > 0, name
    assert set(DEFAULT_FREE) <= set(PARAMETERS)
    units = {"m": "m", "x_r": "m", "v_r": "m/s", "k_": "N/m^3", "c_": "N s^3/m^3"}
    for prefix, unit in units.items():
        rows = [row for name, row in PARAMETERS.items() if name.startswith(prefix)]
        assert rows and all(row.unit == (unit if prefix != "m" else "kg") for row in rows)


def test_with_parts_and_as_task_keep_what_they_do_not_name():
    task = jm.PrescribedMotion(
        0.004, 7.0, noise=jm.BandLimitedNoise(0.02), harmonic=jm.Harmonic(0.01, 6.0)
    )
    other = task.with_parts(harmonic=jm.Harmonic(0.02, 5.0))
    assert (
        other["harmonic_frequency"] == 5.0 and other["F_ext"] == 7.0 and other["noise_K_w"] == 0.02
    )
    assert task["harmonic_frequency"] == 6.0
    turned = task.as_task(jm.PrescribedForce, P_w=jm.model.Constant(2.0))
    assert isinstance(turned, jm.PrescribedForce)
    assert turned["P_w"] == 2.0 and turned["F_ext"] == PARAMETERS["F_ext"].default
    assert eqx.tree_equal(turned.muscle, task.muscle) and eqx.tree_equal(turned.noise, task.noise)
    assert eqx.tree_equal(turned.harmonic, task.harmonic) and turned.settings == task.settings


def test_the_base_coefficients_are_k_times_reference_squared(x64):
    task = jm.Isometric().replace(k_w=3e5, x_ref_w=0.03, c_z=7.0, v_ref_z=0.5)
    np.testing.assert_allclose(task.muscle.base(), [270.0, 200.0, 60.0, 1.75], rtol=1e-14)
    np.testing.assert_allclose(
        task.noise_scale(), [270.0 * 0.15, 200.0 * 0.005, 60e-4, 1.75e-4], rtol=1e-14
    )
    np.testing.assert_allclose(task.harmonic_base(), [270.0, 200.0, 0.0, 0.0, 0.0], rtol=1e-14)


def test_initial_state_has_the_tasks_length():
    with pytest.raises(ValueError, match="initial has 3 entries"):
        jm.Isometric(initial=(0.0, 0.0, 0.0))
    np.testing.assert_allclose(
        jm.Isometric(initial=(0.01, 0.2)).initial_state(), [0.01, 0.2], rtol=1e-6
    )
