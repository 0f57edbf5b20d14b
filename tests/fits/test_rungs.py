"""The ladder: the model that the peaks ask for, and richer ones until one describes the data."""

import functools

import numpy as np
import pytest
from golden import QUICK, TASK, TREMOR, drawn, expected, tremor_fit, with_tremor
from refits import without_intervals
from scipy.optimize import brentq

import jaxmuscle as jm
from jaxmuscle.fits._checks import mass_notices, twitch_notices
from jaxmuscle.fits._model_choice import (
    _fewer,
    criterion,
    find_slower_peak,
    find_tremor,
    find_unseen,
    first_rung,
)
from jaxmuscle.fits._reopened import reopened
from jaxmuscle.fits._result import Estimate
from jaxmuscle.fits._verdict import Endpoint
from jaxmuscle.model._rungs import QUIET, RUNGS
from jaxmuscle.objective._arguments import DAMPING_SD, planned
from jaxmuscle.objective._consequences import expand
from jaxmuscle.objective._coordinates import Coordinates
from jaxmuscle.objective._derived import derived_names
from jaxmuscle.objective._options import FitOptions
from jaxmuscle.response._expected_moments import expected_moments
from jaxmuscle.response._linearised import linearised
from jaxmuscle.spectra._settings import WINDOW


@functools.cache
def climbed_and_told() -> tuple[jm.fits.FitResult, list[tuple[str, float]]]:
    """Of a muscle with a slow twitch and no tremor, over many segments."""
    task = jm.model.on_rung(TASK, 1).replace(activation_time=0.15, harmonic_amplitude=1e-4)
    told: list[tuple[str, float]] = []
    result = jm.fit(
        TASK,
        drawn(expected(task), 900, 1),
        progress=lambda *said: told.append(said),
        **QUICK,
    )
    return result, told


# --- the models


def test_every_rung_adds_its_part():
    assert jm.model.on_rung(TASK, 0) is TASK
    first, second, third = (jm.model.on_rung(TASK, rung) for rung in (1, 2, 3))
    added = [
        set(b.parameter_names) - set(a.parameter_names)
        for a, b in ((TASK, first), (first, second), (second, third))
    ]
    assert added[0] == {"activation_time"}
    assert added[1] == {f"resonance_{what}" for what in ("amplitude", "frequency", "width")}
    assert added[2] == {f"resonance_2_{what}" for what in ("amplitude", "frequency", "width")}
    assert (
        first["harmonic_amplitude"] > 0
        and second["harmonic_amplitude"] == third["harmonic_amplitude"] == 0
    )


@pytest.mark.parametrize("rung", [-1, len(RUNGS)])
def test_other_rungs_are_refused(rung):
    with pytest.raises(ValueError, match="must be one of 0 to 3"):
        jm.model.on_rung(TASK, rung)


def test_a_task_that_stands_on_a_rung_is_not_lifted_again():
    with pytest.raises(ValueError, match="already"):
        jm.model.on_rung(jm.model.on_rung(TASK, 1), 2)
    with pytest.raises(ValueError, match="has no activation or resonance yet"):
        jm.fit(jm.model.on_rung(TASK, 1), drawn(expected(TASK), 12, 1), rungs=2)
    with pytest.raises(ValueError, match="the highest is 3"):
        jm.fit(TASK, drawn(expected(TASK), 12, 1), rungs=4)
    with pytest.raises(ValueError, match="states segments or sigma"):
        jm.fit(TASK, jm.Target("no spread", expected(TASK)), rungs=1)


def test_frequency_and_width_of_what_has_no_amplitude_are_not_free(x64):
    plan = planned(jm.model.on_rung(TASK, 2), drawn(expected(TASK), 12, 1), FitOptions())
    assert not {"harmonic_amplitude", "harmonic_frequency"} & set(plan.problem.coordinates.names)


# --- the damping ratio has a prior


def damping_ratio(task: jm.Isometric) -> float:
    """ζ of s² + 2 ζ ω s + ω², the characteristic polynomial of the linearised muscle."""
    A = np.asarray(linearised(task).system.A)
    return float(-np.trace(A) / (2 * np.sqrt(np.linalg.det(A))))


