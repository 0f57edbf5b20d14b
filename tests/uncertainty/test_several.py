"""Profile, posterior, identifiability, goodness and bootstrap of fits of several targets, against
those of one."""

import dataclasses
import functools

import equinox as eqx
import jax
import matplotlib.pyplot as plt
import numpy as np
import pytest
from compiled import at_once
from refits import without_intervals

import jaxmuscle as jm
from jaxmuscle.checks import _bootstrap
from jaxmuscle.fits._reopened import reopened
from jaxmuscle.objective._consequences import expand
from jaxmuscle.objective._likelihood import Likelihood
from jaxmuscle.uncertainty._design_information import expansion_at, information_of
from jaxmuscle.uncertainty._posterior_density import density_about

TRUTH = jm.Isometric().replace(
    c_w=80.0, noise_K_w=0.2, harmonic_amplitude=0.012, harmonic_frequency=5.0
)
TASKS = {"low": TRUTH.replace(P_w=4.0), "high": TRUTH.replace(P_w=8.0)}
FREE = ("c_w", "noise_K_w", "harmonic_amplitude")
QUICK = {"starts": 2, "seeds": 0}


@functools.cache
def targets():
    """Expected spectra with scatter of the size that their segments have."""
    rng = np.random.default_rng(4)
    powers = {
        name: (
            np.asarray(jm.expected_spectrum(task).proportional)
            * np.exp(0.2 * rng.standard_normal(30))
        )
        for name, task in TASKS.items()
    }
    return {
        name: jm.Target(name, power, segments=24, coefficient_of_variation=0.02)
        for name, power in powers.items()
    }


@functools.cache
def both(free=FREE, separate=()):
    with without_intervals():
        return jm.fit(TASKS, targets(), free=free, separate=separate, **QUICK)


@functools.cache
def alone(name, free=FREE):
    return jm.fit(TASKS[name], targets()[name], free=free, check_seeds=0, **QUICK)


def test_a_joint_fit_of_one_target_is_the_fit_of_that():
    joint = jm.fit({"low": TASKS["low"]}, {"low": targets()["low"]}, free=FREE, **QUICK)
    for name in (
        "parameters",
        "derived",
        "correlation",
        "undetermined",
        "starts",
        "settings",
        "notices",
    ):
        assert getattr(joint, name) == getattr(alone("low"), name), name
    np.testing.assert_array_equal(joint.fitted, alone("low").fitted)
    assert jm.profile(joint, "c_w").intervals == jm.profile(alone("low"), "c_w").intervals


@pytest.mark.parametrize(
    "separate", [(), ("c_w", "harmonic_amplitude")], ids=["shared", "separate"]
)
def test_a_fit_taken_up_again_is_at_the_same_point(x64, separate):
    joint = both(separate=separate)
    problem = reopened(joint)
    theta = problem.theta_of(tuple(joint.tasks.values()))
    for task, again in zip(joint.tasks.values(), problem.tasks_at(theta), strict=True):
        for name, value in task.parameters.items():
            assert float(again[name]) == pytest.approx(float(value), rel=1e-12), name
    centre = dict(zip(problem.coordinates.names, problem.coordinates.centre, strict=True))
    assert {n: float(c) for n, c in centre.items()} == joint.settings["prior_centre"]


def test_proportional_parameters_are_taken_up_with_their_ratio(x64):
    names = (
        "k_w",
        "k_z",
        "c_w",
        "c_z",
        "noise_K_w",
        "noise_K_z",
        "noise_C_w",
        "noise_C_z",
        "harmonic_amplitude",
    )
    tasks = {"low": TRUTH.at_level(0.15), "high": TRUTH.at_level(0.6)}
    with without_intervals():
        joint = jm.fit(tasks, targets(), free=("k_w", "c_w"), proportional=names, **QUICK)
    problem = reopened(joint)
    for part, task in zip(problem.parts, tasks.values(), strict=True):
        np.testing.assert_allclose(
            part.coordinates.centre, [float(task[n]) for n in ("k_w", "c_w")], rtol=1e-12
        )


