"""Joint fits: what is shared, what two measurements of one truth determine together, and that they
are single fits else."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
from refits import without_intervals
from test_fit import true_derived
from test_result import assert_equal

import jaxmuscle as jm
from jaxmuscle._common.arrays import as_arrays
from jaxmuscle.fits._joint import planned_jointly
from jaxmuscle.model._parameters import DEFAULT_FREE
from jaxmuscle.objective._arguments import joint_names
from jaxmuscle.objective._consequences import expand, quantities
from jaxmuscle.objective._covariance import common_scales, identifiability
from jaxmuscle.objective._options import FitOptions
from jaxmuscle.objective._residuals import Residuals, data_residuals
from jaxmuscle.objective._starts import distinct, starting_points

TRUTH = jm.Isometric().replace(
    k_w=3.5e5, k_z=7e5, c_w=80.0, harmonic_frequency=5.0, harmonic_amplitude=0.012
)
SEEDS = 24
BIN = 0.390625
# Of every comparison here one in a thousand may fail by scatter, whatever the number of them.
RARE = 1e-3


def bound(comparisons):
    """Šidák's, in standard errors."""
    from scipy.stats import norm

    return norm.ppf(1 - (1 - (1 - RARE) ** (1 / comparisons)) / 2)


def simulated(task, name, seed, variation=True):
    """A target from seeds of the nonlinear simulator; six Welch segments of each."""
    runs = jm.ensemble(task.settled(), jax.random.key(seed), seeds=SEEDS, dt=2.5e-3, control=False)
    held = np.asarray(runs.between((5.0, 15.0)))
    cv = float(np.sqrt(held.var(axis=1).mean()) / held.mean()) if variation else None
    quantity = "displacement" if task.output_unit == "m" else "force"
    power = np.asarray(runs.spectrum().mean().proportional)
    return jm.Target(
        name, power, segments=(6,) * SEEDS, coefficient_of_variation=cv, quantity=quantity
    )


def expected(task, name="expected", **fields: Any):
    """A target that is the expected spectrum."""
    power = np.asarray(jm.expected_spectrum(task).proportional)
    quantity = "displacement" if task.output_unit == "m" else "force"
    return jm.Target(name, power, quantity=quantity, **({"segments": 24} | fields))


def assert_near_the_truth(estimates, truth, names):
    for name in names:
        p = estimates[name]
        assert p.stderr is not None, f"{name} is not determined"
        assert abs(p.value - truth[name]) < bound(len(names)) * p.stderr, (
            f"{name}: {p.value} ± {p.stderr}, true {truth[name]}"
        )


# --- recovery


@functools.cache
def levels():
    """One truth at two force levels."""
    return {
        name: simulated(TRUTH.replace(P_w=P_w), name, seed)
        for name, P_w, seed in (("low", 3.0, 1), ("high", 12.0, 2))
    }


LEVELS = {"low": jm.Isometric().replace(P_w=3.0), "high": jm.Isometric().replace(P_w=12.0)}


@functools.cache
def two_levels():
    with without_intervals():
        # as many as its check simulates: one program
        return jm.fit(LEVELS, levels(), starts=16, seeds=64)


@pytest.mark.slow
def test_two_force_levels_tell_what_one_does_not():
    joint = two_levels()
    assert joint.success, joint.message
    with without_intervals():
        alone = jm.fit_cohort([levels()["low"]], fix={"P_w": 3.0}, starts=16).results["low"].derived
        more = (
            jm.fit_cohort([levels()["high"]], fix={"P_w": 12.0}, starts=16).results["high"].derived
        )
    assert alone["K_z0"].stderr is None and more["K_z0"].stderr is None
    with jax.enable_x64(True):
        low, high = (true_derived(TRUTH.replace(P_w=P_w)) for P_w in (3.0, 12.0))
    names = (
        "corner_frequency",
        "harmonic_share",
        "band_8_12",
        "model_coefficient_of_variation",
    )
    truth = (
        {f"{n}@low": low[n] for n in names}
        | {f"{n}@high": high[n] for n in names}
        | {"K_z0": low["K_z0"]}
    )
    assert_near_the_truth(joint.derived, truth, list(truth))
    assert abs(joint.parameters["harmonic_frequency"].value - 5.0) < 0.1 * BIN
    assert set(joint.derived) >= {"K_w0", "model_mean@low", "model_mean@high"}
    assert "K_w0@low" not in joint.derived
    for name, part in joint.parts.items():
        assert part.chi2_per_bin < 1 + 4 * 0.31  # its standard deviation, see test_uncertainty
        assert float(part.task["P_w"]) == float(LEVELS[name]["P_w"])
        assert part.check["largest_deviation"] < 0.02
    assert joint.parameters["P_w@high"].value == 12.0 and not joint.parameters["P_w@high"].free


