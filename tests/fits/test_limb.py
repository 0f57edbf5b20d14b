"""What is stated of a moved limb: what holds whatever its tissues are, what if there are two in
series, and what rests on the prior."""

import math

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

import jaxmuscle as jm
from jaxmuscle.fits._report import lopsided
from jaxmuscle.fits._stages import Stage
from jaxmuscle.fits._verdict import Endpoint
from jaxmuscle.objective._arguments import at_mean, planned
from jaxmuscle.objective._derived import of_response, tangents, thirds
from jaxmuscle.objective._least_squares import least_squares
from jaxmuscle.objective._options import FitOptions
from jaxmuscle.reports._fit_text import fit_text
from jaxmuscle.response._expected_moments import expected_moments
from jaxmuscle.spectra._bin_law import bin_statistics, recorded_interval, trial_samples
from jaxmuscle.spectra._settings import WINDOW

TASK = jm.PrescribedLength().replace(harmonic_amplitude=0.0)
# a strong muscle, not where a fit begins
STRONG = TASK.replace(
    **{"m_w": 0.3, "m_z": 1.0, "k_w": 1500 / 4e-4, "k_z": 3000 / 4e-4, "c_w": 150.0, "c_z": 20.0},
    **{"P_w": 60.0, "noise_K_w": 0.15, "noise_K_z": 0.003},
)
QUICK = {"rungs": 0, "starts": 16, "seeds": 0, "check_seeds": 0}
BASES = {"K_w0": 1500.0, "K_z0": 3000.0, "C_w0": 150.0, "C_z0": 20.0}


def truth():
    """Of the strong muscle, by the equations of two tissues in series."""
    x = scipy.optimize.brentq(lambda x: 1500 * (1 + (x / 0.02) ** 2) * x + 3000 * x - 60, 0, 0.5)
    return BASES | {"K_w_tangent": 1500 * (1 + 3 * (x / 0.02) ** 2), "mean": 3000 * x, "m_z": 1.0}


def answer(f):
    """Its dynamic stiffness."""
    s, T = 2j * np.pi * f, truth()["K_w_tangent"]
    active, passive = 0.3 * s**2 + 150 * s + T, 20 * s + 3000
    return active * passive / (active + passive) + s**2


def exactly(mean=None, error=1.0):
    """Exact response, spectrum, variation and mean, with the errors of a minute moved by 1 mm rms
    from 0.5 to 5 Hz; those of the response times `error`."""
    f, settings = np.geomspace(0.5, 5.0, 22), STRONG.settings
    noise, moved = np.asarray(jm.response.noise_density(STRONG, f)), 1e-6 / 4.5
    stderr = np.sqrt(noise / (2 * 60 * np.clip(0.12 * f, 0.05, 0.4) * moved))
    power = np.asarray(jm.response.expected_spectrum(STRONG).proportional)
    given = {"segments": 46, "settings": settings}
    bare = jm.Target("exact", power, coefficient_of_variation=0.01, **given)
    sampled = trial_samples(bare), recorded_interval(bare, settings)
    moments, _ = expected_moments(STRONG, settings, WINDOW, *sampled)
    biased = np.asarray(moments.power) * np.exp(bin_statistics(bare).bias)
    return jm.Target(
        "exact",
        biased / biased.sum(),
        coefficient_of_variation=float(np.sqrt(moments.variance) / moments.mean),
        mean=truth()["mean"] if mean is None else mean,
        unit="N",
        stiffness=jm.data.FrequencyResponse(f, answer(f), error * stderr),
        **given,
    )


@pytest.fixture(scope="module")
def exact():
    return exactly()


@pytest.fixture(scope="module")
def fitted(exact):
    return jm.fit(TASK, exact, rungs=0, seeds=0, check_seeds=0)


def test_damping_goes_with_the_root_of_the_force_where_the_masses_stay():
    """Then the damping ratio C / 2√(K m) is that of the task."""
    task, _ = at_mean(TASK, exactly(35.76), FitOptions())
    assert task["c_w"] == pytest.approx(243, abs=1)
    assert task["c_z"] == pytest.approx(20.3, abs=0.1)
    assert task["m_w"] == TASK["m_w"] and task["m_z"] == TASK["m_z"]
    ratio = [float(t["c_w"]) / math.sqrt(float(t["k_w"]) * float(t["m_w"])) for t in (TASK, task)]
    assert ratio[1] == pytest.approx(ratio[0])


@pytest.mark.parametrize(("task", "value"), [(TASK, 9.33), (STRONG, 41.46)])
def test_slow_damping_in_closed_form(task, value, x64):
    for x_z in (0.0, 0.004):
        held = task.replace(x_z=x_z)
        rest = jnp.asarray(jm.response.linearise(held).rest)
        found = {n: float(v) for n, v in tangents(held, rest).items()}
        H = complex(np.asarray(jm.response.dynamic_stiffness(held, np.array([1e-4])))[0])
        assert found["B0"] == pytest.approx(H.imag / (2e-4 * np.pi), rel=1e-5)
        assert found["tangent_stiffness"] == pytest.approx(H.real, rel=1e-5)
        if x_z == 0:
            assert found["B0"] == pytest.approx(value, abs=0.005)


