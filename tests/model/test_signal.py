"""Input signals: values, smoothness across their joints, and splines against SciPy's."""

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
import references
import scipy.interpolate
from compiled import at_once

import jaxmuscle as jm
from jaxmuscle.model import Constant, Decay, RampHold, Sampled, SmoothStep
from jaxmuscle.model._signals import Tabulated, derivatives

TIMES = np.linspace(0.0, 6.0, 25)
CASES = {
    "constant": (Constant(2.0), 6, []),
    "step": (SmoothStep(2.0, 0.7, 1.3, -1.0), 3, [0.7, 2.0]),
    "ramp": (RampHold(2.0, 0.5, 2.0, 0.3, -1.0), 3, [0.5, 0.8, 2.2, 2.5]),
    "decay": (Decay(2.0, 0.5, 1.0, 0.8), 1, [1.0]),
    "sampled": (Sampled.through(TIMES, np.sin(3 * TIMES)), 4, list(TIMES[3:-3:4])),
}


def jumps(signal, joints, highest, h=1e-9):
    """Differences of all derivatives just right and left of each joint, and their sizes near it:
    (joint, order)."""
    every = jax.jit(jax.vmap(lambda t: jnp.stack(derivatives(signal, t, highest))))
    left, right, near = (np.asarray(every(jnp.asarray(joints) + s)) for s in (-h, h, 0.05))
    return abs(right - left), abs(near) + abs(left) + abs(right)


@pytest.mark.parametrize("name", CASES)
def test_as_many_derivatives_are_continuous_as_claimed_and_no_more(x64, name):
    signal, smooth, joints = CASES[name]
    assert smooth == min(signal.smoothness, 6)
    if joints:
        step, size = jumps(signal, joints, smooth + 1)
        # h times the next slope
        assert np.all(step < 1e-4 * np.maximum(size, 1.0), where=np.arange(smooth + 2) <= smooth)
        assert np.max(step[:, -1] / size[:, -1]) > 0.1


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize(
    "signal", [RampHold(1.0), RampHold(2.0, 0.3, 1.7, 0.3), SmoothStep(), Decay()]
)
def test_the_slope_is_not_lost_at_a_joint(signal, precision):
    """On a grid that hits the joints, compiled, as in a simulation; there, pieces were once counted
    twice or not."""
    with jax.enable_x64(precision == "float64"):
        times = np.arange(0.0, 6.0, 0.1)
        slope = jax.jit(jax.vmap(lambda t: derivatives(signal, t, 1)[1]))
        here, before, after = (
            np.asarray(slope(jnp.asarray(times + s))) for s in (0.0, -1e-4, 1e-4)
        )
        # The slope moves by 1e-4 s times a curvature below 10 / s².
        np.testing.assert_allclose(here, 0.5 * (before + after), atol=1e-3)


@pytest.mark.parametrize("name", CASES)
def test_derivatives_are_those_of_finite_differences(x64, name):
    signal, smooth, _ = CASES[name]
    h, value = 1e-3, jax.jit(jax.vmap(signal))
    slopes = jax.jit(lambda t: derivatives(signal, t, min(smooth, 3)))
    for t in (0.9, 1.2, 2.3, 4.6):  # in smooth pieces
        around = np.asarray(value(t + h * np.arange(-3, 4)))
        exact = [float(d) for d in slopes(t)]
        # Central differences: error h² f'''/6 and h² f''''/12; f'''' below 400 in every case.
        np.testing.assert_allclose(exact[0], around[3], rtol=1e-14)
        np.testing.assert_allclose(exact[1], (around[4] - around[2]) / (2 * h), atol=1e-4)
        if smooth >= 2:
            np.testing.assert_allclose(
                exact[2], (around[4] - 2 * around[3] + around[2]) / h**2, atol=1e-3
            )
        if smooth >= 3:
            third = (around[5] - 2 * around[4] + 2 * around[2] - around[1]) / (2 * h**3)
            np.testing.assert_allclose(exact[3], third, atol=2e-2)