@pytest.mark.slow
def test_force_and_displacement_tell_every_stiffness_and_damping():
    load = 3.0
    held = TRUTH.as_task(jm.PrescribedForce, P_w=TRUTH.P_w, F_ext=load)
    targets = {
        "force": simulated(TRUTH, "force", 3),
        "displacement": simulated(held, "displacement", 4, variation=False),
    }
    tasks = {"force": jm.Isometric(), "displacement": jm.PrescribedForce(F_ext=load)}
    with without_intervals():
        joint = jm.fit(tasks, targets, starts=16, seeds=64)
        alone = jm.fit_cohort([targets["force"]], starts=16).results["force"].derived
    assert joint.success, joint.message
    determined = ("K_w0", "K_z0", "C_w0", "C_z0")
    assert all(alone[name].stderr is None for name in ("K_w0", "K_z0", "C_z0"))
    with jax.enable_x64(True):
        truth = dict(zip(determined, np.asarray(as_arrays(TRUTH).muscle.base()), strict=True))
        truth["model_mean@force"] = true_derived(TRUTH)["model_mean"]
        seen = true_derived(held)
    truth |= {
        f"{name}@displacement": seen[name]
        for name in ("corner_frequency", "harmonic_share", "band_8_12")
    }
    assert_near_the_truth(joint.derived, truth, list(truth))
    assert abs(joint.parameters["harmonic_frequency"].value - 5.0) < 0.1 * BIN
    assert joint.parameters["F_ext"].value == load  # only one task has it
    # little is known of it about a mean near zero
    variation = joint.derived["model_coefficient_of_variation@displacement"]
    assert variation.stderr is None or variation.stderr > 0.25 * variation.value


@functools.cache
def two_people():
    """Different harmonics, so that every target has minima of its own."""
    other = TRUTH.replace(harmonic_frequency=7.3, c_w=50.0, noise_K_w=0.1)
    return {"one": simulated(TRUTH, "one", 5), "other": simulated(other, "other", 6)}


def test_with_all_parameters_separate_it_is_the_single_fits():
    with without_intervals():
        joint = jm.fit(None, two_people(), separate=DEFAULT_FREE, starts=16, seeds=0)
        alone = jm.fit_cohort(two_people().values(), starts=16).results
    assert joint.success
    assert set(joint.free) == {f"{n}@{t}" for t in two_people() for n in DEFAULT_FREE}
    values = [s for result in alone.values() for s in result.singular_values]
    np.testing.assert_allclose(
        joint.singular_values, sorted(values, reverse=True), rtol=0.02, atol=0.05
    )
    for target, result in alone.items():
        assert joint.parts[target].chi2_per_bin == pytest.approx(result.chi2_per_bin, rel=0.01)
        for name, estimate in result.derived.items():
            found = joint.derived[f"{name}@{target}"]
            assert (found.stderr is None) is (estimate.stderr is None), name
            if estimate.stderr is not None:
                # Both stop within a thousandth of the cost of the minimum.
                assert abs(found.value - estimate.value) < 0.2 * estimate.stderr, name
                assert found.stderr == pytest.approx(estimate.stderr, rel=0.05), name


