"""What the mean spectrum cannot see: steady records of the nonlinear muscle give no notice, bursts
and lines do, and the errors follow."""

import jax
import numpy as np
import pytest

import jaxmuscle as jm
from jaxmuscle.data._measured import RECORDED
from jaxmuscle.data._recording import BURST
from jaxmuscle.fits._signal_checks import CHANGES, check_signals
from jaxmuscle.model._noise import NoiseSum

RATE, LEAD = 100.0, 10.0


@pytest.fixture(scope="module")
def task():
    return jm.Isometric(harmonic_amplitude=0.0).settled()


@pytest.fixture(scope="module")
def records(task):
    runs = jm.ensemble(task, 11, seeds=40, duration=LEAD + 15.0, control=False)
    return np.asarray(runs.filtered(RECORDED, (LEAD, LEAD + 15.0)), float)


def noticed(signals, task, notices=()):
    target = jm.Target("someone", np.ones(30), settings=RECORDED, signals=signals, notices=notices)
    return check_signals(target, task, jax.random.key(0))


def about(x, size):
    """The record with fluctuations of another size about its mean."""
    return np.mean(x) + size * (x - np.mean(x))


def test_records_of_the_muscle_give_no_notice(records, task):
    said = [noticed([x], task).notices for x in records]
    assert sum(map(len, said)) <= 4  # of 80 tests at 1 %


def test_what_changes_its_size_is_found_and_widens_the_errors(records, task):
    time = np.arange(records.shape[1]) / RATE
    for x in records[:5]:
        found = noticed([about(x, 1 + 0.5 * np.sin(2 * np.pi * time / 8))], task)
        assert len(found.notices) == 1 and CHANGES in found.notices[0]
        assert found.widening > 1.2 and found.common > 0
    named = noticed([about(x, 1 + 0.5 * np.sin(2 * np.pi * time / 8))], task, [f"{BURST} at 6 s"])
    assert named.widening == found.widening and CHANGES not in named.notices[0]
    growing = [about(x, 0.5 + 1.5 * time / time[-1]) for x in records[:3]]
    found = noticed(growing, task)
    assert "the fluctuations grow within the trials" in found.notices[0]


def test_a_line_is_named(records, task):
    time = np.arange(records.shape[1]) / RATE
    line = 0.4 * np.std(records) * np.sin(2 * np.pi * 8.3 * time)
    for x in records[:5]:
        notice = noticed([x + line], task).notices[-1]
        seen = float(notice.removeprefix("a sharp rhythm at ").split()[0])
        assert abs(seen - 8.3) < 0.05


def test_a_resonance_narrower_than_a_bin_is_named(records, task):
    """Also where it has taken up all of the line."""
    narrow = jm.ResonantNoise(0.01, frequency=8.3, width=0.05)
    found = noticed(records[:1], task.with_parts(noise=NoiseSum((*task.noise.components, narrow))))
    assert any("narrower than a bin" in notice for notice in found.notices)


def test_a_spectrum_alone_gives_no_notice(task):
    assert noticed([], task).notices == ()


def test_a_fit_says_it_and_measures_with_wider_errors(records):
    time = np.arange(records.shape[1]) / RATE
    given = jm.Recording(about(records[0], 1 + 0.5 * np.sin(2 * np.pi * time / 8)), RATE)
    target = given.target()
    task = target.task()
    quick = {"check_seeds": 0, "seeds": 0, "rungs": 0, "starts": 8}
    result = jm.fit(task, target, **quick)
    bare = jm.fit(task, jm.Target.from_table(target.to_table()), **quick)
    assert sum(CHANGES in n for n in result.notices) == 1
    assert not any(CHANGES in n for n in bare.notices)
    for name in ("coefficient_of_variation", "share_1_2", "power_1_2", "median_frequency"):
        assert result.measured[name].stderr > 1.2 * bare.measured[name].stderr
        assert result.measured[name].value == bare.measured[name].value
    assert result.measured["mean"] == bare.measured["mean"]
    name = "model_coefficient_of_variation"
    assert result[name].stderr > 1.2 * bare[name].stderr
    assert jm.Target.from_table(target.to_table()) == target
