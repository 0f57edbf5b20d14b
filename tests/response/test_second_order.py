"""Where first order ends: predicted by the second order, measured by simulation; and what is
refused before."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import jaxmuscle as jm
from jaxmuscle._common.errors import FirstOrderWarning, OperatingPointError
from jaxmuscle.response._expected_moments import linear_spectrum
from jaxmuscle.response._second_order import FAINT, negative_coefficients, second_order

MOVING = {
    "ramp": jm.model.RampHold(5.0, start=2.0, ramp=10.0),
    "decay": jm.model.Decay(5.0, 2.0, 7.0, 3.0),
    "sampled": jm.model.Sampled.through(
        np.linspace(0, 15, 31), 5 + 0.1 * np.sin(np.linspace(0, 15, 31))
    ),
}


def simulated(task: jm.Isometric, seeds: int = 256) -> np.ndarray:
    """What the nonlinear model has more than the linear response, over that (at least a thousandth
    of its mean)."""
    runs = jm.ensemble(task.settled(), jax.random.key(3), seeds=seeds, chunk=32)
    first = np.asarray(linear_spectrum(task, task.settings).power)
    return (np.asarray(runs.mean_spectrum().power) - first) / np.maximum(
        first, FAINT * first.mean()
    )


CASES = {
    "harmonic of 10 %": jm.Isometric().replace(harmonic_amplitude=0.1),
    "harmonic of 30 %": jm.Isometric().replace(harmonic_amplitude=0.3),
    "light damping": jm.Isometric().replace(c_w=0.3, c_z=0.3, noise_K_w=0.2),
    "displacement, harmonic of 10 %": jm.PrescribedForce(F_ext=3.0).replace(harmonic_amplitude=0.1),
    "motion, harmonic of 10 %": jm.PrescribedMotion().replace(harmonic_amplitude=0.1),
    "activation, harmonic of 30 %": (
        jm.Isometric(activation=jm.Activation()).replace(harmonic_amplitude=0.3)
    ),
    "activation, resonance": jm.Isometric(
        noise=jm.ResonantNoise({"K_w": 0.5}, 4.0, 1.0), activation=jm.Activation(0.03)
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("task", CASES.values(), ids=CASES)
def test_what_the_second_order_adds_is_what_a_simulation_has_more(task, x64):
    """Good to a factor of two: the cross term of first and third order is left out, and a line
    counts as a resonance."""
    found = second_order(task)
    more = simulated(task)
    worst = int(np.argmax(more))
    assert more[worst] > 0.1 and found.notices
    assert 0.5 < found.power[worst] / more[worst] < 2.0


@pytest.mark.parametrize(
    "task",
    [
        jm.Isometric(),
        jm.Isometric().replace(noise_K_w=0.3),
        jm.PrescribedForce(F_ext=3.0),
        jm.PrescribedMotion(),
    ],
    ids=["default", "noise of 30 %", "displacement", "motion"],
)
def test_nothing_is_said_where_simulation_and_linear_response_agree(task, x64):
    assert np.max(np.abs(simulated(task))) < 0.05
    assert second_order(task).notices == ()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        jm.expected_spectrum(task)


def test_the_mean_of_a_squared_gaussian(x64):
    """A displacement that the stiffness K(x) = k (x_ref² + x²) answers: the mean shift against a
    simulation's."""
    task = jm.PrescribedForce(F_ext=3.0).replace(harmonic_amplitude=0.1)
    runs = jm.ensemble(task.settled(), jax.random.key(5), seeds=64, chunk=32)
    rest = float(np.asarray(runs.output)[0, 0])
    shift = (float(np.mean(np.asarray(runs.output)[:, 500:])) - rest) / abs(rest)
    assert second_order(task).mean == pytest.approx(shift, rel=0.5)


