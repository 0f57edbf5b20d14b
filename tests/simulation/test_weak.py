"""Weak increments: expectations of linear and nonlinear tasks against closed forms and Gaussian
ensembles."""

import json
from typing import Any

import jax
import numpy as np
import pytest
import references
from test_simulate import Integral

import jaxmuscle as jm

KEY = jax.random.key(8)
SHORT = {"duration": 1.0, "chunk": 8}
STILL = jm.Harmonic(0.0)


class Growth(Integral):
    """`y' = (ΔK_w - 2) (1 + y)`: 1 + y is a geometric Brownian motion, if the noise is white."""

    def vector_field(self, t, y, u):
        return (u[:1] - 2.0) * (1 + y)


class Decaying(Integral):
    """`y' = ΔK_w - 3 y`."""

    def vector_field(self, t, y, u):
        return u[:1] - 3.0 * y


def at_the_end(task, dt, increments, seeds=400_000, seconds=1.0, key=KEY):
    """Mean and variance of y, and their standard errors if y were normal."""
    found = jm.ensemble(
        task,
        key,
        seeds=seeds,
        duration=seconds,
        dt=dt,
        rate=1 / max(dt, seconds / 5),
        substeps=1,
        sampling="instant",
        control=False,
        reduce=True,
        increments=increments,
    )
    return float(found.mean[-1]), float(found.variance[-1])


@pytest.mark.slow
@pytest.mark.parametrize("increments", ["weak", "gaussian"])
def test_weak_order_of_geometric_brownian_motion(x64, increments):
    """Stratonovich, σ = 1: E(1 + y) = exp(-3/2 t), E(1 + y)² = exp(-2 t); Heun's mean is of order
    one."""
    task = Growth(noise=jm.WhiteNoise({"K_w": 1.0}, rate=1.0, relative=False), harmonic=STILL)
    errors, dts = [], [0.1, 0.05, 0.025]
    for i, dt in enumerate(dts):
        mean, variance = at_the_end(task, dt, increments, key=jax.random.fold_in(KEY, i))
        steps = round(1 / dt)
        # One step multiplies by 1 + a + a²/2, a = -2 dt + √dt z: its moments are those of the
        # normal up to z⁴.
        first = 1 - 2 * dt + dt / 2 + 2 * dt**2
        z = np.sqrt(2) * np.polynomial.hermite.hermgauss(9)[0]
        a, weight = (
            -2 * dt + np.sqrt(dt) * z,
            np.polynomial.hermite.hermgauss(9)[1] / np.sqrt(np.pi),
        )
        second = weight @ (1 + a + a**2 / 2) ** 2
        error = np.sqrt(variance / 400_000)
        assert abs(1 + mean - first**steps) < 4 * error
        # A product of many has heavy tails: the standard error of its square is that of eighth
        # moments, 2 % here.
        assert abs((variance + (1 + mean) ** 2) / second**steps - 1) < 0.08
        errors.append(1 + mean - np.exp(-1.5))
    # By the closed form 1.14 at these steps, whose next order still counts; standard error 0.06.
    assert abs(references.observed_order(dts, np.abs(errors)) - 1.14) < 0.2, errors


@pytest.mark.parametrize("increments", ["weak", "gaussian"])
def test_moments_of_a_linear_task_are_exact(x64, increments):
    """`y' = N - 3 y` with an Ornstein-Uhlenbeck N of unit variance and rate 5/s, from rest."""
    task = Decaying(
        noise=jm.OrnsteinUhlenbeckNoise({"K_w": 1.0}, 0.2, relative=False), harmonic=STILL
    )
    seeds, t, slow, fast = 200_000, 1.0, 3.0, 5.0
    mean, variance = at_the_end(task, 0.01, increments, seeds)
    # ∫∫ exp(-λ(t-s)) exp(-λ(t-s')) exp(-r|s-s'|) ds ds'
    both = (1 - np.exp(-2 * slow * t)) / (2 * slow) - (
        np.exp(-2 * slow * t) - np.exp(-(slow + fast) * t)
    ) / (fast - slow)
    exact = 2 / (slow + fast) * both
    assert abs(mean) < 4 * np.sqrt(exact / seeds)
    # The trapezoid of a step of 10 ms leaves some 1e-3.
    assert abs(variance / exact - 1) < 4 * np.sqrt(2 / seeds) + 2e-3