def test_exact_data_give_the_muscle_back(fitted):
    """Within the bounds of the issue, although the prior has another muscle in its centre."""
    true = truth()
    T, K = true["K_w_tangent"], 3000.0
    assert fitted.adequate
    assert fitted["K_z0"].value == pytest.approx(K, rel=0.05)
    assert fitted["K_w_tangent"].value == pytest.approx(T, rel=0.06)
    assert fitted["tangent_stiffness"].value == pytest.approx(T * K / (T + K), rel=0.01)
    assert fitted["B0"].value == pytest.approx(41.46, rel=0.01)
    for f, gain, phase in zip(fitted.only.thirds, *names_of_response(), strict=True):
        assert fitted[gain].value == pytest.approx(abs(answer(f)), rel=0.01)
        assert fitted[phase].value == pytest.approx(np.degrees(np.angle(answer(f))), abs=0.3)
    for name in ("tangent_stiffness", "B0", "m_z", *np.ravel(names_of_response())):
        low, high = fitted[name].interval
        assert fitted[name].stderr and low < fitted[name].value < high, name


def names_of_response():
    return [
        [f"{what}_{third}" for third in ("low", "middle", "high")] for what in ("gain", "phase")
    ]


def test_what_holds_whatever_the_tissues_are_is_printed_first(fitted):
    text = fit_text(fitted)
    lines = text.splitlines()
    assert len(lines) <= 24
    below = next(i for i, line in enumerate(lines) if "two tissues in series" in line)
    above, split = "\n".join(lines[:below]), lines[below + 1 : below + 5]
    for said in ("tangent_stiffness, H(0)", "B0, damping", "m_z, moved mass"):
        assert said in above
    assert sum("deg" in line for line in lines[:below]) == 3
    # their errors would not describe these intervals
    assert [line.split()[0] for line in split] == ["K_w_tangent", "K_z0", "C_w0", "C_z0"]
    assert not any("±" in line for line in split)
    assert "stiffness" not in text.partition("NOT KNOWN")[2].partition("\n")[0]


def test_an_end_that_only_the_prior_stops_is_open():
    """Of three times the errors: the passive damping is known from above alone."""
    result = jm.fit(TASK, exactly(error=3.0), **QUICK)
    low, high = result["C_z0"].interval
    assert low is None and high > 20 and result["C_z0"].stderr is None
    assert f"C_z0{'':24}below {high:.3g} N s/m" in fit_text(result)


def test_wide_priors_lead_where_a_fit_with_wide_priors_ends(exact, fitted, x64):
    task, options = at_mean(TASK, exact, FitOptions())
    plan = planned(task, exact, options)
    problem, names = plan.problem, plan.problem.coordinates.names
    objective = problem.linear()
    found = least_squares(objective, np.zeros((1, len(names))), 100)
    ended = Endpoint.of(problem, Stage("here", objective, found))
    wide = ended.with_wide_priors(found, 100)
    sds = {n: 3 * sd for n, sd in fitted.settings["prior_sd"].items()}
    other = jm.fit(TASK, exact, priors=sds, **QUICK)
    for name, value in wide.values_of(("K_z0", "C_z0", "K_w_tangent", "m_w")).items():
        assert value == pytest.approx(other[name].value, rel=0.01), name
        assert value != pytest.approx(ended.values_of([name])[name], rel=0.002), name


def test_what_rests_on_the_prior_is_said_and_has_the_wide_interval(exact, fitted):
    """A prior that is sure of twice the passive damping; the usual one moves nothing."""
    sure = TASK.replace(c_z=2 * float(TASK["c_z"]))
    result = jm.fit(sure, exact, priors={"c_z": 0.1}, **QUICK)
    said = [notice for notice in result.notices if notice.startswith("rests on the prior")]
    assert len(said) == 1 and "C_z0" in said[0].partition(".")[0]
    low, _ = result["C_z0"].interval
    # the prior alone would hold it within a factor of 1.2 of 40 N s/m
    assert result["C_z0"].value > 30 and (low or 0.0) < 25
    assert not any(notice.startswith("rests on") for notice in fitted.notices)


def test_errors_of_the_tissues_are_stated_together_or_not_at_all():
    straight = jm.fits.Estimate(10.0, "N/m", 1.0, interval=(8.0, 12.0))
    bent = jm.fits.Estimate(10.0, "N/m", 1.0, interval=(8.0, 14.0))
    named = {"B0": straight, "K_z0": straight, "k_z": straight, "C_w0": bent}
    assert lopsided(named) == {"K_z0", "k_z", "C_w0"}
    assert lopsided(named | {"C_w0": straight}) == set()
    assert lopsided({"B0": jm.fits.Estimate(10.0, "N s/m", 1.0, interval=(None, 12.0))}) == {"B0"}


def test_the_thirds_are_of_the_band_that_was_moved():
    f = np.geomspace(0.1, 10.0, 41)
    stderr = np.where((f > 0.45) & (f < 5.1), 1.0, 50.0)
    at = f[thirds(f, np.full(41, 100.0 + 0j), stderr)]
    np.testing.assert_allclose(at, 0.5 * 10 ** (np.array([1, 3, 5]) / 6), rtol=0.08)


def test_a_phase_near_half_a_turn_does_not_jump():
    H = np.exp(1j * np.radians([179.0, -179.0]))
    rows = np.stack([H.real, H.imag], axis=1)[:, :, None].repeat(3, axis=2)
    measured = rows[0]
    found, slopes = of_response(rows, rows[..., None], measured, np.arange(3))
    np.testing.assert_allclose(found["phase_low"], [179.0, 181.0])
    np.testing.assert_allclose(found["gain_low"], 1.0)
    np.testing.assert_allclose(slopes["gain_low"], 1.0)  # along itself it grows, and does not turn
    np.testing.assert_allclose(slopes["phase_low"], 0.0, atol=1e-12)
