"""The linear response of many points by programs that models share: the numbers and slopes of one
whole program, and how many programs a fit makes."""

import json

import jax
import numpy as np
import pytest
from compiled import at_once
from processes import ended, true_python

import jaxmuscle as jm
from jaxmuscle._common.arrays import as_arrays
from jaxmuscle.response._expected import response
from jaxmuscle.response._rows import Sampling, moments_of_rows

WINDOW = (4.0, 20.0)
TREMOR = jm.ResonantNoise(0.006, frequency=9.0, width=1.5)
SLOW = jm.ResonantNoise(0.01, frequency=3.5, width=1.5)
ALL = [0.02, 0.01, 0.003, 0.001, 0.02]
OWN = (
    *("k_w", "c_w", "k_z", "m_w", "P_w", "noise_K_w", "noise_P_w", "noise_correlation_time"),
    *("activation_time", "resonance_frequency", "resonance_2_width", "harmonic_frequency"),
)
SETTINGS = {
    "instant": jm.SpectrumSettings(),
    "filtered": jm.SpectrumSettings(sampling="filtered", filter_direction="both"),
    "average": jm.SpectrumSettings(sampling="average", rate=200.0, length=512, detrend="linear"),
    "long": jm.SpectrumSettings(sampling="filtered", length=1280, window="dpss", tapers=3),
}
TASKS = {
    "base": jm.Isometric(),
    "all parts": jm.Isometric(
        noise=jm.OrnsteinUhlenbeckNoise(ALL, 0.05) + TREMOR + SLOW, activation=jm.Activation(0.06)
    ),
    "shared": jm.PrescribedForce(
        noise=jm.BandLimitedNoise(shared=True), activation=jm.Activation(0.06)
    ),
    "pink": jm.PrescribedLength(noise=jm.PinkNoise(0.02), harmonic=jm.Harmonic(0.01, 5.3)),
    "enveloped": jm.Isometric(
        harmonic=jm.Harmonic(0.02, 5.3, envelope=jm.model.Decay(1.0, start=6.0, final=0.3))
    ),
    "motion": jm.PrescribedMotion(noise=jm.BandLimitedNoise() + TREMOR, F_ext=10.0),
}


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("base", "filtered"),
        ("all parts", "instant"),
        ("shared", "average"),
        ("pink", "filtered"),
        ("enveloped", "instant"),
        pytest.param("motion", "long", marks=pytest.mark.slow),
        pytest.param("all parts", "long", marks=pytest.mark.slow),
        pytest.param("pink", "average", marks=pytest.mark.slow),
    ],
)
def test_moments_and_slopes_are_those_of_one_program(x64, name, kind):
    """To 1e-9 of the largest bin: of a bin without power two programs differ by rounding."""
    task, settings = TASKS[name], SETTINGS[kind]
    own = tuple(n for n in OWN if n in task.parameter_names)
    values = np.array([float(task[n]) for n in own]) * np.array([[1.0], [1.03]])
    sampled = Sampling(settings, WINDOW, 1500, 0.001)
    found, slopes, _ = moments_of_rows(task, own, values, sampled)

    def whole(at):
        there = as_arrays(task).replace(**dict(zip(own, at, strict=True)))
        return response(there, settings, WINDOW, np.array(1500), np.array(0.001))[0]

    def both(at):
        return jax.tree.leaves(whole(at)), jax.tree.leaves(jax.jacfwd(whole)(at))

    expected, by = at_once(both, values[1])
    every = zip(*map(jax.tree.leaves, (found, expected, slopes, by)), strict=True)
    for value, aim, slope, along in every:
        np.testing.assert_allclose(value[1], aim, rtol=0, atol=1e-9 * np.max(np.abs(aim)))
        each, size = along * values[1], np.max(np.abs(along * values[1]))
        np.testing.assert_allclose(slope[1] * values[1], each, rtol=0, atol=1e-9 * size)


def test_slopes_along_some_of_what_is_given_or_none(x64):
    task, own = TASKS["all parts"], ("k_w", "activation_time", "resonance_frequency")
    values = np.array([[float(task[n]) for n in own]] * 3) * np.array([[1.0], [1.1], [0.9]])
    sampled = Sampling(SETTINGS["instant"], WINDOW, 1500, 0.0)
    all_values, slopes, _ = moments_of_rows(task, own, values, sampled)
    some_values, some, _ = moments_of_rows(task, own, values, sampled, along=own[2:])
    none_values, none, _ = moments_of_rows(task, own, values, sampled, along=())
    for found in (some_values, none_values):
        jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-12), found, all_values)
    np.testing.assert_allclose(some.power[..., 0], slopes.power[..., 2], rtol=1e-9, atol=1e-20)
    assert none.power.shape == (3, 30, 0)


COUNTED = """
import collections, json, re
import numpy as np, jaxmuscle as jm
from jaxmuscle._common import programs
names, compiled = [], programs._machine_code
def counted(lowered, options):
    names.append(re.search(r"module @jit_(\\w+)", lowered.as_text())[1])
    return compiled(lowered, options)
programs._machine_code = counted
def fit(quantity, length, rungs=(0, 1, 2, 3)):
    settings = jm.SpectrumSettings(sampling="filtered", length=length)
    f = settings.frequency
    power = 1 / (0.3 + f**1.6) + 0.02 * np.exp(-0.5 * ((f - 9) / 0.8) ** 2)
    target = jm.Target("made", power, settings=settings, segments=[12], quantity=quantity)
    for rung in rungs:
        task = jm.model.on_rung(target.task(), rung)
        jm.fit(task, target, starts=4, seeds=2, check_seeds=0, rungs=0, method="linear")
    found = collections.Counter(names)
    names.clear()
    return found
print(json.dumps([fit("force", 256), fit("force", 200, (0, 3)), fit("displacement", 256, (3,))]))
"""
# of each model: what simulates it, and what looks for the second order of its own noise
OF_EACH_MODEL = {"run_seeds", "_start", "_parts", "_inputs", "further_residuals"}


def test_a_fit_through_all_models_compiles_no_program_twice():
    """But for two sizes of the large one, for what is with and without an activation, and for what
    only a single model needs. Another length of segments needs none, another kind of task its
    own."""
    said, _ = ended(true_python(COUNTED, JAXMUSCLE_CACHE="off"), seconds=900)
    first, other, moved = json.loads(said)
    twice = {name for name, count in first.items() if count > 1} - OF_EACH_MODEL
    # `_parts_of`: of the main noise with and without activation, and of a resonance
    assert twice <= {"_noise_rows", "_parts_of", "_line_of"}
    assert first["_noise_rows"] == 2 and first["_parts_of"] <= 3 and first["_line_of"] <= 2
    assert set(other) <= OF_EACH_MODEL | {"_kept_arrays", "_operator", "_lowpass", "filtered_power"}
    assert moved["_noise_rows"] <= 2 and moved["_operating_points"] == 1