def test_the_likelihoods_of_the_targets_add_up(x64):
    joint = both()
    problem = reopened(joint)
    likelihood = Likelihood.of(problem)
    moments = (
        expand(problem.linear(), problem.theta_of(tuple(joint.tasks.values()))[None]).row(0).moments
    )
    each = [jm.objective.log_likelihood(part.task, part.target) for part in joint.parts.values()]
    # `log_likelihood` also has the normalisation of the coefficient of variation's law.
    each = [
        float(x) + np.log(part.variation[1]) for x, part in zip(each, problem.parts, strict=True)
    ]
    assert float(likelihood.marginal(moments)) == pytest.approx(sum(each), rel=1e-9)


@pytest.mark.slow
def test_information_adds_up(x64):
    """Of what is shared: at the same point, that of both is the sum of that of each."""
    joint = both()
    tasks = tuple(joint.tasks.values())
    problem = reopened(joint)
    whole = information_of(problem, expansion_at(problem, problem.theta_of(tasks)))
    parts = []
    for i, name in enumerate(TASKS):
        single = dataclasses.replace(
            reopened(alone(name)), parts=(problem.parts[i],), coordinates=problem.coordinates
        )
        parts.append(information_of(single, expansion_at(single, problem.theta_of(tasks))))
    np.testing.assert_allclose(whole, sum(parts), rtol=1e-9, atol=1e-9 * np.abs(whole).max())
    found = jm.identifiability(joint)
    np.testing.assert_allclose(
        found.present.singular_values**2, np.linalg.eigvalsh(whole)[::-1], rtol=1e-8
    )
    assert {"band_8_12@low", "band_8_12@high", "C_w0"} <= set(found.present.quantities)
    # A force level beyond each end, and of each target a longer recording.
    levels = [design.name for design in found.designs if "force level" in design.name]
    assert levels == [
        "a second force level 0.5 times as high (low)",
        "a second force level 2 times as high (high)",
    ]
    assert sum("10 times as long" in design.name for design in found.designs) == 2


def test_a_design_is_like_the_target_that_it_names():
    designs = [jm.uncertainty.Design(name, segments=100, target=name) for name in ("high", "low")]
    high, low = jm.identifiability(both(), designs=designs).designs
    assert not np.allclose(high.singular_values, low.singular_values, rtol=1e-3)
    design = designs[0]
    with pytest.raises(ValueError, match=r"high: target: the fit has none called 'middle'"):
        jm.identifiability(both(), designs=[dataclasses.replace(design, target="middle")])


@pytest.mark.slow
def test_two_targets_narrow_the_profile():
    found, single = jm.profile(both(), "c_w"), [jm.profile(alone(name), "c_w") for name in TASKS]
    # of one target alone the scale is unknown: then it is per newton
    told = [(p.value / p.stderr) ** 2 for p in (found, *single)]
    assert told[0] == pytest.approx(sum(told[1:]), rel=0.2)
    low, high = (
        jm.profile(both(), "corner_frequency@low"),
        jm.profile(both(), "corner_frequency@high"),
    )
    assert low.value < high.value and low.unit == high.unit == "Hz"  # stiffer under force
    assert low.low is not None and high.high is not None
    with pytest.raises(ValueError, match="'corner_frequency' is neither free nor derived"):
        jm.profile(both(), "corner_frequency")


@pytest.mark.slow
def test_densities_of_separate_parameters_add_up(x64):
    """With nothing shared the posterior density is the product of those of the two fits."""
    free = ("c_w", "noise_K_w", "harmonic_amplitude", "harmonic_frequency")
    joint = both(free, free)
    problem = reopened(joint)
    whole, _, _ = density_about(
        problem, Likelihood.of(problem), problem.theta_of(tuple(joint.tasks.values()))
    )
    assert [band.name for band in whole.bands] == [
        "harmonic_frequency@low",
        "harmonic_frequency@high",
    ]
    assert len(whole.levels) == 2 and whole.size == 6 + 2
    single = []
    for name in TASKS:
        with without_intervals():
            result = alone(name, free)
        own = reopened(result)
        single.append(density_about(own, Likelihood.of(own), own.theta_of((result.task,)))[0])

    rng = np.random.default_rng(0)
    steps = 0.3 * rng.standard_normal((4, 8))
    # Coordinates of the joint density: three of each target, then the offsets.
    own = [[0, 1, 2, 6], [3, 4, 5, 7]]
    found = rises(whole, whole.centre, steps)
    wanted = [
        rises(density, whole.centre[part], steps[:, part])
        for density, part in zip(single, own, strict=True)
    ]
    np.testing.assert_allclose(found, sum(wanted), rtol=0.02, atol=0.02)


