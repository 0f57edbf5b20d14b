"""Fits of spectra with longer segments, for what lies below 1 Hz: what comes back of a simulated
recording, what is said."""

import dataclasses

import jax
import numpy as np
import pytest

import jaxmuscle as jm
from jaxmuscle.fits._report import of_several
from jaxmuscle.objective._starts import candidate_frequencies
from jaxmuscle.response._equilibrium import slowest_rate

TRUTH = jm.Isometric(
    P_w=20.0,
    noise=jm.BandLimitedNoise({"K_w": 0.15, "K_z": 0.003}),
    harmonic=jm.Harmonic(0.0, 4.25),
)
TRUTH = TRUTH.replace(k_w=1e5, c_w=150.0)


@pytest.fixture(scope="module")
def recording():
    """A minute at rest, after 6 s."""
    run = jm.simulate(TRUTH.settled(), jax.random.key(6), duration=66.0)
    return jm.Recording(run.output, run.rate, name="minute", window=(6.0, 66.0))


@pytest.mark.slow
def test_a_minute_gives_its_corner_frequency(recording, tmp_path):
    target = recording.target(settings="slow")
    task = TRUTH.replace(k_w=5e5, c_w=60.0)
    # as many seeds each: one program
    quick = {"starts": 4, "seeds": 8, "check_seeds": 8, "rungs": 0}
    result = jm.fit(task, target, free=("c_w", "noise_K_w", "noise_K_z"), **quick)
    corner, true = result.derived["corner_frequency"], float(slowest_rate(TRUTH)) / (2 * np.pi)
    assert result.success and result.adequate
    assert abs(corner.value - true) < 4 * corner.stderr < 4 * true
    # One segment of each seed; the nonlinear model is the linear one within the control variate's
    # error and 0.5 % of a bin.
    assert result.only.check["largest_deviation"] < 0.005
    result.save(tmp_path / "fit.json")
    assert jm.load_result(tmp_path / "fit.json").target.settings.name == "slow"
    parts = {
        "slow": result.only,
        "usual": dataclasses.replace(result.only, target=recording.target()),
    }
    (said,) = of_several(parts)
    assert said.startswith("slow and usual state one source and different spectra")
    assert not of_several({"one": result.only, "two": result.only})


@pytest.mark.slow
def test_segments_that_a_simulation_does_not_hold_are_refused(recording):
    target = recording.target(settings=jm.SpectrumSettings(length=2048, last_bin=240))
    with pytest.raises(
        ValueError, match="length=2048: a fit simulates 10 s, which is shorter than a segment"
    ):
        jm.fit(TRUTH, target)


def test_a_line_among_many_maxima_is_tried():
    """117 bins have about 30 maxima; a faint line is not among the sharpest."""
    f = jm.SpectrumSettings.named("slow").frequency
    noise = np.exp(np.random.default_rng(0).standard_normal(f.size))
    noise[40:45] = [1, 2, 2.2, 2, 1]
    target = jm.Target("faint", noise, settings=jm.SpectrumSettings.named("slow"), segments=11)
    assert np.min(np.abs(candidate_frequencies(target, 100)[:50] - f[42])) < 0.01