LARGE = {"K_w": 0.15, "K_z": 0.005, "C_w": 1e-4, "C_z": 1e-4}
NONLINEAR = {
    "isometric, two noises": jm.Isometric(
        5.0, 0.003, noise=jm.BandLimitedNoise(LARGE) + jm.OrnsteinUhlenbeckNoise(LARGE)
    ),
    "force, white": jm.PrescribedForce(5.0, 1.0, noise=jm.WhiteNoise(LARGE)),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", NONLINEAR)
def test_expectations_of_a_nonlinear_task_are_those_of_gaussian_noise(x64, name):
    task, seeds = NONLINEAR[name], 512
    weak, gaussian = (
        jm.ensemble(
            task,
            jax.random.fold_in(KEY, i),
            seeds=seeds,
            dt=2.5e-3,
            reduce=True,
            increments=increments,
        )
        for i, increments in enumerate(("weak", "gaussian"))
    )
    later = np.arange(200, len(weak.time), 100)  # every second, long after what is remembered
    spread = weak.variance + gaussian.variance
    references.assert_standard_normal(
        (weak.mean - gaussian.mean)[later] / np.sqrt(spread[later] / seeds)
    )
    references.assert_standard_normal(
        np.log(weak.variance[later] / gaussian.variance[later]) / np.sqrt(4 / (seeds - 1))
    )
    a, b = weak.spectrum, gaussian.spectrum
    references.assert_standard_normal(
        (a.plain_power - b.plain_power) / np.hypot(a.plain_stderr, b.plain_stderr), every=3
    )
    # Beside the linear response of the same numbers, a hundred times sharper.
    references.assert_standard_normal((a.power - b.power) / np.hypot(a.stderr, b.stderr), every=3)
    shift = weak.coefficient_of_variation[0] - gaussian.coefficient_of_variation[0]
    assert abs(shift) < 4 * np.hypot(
        weak.coefficient_of_variation[1], gaussian.coefficient_of_variation[1]
    )


def test_weak_increments_are_for_expectations():
    task = jm.Isometric()
    with pytest.raises(
        ValueError,
        match=r'increments = "weak" is for expectations, its paths mean nothing: give reduce=True',
    ):
        jm.ensemble(task, KEY, seeds=4, increments="weak")
    with pytest.raises(ValueError, match="its paths mean nothing"):
        jm.ensemble(task, KEY, seeds=4, increments="weak", store="never-made.zarr")
    with pytest.raises(
        ValueError,
        match=r"quantiles beyond 0.01 and 0.99 depend on the tails of single increments \(0.001\)",
    ):
        jm.ensemble(task, KEY, seeds=4, increments="weak", reduce=(0.001, 0.5))
    found = jm.ensemble(task, KEY, seeds=4, increments="weak", reduce=(0.01, 0.99), **SHORT)
    assert found.success and found.levels == (0.01, 0.99)


def test_unknown_random_numbers_are_refused():
    with pytest.raises(ValueError, match=r"increments = 'strong': .*gaussian.*weak"):
        jm.ensemble(jm.Isometric(), KEY, seeds=4, increments="strong")
    with pytest.raises(ValueError, match=r"generator = 'philox': .*hash.*threefry"):
        jm.ensemble(jm.Isometric(), KEY, seeds=4, generator="philox")


def test_the_generator_and_the_increments_change_the_noise():
    ways: list[dict[str, Any]] = [{}, {"generator": "threefry"}, {"increments": "weak"}]
    made = [
        jm.ensemble(jm.Isometric(), KEY, seeds=4, reduce=True, **SHORT, **how).variance[-1]
        for how in ways
    ]
    assert len({float(v) for v in made}) == 3


class Stop(Exception):
    """The run is interrupted."""


def stop(*told):
    raise Stop


def begun(path):
    """A store that was interrupted after its first chunk."""
    with pytest.raises(Stop):
        jm.ensemble(jm.Isometric(), KEY, seeds=20, store=path, progress=stop, **SHORT)
    return path


def test_a_store_of_other_random_numbers_is_not_resumed(tmp_path):
    path = begun(tmp_path / "a.zarr")
    with pytest.raises(
        ValueError, match=r'random numbers.generator = "hash" there, "threefry" here'
    ):
        jm.ensemble(
            jm.Isometric(), KEY, seeds=20, store=path, resume=True, generator="threefry", **SHORT
        )


def test_a_store_of_earlier_noise_is_not_resumed(tmp_path):
    path = begun(tmp_path / "a.zarr")
    root = path / "zarr.json"
    whole = json.loads(root.read_text(encoding="utf-8"))
    settings = json.loads(whole["attributes"]["settings"])
    del settings["random numbers"]
    whole["attributes"]["settings"] = json.dumps(settings)
    root.write_text(json.dumps(whole), encoding="utf-8")
    with pytest.raises(
        ValueError,
        match=(
            r"a\.zarr: was begun by an earlier version of jaxmuscle, whose seeds have other noise"
        ),
    ):
        jm.ensemble(jm.Isometric(), KEY, seeds=20, store=path, resume=True, **SHORT)
    found = jm.ensemble(jm.Isometric(), KEY, seeds=20, store=path, overwrite=True, **SHORT)
    assert found.attrs["complete"]