def test_a_second_equal_target_narrows_errors_by_the_root_of_two():
    """Of another level, which the tasks do not know of: that is noticed."""
    target, other = (
        expected(TRUTH, coefficient_of_variation=0.016, mvc_fraction=level) for level in (0.2, 0.4)
    )
    with without_intervals():
        alone = jm.fit_cohort([target], starts=8).results["expected"]
        joint = jm.fit(None, {"a": target, "b": other}, starts=8, seeds=0)
    assert any(
        "different levels (a 20 % MVC, b 40 % MVC), but their tasks have the same forces" in n
        for n in joint.notices
    )
    names = [
        n
        for n, p in alone.derived.items()
        if p.stderr is not None and n not in ("K_w0", "C_w0", "model_mean")
    ]
    assert len(names) >= 5
    for name in names:
        found = joint.derived.get(name) or joint.derived[f"{name}@a"]
        ratio = found.stderr / alone.derived[name].stderr
        # Where the prior holds a tenth of the variance it narrows less; what is just determined,
        # most of all.
        assert 0.99 < ratio * np.sqrt(2) < 1.12, name
    # The prior pulls half as much against two targets, so that both end at slightly different
    # points.
    np.testing.assert_allclose(
        joint.singular_values, np.sqrt(2) * alone.singular_values, rtol=0.06, atol=0.05
    )


# --- sharing

ISOMETRIC, FORCE = jm.Isometric(), jm.PrescribedForce()


@pytest.mark.parametrize(
    ("free", "separate", "names"),
    [
        (
            {"a": ["k_w", "c_w"], "b": ["k_w", "c_w"]},
            (),
            {"a": ["k_w", "c_w"], "b": ["k_w", "c_w"]},
        ),
        (
            {"a": ["k_w", "c_w"], "b": ["k_w", "c_w"]},
            ("c_w",),
            {"a": ["k_w", "c_w@a"], "b": ["k_w", "c_w@b"]},
        ),
        ({"a": ["P_w"], "b": ["P_w", "F_ext"]}, (), {"a": ["P_w@a"], "b": ["P_w@b", "F_ext"]}),
        ({"a": ["x_z"], "b": ["F_ext"]}, ("x_z",), {"a": ["x_z"], "b": ["F_ext"]}),
        ({"a": ["k_w"], "b": ["c_w"]}, (), {"a": ["k_w@a"], "b": ["c_w@b"]}),
    ],
    ids=["shared", "separate", "inputs", "of one task", "free in one"],
)
def test_names(free, separate, names):
    found = joint_names(free, {"a": ISOMETRIC, "b": FORCE}, separate)
    assert {t: list(of.values()) for t, of in found.items()} == names


def planned(targets, tasks=None, separate=(), proportional=(), **options: Any):
    tasks = {name: target.task() for name, target in targets.items()} if tasks is None else tasks
    return planned_jointly(tasks, targets, FitOptions(**options), separate, proportional)


def joint_problem(**options: Any):
    load = FORCE.replace(F_ext=1.0)
    targets = {"force": expected(ISOMETRIC), "shift": expected(load)}
    return planned(targets, {"force": ISOMETRIC, "shift": load}, **options).problem


def test_the_joint_problem_is_its_parts(x64):
    problem = joint_problem(separate=("c_w",), coefficient_of_variation=False)
    assert problem.coordinates.names == (
        "k_w",
        "k_z",
        "c_w@force",
        "c_z",
        "harmonic_amplitude",
        "harmonic_frequency",
        "noise_K_w",
        "noise_K_z",
        "c_w@shift",
    )
    objective = problem.linear()
    theta = 0.2 * np.random.default_rng(0).standard_normal((2, 9))
    seen = expand(objective, theta)
    columns = [list(range(8)), [0, 1, 8, 3, 4, 5, 6, 7]]
    for i, (part, own) in enumerate(zip(objective.parts, columns, strict=True)):
        alone = expand(
            Residuals((part,), part.coordinates, np.eye(8), np.ones(8), (tuple(range(8)),)),
            theta[:, own],
        )
        np.testing.assert_array_equal(seen.moments[i].power, alone.moments[0].power)
        np.testing.assert_array_equal(seen.slopes[i].power[..., own], alone.slopes[0].power)
        assert not np.any(np.delete(seen.slopes[i].power, own, axis=-1))
    here = seen.row(0)
    residuals = np.asarray(objective.residuals(jnp.asarray(theta[0]), here.moments, objective.data))
    parts = [data_residuals(m, p.data) for p, m in zip(objective.parts, here.moments, strict=True)]
    np.testing.assert_allclose(residuals, np.concatenate([*parts, theta[0]]))


