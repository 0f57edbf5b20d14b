"""Whitened records: their law where they are steady; what changes their size, and lines, are
found."""

import numpy as np
import pytest
import scipy.signal

from jaxmuscle.spectra._whitened import (
    envelope_power,
    log_powers,
    sharpest,
    slopes_of,
    trend_p,
    whiten,
)

RATE, N = 100.0, 1500
T = np.arange(N) / RATE


def slow(f):
    """The density of the records: an Ornstein-Uhlenbeck process of 1 Hz."""
    return 1 / (1 + f**2)


def flat(f):
    return np.ones(len(f))


def records(count, seed, modulation=1.0):
    n, rng = 4 * N, np.random.default_rng(seed)
    f = np.fft.rfftfreq(n, 1 / RATE)
    z = rng.standard_normal((count, f.size)) + 1j * rng.standard_normal((count, f.size))
    x = np.fft.irfft(z * np.sqrt(slow(f)), n)[:, :N] * modulation
    return scipy.signal.sosfiltfilt(scipy.signal.butter(9, 30, fs=RATE, output="sos"), x)


def test_a_steady_record_becomes_white_whatever_its_spectrum():
    """Its power is even over the band, also where the density is wrong by a slope."""
    for density in (slow, flat):
        w = whiten(records(400, 1), RATE, density)
        f, power = scipy.signal.periodogram(w, RATE)
        thirds = [power[:, (f >= a) & (f < b)].mean() for a, b in ((1, 4), (4, 8), (8, 11.5))]
        # the mean over 3 Hz does not follow the bend of 1/f² wholly, of which flat knows nothing
        np.testing.assert_allclose(thirds, np.mean(thirds), rtol=0.1 if density is flat else 0.02)
        np.testing.assert_allclose(np.var(w, axis=-1), 1, rtol=1e-12)


def test_the_envelope_says_how_the_mean_power_of_records_scatters():
    """`E / n` is the relative variance of the mean power, of steady records and of others."""
    rng = np.random.default_rng(2)
    phase = rng.uniform(0, 2 * np.pi, (600, 1))
    for modulation in (1.0, 1 + 0.5 * np.sin(2 * np.pi * 0.7 * T + phase)):
        E = envelope_power(whiten(records(600, 3, modulation), RATE, slow), RATE)
        steady = envelope_power(whiten(rng.standard_normal((600, N)), RATE, flat), RATE)
        if np.ndim(modulation):
            # of a sine the squared size has the variance 0.36, all of it between 0 and 1.4 Hz:
            # 0.31 of that at 0.7 Hz, in a density over 1 Hz on both sides
            assert np.mean(E) - np.mean(steady) > 0.31 * RATE / 2
        else:
            # RATE over the band, less what falls off up to 1 Hz, plus the taper; se 1.5 %
            np.testing.assert_allclose(np.mean(E), RATE / 11.5, rtol=0.15)
            np.testing.assert_allclose(np.mean(E), np.mean(steady), rtol=0.06)


def test_a_trend_is_told_from_bursts():
    rng = np.random.default_rng(4)
    grown = log_powers(whiten(records(100, 5, 0.6 + 0.8 * T / T[-1]), RATE, slow))
    # the power grows from 0.65² to 1.35² between the middles of the first and the last part
    np.testing.assert_allclose(np.mean(slopes_of(grown)), 2 * np.log(1.35 / 0.65), atol=0.1)
    assert np.mean([trend_p(row[None]) < 0.01 for row in grown]) > 0.8
    noise = scipy.signal.lfilter([1], [1, -np.exp(-0.02)], rng.standard_normal((100, N)))
    burst = log_powers(whiten(records(100, 6, np.exp(0.8 * noise * 0.2)), RATE, slow))
    assert np.mean([trend_p(row[None]) < 0.01 for row in burst]) < 0.1


@pytest.mark.parametrize("at", [2.7, 8.31])
def test_a_line_is_found_where_it_is(at):
    x = records(100, 7)
    null = sharpest([x], RATE, slow)[1]
    line = 0.7 * np.std(x) * np.sqrt(slow(at) / slow(2.7)) * np.sin(2 * np.pi * at * T)
    frequency, height = sharpest([x + line], RATE, slow)
    assert np.mean(height > np.max(null)) > 0.9
    assert np.max(np.abs(frequency[height > np.max(null)] - at)) < 0.1


def test_trials_of_different_lengths_count_alike():
    long, short = records(1, 8), records(1, 9)[:, :1000]
    np.testing.assert_allclose(
        sharpest([long, short], RATE, slow), sharpest([long, 100 * short], RATE, slow)
    )
