"""A stretch reflex in a fitted response: of an ankle that NumPy made."""

import functools

import numpy as np
import pytest

import jaxmuscle as jm
from jaxmuscle.fits._reflex import DELAYS, ReflexTest

F = np.geomspace(0.5, 30.0, 45)
ARM = 0.05  # m
STIFF = {"K_w_tangent": 200 / ARM**2, "K_z0": 400 / ARM**2}  # N/m
ACTIVE = 200 * 400 / 600 / ARM**2  # of both in series


def ankle(f, gain):
    """Two tissues and a velocity reflex of 40 ms, in joint units (N m/rad), carried to the arm."""
    s = 2j * np.pi * f
    z = 400.0 + 1.0 * s
    d = 0.01 * s**2 + 6.0 * s + 200.0 + z
    reflex = gain * s * np.exp(-0.04 * s) / (1 + 0.05 * s) ** 2
    return (0.02 * s**2 + z - z**2 / d + z / d * reflex) / ARM**2


@functools.cache
def fitted(gain, reflex="auto", seed=1):
    generator, sd = np.random.default_rng(seed), 0.03 * np.abs(ankle(F, 0.0))
    noise = generator.normal(size=F.size) + 1j * generator.normal(size=F.size)
    given = jm.data.FrequencyResponse(F, ankle(F, gain) + sd * noise, sd, name="ankle")
    # m_w is 4 kg at this arm
    return jm.fit(jm.PrescribedLength(m_w=4.0, m_z=8.0), given, reflex=reflex, starts=32)


def test_a_reflex_is_told_from_the_muscle():
    found = fitted(6.0)
    assert found.adequate and found.parameters["reflex_delay"].stderr is not None
    for name, true in {
        "reflex_gain": 6.0 / ARM**2,
        "reflex_delay": 0.04,
        "reflex_time": 0.05,
        **STIFF,
        "tangent_stiffness": ACTIVE,
    }.items():
        error = found[name].stderr
        assert error is not None and abs(found[name].value - true) < 3.5 * error < 0.5 * true, name
    assert found.ladder[-1].chosen and found.ladder[-1].model.endswith(" + stretch reflex")
    text = str(found)
    assert "stretch reflex: fits" in text and "reflex, delay" in text


def test_without_it_the_muscle_is_wrong_and_the_verdict_says_so():
    """The prototypes found the stiffness off by half."""
    left_out = fitted(6.0, "none")
    assert left_out.adequate is False and "reflex_gain" not in left_out.parameters


def test_none_is_found_where_none_is_and_it_is_said_what_would_have_been():
    found = fitted(0.0)
    assert "reflex_gain" not in found.parameters and found.adequate
    (said,) = (notice for notice in found.notices if "stretch reflex is seen (p = " in notice)
    assert " N s/m) would" in said or "would have been seen" in said


def test_it_is_fitted_where_that_is_asked_for():
    found = fitted(0.0, "linear")
    gain = found.parameters["reflex_gain"]
    assert gain.stderr is None or gain.value < 4 * gain.stderr


def test_what_cannot_be_told_is_said():
    nothing = np.zeros(len(DELAYS))
    shifts = {"K_z0": (0.4, 2.5), "K_w_tangent": (0.01, 0.2)}
    unsure = ReflexTest(0.31, nothing, 12.3, shifts)
    assert not unsure.seen
    assert unsure.notice.startswith("muscle and stretch reflex cannot be told apart in these data.")
    assert "would change K_z0 by 40 %, more than the stated errors" in unsure.notice
    assert "K_w_tangent" not in unsure.notice and "20 or 30 Hz" in unsure.notice
    sure = ReflexTest(0.31, nothing, 12.3, {"K_z0": (0.01, 0.3)})
    assert sure.notice == (
        "no stretch reflex is seen (p = 0.31). One of 12 N s/m would have been seen"
    )


def test_what_is_asked_for_must_be_known():
    with pytest.raises(ValueError, match=r"reflex = 'maybe': "):
        jm.fit(jm.Isometric(), "vastus-lateralis-26mvc", reflex="maybe")