def test_slopes_of_the_joint_moments_are_those_of_differences(x64):
    objective = joint_problem(separate=("harmonic_frequency",)).linear()
    theta, step = np.full((1, 9), 0.1), 1e-5
    seen = expand(objective, theta)
    for j in range(9):
        up, down = (
            expand(objective, theta + side * step * np.eye(9)[j]).moments for side in (1, -1)
        )
        for i in range(2):
            slope = (up[i].power - down[i].power)[0] / (2 * step)
            size = np.abs(slope).max() + 1e-6 * np.abs(seen.moments[i].power).max()
            np.testing.assert_allclose(seen.slopes[i].power[0, :, j], slope, atol=1e-5 * size)


def test_tasks_at_theta_have_the_shared_values(x64):
    problem = joint_problem(separate=("c_w",))
    theta = np.linspace(-0.4, 0.4, 9)
    force, shift = problem.tasks_at(theta)
    for name in ("k_w", "noise_K_z", "harmonic_frequency"):
        assert float(force[name]) == float(shift[name])
    assert float(force["c_w"]) == pytest.approx(60 * np.exp(theta[2]))
    assert float(shift["c_w"]) == pytest.approx(60 * np.exp(theta[8]))
    assert float(shift["F_ext"]) == 1.0
    np.testing.assert_allclose(problem.theta_of((force, shift)), theta, atol=1e-12)


def test_proportional_parameters_keep_the_ratio_of_their_tasks(x64):
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
    tasks = {f"{100 * level:g}": TRUTH.at_level(level) for level in (0.15, 0.6)}
    targets = {name: expected(task) for name, task in tasks.items()}
    problem = planned(targets, tasks, proportional=names).problem
    assert problem.coordinates.names == DEFAULT_FREE
    weak, strong = problem.tasks_at(np.linspace(-0.5, 0.5, 8))
    for name in names:
        ratio = float(tasks["60"][name]) / float(tasks["15"][name])
        assert float(strong[name]) / float(weak[name]) == pytest.approx(ratio), name


def test_starts_are_at_the_maxima_of_all_targets(x64):
    def peaked(f):
        return expected(
            ISOMETRIC.replace(harmonic_frequency=f, harmonic_amplitude=0.02), name=str(f)
        )

    for separate in ((), ("harmonic_frequency",)):
        problem = planned({"a": peaked(4.0), "b": peaked(8.0)}, separate=separate).problem
        c, starts = problem.coordinates, starting_points(problem, 32)
        for target, maximum in (("a", 4.0), ("b", 8.0)):
            name = f"harmonic_frequency@{target}" if separate else "harmonic_frequency"
            column = c.names.index(name)
            frequency = c.centre[column] * np.exp(
                c.sd[column] * np.asarray(c.theta(starts))[:, column]
            )
            assert np.min(np.abs(frequency - maximum)) < 0.5 * BIN
            assert len(np.unique(np.round(frequency, 6))) == 32
        np.testing.assert_array_equal(np.asarray(c.theta(starts))[0, :4], 0.0)
        apart = np.zeros((2, len(c.names)))
        apart[1, c.names.index(name)] = 1.0  # in one frequency, of whichever target, is enough
        assert distinct(problem, np.zeros(2), apart, BIN, 1.0) == [0, 1]
        assert distinct(problem, np.zeros(2), 0 * apart, BIN, 1.0) == [0]


def test_directions_of_single_targets_are_named():
    names = (
        "k_w",
        "noise_K_w@a",
        "noise_K_z@a",
        "harmonic_amplitude@a",
        "noise_K_w@b",
        "noise_K_z@b",
        "harmonic_amplitude@b",
    )
    flat = np.zeros((2, 7))
    flat[0, 1:4] = flat[1, 4:] = 1 / np.sqrt(3)
    found = identifiability(10 * (np.eye(7) - flat.T @ flat))
    scale = (
        "all amplitudes of noise and harmonic can be multiplied by one number, and the fit stays as"
        " good"
    )
    assert common_scales(names, found) == (f"{scale} (a)", f"{scale} (b)")


