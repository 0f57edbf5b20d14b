"""Resonant noise against its closed forms: density, autocovariance, exact steps; its paths in both
precisions; sums."""

import itertools

import jax
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
import scipy.signal
from compiled import at_once
from noise_paths import draw_normals

import jaxmuscle as jm
from jaxmuscle.model import NoiseSum
from jaxmuscle.model._resonant_noise import exact_step

KEY = jax.random.key(17)
CASES = {"tremor": (9.0, 2.0), "narrow": (9.0, 0.02), "overdamped": (4.0, 10.0)}


def density(f, frequency, width):
    return width / np.pi * f**2 / ((frequency**2 - f**2) ** 2 + width**2 * f**2)


def equation(frequency, width):
    """`q' = ω N`, `N' = -ω q - 2πb N + √(4πb) w`."""
    omega = 2 * np.pi * frequency
    return np.array([[0.0, omega], [-omega, -2 * np.pi * width]]), np.array(
        [[0.0], [np.sqrt(4 * np.pi * width)]]
    )


@pytest.mark.parametrize("case", CASES)
def test_the_density_is_that_of_the_equation(x64, case):
    frequency, width = CASES[case]
    noise, f = jm.ResonantNoise(0.3, frequency, width), np.r_[0.0, np.geomspace(0.01, 1e3, 50)]
    np.testing.assert_allclose(noise.psd(f), 0.09 * density(f, frequency, width), rtol=1e-12)
    halves = np.sqrt(frequency**2 + width**2 / 4) + np.array([-0.5, 0.5]) * width
    np.testing.assert_allclose(noise.density(halves), 0.5 * noise.density(frequency), rtol=1e-9)
    edges = [
        0.0,
        *np.clip(frequency + width * np.array([-20, -2, 0, 2, 20]), 0.0, None),
        500.0,
        np.inf,
    ]
    parts = [
        scipy.integrate.quad(lambda f: float(noise.density(f)), *pair, epsrel=1e-11)
        for pair in itertools.pairwise(edges)
    ]
    assert 2 * sum(part for part, _ in parts) == pytest.approx(1.0, rel=1e-9)


@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize("case", CASES)
def test_a_step_is_the_exact_one(case, precision):
    """Transition by scipy's expm, what is added by Van Loan's, and the stationary covariance of
    both, which is 1."""
    F, G = equation(*CASES[case])
    decay = np.linalg.eigvals(F).real.max()
    # of an exponential, and of sums of eight kicks relative to their own size
    rounding = 8 * np.finfo(precision).eps
    grids = (1e-3, 1e-2)
    with jax.enable_x64(precision == "float64"):
        made = at_once(
            lambda *numbers: [
                exact_step(jm.ResonantNoise(1.0, *numbers).shaping_filter(), dt) for dt in grids
            ],
            *CASES[case],
        )
    for dt, (step, kick) in zip(grids, made, strict=True):
        assert step.dtype == kick.dtype == precision
        step, kick = np.asarray(step, float), np.asarray(kick, float)
        whole = scipy.linalg.expm(dt * np.block([[-F, G @ G.T], [np.zeros((2, 2)), F.T]]))
        exact = whole[2:, 2:].T
        added = exact @ whole[:2, 2:]
        scale = np.sqrt(np.diag(added))
        np.testing.assert_allclose(step, exact, rtol=0, atol=rounding)
        relative = np.outer(scale, scale)
        np.testing.assert_allclose(
            kick @ kick.T / relative, added / relative, rtol=0, atol=rounding
        )
        assert kick[0, 1] == 0
        stationary = scipy.linalg.solve_discrete_lyapunov(step, kick @ kick.T)
        np.testing.assert_allclose(
            stationary, np.eye(2), rtol=0, atol=rounding / -np.expm1(2 * decay * dt)
        )


def test_a_sum_is_its_parts(x64):
    band, tremor = jm.BandLimitedNoise({"K_w": 0.2}), jm.ResonantNoise(0.03)
    both, f = band + tremor, np.array([1.0, 9.0])
    assert isinstance(both, NoiseSum) and [type(part) for part in both.components] == [
        type(band),
        type(tremor),
    ]
    assert len((both + tremor).components) == len((tremor + both).components) == 3
    rows = np.zeros((5, 2))
    rows[0], rows[4] = 0.04 / 100 / (1 + (f / 50) ** 4), 9e-4 * density(f, 9.0, 2.0)
    independent, shared = (
        jm.ResonantNoise((0.1, 0.1, 0.0, 0.0, 0.2), shared=shared) for shared in (False, True)
    )

    def drawn(key):
        alone, together = (draw_normals(noise.per_channel(), key, 20) for noise in (band, both))
        again = draw_normals(tremor + tremor, key, 2000)
        few = (draw_normals(noise, key, 3)[0] for noise in (independent, shared))
        return both.psd(f), alone[0], together, again, *few

    found, alone, together, again, *four = at_once(drawn, KEY)
    np.testing.assert_allclose(found, rows, rtol=1e-12)
    np.testing.assert_array_equal(together[0], alone)  # a tremor is added to a path
    assert abs(np.corrcoef(np.ravel(again[0]), np.ravel(again[1]))[0, 1]) < 3.3 / np.sqrt(4002)
    assert [rows.shape for rows in four] == [(4, 10), (4, 2)]


FAST = jm.ResonantNoise(0.1, 90.0, 20.0)


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: jm.ResonantNoise(width=0.0), "resonance_width = 0.0 Hz must be positive"),
        (
            lambda: jm.ResonantNoise(frequency=-1.0),
            "resonance_frequency = -1.0 Hz must be positive",
        ),
        (lambda: jm.ResonantNoise(-0.1), "must not be negative"),
        (lambda: jm.ResonantNoise(np.ones(3)), r"shape \(3,\): give one number, four or five"),
        (lambda: NoiseSum(()), "needs at least one"),
        (lambda: (jm.BandLimitedNoise() + jm.ResonantNoise()).density(1.0), "no density"),
        (lambda: jm.simulate(jm.Isometric(noise=FAST), KEY), "too coarse for a resonance at 90"),
        (
            lambda: jm.simulate(jm.Isometric(noise=jm.BandLimitedNoise() + FAST), KEY),
            "too coarse for a resonance at 90",
        ),
        (
            lambda: jm.PrescribedMotion(noise=jm.ResonantNoise({"K_z": 0.1})),
            "ResonantNoise on K_z cannot be used",
        ),
    ],
)
def test_impossible_resonances_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
    with pytest.raises(TypeError):
        jm.ResonantNoise() + 1.0  # pyright: ignore[reportOperatorIssue]
