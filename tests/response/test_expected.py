"""The expected spectrum: against quadrature of hand-derived transfer functions, scipy, simulation;
derivatives, errors."""

import functools
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import references
import scipy.linalg
import scipy.optimize
import scipy.signal
from compiled import at_once, kept_jit

import jaxmuscle as jm
from jaxmuscle._common import programs
from jaxmuscle._common.arrays import as_arrays
from jaxmuscle.model import Constant, Decay, RampHold
from jaxmuscle.objective._coordinates import Coordinates
from jaxmuscle.objective._problem import Part, target_variation
from jaxmuscle.response._autocovariance import Autocovariance
from jaxmuscle.response._expected import covariance_operator, expected_powers, lags_of
from jaxmuscle.response._expected_moments import expected_moments, linear_spectrum
from jaxmuscle.response._harmonic_line import _ordinates, line_table
from jaxmuscle.response._linearised import check_equilibrium, has_response, linearised
from jaxmuscle.response._rows import _noise_rows
from jaxmuscle.response._transfer import system_of, transfer
from jaxmuscle.spectra._bin_law import bin_rows
from jaxmuscle.spectra._decimation import FINER

KEY = jax.random.key(31)
WINDOW, SHIFTED = (5.0, 15.0), (2.7, 12.7)
Settings = jm.SpectrumSettings


def root(function):
    return scipy.optimize.brentq(function, -1.0, 1.0, xtol=1e-16, rtol=1e-15)


def coefficients(p, x_w, x_z):
    """At rest: K_w's tangent, K_z, C_w, C_z."""
    K_w = p["k_w"] * (p["x_ref_w"] ** 2 + 3 * x_w**2)
    K_z = p["k_z"] * (p["x_ref_z"] ** 2 + x_z**2)
    return K_w, K_z, p["c_w"] * p["v_ref_w"] ** 2, p["c_z"] * p["v_ref_z"] ** 2


def active(p, x):
    return p["k_w"] * (p["x_ref_w"] ** 2 + x**2) * x


def isometric(p, s):
    """Responses of F_ext to N_Kw, N_Kz and P_w by equation (1a) with x_z held, and F_ext at
    rest."""
    held = p["x_z"]
    K_z = coefficients(p, 0.0, held)[1]
    x = root(lambda x: active(p, x) + K_z * (x - held) - p["P_w"])
    K_w, _, C_w, C_z = coefficients(p, x, held)
    passive = (C_z * s + K_z) / (p["m_w"] * s**2 + (C_w + C_z) * s + K_w + K_z)
    return -x * passive, (x - held) * (1 - passive), passive, K_z * (x - held)


def prescribed_force(p, s):
    """Responses of x_z by (1a) and (1b), solved by Cramer's rule; K_z at x_z as printed, so its
    tangent is not K_z."""
    x_w = root(lambda x: active(p, x) + p["F_ext"] - p["P_w"])
    x_z = root(lambda z: coefficients(p, x_w, z)[1] * (z - x_w) + p["F_ext"])
    K_w, K_z, C_w, C_z = coefficients(p, x_w, x_z)
    tangent = K_z + 2 * p["k_z"] * x_z * (x_z - x_w)
    inner, link = p["m_w"] * s**2 + (C_w + C_z) * s + K_w + K_z, C_z * s + K_z
    outer, back = p["m_z"] * s**2 + C_z * s + tangent, C_z * s + tangent
    determinant = inner * outer - back * link
    return (
        -link * x_w / determinant,
        (x_z - x_w) * (link - inner) / determinant,
        link / determinant,
        x_z,
    )


def prescribed_motion(p, s):
    """Responses of P_w: (1b) gives x_w, (1a) then P_w."""
    K_z = coefficients(p, 0.0, p["x_z"])[1]
    x = p["x_z"] + p["F_ext"] / K_z
    K_w, _, C_w, C_z = coefficients(p, x, p["x_z"])
    along = (p["x_z"] - x) / (C_z * s + K_z)
    return x + 0 * s, along * (p["m_w"] * s**2 + C_w * s + K_w), 0 * s, active(p, x) + p["F_ext"]


def acceleration(p, s):
    """Responses of x_z'': s² those of x_z."""
    *moved, _ = prescribed_force(p, s)
    return *(s**2 * H for H in moved), 0.0


RESPONSES = {
    "F_ext": isometric,
    "x_z": prescribed_force,
    "a_z": acceleration,
    "P_w": prescribed_motion,
}


def stiffness(p):
    return p["k_w"] * p["x_ref_w"] ** 2, p["k_z"] * p["x_ref_z"] ** 2


def replies(task, p, f):
    """Of the output to a relative change of K_w, K_z, C_w, C_z and P_w; at rest damping does
    nothing."""
    s = 2j * np.pi * f
    H_w, H_z, H_P, _ = RESPONSES[task.output_name](p, s)
    (K_w, K_z), twitch = stiffness(p), 1 / (1 + s * p.get("activation_time", 0.0)) ** 2
    return np.stack([K_w * H_w * twitch, K_z * H_z, 0 * s, 0 * s, p.get("P_w", 0.0) * H_P * twitch])


def shape(noise, f):
    """Two-sided density of a noise of amplitude 1."""
    match noise:
        case jm.WhiteNoise():
            return 1 / noise.rate
        case jm.BandLimitedNoise():
            return 1 / noise.rate / (1 + (f / noise.cutoff) ** 4)
        case jm.ResonantNoise():
            return (
                noise.width
                / np.pi
                * f**2
                / ((noise.frequency**2 - f**2) ** 2 + noise.width**2 * f**2)
            )
        case _:
            tau = noise.correlation_time
            return 2 * tau / (1 + (2 * np.pi * f * tau) ** 2)


ACTS_ON = {1: [4], 4: [0, 1, 2, 3], 5: [0, 1, 2, 3, 4]}


def density(task, p, settings, f):
    """Two-sided density of the output's noise before sampling."""
    total, reply = np.zeros(np.shape(f)), replies(task, p, f)
    for noise in task.noise.components:
        part = np.asarray(noise.amplitude)[:, None] * reply[ACTS_ON[len(noise.amplitude)]]
        gain = np.abs(part.sum(axis=0)) ** 2 if noise.shared else np.sum(np.abs(part) ** 2, axis=0)
        total = total + gain * shape(noise, f)
    averaged = np.sinc(f / settings.rate) ** 2 if settings.sampling == "average" else 1.0
    return total * averaged


REACH = 100


def sampled(density, rate, f):
    """Density of the sampled signal, the aliases beyond REACH as the integral over their power
    law."""
    total = references.aliased(density, rate, f, REACH)
    for sign in (-1, 1):
        near, far = f + sign * (REACH + 1) * rate, f + 2 * sign * (REACH + 1) * rate
        edge = np.abs(f + sign * (REACH + 0.5) * rate)
        at_near, at_far = density(near), density(far)
        seen = at_near > 0
        power = np.log(at_near[seen] / at_far[seen]) / np.log(far[seen] / near[seen])
        total[seen] += (
            at_near[seen]
            * (np.abs(near[seen]) / edge[seen]) ** power
            * edge[seen]
            / ((power - 1) * rate)
        )
    return total


