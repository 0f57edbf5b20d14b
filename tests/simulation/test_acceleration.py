"""The acceleration of the insertion: of the simulated motion, of its linear response, of a Monte
Carlo ensemble."""

import jax
import numpy as np
import pytest
import references

import jaxmuscle as jm

KEY = jax.random.key(53)
RHYTHM = jm.Harmonic(0.02, 9.0)


def test_it_is_the_second_difference_of_the_simulated_motion(x64):
    """To second order in the step, without noise and beside noise on K_w: x_z'' then has two
    derivatives."""
    silent = references.quiet(jm.PrescribedForce(5.0, 1.0, harmonic=RHYTHM, observe="acceleration"))
    steps = [2e-3, 5e-4]
    # Another step is another path: 200 independent values (2 s up to 50 Hz) give the root mean
    # square to 5 %.
    for task, least, lowest, highest in (
        (silent, 1e-4, 1.9, 2.1),
        (silent.replace(noise_K_w=0.15), 4e-3, 1.75, 2.15),
    ):
        errors = []
        for dt in steps:
            run = jm.simulate(task, KEY, duration=2.0, dt=dt, rate=1 / dt, substeps=1)
            x, found = np.asarray(run.state("x_z")), np.asarray(run.output)
            errors.append(
                np.std((x[2:] - 2 * x[1:-1] + x[:-2]) / dt**2 - found[1:-1]) / found.std()
            )
        assert errors[-1] < least
        assert lowest < references.observed_order(steps, errors) < highest


@pytest.mark.slow
def test_plain_monte_carlo_has_the_expected_spectrum(x64):
    """Of the nonlinear model, tremor and harmonic included; a settled task has forgotten its start
    by 1 s to e^-7."""
    window = (1.0, 6.12)
    base = jm.PrescribedForce(5.0, 1.0, observe="acceleration")
    task = jm.model.on_rung(base, 2).replace(
        resonance_amplitude=0.05, harmonic_amplitude=base["harmonic_amplitude"]
    )
    task = task.settled()
    # Three segments of 400 seeds leave 3 %; the step changes a bin by 0.1 % at most.
    options = {"seeds": 400, "duration": window[1], "dt": 1e-3, "substeps": 1, "control": False}
    runs = jm.ensemble(task, KEY, **options)
    power = np.asarray(runs.spectrum(window=window).power)
    expected = jm.expected_spectrum(task, window=window)
    assert expected.unit == "m/s^2"
    z = (power.mean(axis=0) - np.asarray(expected.power)) / (
        power.std(axis=0, ddof=1) / np.sqrt(len(power))
    )
    references.assert_standard_normal(z, every=3)
    # The window holds no whole number of cycles of the harmonic, whose mean acceleration in it is
    # that without noise.
    means = np.asarray(runs.between(window)).mean(axis=1)
    silent = references.quiet(task).replace(resonance_amplitude=0.0)
    # all alike: by the same program
    still = np.asarray(jm.ensemble(silent, KEY, **options).between(window)).mean()
    assert abs(means.mean() - still) < 4 * means.std(ddof=1) / np.sqrt(len(means))


def test_a_file_says_what_it_holds(tmp_path):
    task = jm.PrescribedForce(observe="acceleration")
    found = jm.ensemble(task, KEY, seeds=4, store=tmp_path / "runs.zarr")
    assert (
        found["a_z"].attrs["units"] == "m/s^2" and found["power"].attrs["units"] == "(m/s^2)^2/Hz"
    )
    summary = jm.ensemble(task, KEY, seeds=4, reduce=True)
    assert "coefficient of variation" not in str(summary)