# --- results


@pytest.fixture(scope="module")
def quick():
    """Four parameters, one start of each, no simulation."""
    tasks = {"low": TRUTH.replace(P_w=4.0), "high": TRUTH.replace(P_w=8.0)}
    targets = {name: expected(task, name, mvc_fraction=0.2) for name, task in tasks.items()}
    free = ("c_w", "noise_K_z", "harmonic_amplitude", "harmonic_frequency", "k_w@high")
    return jm.fit(tasks, targets, free=free, separate=("harmonic_amplitude",), starts=2, seeds=0)


def test_a_result_holds_everything(quick):
    assert quick.success, quick.message
    assert quick.free == (
        "c_w",
        "noise_K_z",
        "harmonic_amplitude@low",
        "harmonic_frequency",
        "k_w@high",
        "harmonic_amplitude@high",
    )
    assert quick.parameters["P_w@low"].value == 4.0 and not quick.parameters["P_w@low"].free
    assert quick.parameters["k_w@low"].value == 3.5e5 and not quick.parameters["k_w@low"].free
    assert set(quick.tasks) == set(quick.targets) == {"low", "high"}
    for part in quick.parts.values():
        # The target is the expected spectrum: what is left is the bias of a log power where a line
        # holds part of a bin.
        np.testing.assert_allclose(part.fitted, part.target.proportional_power, rtol=0.05)
        assert part.fitted.sum() == pytest.approx(1.0) and part.chi2_per_bin < 0.05
    assert np.array(quick.correlation["matrix"]).shape == (6, 6)
    with jax.enable_x64(True):
        objective = planned(
            quick.targets, quick.tasks, ("harmonic_amplitude", "k_w"), free=("c_w",)
        ).problem.linear()
        tables, _ = quantities(objective, expand(objective, np.zeros((1, 1))))
        for values, target in zip(tables, quick.parts, strict=True):
            for name in ("corner_frequency", "model_mean", "band_8_12"):
                assert quick.derived[f"{name}@{target}"].value == pytest.approx(
                    float(values[name][0])
                )
    assert any(notice.startswith("fitted by the formula alone") for notice in quick.notices)


def test_a_result_in_words(quick):
    text, whole = str(quick), quick.details()
    in_order = (
        "low   spectrum of force (user), 30 bins, 24 segments",
        "high   spectrum of force (user), 30 bins, 24 segments",
        "\nMEASURED of low ",
        "\nMEASURED of high ",
        "\nMODEL  slow part + regular rhythm: fits, p = 1",
        "\nNOT KNOWN from these data: ",
        "\nCHECK  ",
    )
    places = [text.index(part) for part in in_order]
    assert places == sorted(places) and max(map(len, text.splitlines())) <= 80
    in_order = (
        "together: low, high",
        "  low: low, Isometric, BandLimitedNoise, chi2 per bin 0.0",
        "determined by the data",
        "corner_frequency@low",
        "not determined: do not interpret",
    )
    places = [whole.index(part) for part in in_order]
    assert places == sorted(places) and "harmonic_amplitude@high" in whole


def test_what_is_measured_of_each_target_has_its_name(quick):
    own = {n: target.measured for n, target in quick.targets.items()}
    names = {f"{name}@{target}" for target, found in own.items() for name in found}
    assert set(quick.measured) == names and "share_8_12@low" in names
    assert all(target.measures for target in quick.targets.values())  # kept, so in its file
    assert quick["share_8_12@high"] == own["high"]["share_8_12"]


def test_what_is_saved_is_read_back_equal(quick, tmp_path):
    path = tmp_path / "new" / "joint.json"
    quick.save(path)
    assert_equal(jm.load_result(path), quick)


def test_what_belongs_to_one_target_is_asked_of_its_part(quick):
    for name in ("task", "target", "fitted", "chi2_per_bin", "residual"):
        with pytest.raises(
            AttributeError,
            match=r"2 targets were fitted together: low, high.*result\.parts\['low'\]",
        ):
            getattr(quick, name)


def test_the_figure(quick):
    figure = quick.plot()
    try:
        titles = [ax.get_title(loc="left") for ax in figure.axes]
        assert titles == ["low", "", "high", ""]
    finally:
        plt.close(figure)