def test_a_step_is_the_incomplete_beta_function(x64):
    t = np.linspace(0, 3, 50)
    signal = SmoothStep(2.5, 0.5, 1.0)
    np.testing.assert_allclose(signal(t), references.smooth_step(t, 2.5), atol=1e-12)


def test_the_usual_step_rises_from_half_a_second_on_within_one():
    """As design.md, section 2 has it."""
    found = np.asarray(jax.vmap(SmoothStep())(jnp.array([0.0, 0.5, 1.0, 1.5, 15.0])))
    np.testing.assert_allclose(found, [0.0, 0.0, 0.5, 1.0, 1.0], atol=1e-6)
    np.testing.assert_array_equal(jax.vmap(RampHold())(jnp.array([0.5, 2.5])), [0.0, 1.0])


def test_ends_are_reached_and_held_exactly():
    for dtype in (np.float32, np.float64):
        with jax.enable_x64(dtype == np.float64):
            eps = float(np.finfo(dtype).eps)
            for signal in (SmoothStep(0.01, 0.5, 1.0, 0.002), RampHold(0.01, 0.5, 2.0, 0.2, 0.002)):
                before, after = (
                    np.asarray(signal(jnp.asarray(t))) for t in ([0.0, 0.25, 0.5], [2.5, 3.0, 15.0])
                )
                np.testing.assert_array_equal(before, np.asarray(0.002, dtype))
                # Rounding of the times, 15 s at most, over a ramp of 1.8 s.
                np.testing.assert_allclose(after, 0.01, rtol=40 * eps)


def test_the_ramp_is_straight_between_its_corners(x64):
    signal = RampHold(3.0, 0.5, 2.0, 0.2, 1.0)
    t = np.linspace(0.71, 2.29, 20)
    # The rounded ramp runs through the middle (1.5 s, 2.0) with slope (level - initial) / (ramp -
    # corner).
    np.testing.assert_allclose(signal(t), 2.0 + (t - 1.5) * 2.0 / 1.8, rtol=1e-12)


def test_decay_is_its_formula(x64):
    signal = Decay(2.0, 0.5, 1.0, 0.8)
    p = 1.7 / 0.8
    np.testing.assert_allclose(
        signal(2.7), 0.5 + 1.5 * (2 * np.exp(-p) - np.exp(-2 * p)), rtol=1e-13
    )
    np.testing.assert_allclose(
        [signal(0.3), signal(1.0), signal(100.0)], [2.0, 2.0, 0.5], rtol=1e-13
    )


def test_samples_give_scipys_spline(x64):
    rng = np.random.default_rng(0)
    times = np.cumsum(rng.uniform(0.05, 0.2, 30))
    values = rng.normal(size=30)
    signal = Sampled.through(times, values)
    spline = scipy.interpolate.make_interp_spline(times, values, k=5)
    t = rng.uniform(times[0], times[-1], 200)
    np.testing.assert_allclose(signal(t[0]), spline(t[0]), rtol=1e-9)
    every = np.r_[t, times, times[0] - 1.0, times[-1] + 1.0]
    ours = np.asarray(at_once(jax.vmap(lambda t: jnp.stack(derivatives(signal, t, 3))), every))
    np.testing.assert_allclose(ours[:200, 0], spline(t), rtol=1e-8, atol=1e-10)
    for order in (1, 2, 3):
        np.testing.assert_allclose(
            ours[:200, order], spline(t, nu=order), rtol=1e-7, atol=1e-6 * 10**order
        )
    np.testing.assert_allclose(ours[200:-2, 0], values, atol=1e-10)
    np.testing.assert_allclose(ours[-2:, 0], [values[0], values[-1]], atol=1e-9)


