"""Variance by frequency and detrended fluctuations against their definitions, closed forms and
antropy."""

import numpy as np
import pytest
from test_metrics import RECORDS

from jaxmuscle.spectra._fluctuations import dfa, variance_spectrum


def noise_of(exponent, samples, seed):
    """Gaussian noise with density 1/f^exponent, without the mean; of twice the length, so that its
    ends differ."""
    rng, f = np.random.default_rng(seed), np.fft.rfftfreq(2 * samples)[1:]
    z = (rng.standard_normal(f.size) + 1j * rng.standard_normal(f.size)) * f ** (-exponent / 2)
    return np.fft.irfft(np.concatenate(([0.0], z)))[:samples]


@pytest.mark.parametrize("exponent, alpha", [(0, 0.5), (1, 1.0), (2, 1.5)])
def test_dfa_of_white_pink_and_brownian_noise(exponent, alpha):
    """α = (1 + exponent) / 2 for large windows; from 16 samples on F is still bent, which makes
    less than 0.03."""
    values = [dfa(noise_of(exponent, 4096, seed), smallest=16) for seed in range(40)]
    standard_error = np.std(values, ddof=1) / np.sqrt(len(values))
    assert standard_error < 0.015
    assert abs(np.mean(values) - alpha) < 4 * standard_error + 0.03


def test_dfa_is_its_definition():
    x, sizes, left = RECORDS["walk"], (4, 5, 6, 8, 9), []
    y = np.cumsum(x - x.mean())
    for n in sizes:  # 4 * 1.2^k, rounded down: 4, 4.8, 5.76, 6.9, 8.3, 9.95
        windows = [y[i : i + n] for i in range(0, len(y) - n + 1, n)]
        squares = [
            (w - np.polyval(np.polyfit(np.arange(n), w, 1), np.arange(n))) ** 2 for w in windows
        ]
        left.append(np.sqrt(np.mean(squares)))
    assert dfa(x, largest=10) == pytest.approx(
        np.polyfit(np.log(sizes), np.log(left), 1)[0], rel=1e-9
    )


@pytest.mark.parametrize("name", RECORDS)
def test_dfa_is_that_of_antropy(name):
    import antropy  # takes 7 s: not in every worker

    assert dfa(RECORDS[name]) == pytest.approx(
        antropy.detrended_fluctuation(RECORDS[name]), abs=1e-9
    )


def test_dfa_needs_windows():
    x = RECORDS["noise"]
    for arguments, message in (
        ((x, 3), "smallest=3: give at least 4"),
        ((x[:40],), "largest=4.0: give smallest < largest"),
        ((x, 4, 201), "largest=201: give smallest < largest <= 200"),
        ((np.ones(80),), "not constant"),
    ):
        with pytest.raises(ValueError, match=message):
            dfa(*arguments)


def test_variance_spectrum_is_its_definition_and_loses_nothing():
    x, n = RECORDS["walk"], len(RECORDS["walk"])
    f, power = variance_spectrum(x, 100.0)
    m, k = np.arange(n), np.arange(1, n)
    cosines = np.sqrt(2 / n) * np.cos(np.pi * k[:, None] * (m + 0.5) / n)
    np.testing.assert_allclose(power, (cosines @ (x - x.mean())) ** 2 / n, rtol=1e-9, atol=1e-18)
    np.testing.assert_allclose(f, k * 100.0 / (2 * n))
    assert power.sum() == pytest.approx(np.var(x), rel=1e-12)


def test_a_drift_stays_slow_in_the_variance_spectrum():
    """Of a straight line Σ 1/k⁴ over odd k, of which k = 1 is 96/π⁴; of a periodogram its end would
    be a jump: 6/(πk)²."""
    power = variance_spectrum(np.arange(3000.0), 100.0)[1]
    assert power[0] / power.sum() == pytest.approx(96 / np.pi**4, rel=1e-5)
    assert power[30:].sum() / power.sum() < 32 / np.pi**4 / 30**3


def test_a_sine_and_white_noise_in_the_variance_spectrum():
    f, power = variance_spectrum(
        3.0 + 2.0 * np.sin(0.3 + 2 * np.pi * 9 * np.arange(2000) / 100), 100.0
    )
    # Beyond m = 40 ordinates on either side lies at most 4/(π² m) = 1 %.
    assert 0.98 * 2.0 < power[abs(f - 9) < 1].sum() < 2.0
    shares = [
        p[f < 10].sum() / p.sum()
        for p in (variance_spectrum(noise_of(0, 2000, s), 100.0)[1] for s in range(40))
    ]
    assert abs(np.mean(shares) - 0.2) < 4 * np.std(shares, ddof=1) / np.sqrt(40)