def test_the_row_of_the_damping_ratio_is_its_slope(x64):
    """At next to no force, where tangents are the values at rest, against the eigenvalues."""
    task = jm.model.on_rung(TASK, 2).replace(P_w=1e-6)
    problem = planned(task, drawn(expected(TASK), 12, 1), FitOptions()).problem
    (row,), c = problem.damping, problem.coordinates
    for i, name in enumerate(c.names):
        step = 1e-4
        moved = task.replace(**{name: float(task[name]) * np.exp(step * c.sd[i])})
        slope = np.log(damping_ratio(moved) / damping_ratio(task)) / step / DAMPING_SD
        assert row[i] == pytest.approx(slope, abs=2e-3), name
    assert np.count_nonzero(row) == 4


def test_a_muscle_without_activation_and_a_moved_one_have_no_such_prior(x64):
    target = drawn(expected(TASK), 12, 1)
    assert planned(TASK, target, FitOptions()).problem.damping == ()
    task = jm.model.on_rung(TASK, 1)
    assert planned(task, target, FitOptions(), moved=True).problem.damping == ()
    plan = planned(task, target, FitOptions(priors={"damping_ratio": None}))
    assert plan.problem.damping == () and plan.settings["damping_ratio_sd"] is None
    own = planned(task, target, FitOptions(priors={"damping_ratio": 0.25})).problem
    usual = planned(task, target, FitOptions()).problem
    np.testing.assert_allclose(own.damping[0], 2 * usual.damping[0])


def test_the_prior_of_a_fit_is_that_of_all_that_follows(x64):
    problem = reopened(tremor_fit())
    (row,) = problem.damping
    theta = problem.theta_of((tremor_fit().task,))
    residuals = problem.prior_root @ theta
    assert np.sum(residuals**2) == pytest.approx(np.sum(theta**2) + (row @ theta) ** 2)
    assert reopened(tremor_fit(), priors={"damping_ratio": None}).damping == ()


def test_targets_that_share_a_muscle_have_one_prior_of_its_damping(x64):
    from jaxmuscle.fits._joint import planned_jointly

    task, target = jm.model.on_rung(TASK, 2), drawn(expected(TASK), 12, 1)
    tasks, targets = {"a": task, "b": task}, {"a": target, "b": target}
    shared = planned_jointly(tasks, targets, FitOptions()).problem
    apart = planned_jointly(tasks, targets, FitOptions(), separate=("c_w",)).problem
    assert len(shared.damping) == 1 and len(apart.damping) == 2


# --- what the peaks ask for


def test_a_tremor_asks_for_a_resonance_and_with_a_slower_peak_for_two():
    f, plain = TASK.settings.frequency, expected(TASK.replace(harmonic_amplitude=0.0))

    def peaked(*at: float) -> jm.Target:
        bells = [3 * np.exp(-(((f - each) / 0.7) ** 2)) for each in at]
        return drawn(plain * (1 + sum(bells)), 60, 2)

    tremor, slower, neither = peaked(9.0), peaked(3.5), drawn(plain, 60, 2)
    assert abs((find_tremor(tremor) or 0) - 9.0) < 0.5
    assert abs((find_slower_peak(slower) or 0) - 3.5) < 0.5
    assert find_tremor(neither) is find_tremor(slower) is find_slower_peak(neither) is None
    assert first_rung([neither, tremor], 0, 3) == first_rung([tremor], QUIET, 3) == 2
    assert first_rung([slower], QUIET, 3) == first_rung([neither], QUIET, 3) == QUIET
    assert first_rung([tremor], 0, 1) == 1  # no more were allowed
    assert first_rung([slower, tremor], 0, 3) == 2 and first_rung([peaked(3.5, 9.0)], 0, 3) == 3
    # of what cannot be tested nothing is asked
    unknown = jm.Target("unknown", tremor.proportional_power, sigma=0.1 * tremor.proportional_power)
    assert find_tremor(unknown) is find_slower_peak(unknown) is None