def against_aliases(settings, f, finer):
    """Frequency response of the low-pass of `scipy.signal.resample_poly`, from a rate so many times
    that of the samples."""
    taps = scipy.signal.firwin(20 * finer + 1, 1 / finer, window=("kaiser", 5.0))
    return scipy.signal.freqz(taps, worN=np.abs(f), fs=finer * settings.rate)[1]


def filtered(density, settings, f, recorded_at=None):
    """Density of samples low-passed before: of a signal known at all times, or of a recording with
    its aliases."""
    total = np.zeros(len(f))
    for shifted in (f + k * settings.rate for k in range(-FINER // 2, FINER // 2)):
        before = density(shifted) if recorded_at is None else sampled(density, recorded_at, shifted)
        total += before * np.abs(against_aliases(settings, shifted, FINER)) ** 2
    return total


# The rest is a midpoint rule for Σ m^-2 from REACH on, which is 1 / 12 REACH³ = 8e-8 of the
# aliases, themselves at most ten times what lies below half the sampling rate.
ALIASES = 1e-6


def detrended(x, settings):
    """Along the first axis, for complex segments, too."""
    if settings.detrend == "none":
        return x
    return sum(
        f * scipy.signal.detrend(part, 0, settings.detrend)
        for f, part in ((1, x.real), (1j, x.imag))
    )


def low_pass(settings, f):
    if settings.filter_cutoff is None:
        return np.ones_like(f, dtype=complex)
    sos = scipy.signal.butter(
        settings.filter_order, settings.filter_cutoff, fs=settings.rate, output="sos"
    )
    gain = scipy.signal.sosfreqz(sos, f, fs=settings.rate)[1]
    return np.abs(gain) ** 2 if settings.filter_direction == "both" else gain


def tapers_by_scipy(settings):
    if settings.window == "dpss":
        return scipy.signal.windows.dpss(
            settings.length, (settings.tapers + 1) / 2, settings.tapers
        )
    return [scipy.signal.get_window(settings.window, settings.length)]


def welch_by_scipy(x, settings):
    """Along the first axis."""
    cut = {
        "noverlap": settings.length - settings.step,
        "detrend": False if settings.detrend == "none" else settings.detrend,
    }
    tapers = tapers_by_scipy(settings)
    power = np.mean(
        [scipy.signal.welch(x, settings.rate, taper, **cut, axis=0)[1] for taper in tapers], axis=0
    )
    return power[settings.first_bin : settings.last_bin + 1]


def line_by_scipy(task, settings, window):
    """Welch power and variance of the harmonic's steady response as a time series."""
    p = {name: float(value) for name, value in task.parameters.items()}
    f = np.array([p["harmonic_frequency"]])
    reply = (
        replies(task, p, f)[:2].sum(axis=0)
        * p["harmonic_amplitude"]
        * np.exp(1j * p["harmonic_phase"])
    )
    if settings.sampling == "average":
        reply = reply * np.sinc(f / settings.rate) * np.exp(-1j * np.pi * f / settings.rate)
    if settings.sampling == "filtered":
        reply = reply * np.abs(against_aliases(settings, f, FINER))
    time = (
        np.arange(round(window[0] * settings.rate), round(window[1] * settings.rate))
        / settings.rate
    )
    turning = np.exp(2j * np.pi * f * time)
    seen = (reply * low_pass(settings, f) * turning).imag
    return welch_by_scipy(seen, settings), np.var(seen)


def by_quadrature(task, settings, window, points=4096, recorded_at=None):
    """Noise, line, mean and variance, all written from the equations.

    Every integrand is periodic in f, so equally spaced points integrate it to what is left of the
    autocovariance after `points` samples.
    """
    p = {name: float(value) for name, value in task.parameters.items()}
    f = (np.arange(points) / points - 0.5) * settings.rate
    before = functools.partial(density, task, p, settings)
    S = (
        filtered(before, settings, f, recorded_at)
        if settings.sampling == "filtered"
        else sampled(before, settings.rate, f)
    )
    S = S * np.abs(low_pass(settings, np.abs(f))) ** 2
    bins, m = np.arange(settings.first_bin, settings.last_bin + 1), np.arange(settings.length)
    tapers, turns = (
        tapers_by_scipy(settings),
        np.exp(-2j * np.pi * np.outer(bins, m) / settings.length),
    )
    waves = detrended(np.exp(2j * np.pi * np.outer(m, f) / settings.rate), settings)
    kernel = np.mean(
        [np.abs((turns * taper) @ waves) ** 2 / np.sum(taper**2) for taper in tapers], axis=0
    )
    sides = np.where((bins == 0) | (2 * bins == settings.length), 1.0, 2.0) / settings.rate
    noise = sides * (kernel @ S) * settings.rate / points
    line, swing = line_by_scipy(task, settings, window)
    samples = round((window[1] - window[0]) * settings.rate)
    turn = np.exp(2j * np.pi * f / settings.rate)
    mean = np.where(f == 0, samples, (turn**samples - 1) / np.where(f == 0, 1, turn - 1)) / samples
    variance = np.sum(S * (1 - np.abs(mean) ** 2)) * settings.rate / points
    return noise, line, RESPONSES[task.output_name](p, np.zeros(1))[-1], variance + swing


SLOW, MULTITAPER = (Settings.named(name).to_dict() for name in ("slow", "multitaper"))
BOTH = {"K_w": 0.15, "K_z": 0.05}
ALONE = {"K_w": 0.15}
RHYTHM = jm.Harmonic(0.003, 4.25, 0.7)
CASES = {
    "isometric, band-limited": (jm.Isometric, jm.BandLimitedNoise(BOTH), {}),
    "isometric, OU": (
        jm.Isometric,
        jm.OrnsteinUhlenbeckNoise(BOTH, 0.05),
        {"filter_direction": "both", "first_bin": 0},
    ),
    "isometric, slow": (jm.Isometric, jm.OrnsteinUhlenbeckNoise(BOTH, 0.3), SLOW),
    "isometric, multitaper": (jm.Isometric, jm.OrnsteinUhlenbeckNoise(BOTH, 0.3), MULTITAPER),
    "isometric, white": (
        jm.Isometric,
        jm.WhiteNoise(ALONE),
        {"detrend": "none", "filter_cutoff": None, "last_bin": 128},
    ),
    "force, band-limited": (jm.PrescribedForce, jm.BandLimitedNoise(BOTH), {}),
    "force, shared OU": (
        jm.PrescribedForce,
        jm.OrnsteinUhlenbeckNoise(BOTH, shared=True),
        {"rate": 200.0, "length": 100, "sampling": "average"},
    ),
    "force, white": (
        jm.PrescribedForce,
        jm.WhiteNoise(BOTH),
        {"window": "hamming", "overlap": 0.3},
    ),
    "isometric, filtered": (
        jm.Isometric,
        jm.OrnsteinUhlenbeckNoise(BOTH, 0.05),
        # to 44 Hz; at 50 Hz, where ρ turns fastest, the aliases that are left out are known to 2e-6
        {"filter_cutoff": None, "last_bin": 112, "first_bin": 0, "sampling": "filtered"},
    ),
    "force, filtered": (
        jm.PrescribedForce,
        jm.WhiteNoise(BOTH),
        {"rate": 50.0, "filter_cutoff": 20.0, "sampling": "filtered"},
    ),
    "motion, band-limited": (jm.PrescribedMotion, jm.BandLimitedNoise(BOTH), {}),
    "motion, shared": (
        jm.PrescribedMotion,
        jm.BandLimitedNoise(BOTH, cutoff=20.0, shared=True),
        {"filter_direction": "both", "detrend": "linear", "sampling": "average"},
    ),
}
INPUTS = {
    jm.Isometric: (5.0, 0.003),
    jm.PrescribedForce: (5.0, 1.0),
    jm.PrescribedMotion: (0.004, 6.0),
}


FAST = ("isometric, band-limited", "isometric, OU", "force, shared OU", "motion, band-limited")


def some_slow(names, fast):
    return [name if name in fast else pytest.param(name, marks=pytest.mark.slow) for name in names]


@pytest.mark.parametrize("name", some_slow(CASES, FAST))
def test_closed_form_is_the_quadrature_of_the_transfer_functions(x64, name):
    kind, noise, changes = CASES[name]
    settings, window = Settings().replace(**changes), SHIFTED if name == "isometric, OU" else WINDOW
    assert_as_by_quadrature(kind(*INPUTS[kind], noise=noise, harmonic=RHYTHM), settings, window)


@pytest.mark.parametrize("sampling", ["instant", "average", "filtered"])
def test_acceleration_in_closed_form_is_the_quadrature(x64, sampling):
    """Of noise on all that moves it: band-limited, resonant on the drive, the active part
    slowed."""
    noise = jm.BandLimitedNoise((0.15, 0.05, 0.0, 0.0, 0.02)) + jm.ResonantNoise(0.05)
    task = jm.PrescribedForce(
        5.0,
        1.0,
        noise=noise,
        harmonic=RHYTHM,
        activation=jm.Activation(0.06),
        observe="acceleration",
    )
    assert_as_by_quadrature(task, Settings(sampling=sampling), WINDOW)


def filtered_and_not(task, settings, window):
    return (
        expected_moments(as_arrays(task), settings.replace(sampling=s), window)[0]
        for s in ("filtered", "instant")
    )


def test_aliases_are_a_twentieth_of_a_bin_at_the_sampling_instants(x64):
    task = jm.Isometric(5.0, 0.003, noise=jm.BandLimitedNoise(BOTH)).replace(harmonic_amplitude=0.0)
    settings = Settings(filter_direction="both", sampling="filtered")
    found, instant = filtered_and_not(task, settings, WINDOW)
    assert np.max(instant.power / found.power) > 1.04


# Of the series in the rate's inverse the terms beyond the fourth power, as a share of a bin: 3e-5
# (500 Hz) and 2e-3 (200 Hz, where aliases are more than half of the bin).
MOVED = {500.0: 3e-5, 800.0: 2e-6, 1000.0: 2e-6, 4000.0: 2e-6, None: 2e-6}


@pytest.mark.parametrize("amplitude", [(0.0016, 0.0016, 0, 0), (0.15, 0.005, 0, 0)])
@pytest.mark.parametrize("rate, rest", [*MOVED.items(), (200.0, 2e-3)])
def test_aliases_are_those_of_the_rate_of_the_recording(x64, amplitude, rate, rest):
    """In `PrescribedMotion`, whose force has the acceleration of the noise in it, they are 10 % of
    bin 30 at 800 Hz."""
    task = jm.PrescribedMotion(F_ext=10, noise=jm.BandLimitedNoise(amplitude))
    task = task.replace(harmonic_amplitude=0.0)
    settings = Settings(filter_direction="both", sampling="filtered")
    expected, _, _, variance = by_quadrature(task, settings, WINDOW, recorded_at=rate)
    found = jm.expected_spectrum(task, settings, recorded_at=rate)
    np.testing.assert_allclose(found.power, expected, rtol=rest)
    mean = expected_moments(as_arrays(task), settings, WINDOW)[0].mean
    variation = jm.response.expected_variation(task, settings, recorded_at=rate)
    np.testing.assert_allclose((variation * mean) ** 2, variance, rtol=rest)


def test_one_program_serves_recordings_of_all_rates(x64):
    task, settings = jm.PrescribedMotion(F_ext=10), Settings(sampling="filtered")
    jm.expected_spectrum(task, settings)
    before = _noise_rows.traces
    powers = [jm.expected_spectrum(task, settings, recorded_at=r).power for r in (400, 1234.5)]
    assert _noise_rows.traces == before
    assert np.max(np.abs(powers[0] / powers[1] - 1)) > 0.01


def test_the_slope_of_a_spectrum_with_aliases_is_that_of_differences(x64):
    task, settings = jm.PrescribedMotion(F_ext=10), Settings(sampling="filtered")

    def power(k):
        return jm.expected_spectrum(task.replace(k_z=k), settings, recorded_at=500.0).power[-1]

    k, step = jnp.asarray(task["k_z"]), 1e-4
    difference = (power(k * (1 + step)) - power(k * (1 - step))) / (2 * k * step)
    for slope in (jax.grad, jax.jacfwd):
        np.testing.assert_allclose(at_once(slope(power), k), difference, rtol=1e-6)


@pytest.mark.parametrize(
    "rate, sampling", [(150.0, "filtered"), (1000.0, "instant"), (float("nan"), "filtered")]
)
def test_a_rate_without_known_aliases_is_refused(rate, sampling):
    with pytest.raises(ValueError, match=f"recorded_at={rate}: give a rate of 200 Hz or more"):
        jm.expected_spectrum(jm.Isometric(), Settings(sampling=sampling), recorded_at=rate)


def derivative(task, target):
    def power(k):
        return jm.expected_spectrum(task.replace(k_w=k)).proportional[10]

    return jax.grad(power)(jnp.asarray(task["k_w"])), jax.jit(power)(jnp.asarray(task["k_w"]))


PUBLIC = {
    "expected_spectrum": lambda task, target: jm.expected_spectrum(task).power,
    "expected_variation": lambda task, target: jm.response.expected_variation(task),
    "its derivative": derivative,
    "log_likelihood": jm.objective.log_likelihood,
    "sensitivity": lambda task, target: jm.response.sensitivity(task, ["k_w"]).power,
    "simulate": lambda task, target: jm.simulate(task, KEY, duration=1.0).output,
    "fit": lambda task, target: jm.fit(task, target, rungs=0, starts=4, max_steps=3).task["k_w"],
}


@pytest.mark.parametrize(
    "call", [pytest.param(n, marks=pytest.mark.slow) if n == "fit" else n for n in PUBLIC]
)
def test_public_functions_run_where_jax_looks_for_nan(call):
    target = jm.load_target("vastus-lateralis-26mvc")
    with jax.debug_nans(True):
        found = PUBLIC[call](target.task(), target)
        assert np.all(np.isfinite(np.concatenate([np.ravel(x) for x in jax.tree.leaves(found)])))
        with pytest.raises(jm.errors.OperatingPointError, match="undamped"):
            jm.expected_spectrum(jm.Isometric(c_w=0.0, c_z=0.0))


def test_fits_and_likelihoods_expect_the_aliases_of_the_recording(x64):
    """Of the rate at which it was taken, to whatever rates it was resampled since."""
    noise = jm.BandLimitedNoise((0.0016, 0.0016, 0, 0))
    task = jm.PrescribedMotion(F_ext=10, noise=noise).settled().replace(harmonic_amplitude=0.0)
    run = jm.simulate(task, KEY, duration=40.0, rate=500.0)
    target = jm.Recording(np.asarray(run.output).ravel(), 500.0).resampled(250.0).target()
    assert target.recorded_at == 500.0
    settings, table = target.settings, target.to_table()
    at = Coordinates.of({"k_w": task["k_w"]}, {}, {"k_w": 1.0})
    table = {
        k: table[k] for k in table if k not in ("measured", "mean", "coefficient_of_variation")
    }
    shapes = {
        rate: np.asarray(jm.expected_spectrum(task, settings, recorded_at=rate).proportional)
        for rate in (500.0, 1e6)
    }
    assert np.max(np.abs(shapes[500.0] / shapes[1e6] - 1)) > 0.02
    for rate, shape in shapes.items():
        exact = table | {"proportional_power": shape.tolist()}
        own, other = (
            jm.Target.from_table(exact | {"recorded_at": r}) for r in (rate, 500e6 / rate)
        )
        assert jm.objective.log_likelihood(task, own) > jm.objective.log_likelihood(task, other)
        model = Part("", task, own, at, (0,), None, None).linear().model
        found = model.moments(as_arrays(task.with_parts(settings=settings)))
        np.testing.assert_allclose(found.proportional, shape, rtol=1e-10)


@pytest.mark.parametrize("f", [0.4, 3.0, 11.0, 60.0])
def test_the_transfer_function_of_acceleration_is_that_of_displacement_twice_differentiated(x64, f):
    omega = np.asarray(2 * np.pi * f)
    for x, a in replies_of_both()(omega):
        np.testing.assert_allclose(a, -(omega**2) * np.asarray(x), rtol=1e-11)


@functools.cache
def replies_of_both():
    """Of displacement and acceleration to noise of K_w, K_z and P_w each: a program."""
    tasks = [
        jm.PrescribedForce(5.0, 1.0, observe=what) for what in ("displacement", "acceleration")
    ]
    systems = [
        [system_of(t, linearised(t).system, jnp.asarray(base)) for t in tasks]
        for base in np.eye(5)[[0, 1, 4]]
    ]
    return kept_jit(
        lambda omega: [[transfer(system, omega) for system in pair] for pair in systems]
    )


def assert_as_by_quadrature(task, settings, window):
    moments, _ = expected_moments(as_arrays(task), settings, window)
    noise, line, mean, variance = by_quadrature(task, settings, window)
    np.testing.assert_allclose(moments.power, noise + line, rtol=ALIASES)
    # rounding, of the peak far from it
    np.testing.assert_allclose(moments.line, line, rtol=1e-8, atol=1e-12 * line.max())
    # The mean of an acceleration is the rounding of forces of a few newtons.
    np.testing.assert_allclose(
        moments.mean, mean, rtol=1e-10, atol=1e-12 if task.quantity == "acceleration" else 0.0
    )
    np.testing.assert_allclose(moments.variance, variance, rtol=ALIASES)


@pytest.mark.parametrize("frequency", [0.07, 0.31, 2.2])
@pytest.mark.parametrize("direction", ["forward", "both"])
def test_the_variance_of_a_line_is_that_of_its_samples(x64, frequency, direction):
    """Of fractions of a period, too: a sine in time, low-passed by scipy, its variance about the
    mean of the samples."""
    settings, reply = Settings().replace(filter_direction=direction), 1.3 * np.exp(0.4j)
    begin, samples, ahead = 5.0, 1000, 4000
    time = np.arange(-ahead, round(begin * settings.rate) + samples + ahead) / settings.rate
    line = np.imag(reply * np.exp(2j * np.pi * frequency * time))
    passed = scipy.signal.sosfilt(settings.sections, line)
    if direction == "both":
        passed = scipy.signal.sosfilt(settings.sections, passed[::-1])[::-1]
    first = ahead + round(begin * settings.rate)
    expected = np.var(passed[first : first + samples])
    found = variance_of_a_line(settings, (begin, begin + samples / settings.rate), samples)
    np.testing.assert_allclose(found(np.asarray(frequency), reply), expected, rtol=1e-9)


@functools.cache
def variance_of_a_line(settings, window, samples):
    """Of any frequency and reply: a program."""
    return kept_jit(
        lambda frequency, reply: line_table(settings, window, frequency, samples).variance(reply)
    )


def test_the_variance_is_that_of_so_many_samples(x64):
    """A minute after 5 s, as a window or as samples from the begin of a shorter one; more slow
    noise is in it."""
    task = jm.Isometric(
        noise=jm.OrnsteinUhlenbeckNoise(BOTH, 2.0), harmonic=jm.Harmonic(0.003, 0.07, 0.7)
    )
    whole, begun, short = (
        expected_moments(as_arrays(task), task.settings, window, samples)[0]
        for window, samples in (((5.0, 65.0), None), ((5.0, 15.0), 6000), ((5.0, 15.0), None))
    )
    np.testing.assert_allclose(begun.variance, whole.variance, rtol=1e-12)
    np.testing.assert_allclose(
        whole.variance, by_quadrature(task, task.settings, (5.0, 65.0), 2**14)[3], rtol=ALIASES
    )
    assert short.variance < 0.98 * whole.variance
    np.testing.assert_array_equal(begun.power, short.power)


@pytest.mark.parametrize("phase", [0.0, np.pi / 2])
def test_phase_of_a_slow_harmonic(x64, phase):
    """At 0.5 Hz the leakage from negative frequencies depends on the phase; a segment starts it
    anew."""
    kind, noise, changes = CASES["isometric, OU"]
    task = references.quiet(
        kind(*INPUTS[kind], noise=noise), harmonic_amplitude=1e-5, harmonic_frequency=0.5
    )
    settings, tasks = (
        Settings().replace(**changes),
        [task.replace(harmonic_phase=p) for p in (phase, phase + np.pi / 2)],
    )
    here, other = (np.asarray(jm.expected_spectrum(t, settings, SHIFTED).power) for t in tasks)
    np.testing.assert_allclose(here, line_by_scipy(tasks[0], settings, SHIFTED)[0], rtol=1e-8)
    assert np.all(np.abs(other / here - 1)[here < 1e-3 * here.max()] > 0.05)


ENVELOPES = {
    "isometric": (jm.Isometric, jm.Harmonic(1e-5, 4.25, 0.7, Decay(1.0, 0.2, 5.0, 3.0)), {}),
    "force": (
        jm.PrescribedForce,
        jm.Harmonic(1e-5, 4.25, 0.7, RampHold(1.0, 6.0, 4.0, 0.5, 0.1)),
        {},
    ),
    "motion": (
        jm.PrescribedMotion,
        jm.Harmonic(1e-5, 4.25, 0.7, Decay(1.0, 0.2, 5.0, 3.0)),
        {"sampling": "average"},
    ),
}
# An average over the interval before a sample lags by half of it: Δ a' / 2 a of the amplitude, a' /
# a = 0.2/s at most.
LAG = {"motion": 2e-3}


@pytest.mark.parametrize("name", some_slow(ENVELOPES, ["isometric"]))
def test_line_is_the_spectrum_of_a_noise_free_simulation(x64, name):
    kind, harmonic, changes = ENVELOPES[name]
    task = references.quiet(
        kind(*INPUTS[kind], harmonic=harmonic, settings=Settings().replace(**changes))
    )
    power = np.asarray(jm.simulate(task.settled(), KEY, dt=5e-4, substeps=1).spectrum().power)
    # Heun's relative error of a response, (|λ| dt)² / 6 with |λ| <= 120/s; the closed form joins
    # the envelope's samples by lines, Δ² a'' / 8 = 1e-5 of its size.
    expected = linear_spectrum(task, task.settings).power
    np.testing.assert_allclose(
        expected, power, rtol=6e-4 + LAG.get(name, 0.0), atol=1e-6 * power.max()
    )


# the slow one has not forgotten by 5 s where it started from
@pytest.mark.parametrize("c_w", [60.0, 6000.0])
def test_an_envelope_that_does_not_change_is_a_constant_one(x64, c_w):
    task = references.quiet(jm.Isometric(5.0, 0.003, c_w=c_w))
    still = task.with_parts(harmonic=jm.Harmonic(0.003, 4.25, 0.7, Constant(0.5)))
    decayed = task.with_parts(harmonic=jm.Harmonic(0.003, 4.25, 0.7, Decay(0.5, 0.5)))
    # The low-pass starts at t = 0 in one and long before in the other: by 5 s that is forgotten, to
    # rounding.
    a, b = (jm.expected_spectrum(t).power for t in (still, decayed))
    np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-13 * np.max(a))


def test_constant_covariance_is_detrended_away():
    for detrend in ("constant", "linear"):
        operator = covariance_operator(Settings(detrend=detrend))[:-2]
        # Rounding of the sums over the folded lags.
        assert np.abs(operator.sum(axis=1)).max() < 1e-12 * np.abs(operator).sum(axis=1).max()
    operator = covariance_operator(Settings(detrend="none", first_bin=0, filter_cutoff=None))[:-2]
    taper = scipy.signal.get_window("hann", 256)
    leak = (
        np.abs(np.fft.rfft(taper)[:31]) ** 2
        * np.r_[1.0, np.full(30, 2.0)]
        / (100.0 * np.sum(taper**2))
    )
    np.testing.assert_allclose(operator.sum(axis=1), leak, atol=1e-12 * leak.max())


WHITE = np.eye(1, 2000)[0]
RINGING = np.exp(-np.arange(2000) / 20) * np.cos(np.arange(2000) / 3)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"detrend": "linear", "filter_direction": "both"},
        {"detrend": "none", "first_bin": 0, "filter_cutoff": None},
        {
            "window": "boxcar",
            "filter_order": 4,
            "filter_cutoff": 10.0,
            "length": 100,
            "last_bin": 50,
        },
        {
            "window": "hamming",
            "filter_order": 2,
            "filter_direction": "both",
            "rate": 250.0,
            "length": 75,
            "first_bin": 0,
        },
        SLOW,
        MULTITAPER,
    ],
    ids=str,
)
@pytest.mark.parametrize("covariance", [WHITE, RINGING], ids=["white", "ringing"])
def test_covariance_operator_is_scipys_expectation(changes, covariance):
    """x = L e has the covariance L Lᵀ, and its expected power is the sum of the powers of the
    columns of L."""
    settings, edge = Settings().replace(**changes), 400
    samples = settings.length + 2 * edge
    columns = scipy.linalg.cholesky(scipy.linalg.toeplitz(covariance[:samples]), lower=True)
    if settings.filter_cutoff is not None:
        sos = scipy.signal.butter(
            settings.filter_order, settings.filter_cutoff, fs=settings.rate, output="sos"
        )
        columns = scipy.signal.sosfilt(sos, columns, axis=0)
        if settings.filter_direction == "both":
            columns = scipy.signal.sosfilt(sos, columns[::-1], axis=0)[::-1]
    expected = welch_by_scipy(columns[edge:-edge], settings).sum(axis=1)
    operator = covariance_operator(settings)
    assert operator.shape[1] <= 2000
    # The impulse responses are cut at 1e-13 of their largest value.
    *power, passed, lowered = operator @ covariance[: operator.shape[1]]
    np.testing.assert_allclose(power, expected, rtol=1e-10)
    lag, n = np.arange(1, settings.length), settings.length
    of_mean = (covariance[0] + 2 * (1 - lag / n) @ covariance[1:n]) / n
    # That the covariance has decayed at the last lag: in 75 and 100 samples it has, to 2 %, over
    # n².
    variance = columns[edge:-edge].var(axis=0).sum()
    np.testing.assert_allclose(
        passed - of_mean + lowered / n**2, variance, rtol=1e-8 if n > 200 else 1e-4
    )


