"""Two threads that simulate, compute and fit at the same time get what each gets alone."""

import functools
import os
import threading
from concurrent.futures import ThreadPoolExecutor

import jax
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest
from processes import ended, python

import jaxmuscle as jm
from jaxmuscle._common import programs
from jaxmuscle._common.files import write_text
from jaxmuscle.model._parameters import DEFAULT_FREE
from jaxmuscle.uncertainty import _chains

TASK, KEY = jm.Isometric(), jax.random.key(5)


def expected(number):
    return np.asarray(jm.expected_spectrum(TASK.replace(k_w=4e5 + 1e4 * number)).power)


def simulated(number):
    return np.asarray(jm.simulate(TASK, KEY, seed=number).output)


def reduced(number):
    return jm.ensemble(
        TASK.replace(k_w=4e5 + 1e4 * number), KEY, seeds=16, duration=0.2, chunk=8, reduce=True
    ).mean


def in_double(number):
    with jax.enable_x64(True):
        return reduced(number)


def pairs(run, jobs):
    """What two threads make of jobs, which they begin together."""
    together = threading.Barrier(2)

    def one(part):
        together.wait()
        return [run(job) for job in part]

    with ThreadPoolExecutor(2) as pool:
        each = list(pool.map(one, (jobs[::2], jobs[1::2])))
    found = [None] * len(jobs)
    found[::2], found[1::2] = each
    return found


@pytest.mark.slow
def test_two_threads_50_times():
    """In mixed order, with programs that are in memory and with ones that both threads miss; in
    both precisions.

    All are forgotten after ten jobs of each thread: it is the misses that threads could confuse.
    """
    kinds = [expected, simulated, reduced, in_double]
    rng = np.random.default_rng(3)
    jobs = [
        (kinds[kind], int(number))
        for kind, number in zip(rng.integers(0, 4, 100), rng.integers(0, 5, 100), strict=True)
    ]
    alone = {job: job[0](job[1]) for job in sorted(set(jobs), key=str)}
    for start in range(0, 100, 20):
        programs.forget()
        part = jobs[start : start + 20]
        for job, found in zip(part, pairs(lambda job: job[0](job[1]), part), strict=True):
            np.testing.assert_array_equal(found, alone[job], str(job))
            assert found.dtype == alone[job].dtype


def fit(key):
    options = {
        "free": ("c_w", "noise_K_w"),
        "starts": 2,
        "seeds": 8,
        "check_seeds": 0,
        "rungs": 0,
        "max_steps": 8,
    }
    return jm.fit(jm.Isometric(), jm.load_target("vastus-lateralis-26mvc"), key=key, **options)


fit_alone = functools.cache(fit)


TEN = """
import threading
from concurrent.futures import ThreadPoolExecutor
import numpy as np
import jaxmuscle as jm
from jaxmuscle.response import sensitivity

target = jm.load_target("vastus-lateralis-26mvc")
calls = [
    lambda number: jm.fit(jm.Isometric(), target, key=number).parameters,
    lambda number: np.asarray(jm.expected_spectrum(jm.Isometric(k_w=4e5 + number)).power).tobytes(),
    lambda number: np.asarray(jm.simulate(jm.Isometric(), number).output).tobytes(),
    lambda number: jm.ensemble(jm.Isometric(), number, seeds=16, reduce=True).mean.tobytes(),
    lambda number: np.asarray(sensitivity(jm.Isometric(k_w=4e5 + number)).power).tobytes(),
]
jobs = [(call, number) for number in range(2) for call in calls]
alone = [call(number) for call, number in jobs]
print("alone", flush=True)
together = threading.Barrier(len(jobs))

def run(job):
    call, number = job
    together.wait()
    return call(number)

for _ in range(3):
    with ThreadPoolExecutor(len(jobs)) as pool:
        assert list(pool.map(run, jobs)) == alone
print("together")
"""


@pytest.mark.slow
def test_ten_threads_end():
    """Fits and other calls with their default options, each as alone; with jaxlib 0.10 and without
    `programs.LAPACK` they wait for one another for ever."""
    said = ended(python(TEN), seconds=600)[0]
    assert said.split() == ["alone", "together"]


@pytest.mark.slow
def test_two_threads_draw(monkeypatch):
    """Two posteriors of one fit, in threads that both miss the sampler's programs; they are those
    of the README's posterior.

    Paths are a tenth as long, so that each draw takes few steps; the programs are the same.
    """
    monkeypatch.setattr(_chains, "LONGEST", 0.4)

    def drawn(key):
        return jm.posterior(
            fit_alone(0), key=key, chains=2, draws=100, warmup=20, free=DEFAULT_FREE
        ).samples

    alone = [drawn(key) for key in range(2)]
    assert np.any(alone[0]["c_w"] != alone[1]["c_w"])
    for missed in (_chains._first, _chains._block):
        missed.programs.clear()
    for key, found in enumerate(pairs(drawn, [0, 1])):
        assert found.keys() == alone[key].keys()
        for name, draws in found.items():
            np.testing.assert_array_equal(draws, alone[key][name], name)


def test_files_written_by_threads_leave_the_umask(tmp_path):
    before = os.umask(0o027)
    try:
        pairs(lambda number: write_text(tmp_path / f"{number}.txt", "text"), list(range(200)))
        assert os.umask(0o027) == 0o027
    finally:
        os.umask(before)
    assert {path.stat().st_mode & 0o777 for path in tmp_path.iterdir()} == {0o640}


def test_figures_of_threads_leave_the_style():
    before = dict(matplotlib.rcParams)
    spectrum = jm.load_target("vastus-lateralis-26mvc")
    figures = pairs(lambda number: spectrum.plot().figure, list(range(6)))
    assert len({id(figure) for figure in figures}) == 6
    assert dict(matplotlib.rcParams) == before
    for figure in figures:
        plt.close(figure)