def test_a_resonance_is_stated_for_a_peak_alone(x64):
    f, plain = TASK.settings.frequency, expected(TASK.replace(harmonic_amplitude=0.0))
    seen = drawn(plain * (1 + 3 * np.exp(-(((f - 9.0) / 0.7) ** 2))), 60, 2)
    unseen = drawn(plain, 60, 2)

    def left_out(target: jm.Target, **values: float) -> set[str]:
        task = jm.model.on_rung(TASK, 3)
        problem = planned(task, target, FitOptions()).problem
        table = {"corner_frequency": 1.0, "resonance_width": 2.0, "resonance_2_width": 2.0}
        table |= {"resonance_frequency": 9.0, "resonance_2_frequency": 3.0, "K_w0": 1.0} | values
        without, said = find_unseen(problem, {n: Estimate(v, "", 0.1) for n, v in table.items()})
        assert bool(without) == bool(said)
        return without

    slower = {"resonance_2_frequency", "resonance_2_width"}
    faster = {"resonance_frequency", "resonance_width"}
    assert left_out(seen) == slower
    assert left_out(unseen) == slower | faster
    assert left_out(seen, resonance_frequency=13.0) == slower | faster
    assert left_out(seen, corner_frequency=8.6) == slower | {"corner_frequency"}


# --- the climb


def test_the_base_model_is_kept_where_it_describes_the_data():
    result = jm.fit(TASK, drawn(expected(TASK), 30, 4), **QUICK)
    (only,) = result.ladder
    assert only.number == 0 and only.chosen and result.adequate
    assert result.task.activation is None
    same = jm.fit(TASK, drawn(expected(TASK), 30, 4), rungs=0, **QUICK)
    assert same.ladder == () and same.parameters == result.parameters


@pytest.mark.parametrize(("asked", "found"), [(8, 8), (50, 32), (100, 32), (300, 96)])
def test_more_starts_count_for_every_model(asked, found):
    """A third of those of the first model, since the best one so far is among them; but 32 where
    there are as many."""
    assert _fewer(asked) == found


def test_a_tremor_that_is_seen_is_fitted_from_the_first():
    result = tremor_fit()
    (only,) = result.ladder
    assert only.number == 2 and only.chosen and result.adequate
    found = result.derived["resonance_frequency"]
    assert found.stderr is not None and abs(found.value - 9.0) < 3 * found.stderr < 1.5
    assert "the spectrum shows a tremor" in " ".join(result.details().split())


def test_a_richer_model_is_tried_where_the_first_does_not_describe_the_data():
    result, _ = climbed_and_told()
    assert [rung.number for rung in result.ladder] == [0, 1] and result.ladder[0].p < 0.01
    chosen = next(rung for rung in result.ladder if rung.chosen)
    assert chosen.number == 1 and result.adequate
    assert chosen.aic == min(rung.aic for rung in result.ladder)
    text = result.details()
    assert "models tried" in text and "-> 1 slow part + twitch + regular rhythm" in text
    assert "for the description alone" in " ".join(text.split())
    kinds = {start.kind for start in result.starts}
    assert kinds == {"other model", "peak", "spread"}


def test_the_progress_says_which_model_it_is_at_and_never_falls_back():
    _, told = climbed_and_told()
    shares = [share for _, share in told]
    assert shares == sorted(shares) and shares[-1] == 1
    models = [text.partition(":")[0] for text, _ in told if text.startswith("model ")]
    assert list(dict.fromkeys(models)) == [f"model {k} (of models 0 to 3)" for k in (0, 1)]
    assert "model 1 (of models 0 to 3): slow part + twitch + regular rhythm" in dict(told)
    # the descents' share of a fit
    assert max(share for text, share in told if text.startswith("model 1")) <= 2 / 4 * 0.6


def test_a_chosen_model_or_noise_is_not_climbed_from():
    target = drawn(expected(with_tremor()), 90, 1)
    for asked in (
        {"noise": "band-limited"},
        {"free": ("c_w", "noise_K_w", "noise_K_z")},
        {"rungs": 0},
    ):
        with without_intervals():
            assert jm.fit(TASK, target, **asked, **QUICK | {"starts": 2}).ladder == ()