@pytest.mark.parametrize("window", ["boxcar", "hann", "dpss"])
@pytest.mark.parametrize("detrend", ["none", "constant", "linear"])
def test_transforms_of_long_segments_are_the_matrices(x64, window, detrend):
    changes: dict = {"tapers": 3} if window == "dpss" else {}
    settings = Settings().replace(
        length=1100, first_bin=0, last_bin=550, window=window, detrend=detrend, **changes
    )
    operator = covariance_operator(settings)
    assert lags_of(settings) == operator.shape[1]
    r = RINGING[: operator.shape[1]]
    power, expected = expected_powers(settings, r), operator @ r
    # Of bins above the low-pass, and of those that detrending removes, nothing is left but
    # rounding.
    np.testing.assert_allclose(power, expected, rtol=1e-10, atol=1e-12 * expected[:-2].max())
    x = np.cumsum(RINGING[:1100])
    found = bin_rows(settings) @ x
    np.testing.assert_allclose(
        _ordinates(settings, jnp.asarray(x)), found, rtol=1e-10, atol=1e-12 * np.abs(found).max()
    )


def test_settled_tasks_rest(x64):
    for kind, inputs in INPUTS.items():
        held = kind(*inputs).settled()
        slope = held.vector_field(jnp.zeros(()), held.initial_state(), jnp.zeros(4))
        # [1/s, m/s²]: the root find stops at 1e-12 m, A is 1e3/s² at most
        np.testing.assert_allclose(slope, 0.0, atol=1e-9)
        assert held.parameters == kind(*inputs).parameters
    start = jax.jit(lambda P: jnp.stack(jm.Isometric(P).settled().initial))(5.0)
    np.testing.assert_allclose(start, jm.Isometric(5.0).settled().initial, rtol=1e-12)


