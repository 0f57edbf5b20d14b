"""A stretch reflex in a fitted response: of an ankle that NumPy made."""

import functools
import re

import numpy as np
import pytest

import jaxmuscle as jm
from jaxmuscle.data._perturbed import explained_power
from jaxmuscle.fits._perturbed import answer_of, explained, seen_with
from jaxmuscle.fits._reflex import DELAYS, ReflexTest, with_reflex
from jaxmuscle.objective._arguments import planned
from jaxmuscle.objective._options import FitOptions

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


def response(gain, seed=1):
    generator, sd = np.random.default_rng(seed), 0.03 * np.abs(ankle(F, 0.0))
    noise = generator.normal(size=F.size) + 1j * generator.normal(size=F.size)
    return jm.data.FrequencyResponse(F, ankle(F, gain) + sd * noise, sd, name="ankle")


@functools.cache
def fitted(gain, reflex="auto"):
    # m_w is 4 kg at this arm
    task = jm.PrescribedLength(m_w=4.0, m_z=8.0)
    return jm.fit(task, response(gain), reflex=reflex, starts=32)


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


def test_two_records_of_one_person_have_one_reflex():
    """Whose gain they tell better than one of them."""
    tasks = dict.fromkeys(("left", "right"), muscle(0.0))
    aims = {"left": response(6.0), "right": response(6.0, seed=2)}
    assert "reflex_gain" not in jm.fit(tasks, aims, reflex="none").parameters
    found = jm.fit(tasks, aims)
    gain, alone = found.parameters["reflex_gain"], fitted(6.0).parameters["reflex_gain"]
    assert found.adequate and abs(gain.value - 6.0 / ARM**2) < 3.5 * gain.stderr
    assert 0.5 < gain.stderr / alone.stderr < 0.9
    low, high = found["reflex_delay"].interval
    assert low < 0.04 < high


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


def test_of_a_limb_that_is_one_spring_no_tissues_are_stated():
    """The mass between them runs off, which makes one spring of two. Gain and phase are right."""
    s = 2j * np.pi * F
    spring = (133.0 + 2.0 * s + 0.02 * s**2) / ARM**2
    noise = np.random.default_rng(3).normal(size=(2, F.size))
    sd = 0.005 * np.abs(spring)
    seen = jm.data.FrequencyResponse(F, spring + sd * (noise[0] + 1j * noise[1]), sd)
    found = jm.fit(jm.PrescribedLength(m_w=4.0, m_z=8.0), seen, starts=32)
    assert "reflex_gain" not in found.parameters
    assert any(notice.startswith("m_w went to ") for notice in found.notices)
    for name in ("K_w_tangent", "K_z0", "k_w", "tangent_stiffness", "B0"):
        assert found[name].stderr is None and found[name].interval is None, name
    for f, gain in zip(found.only.thirds, ("gain_low", "gain_middle", "gain_high"), strict=True):
        H = abs(np.interp(f, F, spring))
        assert abs(found[gain].value - H) < 3.5 * found[gain].stderr < 0.02 * H


def test_what_cannot_be_told_is_said():
    nothing = np.zeros(len(DELAYS))
    shifts = {"K_z0": (0.4, 2.5), "K_w_tangent": (0.01, 0.2)}
    unsure = ReflexTest(0.31, nothing, 12.3, shifts)
    assert not unsure.seen
    assert unsure.notice.startswith("muscle and stretch reflex cannot be told apart in these data.")
    assert "would change K_z0 by 40 %, more than the errors, which hold if" in unsure.notice
    assert "K_w_tangent" not in unsure.notice and "20 or 30 Hz" in unsure.notice
    sure = ReflexTest(0.31, nothing, 12.3, {"K_z0": (0.01, 0.3)})
    assert sure.notice == (
        "no stretch reflex is seen (p = 0.31). One of 12 N s/m would have been seen"
    )


RATE, SECONDS = 1000, 68