def test_a_fit_that_fails_is_a_result(tmp_path):
    """Noise on C does nothing at rest: no spectrum is finite."""
    still = dict.fromkeys(("noise_K_w", "noise_K_z", "harmonic_amplitude"), 0.0) | {
        "noise_C_w": 0.1
    }
    targets = {"a": expected(ISOMETRIC), "b": expected(ISOMETRIC.replace(P_w=9.0))}
    joint = jm.fit(None, targets, fix=still, free=("k_w",), starts=2)
    assert (
        not joint.success and "none of the starts gives a spectrum of every target" in joint.message
    )
    said = "MODEL  not fitted: none of the starts gives a spectrum of every target"
    assert any(line.startswith(said) for line in str(joint).splitlines())
    joint.save(tmp_path / "failed.json")
    assert_equal(jm.load_result(tmp_path / "failed.json"), joint)
    plt.close(joint.plot())


# --- errors

A, B = (jm.Target(name, 1 / np.arange(1.0, 31.0), segments=12) for name in "ab")
SHIFT = jm.Target("shift", 1 / np.arange(1.0, 31.0), segments=12, quantity="displacement")


@pytest.mark.parametrize(
    ("targets", "options", "message"),
    [
        ({}, {}, "target: none given: name at least one"),
        ({"a": A, "b@c": B}, {}, "a name must not be empty nor contain '@', as 'b@c' does"),
        ({"a": A, "b": "vastus-lateralis-27mvc"}, {}, "vastus-lateralis-26mvc"),
        ({"a": A, "b": B}, {"task": {"c": ISOMETRIC}}, "task: no target is called 'c'"),
        (
            {"a": A, "b": B},
            {"mean_force": {"c": (1.0, 0.1)}},
            "mean_force: no target is called 'c'",
        ),
        (
            {"a": A, "b": B},
            {"separate": ["k_q"]},
            "separate: unknown parameter 'k_q': did you mean",
        ),
        ({"a": A, "b": B}, {"proportional": ["F_ext"]}, "proportional: unknown parameter 'F_ext'"),
        (
            {"a": A, "b": B},
            {"separate": ["k_w"], "proportional": ["k_w"]},
            "k_w cannot be both separate and proportional",
        ),
        ({"a": A, "b": B}, {"free": ["F_ext"]}, "free: no task has a parameter 'F_ext'"),
        ({"a": A, "b": B}, {"free": ["k_w@c"]}, "free: 'k_w@c' names no target"),
        (
            {"a": A, "b": B},
            {"free": ["k_w@a"]},
            "free: none of these belongs to the task of target 'b'",
        ),
        (
            {"a": A, "b": SHIFT},
            {"free": ["k_w", "F_ext@a"]},
            "free: task 'a' has no parameter 'F_ext'",
        ),
        ({"a": A, "b": B}, {"fix": {"K_w": 1.0}}, "fix: no task has a parameter 'K_w'"),
        (
            {"a": A, "b": B},
            {"fix": {"k_w": 1e5}, "free": ["k_w"]},
            "k_w cannot be both free and fixed",
        ),
        (
            {"a": A, "b": B},
            {"task": {"b": ISOMETRIC.replace(k_w=4e5)}},
            (
                "k_w is 500000 in task 'a' and 400000 in 'b', yet they share it: make them equal,"
                " or list it in separate"
            ),
        ),
        (
            {"a": A, "b": B},
            {"fix": {"m_w@b": 0.7}},
            "m_w is 0.5 in task 'a' and 0.7 in 'b', yet they share it",
        ),
        (
            {"a": A, "b": B},
            {"task": {"b": jm.Isometric(noise=jm.OrnsteinUhlenbeckNoise())}},
            (
                "the noise of task 'a' and that of 'b' are BandLimitedNoise and"
                " OrnsteinUhlenbeckNoise, so noise_K_w cannot be"
            ),
        ),
        (
            {"a": A, "b": SHIFT},
            {"task": {"b": ISOMETRIC}},
            "target 'b' is a displacement, but its task Isometric gives F_ext in N",
        ),
        (
            {"a": A, "b": B},
            {"bounds": {"m_w": (0.1, 1.0)}},
            "bounds: unknown or not free parameter 'm_w'",
        ),
        (
            {"a": A, "b": B},
            {"priors": {"k_w@a": 0.1}},
            "priors: unknown or not free parameter 'k_w@a'",
        ),
        ({"a": A, "b": B}, {"starts": 0}, "starts = 0: give a whole number from 1"),
    ],
)
def test_bad_arguments(targets, options, message):
    with pytest.raises(ValueError, match=message):
        jm.fit(options.pop("task", None), targets, **options)