DIFFERENTIATED = {
    "force": jm.PrescribedForce(
        5.0, 1.0, noise=jm.WhiteNoise(0.05), settings=Settings(sampling="filtered")
    ),
    "acceleration": jm.PrescribedForce(
        5.0, 1.0, noise=jm.OrnsteinUhlenbeckNoise(0.05), observe="acceleration"
    ),
    "motion": jm.PrescribedMotion(0.004, 5.0),
    "all": jm.Isometric(
        5.0,
        0.003,
        noise=jm.BandLimitedNoise((0.1, 0.05, 0.01, 0.01, 0.02))
        + jm.ResonantNoise(0.01)
        + jm.ResonantNoise(0.01, 3.5, 1.0),
        activation=jm.Activation(0.06),
    ),
}
# At rest nothing moves: noise on damping has no first-order effect, nor has the mass of an
# insertion that is held.
SILENT = {"noise_C_w", "noise_C_z"}
SILENT_IN = {
    "force": SILENT,
    "acceleration": SILENT,
    "motion": SILENT | {"m_z"},
    "all": SILENT | {"m_z"},
}


@pytest.mark.slow
@pytest.mark.parametrize("name", DIFFERENTIATED)
def test_every_derivative_forward_reverse_and_by_differences(x64, name):
    task = DIFFERENTIATED[name].replace(harmonic_phase=0.4, harmonic_amplitude=0.003)
    names = task.parameter_names
    scale = np.array([float(task[n]) for n in names])
    assert np.all(scale != 0)

    def log_power(relative):
        values = {name: x * s for name, x, s in zip(names, relative, scale, strict=True)}
        return jnp.log(jm.expected_spectrum(task.replace(**values)).power)

    # truncation h² f''' / 6, and rounding 1e-12 / h of an equilibrium found to 1e-12
    n, h = scale.size, 1e-5
    # One program for derivatives and differences: values and slopes along a parameter, at one and a
    # little off.
    along, off = (
        np.concatenate(rows)
        for rows in ([np.eye(n)] * 3, [0 * np.eye(n), h * np.eye(n), -h * np.eye(n)])
    )
    given = 1 + off, along
    power, slopes = at_once(
        lambda *given: jax.lax.map(lambda g: jax.jvp(log_power, g[:1], g[1:]), given), *given
    )
    _, ahead, behind = np.split(np.asarray(power), 3)
    forward, differences = np.asarray(slopes)[:n].T, (ahead - behind).T / (2 * h)
    # A fault of the reverse mode in any bin shows in their sum with weights at random.
    weight = np.random.default_rng(0).normal(size=len(forward))
    value, reverse = at_once(jax.value_and_grad(lambda at: weight @ log_power(at)), np.ones(n))
    largest = np.abs(forward).max()
    np.testing.assert_allclose(value, weight @ power[0], rtol=1e-9)
    np.testing.assert_allclose(reverse, weight @ forward, rtol=1e-8, atol=1e-9 * largest)
    np.testing.assert_allclose(forward, differences, atol=1e-5 * largest)
    silent = {
        n
        for n, column in zip(names, forward.T, strict=True)
        if np.all(np.abs(column) < 1e-9 * largest)
    }
    assert silent == SILENT_IN[name]