def moved(gain, one_way, seed=3):
    """A minute and margins of the ankle moved to 25 Hz, 16 mrad rms, and the share of the variance
    of its force from 0.5 to 25 Hz that is the answer; with a reflex that answers lengthening alone,
    if it is `one_way`."""
    generator, n = np.random.default_rng(seed), RATE * SECONDS
    f = np.fft.rfftfreq(n, 1 / RATE)
    inside = (f >= 0.5) & (f <= 25)
    X = np.fft.rfft(generator.standard_normal(n)) * inside
    X *= 0.016 / np.std(np.fft.irfft(X, n))
    s = 2j * np.pi * f
    answer = ankle(f, 0.0) * X
    speed = np.fft.irfft(s * X, n)
    felt = np.fft.rfft(np.maximum(speed, 0.0) if one_way else speed)
    twitch = (ankle(f, gain) - ankle(f, 0.0))[1:] / s[1:] * felt[1:]
    answer += np.append(0.0, twitch)
    own = np.fft.rfft(generator.standard_normal(n)) * 60 / (1 + 1j * f / 2)
    share = 1 - np.sum(np.abs(own[inside]) ** 2) / np.sum(np.abs((answer + own)[inside]) ** 2)
    pull, arm = 200.0 + ARM * np.fft.irfft(answer + own, n), ARM
    given = jm.data.PerturbedRecording.from_array(
        pull, arm * np.fft.irfft(X, n), RATE, positive="lengthening", window=(4.0, 64.0)
    )
    return given, share


def muscle(gain):
    """The same as a task. Its stiffness is that of the ankle where P_w is 0."""
    values = {"m_w": 0.01, "m_z": 0.02, "c_w": 6.0, "c_z": 1.0}
    task = jm.PrescribedLength(**{name: value / ARM**2 for name, value in values.items()})
    stiff = {f"k_{j}": STIFF[name] / 4e-4 for j, name in (("w", "K_w_tangent"), ("z", "K_z0"))}
    reflex = jm.model.Reflex(gain / ARM**2, 0.04, 0.05) if gain else None
    return task.replace(P_w=0.0, **stiff).with_parts(reflex=reflex)


@pytest.mark.parametrize("one_way", [True, False])
def test_a_reflex_to_lengthening_alone_is_seen_and_taken_off(one_way, x64):
    """Of one to lengthening alone the linear part has half of the gain."""
    given, share = moved(20.0, one_way)
    task = muscle(10.0 if one_way else 20.0)
    target = seen_with(task, (given,))
    said = [notice for notice in target.notices if notice.startswith("the reflex answers")]
    power, whole = explained_power((given,), answer_of(task), (0.5, 25.0))
    assert power / whole == pytest.approx(share, abs=0.004)
    if not one_way:
        assert not said
        return
    (words,) = said
    percent, error = (float(x) for x in re.findall(r"(\d+) ± (\d+) %", words)[0])
    assert abs(percent - 100) < 3 * max(error, 1.0) < 20
    linear, _ = explained_power((given,), answer_of(task)._replace(beside=None), (0.5, 25.0))
    assert linear / whole < share - 0.02


def test_the_shares_of_tissues_and_reflex_and_that_of_the_other_half(x64):
    """Of the answer as it was made; of one half, fitted from far off, that of the other."""
    given, share = moved(20.0, one_way=False)
    windows = []

    def planned_for(target, some):
        windows.extend(one.window for one in some)
        task = muscle(0.0).replace(c_w=4000.0, c_z=300.0)
        options = FitOptions(free=("k_w", "k_z", "c_w", "c_z", "m_z"))
        task, options = with_reflex(task, options)
        return planned(task, jm.Target("half", None, stiffness=target.stiffness), options)

    found = explained(muscle(20.0), (given,), (0.5, 25.0), planned_for, 60)
    assert windows == [(4.0, 34.0), (34.0, 64.0)]
    assert (found["low"], found["high"]) == (0.5, 25.0)
    assert found["together"] == pytest.approx(share, abs=0.004)
    assert found["tissues"] + found["reflex"] == pytest.approx(found["together"])
    assert found["reflex"] > 0.02
    assert found["together"] - 0.02 < found["other_half"] < found["together"] + 0.005
    # a minute that is too short for halves has the other shares
    short = given.steady((4.0, 18.0))
    assert "other_half" not in explained(muscle(20.0), (short,), (0.5, 25.0), planned_for, 60)


def test_what_is_asked_for_must_be_known():
    with pytest.raises(ValueError, match=r"reflex = 'maybe': "):
        jm.fit(jm.Isometric(), "vastus-lateralis-26mvc", reflex="maybe")
