"""Presets that state a mean force: the task is carried to it, its ratios stay, and what cannot be
carried is refused."""

import json

import equinox as eqx
import numpy as np
import pytest
import tomli_w
from test_result import assert_equal, made_result
from test_scaling import moments

import jaxmuscle as jm
from jaxmuscle._common.errors import PresetError
from jaxmuscle.fits._result import FORMAT
from jaxmuscle.model._task_tables import task_to_table
from jaxmuscle.objective._arguments import at_mean, planned
from jaxmuscle.objective._options import FitOptions

BUNDLED = "zagrodny-slifkin"
TASKS = {
    "isometric": jm.Isometric(P_w=3.0),
    "bundled": jm.load_preset(BUNDLED),
    "displacement": jm.PrescribedForce(F_ext=jm.model.Constant(1.0)),
    "no force": jm.Isometric(P_w=0.0),
    "Hill": eqx.tree_at(
        lambda t: t.muscle.stiffness_w, jm.Isometric(), jm.model.QuadraticDamping(c=1e5, v_ref=0.02)
    ),
}


def written(folder, task="isometric", **stated):
    path = folder / "anna.toml"
    path.write_text(tomli_w.dumps(stated | {"task_table": task_to_table(TASKS[task])}))
    return path


@pytest.mark.parametrize("task", ["isometric", "bundled"])
@pytest.mark.parametrize(
    ("mean", "unit", "newtons"), [(40.5, "N", 40.5), (405, "mN", 0.405), (0.0405, "kN", 40.5)]
)
def test_the_task_has_the_mean_force_that_its_file_states(task, mean, unit, newtons, tmp_path, x64):
    loaded, before = jm.load_preset(written(tmp_path, task, mean=mean, unit=unit)), TASKS[task]
    was, found = moments(before), moments(loaded)
    assert float(found.mean) == pytest.approx(newtons, rel=1e-9)
    np.testing.assert_allclose(found.proportional, was.proportional, rtol=1e-8)
    factor = newtons / float(was.mean)
    for name in ("m_w", "m_z", "k_w", "k_z", "c_w", "c_z", "P_w"):
        if name in loaded.parameter_names:
            assert float(loaded[name] / before[name]) == pytest.approx(factor, rel=1e-9), name
    for name in ("x_ref_w", "v_ref_z", "noise_K_w", "harmonic_frequency"):
        assert float(loaded[name]) == float(before[name]), name


def test_single_precision_reaches_it_as_well(tmp_path):
    loaded = jm.load_preset(written(tmp_path, mean=40.5, unit="N"))
    with_digits = TASKS["isometric"].at_force(40.5)
    assert loaded == with_digits and isinstance(loaded["k_w"], float)


def test_a_fit_from_it_has_its_priors_in_ratio(tmp_path, x64):
    """The person's own target has nothing more to carry, and P_w is free about what the file
    says."""
    loaded = jm.load_preset(written(tmp_path, mean=40.5, unit="N"))
    target = jm.Target("anna", 1 / (1 + np.arange(1, 31) ** 2), mean=40.5, unit="N")
    task, options = at_mean(loaded, target, FitOptions())
    assert options.carried == pytest.approx(1.0, rel=1e-9)
    centre, usual = (
        dict(zip(plan.names, plan.centre, strict=True))
        for plan in (
            planned(task, target, options).problem.coordinates,
            planned(
                *at_mean(TASKS["isometric"], target, FitOptions())[:1], target, options
            ).problem.coordinates,
        )
    )
    factor = 40.5 / float(moments(TASKS["isometric"]).mean)
    assert centre["P_w"] == pytest.approx(3.0 * factor, rel=1e-9)
    assert centre == pytest.approx(usual, rel=1e-9)


def test_what_was_carried_is_saved_as_it_is_and_carried_no_second_time(tmp_path):
    loaded = jm.load_preset(written(tmp_path, mean=40.5, unit="N"))
    loaded.save(tmp_path / "again.toml")
    assert "mean" not in (tmp_path / "again.toml").read_text()
    assert_equal(jm.load_preset(tmp_path / "again.toml"), loaded)


def test_a_fit_json_holds_the_fitted_newtons(tmp_path):
    """The mean of its target was a datum of the fit, and says nothing about the task table."""
    path, result = tmp_path / "fit.json", made_result()
    result.save(path)
    table = json.loads(path.read_text())
    table["target_table"] |= {"mean": [99.0], "unit": "N"}
    path.write_text(json.dumps(table))
    assert jm.load_result(path).only.target.mean_force[0] == 99.0
    assert_equal(jm.load_preset(path), result.task)
    path.write_text(json.dumps(table | {"format": FORMAT - 1}))
    with pytest.raises(PresetError, match=f"format = {FORMAT - 1}: is not a fit.json of format"):
        jm.load_preset(path)


WRONG = {
    "no unit": (
        {"mean": 40.5},
        'unit is missing: give both, as in mean = 40.5 and unit = "N", or neither',
    ),
    "no mean": ({"unit": "N"}, "mean is missing: give both"),
    "% MVC": (
        {"mean": 30, "unit": "% MVC"},
        "unit = '% MVC': the parameters of a task are in newtons; .*mN, kN, .*leave",
    ),
    "a.u.": ({"mean": 1.5, "unit": "a.u."}, "unit = 'a.u.'"),
    "torque": ({"mean": 1.5, "unit": "N m"}, "unit = 'N m'"),
    "list of units": ({"mean": 1.5, "unit": ["N"]}, r"unit = \['N'\]"),
    "zero": (
        {"mean": 0, "unit": "N"},
        "mean = 0 N: the mean force of this task is .* of the same sign",
    ),
    "sign": (
        {"mean": -40.5, "unit": "mN"},
        "mean = -40.5 mN: .* N: give a mean of the same sign, not -0.0405 N",
    ),
    "text": (
        {"mean": "40.5", "unit": "N"},
        "mean = '40.5': give the mean force in N as one number",
    ),
    "true": ({"mean": True, "unit": "N"}, "mean = True: give"),
    "not finite": ({"mean": float("inf"), "unit": "N"}, "mean = inf is not finite"),
    "trials": ({"mean": [40.1, 40.9], "unit": "N"}, r"mean = \[40.1, 40.9\]: give .* one number"),
    "displacement": (
        {"mean": 3, "unit": "N", "task": "displacement"},
        "mean = 3 N: the output of Prescribed.* is x_z in m",
    ),
    "no force": (
        {"mean": 3.0, "unit": "N", "task": "no force"},
        "mean = 3.0 N: the mean force of this task is zero",
    ),
    "Hill": (
        {"mean": 3.0, "unit": "N", "task": "Hill"},
        "mean = 3.0 N: .*not made of the paper's quadratic laws",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_cannot_be_carried_is_refused(case, tmp_path):
    stated, message = WRONG[case]
    with pytest.raises(PresetError, match=rf"anna\.toml: {message}"):
        jm.load_preset(written(tmp_path, **stated))