def test_gradient_by_a_natural_name_under_jit_and_vmap(x64):
    task = jm.Isometric()

    def last_bin(k_w):
        return jm.expected_spectrum(task.replace(k_w=k_w)).power[-1]

    k_w, h = np.array([3e5, 5e5, 8e5]), 50.0
    power, slope = at_once(jax.vmap(jax.value_and_grad(last_bin)), k_w)
    # rounding, in another order of summation
    np.testing.assert_allclose(power, [last_bin(k) for k in k_w], rtol=1e-9)
    np.testing.assert_allclose(
        slope, [(last_bin(k + h) - last_bin(k - h)) / (2 * h) for k in k_w], rtol=1e-6
    )


@pytest.mark.parametrize(
    "name", some_slow(["isometric, band-limited", "force, band-limited"], ["force, band-limited"])
)
def test_single_precision(name):
    kind, noise, _ = CASES[name]
    task = kind(*INPUTS[kind], noise=noise, harmonic=RHYTHM)
    single = np.asarray(jm.expected_spectrum(task).power)
    assert single.dtype == np.float32
    with jax.enable_x64(True):
        moments, system = expected_moments(as_arrays(task), task.settings, WINDOW)
        A, double = np.asarray(system.A), np.asarray(moments.power)
    # Rounding, of sums over hundreds of lags and of the Lyapunov equations.
    condition = np.linalg.cond(np.kron(A, np.eye(len(A))) + np.kron(np.eye(len(A)), A))
    np.testing.assert_allclose(single, double, rtol=6e-8 * (280 + condition))