@pytest.mark.parametrize(
    ("task", "message"),
    [
        (ISOMETRIC, "task: one Isometric, but several targets.*fit_cohort"),
        ([ISOMETRIC] * 2, "task: one list, but several"),
    ],
)
def test_one_task_for_several_targets(task, message):
    with pytest.raises(ValueError, match=message):
        jm.fit(task, {"a": A, "b": B})
    with pytest.raises(ValueError, match="task: this is of type dict; give a task first"):
        jm.fit({"a": ISOMETRIC}, A)
    for targets, option in ((A, "separate"), ({"a": A}, "method")):
        with pytest.raises(TypeError, match=f"has no option '{option}'"):
            jm.fit(ISOMETRIC, targets, **{option: ()})


def test_priors_and_bounds_by_joint_or_plain_name(x64):
    plan = planned(
        {"a": A, "b": B},
        separate=("c_w",),
        priors={"c_w": 0.5, "c_w@b": 0.25, "k_w": None},
        bounds={"c_w@a": (10.0, 200.0)},
    )
    c = plan.problem.coordinates
    sd = dict(zip(c.names, c.sd, strict=True))
    assert (sd["c_w@a"], sd["c_w@b"]) == (0.5, 0.25)
    assert (
        plan.problem.prior[c.names.index("k_w")] == 0 and plan.settings["prior_sd"]["k_w"] is None
    )
    assert np.isfinite(c.low[c.names.index("c_w@a")]) and not np.isfinite(
        c.low[c.names.index("c_w@b")]
    )


@pytest.mark.slow
def test_two_targets_climb_together_and_their_aic_is_that_of_both(x64):
    """Two spectra of one person with a tremor: the base model fails, one with a tremor describes
    both."""
    rng, truth = (
        np.random.default_rng(4),
        jm.model.on_rung(jm.Isometric(), 2).replace(resonance_amplitude=0.3),
    )
    power = np.asarray(jm.expected_spectrum(truth).proportional)
    pair = {
        name: jm.Target(name, power * rng.gamma(60, 1 / 60, power.size), segments=60)
        for name in ("first", "second")
    }
    with without_intervals():
        found = jm.fit(None, pair, rungs=2, starts=8, seeds=0, check_seeds=0)
    numbers = [rung.number for rung in found.ladder]
    assert numbers == [2] and found.adequate  # a tremor is seen
    (rung,) = found.ladder
    height = sum(
        float(jm.objective.log_likelihood(part.task, part.target)) for part in found.parts.values()
    )
    assert rung.aic == pytest.approx(2 * rung.parameters - 2 * height, abs=0.05)
    assert abs(found["resonance_frequency"].value - float(truth["resonance_frequency"])) < 1.0
    assert "the spectrum shows a tremor" in " ".join(found.details().split())
    with pytest.raises(ValueError, match="rungs = 2: give at most 3, and no tasks"):
        jm.fit({name: jm.Isometric() for name in pair}, pair, rungs=2)


def test_tasks_of_another_mean_force_are_noticed():
    """With tasks the mean is no datum: their newtons are those of another muscle."""
    stated = expected(TRUTH, mean=[60.0, 61.0], unit="N", segments=[12, 12])
    pair = {"a": stated, "b": stated}
    found = jm.fit(
        dict.fromkeys(pair, TRUTH),
        pair,
        starts=4,
        seeds=0,
        check_seeds=0,
        free=("c_w", "noise_K_w"),
    )
    said = [notice for notice in found.notices if "scale them (task.at_force)" in notice]
    assert len(said) == 2 and "the recording with 60.5 N" in said[0]