def test_the_criterion_is_akaikes(x64):
    """-2 ln L with scipy's gamma laws joined by their normal scores, and the trace of the hat
    matrix by differences."""
    target = drawn(expected(TASK), 12, 5)
    problem = planned(TASK, target, FitOptions(free=("c_w", "noise_K_z"))).problem
    objective = problem.linear()
    theta = np.array([0.1, -0.2])
    aic, parameters = criterion(Endpoint(problem, objective, expand(objective, theta[None]).row(0)))
    assert 0 < parameters < 2
    from jaxmuscle.objective._likelihood import log_likelihood

    height = float(log_likelihood(problem.tasks_at(theta)[0], target))
    assert aic == pytest.approx(2 * parameters - 2 * height, abs=1e-6)


def test_an_active_mass_far_from_its_prior_is_told():
    names, one = ("k_w", "m_w"), np.ones(2)
    coordinates = Coordinates.of({"k_w": 5e5, "m_w": 0.5}, {}, {"k_w": 1.0, "m_w": 0.5})
    assert coordinates.names == names
    (said,) = mass_notices(coordinates, np.array([9.0, 5.0]))
    # 0.5 exp(5/2)
    assert said.startswith("m_w went to 6.1 kg, 5 standard deviations of its prior from the 0.5 kg")
    assert mass_notices(coordinates, 2.1 * one) and mass_notices(coordinates, 1.9 * one) == ()


# --- is the twitch one of human muscle?


@pytest.mark.parametrize(
    ("interval", "words"),
    [
        (
            (0.15, 0.31),
            "(0.150 to 0.310 s) is longer than in human muscle, 0.05 to 0.11 s. It also stands for",
        ),
        ((0.111, None), "(above 0.111 s) is longer"),
        (
            (0.01, 0.049),
            "(0.0100 to 0.0490 s) is shorter than in human muscle, 0.05 to 0.11 s. The relaxation",
        ),
        ((None, 0.03), "(below 0.030 s) is shorter"),
        ((0.09, 0.31), ""),
        ((0.01, 0.06), ""),
        ((None, 0.31), ""),
        (None, ""),
    ],
)
def test_a_contraction_time_that_no_human_twitch_has_is_told(interval, words):
    whole = Estimate(0.6, "Hz", 0.1, interval=(0.4, 0.8))
    told = twitch_notices(
        {
            "contraction_time": Estimate(0.2, "s", 0.03, interval=interval),
            "half_power_frequency": whole,
        }
    )
    assert len(told) == bool(words)
    assert all(words in one and one.startswith("contraction_time (") for one in told)
    assert all("What to do: report half_power_frequency" in one for one in told)


def test_no_remedy_names_what_the_fit_does_not_have():
    slow = Estimate(0.2, "s", 0.03, interval=(0.15, 0.31))
    (told,) = twitch_notices(
        {
            "contraction_time@a": slow,
            "contraction_time@b": Estimate(0.2, "s", interval=(0.15, 0.31)),
        }
    )
    assert told.startswith("contraction_time@a ") and "half_power_frequency" not in told
    assert "What to do: hold activation_time" in told


def test_a_slow_twitch_is_told_by_the_fit():
    """A twitch of 0.25 s and ten times as many segments as above, so that the interval excludes
    that of human muscle."""
    task = jm.model.on_rung(TASK, 2).replace(activation_time=0.25, noise_K_z=5e-4, **TREMOR)
    result = jm.fit(task, drawn(expected(task), 900, 1), **QUICK)
    low, _ = result.derived["contraction_time"].interval or (None, None)
    assert low is not None and low > 0.11
    assert any(notice.startswith("contraction_time (") for notice in result.unstated)


# --- what it gives


def test_components_add_up_and_are_what_their_noise_alone_gives(x64):
    result = tremor_fit()
    parts = result.only.components
    assert set(parts) == {"relaxation", "floor", "harmonic", "resonance"}
    np.testing.assert_allclose(sum(parts.values()), 1.0, rtol=1e-9)
    task = result.task
    alone = task.replace(
        **{
            n: 0.0
            for n in task.parameter_names
            if n.startswith("noise_") and n[6:8] in ("K_", "C_")
        }
    )
    whole, own = (
        np.asarray(expected_moments(t, result.target.settings, WINDOW)[0].power)
        for t in (task, alone)
    )
    np.testing.assert_allclose(parts["resonance"], own / whole, rtol=1e-9)