@pytest.mark.parametrize(
    "samples, head", [(2, 1), (3, 1), (64, 1), (999, 1), (1000, 1), (1000, 20), (21, 20), (9, 20)]
)
def test_lags_and_the_variance_of_a_mean_are_plain_sums(x64, samples, head):
    rng = np.random.default_rng(samples)
    step = 0.99 * scipy.linalg.expm(0.3 * (rng.normal(size=(3, 3)) - 2 * np.eye(3)))
    first, rows, start = rng.normal(size=head), rng.normal(size=(2, 3)), rng.normal(size=(2, 3))
    r, states = list(first), start
    for _ in range(samples - head):
        r.append(sum(row @ state for row, state in zip(rows, states, strict=True)))
        states = [step @ state for state in states]
    powers = jnp.stack([np.linalg.matrix_power(step, 2**k) for k in range(11)])
    r = r[:samples]
    parts = first[None], rows[None], powers[:, None], start.T[None]
    lagged, variance = at_once(
        lambda *found: (found[0].lagged(samples)[0], found[0].mean_variance(samples)[0]),
        Autocovariance(*map(jnp.asarray, parts)),
    )
    np.testing.assert_allclose(lagged, r, rtol=1e-12, atol=1e-13)
    lag = np.abs(np.subtract.outer(np.arange(samples), np.arange(samples)))
    np.testing.assert_allclose(variance, np.array(r)[lag].mean(), rtol=1e-11)


@pytest.mark.parametrize("name", ["zagrodny-slifkin", "zagrodny-hamilton"])
def test_heavy_forces_on_soft_tissue_have_an_equilibrium_in_single_precision(name):
    """Accelerations of 1e3 m/s² are rounded by more than displacements of 1e-2 m are large."""
    task = jm.load_preset(name).as_task(jm.PrescribedForce)
    single = np.asarray(jm.response.equilibrium(task))
    with jax.enable_x64(True):
        np.testing.assert_allclose(single, jm.response.equilibrium(task), rtol=1e-6, atol=1e-8)


def test_a_task_from_outside_a_compiled_function():
    task = jm.Isometric()
    scaled = jax.jit(lambda x: x * jm.expected_spectrum(task).power)(2.0)
    np.testing.assert_allclose(scaled, 2 * np.asarray(jm.expected_spectrum(task).power), rtol=1e-5)


