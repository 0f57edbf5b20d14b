"""The activation against scipy's linear systems; how a task has it, its noises and its drive by
name and on disk."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
from compiled import at_once
from noise_paths import unit_path

import jaxmuscle as jm

KEY = jax.random.key(19)


def twitch(time):
    """1 / (1 + sT)² as states (a, T a')."""
    return (np.array([[0, 1], [-1, -2]]) / time, [[0.0], [1 / time]], np.eye(2), [[0.0], [0.0]])


def through(activation, before, after, dt):
    """Values and slopes of what comes out, from rest, of inputs that run straight from `before` to
    `after` in every step."""
    step = activation.transition(dt)

    def advance(state, given):
        return (step.advance(state, *given),) * 2

    rest = jnp.zeros(before.shape[1:])
    _, states = jax.lax.scan(advance, (rest, rest), (before, after))
    a, b = (jnp.concatenate([rest[None], values]) for values in states)
    return a, b / activation.time


@pytest.mark.parametrize("time, dt", [(0.06, 1e-3), (0.002, 1e-3), (0.2, 1e-2)])
def test_what_comes_out_is_scipys(x64, time, dt):
    """Of inputs that run straight from sample to sample, and of steps that are held."""
    given, seconds = np.random.default_rng(3).normal(size=(301, 2)), dt * np.arange(301)
    activation = jm.Activation(time)
    for before, after, interpolated in (
        (given[:-1], given[1:], True),
        (given[:-1], given[:-1], False),
    ):
        a, slope = through(activation, jnp.asarray(before), jnp.asarray(after), dt)
        for i in range(2):
            _, states, _ = scipy.signal.lsim(
                twitch(time), given[:, i], seconds, interp=interpolated
            )
            np.testing.assert_allclose(a[:, i], states[:, 0], rtol=0, atol=1e-10)
            np.testing.assert_allclose(slope[:, i], states[:, 1] / time, rtol=0, atol=1e-10 / time)


def test_slopes_are_the_derivative_of_values(x64):
    errors = []
    for dt in (2e-3, 1e-3):
        given = jnp.asarray(np.sin(20 * dt * np.arange(round(1 / dt) + 1)))[:, None]
        a, slope = (
            np.asarray(x)[:, 0] for x in through(jm.Activation(0.05), given[:-1], given[1:], dt)
        )
        errors.append(np.abs((a[2:] - a[:-2]) / (2 * dt) - slope[1:-1]).max())
    # Central differences: dt² a''' / 6, a''' at most 1/T³ of a unit input (its jump of slope, 20
    # /s, times 1/T²).
    assert errors[1] < 1e-6 * (20 / 0.05**2) / 6
    assert 3.5 < errors[0] / errors[1] < 4.5


@pytest.mark.parametrize("frequency", [0.5, 4.0, 12.0])
def test_gain_and_phase_of_a_sine(x64, frequency):
    time, dt = 0.06, 2e-4
    t = dt * np.arange(round(2 / dt) + 1)
    given = jnp.asarray(np.sin(2 * np.pi * frequency * t))[:, None]
    a = np.asarray(through(jm.Activation(time), given[:-1], given[1:], dt)[0])[:, 0]
    late, turn = t >= 1.5, np.exp(2j * np.pi * frequency * t)  # e^-25 of the start is left
    columns = np.stack([turn.imag, turn.real], axis=1)
    in_phase, ahead = np.linalg.lstsq(columns[late], a[late], rcond=None)[0]
    omega_t = 2 * np.pi * frequency * time
    # A sine joined by lines is smaller by sinc² = 1 - (ω dt)² / 12.
    assert np.hypot(in_phase, ahead) == pytest.approx(
        1 / (1 + omega_t**2), rel=(2 * np.pi * frequency * dt) ** 2 / 6 + 1e-9
    )
    assert np.arctan2(ahead, in_phase) == pytest.approx(-2 * np.arctan(omega_t), abs=1e-6)


def test_white_noise_comes_out_with_its_variance(x64):
    """∫ h² dt / rate = 1 / (4 T rate); held over a step, less by (dt / T)² / 12 times ∫ h'² T² / ∫
    h², which is 1."""
    time, noise = 0.05, jm.WhiteNoise(1.0, rate=80.0)
    for dt in (5e-3, 1e-3):
        steps = round(1.0 / dt)  # 20 T: all of the response

        def last(normals, dt=dt):
            kicks = unit_path(noise, normals, dt).increments / dt
            return through(jm.Activation(time), kicks, kicks, dt)[0][-1, 0]

        weights = np.asarray(at_once(jax.grad(last), np.zeros((steps + 1, 1))))
        variance = np.sum(weights**2) * 4 * time * 80.0
        assert variance == pytest.approx(1 - (dt / time) ** 2 / 12, abs=0.1 * (dt / time) ** 3)


# --- by name and on disk


def test_what_is_off_is_zero_and_can_be_switched_on():
    task = jm.Isometric()
    assert task.activation is None and task["activation_time"] == 0 and task["noise_P_w"] == 0
    assert "activation_time" not in task.parameter_names and "noise_P_w" not in task.parameter_names
    slower = task.replace(activation_time=0.05, k_w=4e5)
    assert (
        slower["activation_time"] == 0.05
        and slower.activation == jm.Activation(0.05)
        and slower["k_w"] == 4e5
    )
    driven = task.replace(noise_P_w=0.03)
    assert driven["noise_P_w"] == 0.03 and driven["noise_K_w"] == task["noise_K_w"]
    assert set(driven.parameter_names) - set(task.parameter_names) == {"noise_P_w"}
    base = task.muscle.base()
    np.testing.assert_allclose(
        driven.noise_scale(), [*(base * np.array([0.15, 0.005, 1e-4, 1e-4])), 0.03], rtol=1e-6
    )
    beside = jm.Isometric(
        noise=jm.ResonantNoise((0.1, 0.0, 0.0, 0.0)) + jm.BandLimitedNoise()
    ).replace(noise_P_w=0.03)
    assert (
        beside["noise_P_w"] == 0.03
        and beside["resonance_K_w"] == 0.1
        and "resonance_P_w" not in beside.parameter_names
    )


def test_names_of_the_parts_of_a_sum():
    twice = jm.ResonantNoise(0.01, 3.5, 1.0) + jm.ResonantNoise(0.02, 9.0, 2.0)
    task = jm.Isometric(
        noise=jm.OrnsteinUhlenbeckNoise(0.1, 0.3) + twice + jm.BandLimitedNoise(0.05), x_z=0.001
    )
    assert [task[f"resonance_{name}"] for name in ("amplitude", "frequency", "width")] == [
        0.01,
        3.5,
        1.0,
    ]
    assert [task[f"resonance_2_{name}"] for name in ("amplitude", "frequency", "width")] == [
        0.02,
        9.0,
        2.0,
    ]
    assert (
        task["noise_correlation_time"] == 0.3
        and task["noise_2_cutoff"] == 50.0
        and task["noise_2_K_z"] == 0.05
    )
    other = task.replace(resonance_2_frequency=10.0, noise_2_K_z=0.0)
    assert other["resonance_2_frequency"] == 10.0 and other["resonance_frequency"] == 3.5
    assert other["noise_2_K_z"] == 0.0 and other["noise_K_z"] == 0.1
    assert other.as_task(jm.PrescribedForce)["resonance_2_frequency"] == 10.0


@pytest.mark.parametrize(
    "name, near",
    [
        ("activation_tme", "activation_time"),
        ("noise_P_ww", "noise_P_w"),
        ("resonance_freqency", "resonance_frequency"),
    ],
)
def test_an_unknown_name_is_told_the_nearest(name, near):
    noise = jm.BandLimitedNoise() + jm.ResonantNoise()
    tasks = [
        jm.Isometric(noise=noise),
        jm.Isometric(noise=noise, activation=jm.Activation()).replace(noise_P_w=0.01),
    ]
    for task in [*tasks, jm.Isometric()] if near[0] != "r" else tasks:
        for use in (lambda task=task: task[name], lambda task=task: task.replace(**{name: 0.1})):
            with pytest.raises(
                ValueError,
                match=rf"unknown parameter '{name}' of Isometric: did you mean '{near}'\?",
            ):
                use()


def test_impossible_activations_are_refused():
    for time in (0.0, -0.1):
        with pytest.raises(ValueError, match=rf"activation_time = {time} s must be positive"):
            jm.Activation(time)
    with pytest.raises(
        ValueError, match=r"activation_time = -0.1 s is outside its range, 0 or more"
    ):
        jm.Isometric().replace(activation_time=-0.1)
    with pytest.raises(
        ValueError, match=r"dt = 0.001 s is too coarse for activation_time = 0.001 s"
    ):
        jm.simulate(jm.Isometric(activation=jm.Activation(0.001)), KEY)
    with pytest.raises(ValueError, match="unknown parameter 'noise_P_w'"):
        jm.Isometric(noise=jm.ResonantNoise()).replace(noise_P_w=0.1)


SAVED = {
    "activation": jm.Isometric(activation=jm.Activation(0.07), x_z=0.001),
    "drive": jm.PrescribedForce(noise=jm.OrnsteinUhlenbeckNoise({"K_w": 0.1, "P_w": 0.02}, 0.3)),
    "all": (
        jm.Isometric(
            noise=jm.BandLimitedNoise(shared=True)
            + jm.ResonantNoise(0.01, 3.5, 1.0)
            + jm.model.PinkNoise(0.1),
            activation=jm.Activation(),
        ).replace(noise_P_w=0.01)
    ),
}


@pytest.mark.parametrize("name", SAVED)
def test_a_saved_task_is_read_again(tmp_path, name):
    SAVED[name].save(tmp_path / "task.toml")
    assert eqx.tree_equal(jm.load_preset(tmp_path / "task.toml"), SAVED[name])


def test_a_preset_with_an_impossible_part_is_refused(tmp_path):
    SAVED["all"].save(tmp_path / "task.toml")
    text = (tmp_path / "task.toml").read_text()
    for before, after, message in (
        ("time = 0.06", "time = -1.0", "must be positive"),
        ("width = 1.0", "width = 0.0", "resonance_width = 0.0 Hz must be positive"),
        (
            'type = "Activation"\ntime',
            'type = "Constant"\nlevel',
            r"task.activation.type = .* is of the wrong kind",
        ),
        ('type = "PinkNoise"', 'type = "PinkNoises"', "did you mean 'PinkNoise'"),
    ):
        assert text.count(before) == 1
        (tmp_path / "other.toml").write_text(text.replace(before, after))
        with pytest.raises(jm.errors.PresetError, match=message):
            jm.load_preset(tmp_path / "other.toml")
