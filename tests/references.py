"""What the simulator is compared with, written in NumPy and SciPy straight from the equations,
without jaxmuscle."""

import numpy as np
import scipy.integrate
import scipy.signal
import scipy.special
import scipy.stats


def smooth_step(t, level=1.0, start=0.5, rise=1.0):
    """35 p⁴ - 84 p⁵ + 70 p⁶ - 20 p⁷ is the regularised incomplete beta function I_p(4, 4)."""
    return level * scipy.special.betainc(4, 4, np.clip((t - start) / rise, 0.0, 1.0))


def smooth_step_derivatives(t, level=1.0, start=0.5, rise=1.0):
    """The same with its first and second derivative."""
    p, inside = np.clip((t - start) / rise, 0.0, 1.0), (t > start) & (t < start + rise)
    polynomial = np.polynomial.Polynomial([0, 0, 0, 0, 35, -84, 70, -20])
    slopes = [level * inside * polynomial.deriv(n)(p) / rise**n for n in (1, 2)]
    return level * polynomial(p), *slopes


def coefficients(p, x_w, v_w, x_z, v_z, u, argument="literal"):
    """K_w, K_z, C_w, C_z of equations (2a) and (2b); `p` holds parameters by name."""
    q, r = (x_z, v_z) if argument == "literal" else (x_z - x_w, v_z - v_w)
    return (
        p["k_w"] * (p["x_ref_w"] ** 2 + x_w**2) + u[0],
        p["k_z"] * (p["x_ref_z"] ** 2 + q**2) + u[1],
        p["c_w"] * (p["v_ref_w"] ** 2 + v_w**2) + u[2],
        p["c_z"] * (p["v_ref_z"] ** 2 + r**2) + u[3],
    )


def accelerations(p, y, P_w, F_ext, u, argument="literal"):
    """x_w'' and x_z'' of equations (1a) and (1b)."""
    x_w, v_w, x_z, v_z = y
    K_w, K_z, C_w, C_z = coefficients(p, x_w, v_w, x_z, v_z, u, argument)
    a_w = (P_w - C_w * v_w - K_w * x_w + C_z * (v_z - v_w) + K_z * (x_z - x_w)) / p["m_w"]
    a_z = (-F_ext - C_z * (v_z - v_w) - K_z * (x_z - x_w)) / p["m_z"]
    return a_w, a_z


def contraction(p, x_w, motion, F_ext, u):
    """x_w' of Task 1, equation (1b) solved for it; `motion` is (x_z, x_z', x_z'')."""
    x_z, v_z, a_z = motion
    _, K_z, _, C_z = coefficients(p, x_w, 0.0, x_z, v_z, u)
    return v_z + (F_ext + p["m_z"] * a_z + K_z * (x_z - x_w)) / C_z


def harmonic(p, t):
    """S(t) on (K_w, K_z, C_w, C_z)."""
    s = p["harmonic_amplitude"] * np.sin(
        2 * np.pi * p["harmonic_frequency"] * t + p["harmonic_phase"]
    )
    return np.multiply.outer(
        [p["k_w"] * p["x_ref_w"] ** 2, p["k_z"] * p["x_ref_z"] ** 2, 0.0, 0.0], s
    )


def quiet(task, **values):
    """The task without noise."""
    return task.replace(noise_K_w=0.0, noise_K_z=0.0, noise_C_w=0.0, noise_C_z=0.0, **values)


def solve_ode(rhs, y0, times, method="DOP853", rtol=1e-10):
    """Solution at `times`, to near rounding."""
    solution = scipy.integrate.solve_ivp(
        rhs, (times[0], times[-1]), y0, method, t_eval=times, rtol=rtol, atol=1e-13, max_step=0.05
    )
    assert solution.success
    return solution.y.T


def aliased(density, rate, frequency, reach=1000):
    """Density of the sampled signal: Σ_m S(f + m rate)."""
    return sum(density(frequency + m * rate) for m in range(-reach, reach + 1))


def welch_kernel(taper, rate, bins, frequency):
    """κ_k(f) of a segment whose mean is removed: what a unit sine e^{2πift} adds to bin k."""
    m = np.arange(len(taper))
    wave = np.exp(2j * np.pi * np.outer(frequency, m) / rate)
    wave -= wave.mean(axis=1, keepdims=True)
    transform = (wave * taper) @ np.exp(-2j * np.pi * np.outer(m, bins) / len(taper))
    return np.abs(transform) ** 2 / (rate * np.sum(taper**2))


def expected_welch(
    density, rate=100.0, length=256, bins=range(1, 31), lowpass=(9, 30.0), points=4096
):
    """Expected one-sided Hann-Welch spectrum of a signal of that two-sided density, sampled at
    `rate`."""
    # Everything is periodic in f, so equally spaced points integrate it to rounding.
    frequency = (np.arange(points) / points - 0.5) * rate
    sampled = aliased(density, rate, frequency)
    if lowpass is not None:
        sos = scipy.signal.butter(lowpass[0], lowpass[1], fs=rate, output="sos")
        sampled = sampled * np.abs(scipy.signal.sosfreqz(sos, np.abs(frequency), fs=rate)[1]) ** 2
    kernel = welch_kernel(
        scipy.signal.get_window("hann", length), rate, np.asarray(bins), frequency
    )
    return 2 * sampled @ kernel * rate / points


def assert_standard_normal(z, every=1):
    """Deviations in standard errors: the largest within the Šidák bound at 1 %, their squares χ²
    with p > 0.001.

    `every` picks values far enough apart to be independent for χ² (the bound holds for dependent
    ones, too).
    """
    z = np.asarray(z).ravel()
    bound = scipy.stats.norm.isf((1 - 0.99 ** (1 / z.size)) / 2)
    assert np.abs(z).max() < bound, (
        f"largest deviation {np.abs(z).max():.2f} standard errors, bound {bound:.2f}: {z}"
    )
    picked = z[::every]
    p = scipy.stats.chi2.sf(np.sum(picked**2), picked.size)
    assert p > 0.001, f"chi2 p = {p:.2g}, deviations in standard errors {z}"


def observed_order(steps, errors):
    """Slope of log error over log step."""
    return np.polyfit(np.log(steps), np.log(errors), 1)[0]