class Crossbridge(jm.model.AbstractMuscle):
    """A user's own muscle: a cubic active and a linear passive tissue. Counts how often it is
    traced."""

    m_w: float = 0.4
    m_z: float = 0.6
    stiffness: float = 300.0
    damping: float = 40.0
    looks: ClassVar[list] = []

    def base(self):
        return jnp.stack([jnp.asarray(v) * 1.0 for v in (self.stiffness, 200.0, self.damping, 5.0)])

    def active_force(self, x_w, v_w, u):
        self.looks.append(None)
        return (self.stiffness * (1 + (x_w / 0.03) ** 2) + u[0]) * x_w + (self.damping + u[2]) * v_w

    def passive_force(self, x_w, v_w, x_z, v_z, u):
        return (200.0 + u[1]) * (x_z - x_w) + (5.0 + u[3]) * (v_z - v_w)

    def contraction_velocity(self, x_w, x_z, v_z, force, u):
        return v_z - (force - (200.0 + u[1]) * (x_z - x_w)) / (5.0 + u[3])


def test_one_trace_per_structure(x64, monkeypatch):
    monkeypatch.setattr(programs, "program_folder", lambda: None)  # nothing is loaded
    looks, settings = Crossbridge.looks, Settings(last_bin=29)
    task, before = jm.Isometric(5.0, 0.002, muscle=Crossbridge(m_w=0.3)), len(Crossbridge.looks)
    jm.expected_spectrum(task, settings)
    once = len(looks)
    assert once > before
    other = task.replace(stiffness=250.0, harmonic_amplitude=0.01, noise_K_w=0.1, P_w=4.0, x_z=0.0)
    jm.expected_spectrum(other, settings)
    jm.expected_spectrum(other.with_parts(harmonic=jm.Harmonic(0.002, 8.0, 1.0)), settings)
    assert len(looks) == once


@pytest.mark.parametrize("kind", some_slow(INPUTS, [jm.Isometric]))
def test_a_users_own_muscle_in_closed_form(x64, kind):
    """The same muscle out of jaxmuscle's parts: k (x_ref² + x²) with k x_ref² the stiffness and
    x_ref = 0.03."""
    inner, outer = (
        jm.model.QuadraticStiffness(300.0 / 0.03**2, 0.03),
        jm.model.QuadraticStiffness(200.0 / 1e8, 1e4),
    )
    made = jm.Muscle(
        0.4,
        0.6,
        inner,
        outer,
        jm.model.QuadraticDamping(40.0, 1.0),
        jm.model.QuadraticDamping(5.0 / 1e8, 1e4),
    )
    theirs, ours = (
        jm.expected_spectrum(kind(*INPUTS[kind], muscle=m)) for m in (Crossbridge(), made)
    )
    # x_ref = 1e4 m makes a law constant to 1e-12.
    np.testing.assert_allclose(theirs.power, ours.power, rtol=1e-8)
    assert theirs.unit == kind(*INPUTS[kind]).output_unit


AVERAGE = Settings(sampling="average", filter_direction="both")
SIMULATED = {
    "own muscle, shared noise": jm.PrescribedForce(
        5.0, 1.0, muscle=Crossbridge(), noise=jm.BandLimitedNoise(BOTH, shared=True)
    ),
    "average": jm.PrescribedMotion(0.004, 6.0, settings=AVERAGE),
    "filtered": jm.Isometric(5.0, 0.003, settings=AVERAGE.replace(sampling="filtered")),
}


@pytest.mark.slow
def test_the_expected_coefficient_of_variation_is_that_of_simulations(x64):
    """Its square, whose mean over seeds has a known standard error; and its slope by
    differences."""
    task, (start, stop) = jm.Isometric(noise="white").settled(), (5.0, 15.0)
    runs = jm.ensemble(task, KEY, seeds=1000, duration=stop, dt=1.25e-3, control=False)
    rate = task.settings.rate
    passed = np.asarray(jm.spectra.lowpass(np.asarray(runs.output), task.settings))[
        :, round(start * rate) : round(stop * rate)
    ]
    squares = passed.var(axis=1) / passed.mean(axis=1) ** 2
    expected = jm.response.expected_variation(task, window=(start, stop))
    assert abs(squares.mean() - expected**2) < 4 * squares.std() / np.sqrt(len(squares))

    def one(k):
        return jm.response.expected_variation(task.replace(k_w=k))

    k, step = float(task["k_w"]), 1e-4
    difference = (one(k * (1 + step)) - one(k * (1 - step))) / (2 * k * step)
    np.testing.assert_allclose(at_once(jax.grad(one), jnp.asarray(k)), difference, rtol=1e-6)


@pytest.mark.slow
def test_the_mean_of_simulations_is_as_expected(x64):
    # a settled task forgets that it starts without fluctuations, by 1 s to e^-7
    z, window = [], (1.0, 6.12)
    options = {"seeds": 1000, "duration": window[1], "dt": 1.25e-3, "substeps": 1, "control": False}
    for i, task in enumerate(SIMULATED.values()):
        runs = jm.ensemble(task.settled(), jax.random.fold_in(KEY, i), **options)
        power = np.asarray(runs.spectrum(window=window).power)
        expected = np.asarray(linear_spectrum(runs.task, task.settings, window).power)
        z.append(
            (power.mean(axis=0) - expected) / (power.std(axis=0, ddof=1) / np.sqrt(len(power)))
        )
    references.assert_standard_normal(z, every=3)


def test_recordings_of_1_khz_are_as_expected_where_they_are_filtered(x64):
    """Decimated by scipy: spectrum and variation are those of "filtered"; of "instant" 5 % too
    large, with its aliases."""
    task, window, seeds = (
        jm.Isometric(5.0, 0.003, noise=jm.BandLimitedNoise(BOTH)).settled(),
        (5.0, 14.6),
        400,
    )
    runs = jm.ensemble(
        task, KEY, seeds=seeds, rate=1000.0, duration=15.0, substeps=1, control=False
    )
    even = scipy.signal.resample_poly(runs.output, 1, 10, axis=1, padtype="line")
    settings = Settings(filter_direction="both", sampling="filtered")
    held = scipy.signal.sosfiltfilt(settings.sections, even)[:, 500:1460]
    power, variance = welch_by_scipy(held.T, settings).T, held.var(axis=1)
    found, instant = filtered_and_not(task, settings, window)
    references.assert_standard_normal(
        (power.mean(axis=0) - found.power) / (power.std(axis=0) / np.sqrt(seeds)), every=3
    )
    error = variance.std() / np.sqrt(seeds)
    assert abs(variance.mean() - found.variance) < 4 * error
    assert float(instant.variance) > variance.mean() + 5 * error
    # The trajectory's own spectrum is decimated, too.
    np.testing.assert_allclose(runs.filtered(settings, window), held, rtol=1e-10)
    np.testing.assert_allclose(runs.spectrum(settings, window).power, power, rtol=1e-8)