def test_a_spline_follows_a_smooth_function_to_sixth_order(x64):
    middle = np.linspace(1.0, 2.0, 40)
    errors = []
    for points in (31, 61):
        times = np.linspace(0.0, 3.0, points)
        signal = Sampled.through(times, np.exp(np.sin(3 * times)))
        errors.append(
            np.abs(np.asarray(at_once(jax.vmap(signal), middle)) - np.exp(np.sin(3 * middle))).max()
        )
    # Degree five: order 6; between 5.5 and 7 since two grids fit a slope with an accidental part.
    assert 5.5 < np.log2(errors[0] / errors[1]) < 7.0


def test_level_scales_a_sampled_signal():
    task = jm.PrescribedForce(Sampled.through(TIMES, np.sin(TIMES)))
    doubled = task.replace(P_w=2.0)
    assert isinstance(doubled, jm.PrescribedForce)
    np.testing.assert_allclose(doubled.P_w(1.0), 2 * np.sin(1.0), rtol=1e-3)


@pytest.fixture
def user_view():
    """As a user runs it: without the run-time type check, which would see a wrong argument
    first."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


def test_impossible_signals_are_refused(user_view):
    with pytest.raises(
        ValueError, match=r"rise = 0.0 s: a step without rise time .* give rise > 0"
    ):
        SmoothStep(rise=0.0)
    with pytest.raises(ValueError, match=r"corner = 0.0 s must be positive"):
        RampHold(corner=0.0)
    with pytest.raises(ValueError, match=r"corner = 1.1 s must be at most half the ramp 2.0 s"):
        RampHold(ramp=2.0, corner=1.1)
    with pytest.raises(ValueError, match=r"time_constant = 0.0 s must be positive"):
        Decay(time_constant=0.0)
    for times, values in (
        (np.arange(5.0), np.arange(5.0)),
        (np.arange(8.0), np.arange(7.0)),
        (np.array([0, 1, 1, 2, 3, 4, 5.0]), np.zeros(7)),
        (np.arange(7.0), np.array([0, 1, np.nan, 0, 0, 0, 0])),
    ):
        with pytest.raises(ValueError, match="times"):
            Sampled.through(times, values)
    with pytest.raises(ValueError, match="breaks must increase"):
        Sampled(np.array([0.0, 1.0, 1.0]), np.zeros((2, 6)))


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("name", ["step", "ramp", "sampled"])
def test_a_table_gives_its_signal_and_two_derivatives_at_every_grid_point(name, precision):
    with jax.enable_x64(precision == "float64"):
        signal, interval = CASES[name][0], 2.5e-4
        table = Tabulated.of(signal, interval, 20_001)  # not compiled as a whole: the same digits
        times = np.arange(20_001.0, dtype=precision) * np.asarray(interval, precision)
        exact = jax.vmap(lambda t: derivatives(signal, t, 2))(times)
        for seen, known in zip(
            at_once(jax.vmap(lambda t: derivatives(table, t, 2)), times), exact, strict=True
        ):
            np.testing.assert_array_equal(seen, known)
        # and with respect to what the signal itself depends on
        slope = at_once(
            jax.grad(lambda level: Tabulated.of(SmoothStep(level), interval, 9000)(2.0)), 3.0
        )
        np.testing.assert_allclose(slope, 1.0, rtol=1e-6)


def test_a_table_holds_its_first_and_last_value_beyond_its_ends():
    signal = Decay(2.0, start=0.0, time_constant=0.3)  # moves from the first point on
    table = Tabulated.of(signal, 0.1, 5)
    for t, at in ((-1.0, 0.0), (0.0, 0.0), (0.1, 0.1), (0.4, 0.4), (9.0, 0.4)):
        assert table(jnp.asarray(t)) == signal(jnp.asarray(at)), t


def test_the_documented_values_of_a_decay_are_its_defaults():
    assert [float(Decay()(jnp.asarray(t))) for t in (0.0, 5.0)] == [1.0, 1.0]
    p = 2.0 / 3.0
    np.testing.assert_allclose(
        Decay()(jnp.asarray(7.0)), 2 * np.exp(-p) - np.exp(-2 * p), rtol=1e-6
    )