def test_half_power_frequency_against_a_root_of_the_transfer_function(x64):
    result = tremor_fit()
    task = result.task
    k, c = task.muscle.base()[:2], task.muscle.base()[2:]
    # About x_w at rest: K_w x_w³ and so on, the tangent of the quadratic laws.
    A = np.asarray(linearised(task).system.A)
    T = float(task["activation_time"])

    def level(f: float) -> float:
        s = 2j * np.pi * f
        slow = 1 / np.linalg.det(s * np.eye(2) - A)
        ahead = float(k[1]) + s * float(c[1])  # F_ext = K_z x_w + C_z x_w', at small x_w about
        return abs(slow * ahead / (1 + s * T) ** 2) ** 2

    found = brentq(lambda f: level(f) / level(1e-9) - 0.5, 1e-3, 20.0)
    assert result.derived["half_power_frequency"].value == pytest.approx(found, rel=0.05)


def test_a_band_that_is_hardly_covered_is_left_out():
    """Bins 0.39 Hz wide up to 8.2 Hz hold a tenth of 8 to 12 Hz, up to 10.2 Hz more than half."""
    short, longer = (jm.Isometric(settings=jm.SpectrumSettings(last_bin=last)) for last in (21, 26))
    assert "band_8_12" not in derived_names(short) and "band_4_8" in derived_names(short)
    assert "band_8_12" in derived_names(longer)


def test_bands_are_integrals_over_bins():
    """A bin's power is spread evenly over its width: up to a frequency there is the linearly
    interpolated sum."""
    result = tremor_fit()
    f, p = result.frequency_hz, result.fitted
    edges = np.append(f - 0.5 * f[0], f[-1] + 0.5 * f[0])
    total = np.append(0.0, np.cumsum(p))
    for low, high in ((0, 0.5), (0.5, 1), (1, 2), (8, 12)):
        share = np.diff(np.interp([low, high], edges, total))[0]
        assert result.derived[f"band_{low:g}_{high:g}"].value == pytest.approx(share, rel=1e-3)
    said = " ".join(result.details().partition("not determined")[0].split())
    # The first band holds the first bin (0.39 Hz, 0.39 Hz wide) up to 0.5 Hz: 0.78 of it.
    measured = (0.5 / result.target.settings.resolution - 0.5) * result.target.proportional_power[0]
    assert (
        "power by band, fitted (measured): 0-0.5 Hz"
        f" {100 * result.derived['band_0_0.5'].value:.2g} %" in said
    )
    assert f"% ({100 * measured:.2g} %), 0.5-1 Hz" in said and "band_" not in said


def test_all_that_follows_a_fit_takes_a_model_with_tremor(tmp_path):
    result = tremor_fit()
    result.save(tmp_path / "fit.json")
    assert str(jm.load_result(tmp_path / "fit.json")) == str(result)
    assert jm.load_preset(tmp_path / "fit.json")["resonance_frequency"] == pytest.approx(
        result.task["resonance_frequency"]
    )
    profiled = jm.profile(result, "resonance_frequency")
    assert str(profiled)
    assert jm.checks.goodness(result, replicates=19).p_value > 0
    # Those that need no program of another task: at other forces, and for longer.
    same = [
        design
        for design in jm.uncertainty.standard_designs(result)
        if design.task is None or type(design.task) is jm.Isometric
    ]
    assert len(same) >= 3
    names = jm.identifiability(
        result, designs=[design for design in same if design.lengthening is None]
    ).names
    assert "resonance_frequency" in names and "tremor_frequency" not in names
    with without_intervals():
        cohort = jm.fit_cohort([result.target], starts=8, rung=2)
    (found,) = cohort.results.values()
    assert found.derived["resonance_frequency"].value == pytest.approx(
        result.derived["resonance_frequency"].value, abs=0.2
    )