@pytest.mark.parametrize("amplitude", [0.0, 0.04], ids=["noise", "mostly a line"])
def test_the_coefficient_of_variation_of_a_recording_scatters_as_expected(x64, amplitude):
    """Recordings of 9.6 s by the nonlinear simulator; 400 of them know their standard deviation to
    3.5 %."""
    task = jm.Isometric().replace(harmonic_amplitude=amplitude)
    runs = jm.ensemble(task.settled(), KEY, seeds=400, control=False)
    held = runs.filtered(window=(5.0, 14.6))
    variation = held.std(axis=1) / held.mean(axis=1)
    moments = expected_moments(as_arrays(task), task.settings, (5.0, 14.6))[0]
    assert variation.mean() == pytest.approx(float(moments.variation), rel=0.02)
    target = jm.Target(
        "ten seconds",
        np.ones(30),
        segments=6,
        coefficient_of_variation=0.01,
        settings=task.settings,
    )
    assert task.settings.length + 5.5 * task.settings.step == 960
    value, sd = target_variation(target, task)
    assert value == np.log(0.01)
    assert sd == pytest.approx(np.log(variation).std(), rel=0.11)
    line = float(moments.variance) - float(
        expected_moments(as_arrays(quiet_line(task)), task.settings, WINDOW)[0].variance
    )
    assert (line / float(moments.variance) > 0.5) == (amplitude > 0)
    several = jm.Target(
        "trials",
        np.ones(30),
        segments=(6,) * 4,
        coefficient_of_variation=0.01,
        settings=task.settings,
    )
    assert target_variation(several, task)[1] == pytest.approx(sd / 2)


def quiet_line(task):
    return task.replace(harmonic_amplitude=0.0)


def snapped(P_w=41.57, F_ext=7.0):
    """A passive spring K_z(x_z) that softens faster than it is let go: started at its unstable
    equilibrium."""
    p = {name: float(value) for name, value in jm.PrescribedForce(P_w, F_ext).parameters.items()}
    x_w = root(lambda x: active(p, x) + F_ext - P_w)
    x_z = scipy.optimize.brentq(
        lambda z: coefficients(p, x_w, z)[1] * (z - x_w) + F_ext, 0.008, 0.016
    )
    return jm.PrescribedForce(P_w, F_ext, initial=(x_w, 0.0, x_z, 0.0))


LITERAL = {"x_ref_w": 0.0, "x_ref_z": 0.0, "v_ref_w": 0.0, "v_ref_z": 0.0}
REFUSED = {
    "unstable": (
        snapped(),
        r"equilibrium of this PrescribedForce is unstable: eigenvalues .* 1/s at \[",
    ),
    "literal force": (
        jm.PrescribedForce(5.0, 1.0).replace(**LITERAL),
        r"PrescribedForce is undamped: eigenvalues .*v_ref_w",
    ),
    "literal isometric": (
        jm.Isometric(5.0, 0.003).replace(**LITERAL),
        "Isometric is undamped: eigenvalues",
    ),
    "no damping": (jm.Isometric().replace(c_w=0.0, c_z=0.0), "Isometric is undamped"),
    "no stiffness": (
        jm.PrescribedForce().replace(k_w=0.0),
        r"PrescribedForce has no equilibrium at t = 15.0 s .* stiffness",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_has_no_linear_response(x64, name):
    task, message = REFUSED[name]
    with pytest.raises(jm.errors.OperatingPointError, match=message):
        jm.expected_spectrum(task)
    with pytest.raises(ValueError, match=message):
        has_response(task, required=True)
    assert not has_response(task, required=False)
    assert has_response(jm.Isometric(), required=True)


def test_an_undamped_motion_beside_a_fast_decay_is_told_from_rounding():
    # ± 1i/s beside -1e5/s: rounding gives the oscillation a real part of about 1e-16 times 1e5/s,
    # of either sign.
    rng = np.random.default_rng(3)
    for _ in range(8):
        turned = np.linalg.qr(rng.standard_normal((3, 3)))[0]
        A = turned @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1e5]]) @ turned.T
        with pytest.raises(jm.errors.OperatingPointError, match="is undamped"):
            check_equilibrium(jm.Isometric(), np.zeros(3), A)


def test_without_an_equilibrium_under_a_transformation_it_is_not_finite(x64):
    @kept_jit
    def power(F_ext, k_w):
        return jm.expected_spectrum(snapped().replace(F_ext=F_ext, k_w=k_w)).power

    assert not np.any(np.isfinite(power(7.0, 5e5)))  # unstable
    assert not np.any(np.isfinite(power(0.0, 0.0)))  # nothing holds P_w
    assert np.all(np.isfinite(power(0.0, 5e5)))


def test_nothing_to_see(x64):
    with pytest.raises(
        ValueError,
        match="spectrum of this Isometric is zero: it has neither noise nor a harmonic that moves",
    ):
        jm.expected_spectrum(references.quiet(jm.Isometric(), harmonic_amplitude=0.0))
    # Without external force the insertion follows the active mass, and noise on K_z moves nothing.
    unmoved = references.quiet(jm.PrescribedForce(5.0, 0.0), harmonic_amplitude=0.0).replace(
        noise_K_z=0.1
    )
    with pytest.raises(ValueError, match=r"is zero: .* moves x_z"):
        jm.expected_spectrum(unmoved)
    with pytest.raises(
        ValueError, match="is zero: P_w is 0, so that nothing stretches the muscle; set P_w above 0"
    ):
        jm.expected_spectrum(jm.Isometric(P_w=0.0))


def test_a_harmonic_beyond_half_the_sampling_rate(x64):
    task = jm.Isometric().replace(harmonic_frequency=50.0)
    with pytest.raises(
        ValueError,
        match=r"harmonic_frequency = 50.0 Hz is not below half the sampling rate of 100.0 Hz",
    ):
        jm.expected_spectrum(task)
    assert np.all(np.isfinite(jm.expected_spectrum(task.replace(harmonic_amplitude=0.0)).power))
    kind, noise, changes = CASES["force, shared OU"]
    faster = kind(*INPUTS[kind], noise=noise).replace(harmonic_frequency=50.0)
    assert np.all(np.isfinite(jm.expected_spectrum(faster, Settings().replace(**changes)).power))


@pytest.mark.slow
def test_the_expected_spectrum_has_a_second_derivative(x64):
    """Against differences of the first; designs by gradient need it."""
    task = jm.Isometric()

    def power(k):
        return jnp.log(jm.expected_spectrum(task.replace(k_w=k)).power[4])

    k, step = task["k_w"], 10.0
    ahead, behind = at_once(
        lambda ks: jax.lax.map(jax.grad(power), ks), k + step * np.array([1.0, -1.0])
    )
    second = float(at_once(jax.grad(jax.grad(power)), jnp.asarray(k)))
    assert second == pytest.approx(float(ahead - behind) / (2 * step), rel=1e-4)


def test_who_forbids_jax_to_add_axes_can_use_it():
    """`jax_numpy_rank_promotion = "raise"` finds slips in one's own code; ours must not stand
    against it."""
    task = jm.Isometric()
    with jax.numpy_rank_promotion("raise"):
        with pytest.raises(ValueError, match="rank_promotion"):
            jnp.ones((2, 3)) * jnp.ones(3)
        assert jm.expected_spectrum(task).power.shape == (30,)
        # JAX looks at axes while it traces: nothing is computed.
        slope = jax.grad(lambda k_w: jm.expected_spectrum(task.replace(k_w=k_w)).power.sum())
        assert jax.eval_shape(slope, 5e5).shape == ()
        settings = jm.SpectrumSettings(detrend="linear")
        found = jax.eval_shape(
            lambda x: jm.spectra.welch(jm.spectra.lowpass(x, settings), settings),
            np.zeros((2, 3, 1000)),
        )
        assert found.shape == (2, 3, 30)