def rises(density, centre, steps):
    """By how much the log density differs from that at a centre."""
    points = np.concatenate([[centre], centre + steps])
    white = np.linalg.solve(np.asarray(density.scale), (points - density.centre).T).T
    arrays, fixed = eqx.partition(
        density, lambda x: isinstance(x, jax.Array | np.ndarray | np.generic)
    )
    log_density = at_once(
        lambda arrays, white: jax.lax.map(eqx.combine(arrays, fixed).log_density, white),
        arrays,
        white,
    )
    return np.asarray(log_density)[1:] - np.asarray(log_density)[0]


@pytest.mark.slow
def test_the_posterior_of_two_targets(tmp_path, monkeypatch):
    joint = both()
    monkeypatch.setattr("jaxmuscle.uncertainty._posterior.DRAWS", (500, 1500))
    found = jm.posterior(joint, key=1, chains=2, warmup=200)
    assert found.success, found.message
    assert set(found.parts) == {"low", "high"} and set(found.samples) == set(FREE)
    summary = found.summary()
    for name in ("c_w", "noise_K_w"):
        assert (
            abs(summary[name]["median"] - joint.parameters[name].value)
            < joint.parameters[name].stderr
        )
        assert summary[name]["sd"] == pytest.approx(joint.parameters[name].stderr, rel=0.35)
    for name in TASKS:
        task = found.parts[name].task
        assert float(task["c_w"]) == pytest.approx(summary["c_w"]["median"])
        assert float(task["P_w"]) == float(TASKS[name]["P_w"])
        assert 0.01 < found.parts[name].replicates.p_value < 0.99
        plt.close(found.plot_predictive(target=name).figure)
    with pytest.raises(AttributeError, match=r"posterior\.parts\['low'\]"):
        _ = found.target
    tree = found.to_datatree()
    assert tree["posterior"]["expected@high"].dims == ("chain", "draw", "frequency@high")
    assert {"corner_frequency@low", "C_w0"} <= set(tree["posterior"].data_vars)
    for name in ("posterior.nc", "posterior.json"):
        found.save(tmp_path / name)
        assert (tmp_path / name).stat().st_size > 1000
    plt.close(found.plot().figure)
    plt.close(found.plot_chains().figure)


def test_goodness_of_two_targets():
    """The worse of two spectra is named; that of a joint fit of one target is that of the fit."""
    odd = targets()["high"].proportional_power.copy()
    odd[15] *= 8.0
    pair = {
        "low": targets()["low"],
        "high": jm.Target("high", odd, segments=24, coefficient_of_variation=0.02),
    }
    with without_intervals():
        result = jm.fit(TASKS, pair, free=FREE, **QUICK)
    found = jm.checks.goodness(result, replicates=99)
    assert found.parts["high"].p_values["largest"] <= 0.02 < found.parts["low"].p_values["largest"]
    assert found.p_value <= 0.05
    assert "high: compared with 99 spectra" in str(found) and "all targets together: p = " in str(
        found
    )
    assert len(found.plot().axes) == 8
    plt.close("all")


@pytest.mark.slow
def test_bootstrap_of_two_targets(monkeypatch):
    monkeypatch.setattr(_bootstrap, "STARTS", 8)
    with without_intervals():
        found = jm.checks.bootstrap(both(), replicates=12, key=2)
    assert {"c_w", "noise_K_w", "corner_frequency@low", "corner_frequency@high"} <= set(
        found.quantities
    )
    assert found.target == "low, high" and set(found.tasks) == set(TASKS)
    # The spread over the stated error of 12 refits scatters by 0.21.
    for name in ("c_w", "corner_frequency@high"):
        assert abs(found.quantities[name].ratio - 1) < 4 * 0.21, name
