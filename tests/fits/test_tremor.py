"""A tremor that an accelerometer recorded: found by a fit, from the recording to the file."""

import functools

import jax
import numpy as np
import pytest

import jaxmuscle as jm
from jaxmuscle.fits._cohort import _alike
from jaxmuscle.objective._arguments import planned
from jaxmuscle.objective._options import FitOptions

TREMOR = {"resonance_amplitude": 0.05, "resonance_frequency": 8.0, "resonance_width": 1.0}
TRUTH = jm.model.on_rung(jm.PrescribedForce(observe="acceleration"), 2).replace(**TREMOR)


@functools.cache
def target() -> jm.Target:
    """Of a minute of the nonlinear model, in g and with gravity, as a sensor on the finger has
    it."""
    run = jm.simulate(TRUTH.settled(), jax.random.key(1), duration=65.0)
    samples = np.asarray(run.output, dtype=float)[500:] / 9.81 + 0.7
    return jm.Recording(samples, 100.0, unit="g", name="finger").steady().target()


@functools.cache
def result() -> jm.fits.FitResult:
    task = jm.model.on_rung(target().task(), 2)
    return jm.fit(task, target(), starts=16, seeds=16, check_seeds=16)  # as many each: one program


@pytest.mark.slow
def test_the_tremor_is_recovered():
    found = result()
    assert found.success and found.adequate
    assert "PrescribedForce (acceleration)" in found.details()
    for name, true in (
        ("resonance_frequency", 8.0),
        ("resonance_width", 1.0),
        ("contraction_time", 0.06),
    ):
        q = found.derived[name]
        assert q.stderr is not None and abs(q.value - true) < 4 * q.stderr < 2 * true
        assert name != "resonance_frequency" or q.stderr < 0.2  # half a bin
    about_zero = {"model_mean", "model_coefficient_of_variation", "half_power_frequency"}
    assert not about_zero & set(found.derived)
    assert found.check["largest_deviation"] < 0.05  # linear response and simulation agree


def test_its_file_is_the_same_result(tmp_path):
    result().save(tmp_path / "fit.json")
    again = jm.load_result(tmp_path / "fit.json")
    assert again.task.quantity == again.target.quantity == "acceleration"
    assert again.derived == result().derived
    assert jm.load_preset(tmp_path / "fit.json").quantity == "acceleration"


def test_an_acceleration_and_a_displacement_that_look_alike_are_no_batch(x64):
    power = 1 / np.arange(1.0, 31.0)
    same = [
        jm.Target(what, power, quantity=what, segments=45)
        for what in ("acceleration", "displacement")
    ]
    plans = [planned(target.task(), target, FitOptions()) for target in same]
    assert _alike(plans[0]) != _alike(plans[1])
    assert [plan.problem.parts[0].task.quantity for plan in plans] == [
        "acceleration",
        "displacement",
    ]


def test_the_likelihood_is_highest_near_the_tremor(x64):
    low, here, high = (
        float(jm.objective.log_likelihood(TRUTH.replace(resonance_frequency=f), target()))
        for f in (7.0, 8.0, 9.0)
    )
    assert here > max(low, high) + 3
