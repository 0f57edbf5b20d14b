"""What a task can have beyond the paper's model, rung by rung: simulations against the expected
spectrum, at human noise."""

import jax
import numpy as np
import pytest
import references
from compiled import at_once
from noise_paths import coarsen, draw_normals, respond

import jaxmuscle as jm
from jaxmuscle.model import NoiseSum
from jaxmuscle.response._expected_moments import linear_spectrum
from jaxmuscle.simulation._grid import Grid

KEY = jax.random.key(43)
HUMAN = {"K_w": 0.15, "K_z": 0.005, "C_w": 1e-4, "C_z": 1e-4}
TREMOR, SLOW = jm.ResonantNoise(0.005, 9.0, 2.0), jm.ResonantNoise(0.005, 3.5, 1.0)
SLOWED = {"activation": jm.Activation(0.06)}
RUNGS = {
    "activation": jm.Isometric(5.0, 0.003, noise=jm.BandLimitedNoise(HUMAN), **SLOWED),
    "tremor": jm.Isometric(5.0, 0.003, noise=jm.OrnsteinUhlenbeckNoise(HUMAN) + TREMOR, **SLOWED),
    "two": jm.Isometric(5.0, 0.003, noise=jm.BandLimitedNoise(HUMAN) + TREMOR + SLOW, **SLOWED),
    "displacement": jm.PrescribedForce(
        5.0, 1.0, noise=jm.WhiteNoise(HUMAN) + TREMOR + SLOW, **SLOWED
    ),
    "motion": jm.PrescribedMotion(
        0.004,
        6.0,
        noise=jm.BandLimitedNoise(HUMAN, shared=True),
        settings=jm.SpectrumSettings(sampling="average"),
        **SLOWED,
    ),
}


@pytest.mark.slow
def test_plain_monte_carlo_agrees_on_every_rung(x64):
    """As without activation (test_control.py): 500 seeds of three segments leave 3 % per bin, the
    step's bias less.

    The force of a prescribed motion holds second derivatives, and at 1.25 ms a bias of 5 to 10 %: a
    step of 0.5 ms there.
    """
    window, z = (1.0, 6.12), []
    for i, (name, rung) in enumerate(RUNGS.items()):
        task, options = rung.settled(), {"duration": window[1], "substeps": 1, "control": False}
        options["dt"] = 5e-4 if name == "motion" else 1.25e-3
        runs = jm.ensemble(task, jax.random.fold_in(KEY, i), seeds=500, **options)
        power = np.asarray(runs.spectrum(window=window).power)
        expected = np.asarray(linear_spectrum(task, task.settings, window).power)
        z.append(
            (power.mean(axis=0) - expected) / (power.std(axis=0, ddof=1) / np.sqrt(len(power)))
        )
        print(name, f"largest {np.abs(z[-1]).max():.2f}, mean square {np.mean(z[-1] ** 2):.2f}")
    references.assert_standard_normal(z, every=3)


def test_the_control_variate_has_the_expected_spectrum(x64):
    runs = jm.ensemble(RUNGS["two"], KEY, seeds=128, chunk=32)
    power = np.asarray(runs.beside().spectrum().power)
    expected = np.asarray(jm.expected_spectrum(runs.task).power)
    references.assert_standard_normal(
        (power.mean(axis=0) - expected) / (power.std(axis=0, ddof=1) / np.sqrt(128)), every=3
    )
    mean = runs.mean_spectrum()
    assert np.median(mean.variance_reduction) > 100
    # a fluctuation of 1 % is nearly linear
    np.testing.assert_allclose(mean.power, expected, rtol=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in RUNGS if name != "activation"])
def test_half_the_step_gives_the_same_spectrum(x64, name):
    """Of the same 32 paths at 0.5 and 1 ms; the rung "two" has all that "activation" has."""
    task, steps = RUNGS[name].settled(), 12_240

    def spectra(key):
        fine = draw_normals(task.noise, key, steps)
        halved = coarsen(task.noise, fine, 5e-4, 2)
        pairs = (fine, Grid(5e-4, steps, 20)), (halved, Grid(1e-3, steps // 2, 10))
        outputs = [respond(task, normals, grid)[1] for normals, grid in pairs]
        return [
            jm.spectra.spectrum_of(output, task.settings, (1.0, 6.12)).power for output in outputs
        ]

    fine, coarse = (
        np.mean(x, axis=0) for x in at_once(jax.vmap(spectra), jax.random.split(KEY, 32))
    )
    # 4/3 of the difference is the step's bias: at most 0.3 of the 3 % that the seeds above leave.
    assert 4 / 3 * np.abs(coarse / fine - 1).max() < 0.3 * 0.03


def path(noise=jm.BandLimitedNoise(HUMAN), activation=None):  # noqa: B008
    task = jm.Isometric(5.0, 0.003, noise=noise, activation=activation).settled()
    return np.asarray(jm.simulate(task, KEY, duration=1.0, dt=1e-4, substeps=1).output)


def test_what_is_off_changes_no_path(x64):
    """A sum of one, and a resonance of no size on the drive: behind an activation, and without
    one."""
    noise = jm.BandLimitedNoise(HUMAN)
    output = path()
    for activation in (None, SLOWED["activation"]):
        alone = path(activation=activation)
        other = path(noise + jm.ResonantNoise(0.0), activation)
        np.testing.assert_allclose(other, alone, rtol=1e-12, atol=1e-12 * np.abs(alone).max())
    np.testing.assert_allclose(
        path(NoiseSum((noise,))), output, rtol=1e-12, atol=1e-12 * np.abs(output).max()
    )
    assert np.abs(path(noise + jm.ResonantNoise(0.01)) - output).max() > 1e-4 * np.abs(output).max()


def test_a_fast_activation_is_none(x64):
    """The delay 2T of 0.4 ms is a hundredth of that of the other."""
    quick, slowed, none = (
        path(activation=a) for a in (jm.Activation(2e-4), jm.Activation(0.02), None)
    )
    assert np.abs(quick - none).max() < 0.1 * np.abs(slowed - none).max()