def test_linear_numbers_come_with_a_warning_where_first_order_ends():
    loud = jm.Isometric().replace(harmonic_amplitude=0.3)
    for number in (
        jm.expected_spectrum,
        jm.response.sensitivity,
        lambda task: task.at_level(0.5),
    ):
        with pytest.warns(
            FirstOrderWarning,
            match=r"is not exact here: what it leaves out adds about .* to the power",
        ):
            number(loud)
    target = jm.Target("x", np.ones(30), segments=[12])
    with pytest.warns(FirstOrderWarning):
        jm.objective.log_likelihood(loud, target)
    with jax.enable_x64(True), warnings.catch_warnings():
        warnings.simplefilter("error")
        jax.jit(lambda a: jm.expected_spectrum(jm.Isometric().replace(harmonic_amplitude=a)).power)(
            0.3
        )


@pytest.mark.parametrize("std", [0.3, 0.5, 1.0])
def test_how_often_a_coefficient_is_negative(std):
    """Ornstein-Uhlenbeck noise of relative size σ: Φ(-1/σ), 0.04, 2.3 and 15.9 % of the time."""
    task = jm.Isometric(noise=jm.OrnsteinUhlenbeckNoise({"K_w": std}, 0.1)).replace(
        harmonic_amplitude=0.0
    )
    share = scipy.stats.norm.cdf(-1 / std)
    said = negative_coefficients(task)
    assert len(said) == (share > 0.01)
    assert not said or said[0].startswith(f"K_w is negative for {100 * share:.2g} % of the time")


def test_a_harmonic_makes_coefficients_negative_as_often_as_a_sine_is_below():
    """Without noise: 1 + 2 sin is negative for a third of the time."""
    task = jm.Isometric().replace(noise_K_w=0.0, noise_K_z=0.0, harmonic_amplitude=2.0)
    said = negative_coefficients(task)
    assert [sentence.split()[0] for sentence in said] == ["K_w", "K_z"]
    # 64 phases of a turn.
    assert float(said[0].split()[4]) == pytest.approx(100 / 3, abs=100 / 64)


# --- refused before


@pytest.mark.parametrize("name", MOVING)
def test_an_input_that_moves_in_the_window_is_refused(name):
    task = jm.Isometric(P_w=MOVING[name])
    with pytest.raises(
        OperatingPointError, match=r"P_w of this Isometric moves in the analysed window.*montecarlo"
    ):
        jm.expected_spectrum(task)
    target = jm.Target("x", np.ones(30), segments=[12])
    for number in (
        lambda: jm.fit(task, target),
        lambda: jm.objective.log_likelihood(task, target),
        lambda: jm.response.sensitivity(task),
        lambda: task.at_level(0.5),
    ):
        with pytest.raises(OperatingPointError, match="P_w of this Isometric moves"):
            number()
    assert np.all(np.isfinite(np.asarray(jm.expected_spectrum(task.settled()).power)))


def test_an_input_that_is_held_in_the_window_is_not():
    for signal in (
        5.0,
        jm.model.RampHold(5.0, start=0.5, ramp=4.0),
        jm.model.SmoothStep(5.0, start=3.0, rise=1.9),
    ):
        held = jm.expected_spectrum(jm.Isometric(P_w=signal)).power
        np.testing.assert_allclose(held, jm.expected_spectrum(jm.Isometric()).power, rtol=1e-4)
    with pytest.raises(OperatingPointError, match=r"at 0\.5 s it is 0, at the end 5"):
        jm.expected_spectrum(jm.Isometric(), window=(0.5, 10.5))


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_a_spectrum_of_rounding_is_refused(dtype):
    """Without external force noise on K_z does not move Task 2; what is left is the
    arithmetic's."""
    task = jm.PrescribedForce().replace(
        noise_K_w=0.0, noise_K_z=0.3, noise_C_w=0.1, noise_C_z=0.1, harmonic_amplitude=0.0
    )
    with (
        jax.enable_x64(dtype == jnp.float64),
        pytest.raises(ValueError, match="neither noise nor a harmonic that moves x_z"),
    ):
        jm.expected_spectrum(task)
