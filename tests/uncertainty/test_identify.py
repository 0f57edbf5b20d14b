"""Identifiability reports: Fisher information against differences, draws and fits; designs keep
what they promise."""

import dataclasses
import functools
import json
from typing import Any

import equinox as eqx
import jax
import matplotlib.pyplot as plt
import msgspec
import numpy as np
import pytest
import scipy.linalg
import scipy.stats
from scipy.special import gammaincinv, ndtr
from test_result import made_result

import jaxmuscle as jm
from jaxmuscle._common.arrays import as_arrays
from jaxmuscle.fits._joint import planned_jointly
from jaxmuscle.fits._reopened import reopened
from jaxmuscle.model._parameters import DEFAULT_FREE, PARAMETERS
from jaxmuscle.objective._consequences import Expansion, expand, quantities
from jaxmuscle.objective._least_squares import least_squares
from jaxmuscle.objective._likelihood import Likelihood, without_offsets
from jaxmuscle.objective._options import FitOptions
from jaxmuscle.objective._problem import target_variation
from jaxmuscle.objective._scoring import maximise
from jaxmuscle.response._equilibrium import equilibrium
from jaxmuscle.response._expected_moments import expected_moments
from jaxmuscle.spectra._bin_law import samples_of, welch_law
from jaxmuscle.spectra._settings import WINDOW
from jaxmuscle.uncertainty import _identifiability
from jaxmuscle.uncertainty._design_information import (
    design_information,
    expansion_at,
    information_of,
    without_scalars,
)

TRUTH = jm.Isometric().replace(harmonic_amplitude=0.012, harmonic_frequency=5.0)
LOADED = TRUTH.as_task(jm.PrescribedForce, P_w=0.0)
SEGMENTS = 24
LEVELS = ("a second force level 2 times as high", "a second force level 0.5 times as high")
MOVED = [
    "60 s with the insertion moved by 0.1 mm rms to 10 Hz",
    "60 s with the insertion moved by 1 mm rms to 5 Hz",
]
BASES = ("K_w0", "K_z0", "C_w0", "C_z0")
AMPLITUDES = ("noise_K_w", "noise_K_z", "harmonic_amplitude")
# Central differences with this step of a logarithm: truncation and rounding leave five digits of a
# slope.
STEP, DIGITS = 2e-5, 1e-5
DOUBTFUL = 1e-3  # chance of a test to fail by scatter alone, over all it compares


def fitted(
    task=TRUTH, free=DEFAULT_FREE, settings: dict[str, Any] | None = None, **target: Any
) -> jm.fits.FitResult:
    """What a fit would give that found `task`, its target being the expected spectrum; nothing is
    fitted."""
    power = spectrum_of(task)
    quantity = "displacement" if task.output_unit == "m" else "force"
    made = jm.Target(
        "made",
        power,
        quantity=quantity,
        **({"segments": SEGMENTS, "settings": task.settings} | target),
    )
    table = {
        "free": list(free),
        "mean_force": None,
        "bounds": {},
        "starts": 1,
        "dt": 1e-3,
        "prior_centre": {n: float(task[n]) for n in free},
        "prior_sd": {n: PARAMETERS[n].prior_sd for n in free},
        "coefficient_of_variation": made.coefficient_of_variation is not None,
    }
    return made_result(
        task=task, target=made, fitted=power, settings=table | (settings or {}), notices=()
    )


def in_a_line(text):
    """What is printed, whatever its lines."""
    return " ".join(str(text).split())


def spectrum_of(task):
    return np.asarray(jm.expected_spectrum(task).proportional)


def moments_of(task):
    with jax.enable_x64(True):
        found = expected_moments(
            as_arrays(task), task.settings, WINDOW, samples_of(SEGMENTS, task.settings)
        )[0]
        return type(found)(*(np.asarray(x) for x in found))


def slopes(task, read, free=DEFAULT_FREE, step=STEP):
    """d read / d ln parameter by central differences."""
    columns = []
    for name in free:
        up, down = (
            task.replace(**{name: float(task[name]) * np.exp(side * step)}) for side in (1, -1)
        )
        columns.append((read(moments_of(up)) - read(moments_of(down))) / (2 * step))
    return np.stack(columns, axis=-1)


def proportional_information(task, segments, free=DEFAULT_FREE):
    """Fisher information of proportional powers by contrasts of their logarithms, which know
    nothing of the total."""
    moments = moments_of(task)
    law = welch_law(task.settings, np.arange(1, 31), segments)
    keep = 1 - (moments.line / moments.power) ** 2
    sd = np.sqrt(2 / law.degrees * keep)
    covariance = law.correlation * np.outer(sd, sd)
    contrasts = scipy.linalg.helmert(30)
    rows = contrasts @ slopes(task, lambda m: np.log(m.power), free)
    return rows.T @ np.linalg.solve(contrasts @ covariance @ contrasts.T, rows)


def setup_at(result, target=None):
    """FitProblem with the fitted task, and θ. Needs float64."""
    problem = reopened(result, target)
    (part,) = problem.parts
    fitted_part = dataclasses.replace(part, task=result.task)
    return dataclasses.replace(problem, parts=(fitted_part,)), problem.theta_of((result.task,))


def same_information(found, expected, digits=DIGITS):
    """Equal to the digits of a difference, relative to the roots of the diagonal."""
    size = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        found / np.outer(size, size), expected / np.outer(size, size), atol=digits
    )


# --- the information of the data


def test_the_information_is_that_of_log_contrasts(x64):
    problem, theta = setup_at(fitted())
    same_information(
        information_of(problem, expansion_at(problem, theta)),
        proportional_information(TRUTH, (SEGMENTS,)),
    )


def test_a_coefficient_of_variation_adds_its_gradient(x64):
    result = fitted(coefficient_of_variation=0.015)
    problem, theta = setup_at(result)
    row = (
        slopes(TRUTH, lambda m: 0.5 * np.log(m.variance) - np.log(m.mean), step=0.2 * STEP)
        / problem.parts[0].variation[1]
    )
    expected = proportional_information(TRUTH, (SEGMENTS,)) + np.outer(row, row)
    same_information(information_of(problem, expansion_at(problem, theta)), expected)


def test_eliminating_the_offset_is_inverting_with_it():
    root = np.random.default_rng(0).standard_normal((5, 9))
    whole = root @ root.T
    np.testing.assert_allclose(
        np.linalg.inv(without_offsets(whole, len(whole) - 1)), np.linalg.inv(whole)[:-1, :-1]
    )
    whole[-1], whole[:, -1] = 0, 0
    np.testing.assert_array_equal(without_offsets(whole, len(whole) - 1), whole[:-1, :-1])


def drawn(task, segments, count, seed):
    """Proportional powers drawn from the bins' law about the expected spectrum of a task. Needs
    float64."""
    moments, law = moments_of(task), welch_law(task.settings, np.arange(1, 31), segments)
    a = law.degrees / 2 / (1 - (moments.line / moments.power) ** 2)
    normal = np.random.default_rng(seed).multivariate_normal(
        np.zeros(30), law.correlation, size=count
    )
    power = moments.power * gammaincinv(a, ndtr(normal)) / a
    return power / power.sum(axis=1, keepdims=True)


def highest_posteriors(result, count):
    """Derived quantities at the posterior's maxima for spectra drawn at the fit, and those of the
    fit with their slopes."""
    problem, theta = setup_at(result)
    likelihood = Likelihood.of(problem)
    powers = drawn(result.task, result.target.segments, count, 3)
    (bins,) = jax.tree.map(lambda x: np.broadcast_to(x, (count, *np.shape(x))), likelihood.bins)
    bins = (bins._replace(log_power=np.log(powers)),)
    peak = maximise(likelihood, np.tile(theta, (count, 1)), problem.precision, bins=bins)
    assert peak.settled.mean() > 0.97
    objective = without_scalars(problem).linear()
    (values,), _ = quantities(objective, expand(objective, peak.theta))
    (truth,), (gradients,) = quantities(objective, expand(objective, theta[None]))
    return (
        peak,
        values,
        {n: float(v[0]) for n, v in truth.items()},
        {n: g[0] for n, g in gradients.items()},
    )


def test_where_all_is_determined_maxima_scatter_by_the_inverse_information(x64):
    """Four parameters that a spectrum determines; the whole covariance, by its Wishart law."""
    free = ("c_w", "noise_K_z", "harmonic_amplitude", "harmonic_frequency")
    result = fitted(free=free, segments=6 * SEGMENTS)
    report = jm.identifiability(result, designs=())
    assert report.present.determined == 4 and not report.present.undetermined
    count = 400
    peak, *_ = highest_posteriors(result, count)
    information = proportional_information(TRUTH, (6 * SEGMENTS,), free)
    gain = np.linalg.inv(information + np.eye(4))
    # about one truth, the prior's centre, which pulls but does not scatter
    predicted = gain @ information @ gain
    off = peak.theta - peak.theta.mean(axis=0)
    scatter = np.linalg.solve(np.linalg.cholesky(predicted), off.T)
    eigenvalues = np.linalg.eigvalsh(scatter @ scatter.T / (count - 1))
    # Outermost eigenvalues of a white Wishart matrix by simulation.
    rng = np.random.default_rng(1)
    white = np.array(
        [
            np.linalg.eigvalsh(np.cov(rng.standard_normal((4, count))))[[0, -1]]
            for _ in range(20_000)
        ]
    )
    low, high = np.quantile(white[:, 0], DOUBTFUL / 2), np.quantile(white[:, 1], 1 - DOUBTFUL / 2)
    assert low < eigenvalues[0] and eigenvalues[-1] < high
    for i, name in enumerate(free):
        known = report.present.quantities[name]
        np.testing.assert_allclose(known.left, np.sqrt(gain[i, i]), rtol=DIGITS)


def test_determined_quantities_scatter_as_the_report_says(x64):
    """All eight parameters: four directions are open, and the maxima go far along them."""
    result, count = fitted(), 300
    present = jm.identifiability(result, designs=()).present
    _, values, truth, gradients = highest_posteriors(result, count)
    information = proportional_information(TRUTH, (SEGMENTS,))
    gain = np.linalg.inv(information + np.eye(8))
    determined = [n for n, k in present.quantities.items() if k.determined and n in values]
    assert {
        "corner_frequency",
        "harmonic_share",
        "harmonic_frequency",
        "band_8_12",
    } <= set(determined)
    for name in determined:
        g, found = gradients[name], values[name]
        known = present.quantities[name]
        np.testing.assert_allclose(known.stderr, np.sqrt(g @ gain @ g), rtol=1e-3)
        expected = g @ gain @ information @ gain @ g
        assert expected <= known.stderr**2 * (1 + 1e-9)
        centred = found - found.mean()
        # of the variance, relative
        scatter = np.sqrt((np.mean(centred**4) / np.mean(centred**2) ** 2 - 1) / count)
        bound = scipy.stats.norm.ppf(1 - DOUBTFUL / 2 / len(determined)) * scatter
        # The corner frequency is curved along what is open: its errors are a fifth larger than to
        # first order.
        curved = 0.45 if name == "corner_frequency" else 0.0
        assert -bound < np.mean(centred**2) / expected - 1 < bound + curved, name
        assert abs(found.mean() - truth[name]) < 0.5 * known.stderr


# --- what designs add


def test_a_longer_recording_multiplies_the_information():
    report = jm.identifiability(
        fitted(), designs=[jm.uncertainty.Design("more", segments=9 * SEGMENTS)]
    )
    degrees = [jm.SpectrumSettings().degrees_of_freedom(k) for k in (SEGMENTS, 9 * SEGMENTS)]
    shown = report.present.singular_values > 1e-2  # below, rounding
    ratio = report.designs[0].singular_values[shown] / report.present.singular_values[shown]
    # The law of bins knows of leakage into the lowest ones, the equivalent degrees of freedom do
    # not.
    np.testing.assert_allclose(ratio, np.sqrt(sum(degrees) / degrees[0]), rtol=2e-3)


@pytest.mark.parametrize("what", ["variation", "mean"])
def test_a_single_number_adds_one_row(x64, what):
    problem, theta = setup_at(fitted())
    given = {"coefficient_of_variation": True} if what == "variation" else {"mean": 0.03}
    found = design_information(
        problem, theta, jm.uncertainty.Design("one number", segments=0, **given)
    )
    if what == "variation":
        # The variance in the window ripples with the frequency.
        row = slopes(TRUTH, lambda m: 0.5 * np.log(m.variance) - np.log(m.mean), step=0.2 * STEP)
        stated = jm.Target("stated", np.ones(30), segments=SEGMENTS, coefficient_of_variation=0.01)
        sd = target_variation(stated, TRUTH)[1]  # tests/test_expected.py checks it by simulation
    else:
        row, sd = slopes(TRUTH, lambda m: np.log(m.mean)), 0.03
    expected = np.outer(row, row) / sd**2
    np.testing.assert_allclose(found, expected, atol=DIGITS * np.abs(expected).max())
    assert np.linalg.matrix_rank(found, tol=1e-6 * np.abs(found).max()) == 1


def test_a_known_mean_is_known_as_well_as_it_was_measured():
    report = jm.identifiability(
        fitted(), designs=[jm.uncertainty.Design("the mean", segments=0, mean=0.02)]
    )
    mean = report.designs[0].quantities["model_mean"]
    # The prior adds next to nothing: its own error is 79 %.
    assert (
        mean.stderr / mean.value == pytest.approx(0.02, rel=1e-3)
        and "model_mean" in report.designs[0].gained
    )


def test_a_design_at_other_values_knows_the_factors(x64):
    """Information about θ at the design's own values, as if its task had been fitted."""
    stronger = TRUTH.at_level(0.5)
    assert float(stronger["k_w"]) > 1.5 * float(TRUTH["k_w"])
    elsewhere = {n: 0.7 * float(TRUTH[n]) for n in DEFAULT_FREE}
    problem, theta = setup_at(fitted(settings={"prior_centre": elsewhere}))
    np.testing.assert_allclose(theta, -np.log(0.7))
    found = design_information(
        problem, theta, jm.uncertainty.Design("half of the maximum", stronger, 12)
    )
    same_information(found, proportional_information(stronger, (12,)))


def test_separate_parameters_are_eliminated(x64):
    problem, theta = setup_at(fitted())
    task = TRUTH.replace(P_w=10.0)
    present = information_of(problem, expansion_at(problem, theta))
    tied = design_information(problem, theta, jm.uncertainty.Design("tied", task))
    loose = design_information(
        problem, theta, jm.uncertainty.Design("loose", task, separate=AMPLITUDES)
    )
    own = [DEFAULT_FREE.index(n) for n in AMPLITUDES]
    where = np.arange(8)
    where[own] = 8 + np.arange(3)
    whole = np.diag([*np.ones(8), *np.full(3, 1e-6)])  # the prior; of their own values next to none
    whole[:8, :8] += present
    whole[np.ix_(where, where)] += tied
    expected = np.linalg.inv(whole)[:8, :8]
    # Condition number 1e11: the scale of the amplitudes by themselves is not in the data.
    np.testing.assert_allclose(
        np.linalg.inv(present + loose + np.eye(8)), expected, rtol=0, atol=1e-5
    )
    # Less is known than if they were shared, in every direction.
    assert np.linalg.eigvalsh(tied - loose)[0] > -1e-9 * np.abs(tied).max()


def test_the_load_keeps_the_operating_point(x64):
    result = fitted()
    design = next(d for d in jm.uncertainty.standard_designs(result) if "displacement" in d.name)
    assert isinstance(design.task, jm.PrescribedForce)
    held, moving = np.asarray(equilibrium(TRUTH)), np.asarray(equilibrium(design.task))
    np.testing.assert_allclose(moving, [held[0], 0, 0, 0], atol=1e-9)
    for name in DEFAULT_FREE:
        assert float(design.task[name]) == float(TRUTH[name])


LONGER = "a recording 10 times as long"
HELD = ["the displacement under a load of 2.18 N", *MOVED, *LEVELS, LONGER]
VARIATION = "the coefficient of variation"


@pytest.mark.parametrize(
    ("given", "names"),
    [
        ({}, [VARIATION, "the mean force, known to 2 %", *HELD]),
        ({"coefficient_of_variation": 0.016, "settings": {"mean_force": [2.18, 0.05]}}, HELD),
        (
            {"task": jm.PrescribedForce(F_ext=1.0)},
            [
                VARIATION,
                "the mean displacement, known to 2 %",
                "the force with the insertion held",
                *LEVELS,
                LONGER,
            ],
        ),
    ],
    ids=["isometric", "all numbers known", "force"],
)
def test_the_usual_designs(given, names):
    designs = jm.uncertainty.standard_designs(fitted(**given))
    assert [design.name for design in designs] == names
    for design in designs:
        assert (design.separate == AMPLITUDES) is design.name.startswith("a second force level")


def test_the_usual_designs_of_a_motion(monkeypatch):
    """They follow from its moments alone: slopes are not compiled for this task."""
    monkeypatch.setattr(
        _identifiability,
        "expansion_at",
        lambda problem, theta: Expansion(theta, (moments_of(problem.parts[0].task),), None),
    )
    names = [
        design.name
        for design in jm.uncertainty.standard_designs(fitted(jm.PrescribedMotion(F_ext=8.0)))
    ]
    assert names == [VARIATION, "the mean force, known to 2 %", *LEVELS, LONGER]


def test_no_design_is_above_the_maximal_force():
    names = [
        [d.name for d in jm.uncertainty.standard_designs(fitted(mvc_fraction=level))]
        for level in (0.5, 0.6)
    ]
    assert set(names[0]) - set(names[1]) == {LEVELS[0]} and LEVELS[1] in names[1]


# --- the report


@functools.cache
def report() -> jm.uncertainty.IdentifiabilityReport:
    return jm.identifiability(fitted(coefficient_of_variation=0.016))


def test_the_report_agrees_with_itself():
    found = report()
    assert found.present.determined == np.sum(found.present.singular_values >= 3) == 5
    for outlook in (found.present, *found.designs):
        assert outlook.determined == len(outlook.products) == np.sum(outlook.singular_values >= 3)
        for name, known in outlook.quantities.items():
            assert known.determined is (known.left**2 <= 0.1), name
            assert known.left <= found.present.quantities[name].left * (1 + 1e-9)
        assert set(outlook.gained) == {
            n
            for n, k in outlook.quantities.items()
            if k.determined and not found.present.quantities[n].determined
        }


def test_what_is_proportional_is_known_alike():
    for outlook in (report().present, *report().designs):
        for one, other in (("k_w", "K_w0"), ("c_z", "C_z0")):
            a, b = outlook.quantities[one], outlook.quantities[other]
            np.testing.assert_allclose(a.stderr / a.value, b.stderr / b.value, rtol=1e-6)


def test_the_report_in_words():
    text = str(report())
    lines = text.splitlines()
    assert max(map(len, lines)) <= 80
    assert lines[0] == "what the data of made determine"
    displacement = report().designs[1]
    percent = displacement.quantities["K_w0"].percent
    said = in_a_line(text)
    assert (
        "the displacement under a load of 2.18 N would determine" in said
        and f"K_w0 to {percent}" in said
    )
    assert "with its own values of noise_K_w, noise_K_z, harmonic_amplitude" in said
    assert "k_w to" not in said  # K_w0 says it
    # the answer, before its details
    assert said.count("mm rms to 5 Hz: 1 of 8 combinations would stay open") == 1
    parts = (
        "what to measure next: most would be learnt from D, 60 s",
        "fatigue is not considered",
        "standard errors in",
    )
    assert [said.index(part) for part in parts] == sorted(said.index(part) for part in parts)
    for sentence in report().present.undetermined:
        assert sentence in said


def test_the_report_names_what_it_knows_and_the_fit_does_not():
    sure, unsure = jm.fits.Estimate(1.0, "Hz", 0.1), jm.fits.Estimate(1.0, "Hz", None, True, False)
    quantities = {
        "corner_frequency": sure,
        "harmonic_share": unsure,
        "K_w0": unsure,
        "model_mean": unsure,
    }
    result = eqx.tree_at(
        lambda r: r.derived, fitted(), quantities, is_leaf=lambda x: isinstance(x, dict)
    )
    found = jm.identifiability(result, designs=())
    known = found.present.quantities
    assert known["harmonic_share"].determined and not known["K_w0"].determined
    assert "harmonic_share" in found.open_in_fit and not {"corner_frequency", "K_w0"} & set(
        found.open_in_fit
    )
    said = in_a_line(found)
    assert (
        f"known here, but not determined in the fit: {', '.join(found.open_in_fit)}. The fit is"
        " stricter" in said
    )
    assert found.to_dict()["not_determined_in_fit"] == list(found.open_in_fit)
    # Neither the table nor the figure shows it as determined.
    row = next(line for line in str(found).splitlines() if line.split()[:1] == ["harmonic_share"])
    assert row.rstrip().endswith(")")
    figure = found.plot()
    (matrix,) = (ax for ax in figure.axes if "bold" in ax.get_title(loc="left"))
    names = [tick.get_text().replace("\n", " ") for tick in matrix.get_yticklabels()]
    bold = {
        names[int(cell.get_position()[1])]: cell.get_weight() == "bold" for cell in matrix.texts
    }
    assert not bold["harmonic share"] and bold["corner frequency"]
    plt.close(figure)
    # of another target the fit has said nothing
    other = jm.identifiability(result, result.target, designs=())
    assert not other.open_in_fit and "not determined in the fit" not in str(other)


def test_a_report_about_a_fit_that_misses_its_data_says_so_first():
    kept = fitted().adequacy
    missing = eqx.tree_at(
        lambda r: r.adequacy,
        fitted(),
        msgspec.structs.replace(kept, chi2=4 * kept.expected, p=1e-4),
        is_leaf=lambda x: isinstance(x, type(kept)),
    )
    found = jm.identifiability(missing, designs=())
    assert (
        missing.adequacy.widening == 2.0
        and f"(chi2 {4 * kept.expected:.3g}, expected" in found.notices[0]
    )
    said = in_a_line(found)
    assert "note: the fit does not describe its data" in said and "by a factor of 2" in said
    assert found.to_dict()["notices"][0] == found.notices[0]
    for about in (
        jm.identifiability(fitted(), designs=()),
        jm.identifiability(missing, missing.target, designs=()),
    ):
        assert "does not describe" not in str(about)
    motion = jm.uncertainty.design_input(missing, seconds=10.0, band=(0.5, 5.0), rate=50.0)
    assert motion.notices == found.notices[:1] == tuple(motion.to_dict()["notices"])
    assert "note: the fit does not describe its data" in in_a_line(motion)


def test_the_numbers_in_the_table_are_those_of_the_report():
    rows = [line.split() for line in str(report()).splitlines() if line.startswith("  K_w0  ")]
    first = rows[0]
    known = [o.quantities["K_w0"] for o in (report().present, *report().designs)]
    # a row of every block of designs, which begins with what is known without them
    assert first[2] == "1/m" and all(row[:5] == first[:5] for row in rows)
    cells = [first[4], *(cell for row in rows for cell in row[5:])]
    assert [cell.startswith("(") for cell in cells] == [not k.determined for k in known]
    for cell, k in zip(cells, known, strict=True):
        # two digits
        assert float(cell.strip("()")) == pytest.approx(100 * k.stderr / k.value, rel=0.06)


def test_without_newtons_values_are_stated_per_newton_as_in_the_fit():
    found = jm.identifiability(fitted(), designs=())
    rows = {words[0]: words for words in map(str.split, str(found).splitlines()) if words}
    stiffness, mean = found.present.quantities["K_w0"], fitted().derived["model_mean"]
    assert (stiffness.unit, mean.unit) == ("N/m", "N")
    # three digits
    assert float(rows["K_w0"][1]) == pytest.approx(stiffness.value / mean.value, rel=5e-3)
    assert rows["K_w0"][2] == "1/m" and "per newton of mean force" in in_a_line(found)


@pytest.mark.parametrize("order", [1, -1])
def test_of_designs_that_determine_as_much_the_one_with_smaller_errors_is_named(order):
    lengthenings = [
        jm.uncertainty.Lengthening.flat(1e-3, (0.5, 5.0), seconds) for seconds in (30.0, 240.0)
    ]
    moved = [
        jm.uncertainty.Design(f"{x.seconds:g} s", segments=0, lengthening=x) for x in lengthenings
    ]
    found = jm.identifiability(fitted(), designs=moved[::order])
    short, long = found.designs[::order]
    assert (short.determined, len(short.gained)) == (long.determined, len(long.gained))
    letter = "AB"[found.designs.index(long)]
    assert f"most would be learnt from {letter}, 240 s:" in in_a_line(found)


def test_the_report_as_json(tmp_path):
    path = tmp_path / "folder" / "report.json"
    report().save(path)
    table = json.loads(path.read_text())
    assert table == json.loads(json.dumps(report().to_dict()))
    assert [p.name for p in path.parent.iterdir()] == ["report.json"]
    assert table["present"]["determined"] == 5 and table["threshold"] == 3.0
    known = table["designs"][1]["quantities"]["K_z0"]
    assert known["left"] == pytest.approx(known["stderr"] / known["prior_sd"])
    assert table["designs"][-1]["masses_open"] is False
    rows = report().to_dataframe().set_index(["design", "quantity"])
    assert rows["stderr"][report().designs[1].name, "K_z0"] == known["stderr"]
    assert rows["left"]["", "K_z0"] == table["present"]["quantities"]["K_z0"]["left"]


def test_the_figure():
    figure = report().plot()
    try:
        (lower,) = figure.axes
        names = [label.get_text() for label in lower.get_yticklabels()]
        assert "K_w0" in names and "k_w" not in names
        texts = [text.get_text() for text in lower.texts]
        columns = len(texts) // len(names)
        assert texts[names.index("K_z0") * columns + 2] == report().designs[1].quantities[
            "K_z0"
        ].percent.removesuffix(" %")
        assert [label.get_text() for label in lower.get_xticklabels()][:3] == ["now", "A", "B"]
        determined = [report().present.determined, *(d.determined for d in report().designs)]
        assert texts[: len(determined)] == [str(count) for count in determined]
    finally:
        plt.close(figure)


def test_a_design_without_equilibrium_is_impossible_and_the_rest_goes_on():
    undamped = TRUTH.replace(c_w=0.0, c_z=0.0)
    found = jm.identifiability(
        fitted(),
        designs=[
            jm.uncertainty.Design("undamped", undamped),
            jm.uncertainty.Design("the mean", segments=0, mean=0.02),
        ],
    )
    assert found.designs[0].failed is not None and "undamped" in found.designs[0].failed
    assert found.designs[0].quantities["k_w"].stderr == found.present.quantities["k_w"].stderr
    assert "undamped is impossible" in in_a_line(found)
    figure = found.plot()
    plt.close(figure)


def test_a_target_with_a_sigma_only():
    power = spectrum_of(TRUTH)
    nu = jm.SpectrumSettings().degrees_of_freedom(SEGMENTS)
    given = fitted(segments=None, sigma=power * np.sqrt(2 / nu))
    found = jm.identifiability(given)
    # Without correlation of the bins they tell more.
    assert found.present.determined >= 4
    # as many segments as scatter like the stated sigma
    (longer,) = (d for d in jm.uncertainty.standard_designs(given) if d.name == LONGER)
    assert longer.counts == (SEGMENTS * 9,)


def test_another_target_can_be_given():
    result = fitted()
    longer = jm.Target("longer", result.fitted, segments=4 * SEGMENTS)
    a, b = (jm.identifiability(result, target, designs=()).present for target in (None, longer))
    assert b.quantities["harmonic_share"].stderr == pytest.approx(
        0.5 * a.quantities["harmonic_share"].stderr, rel=0.03
    )


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: jm.uncertainty.Design("nothing", segments=0),
            "nothing: measures nothing: give segments",
        ),
        (
            lambda: jm.uncertainty.Design("few", segments=-1),
            "few: segments = -1 must not be negative",
        ),
        (
            lambda: jm.uncertainty.Design("exact", mean=0.0),
            "exact: mean = 0.0 must be a positive relative standard error",
        ),
        (
            lambda: jm.identifiability(
                fitted(), designs=[jm.uncertainty.Design("a"), jm.uncertainty.Design("a")]
            ),
            "two are called 'a'",
        ),
        (
            lambda: jm.identifiability(
                fitted(), designs=[jm.uncertainty.Design("a", separate=("m_w",))]
            ),
            "a: separate: 'm_w' is not free in the fit; free are k_w, ",
        ),
        (
            lambda: jm.identifiability(
                fitted(), designs=[jm.uncertainty.Design("x", LOADED, mean=0.1)]
            ),
            "x: the mean of its output is",
        ),
        (lambda: jm.identifiability(fitted(segments=None)), "states neither segments nor sigma"),
        (
            lambda: jm.identifiability(made_result(fitted=np.full(30, np.nan))),
            "the fit of made failed",
        ),
    ],
)
def test_bad_arguments(make, message):
    with pytest.raises(ValueError, match=message):
        make()


# --- promises


@functools.cache
def displaced():
    """The design of a displacement: its task, and what it promises."""
    promised = next(d for d in jm.identifiability(fitted()).designs if "displacement" in d.name)
    return next(
        d.task for d in jm.uncertainty.standard_designs(fitted()) if d.name == promised.name
    ), promised


def test_a_design_keeps_its_promise(x64):
    """Force and displacement drawn and fitted together 200 times: the spread is the report's
    prediction."""
    (held, promised), count = displaced(), 200
    assert set(BASES) <= set(promised.gained)
    tasks = {"force": TRUTH, "displacement": held}
    targets = {
        name: jm.Target(
            name,
            spectrum_of(task),
            segments=SEGMENTS,
            quantity=name,
        )
        for name, task in tasks.items()
    }
    problem = planned_jointly(tasks, targets, FitOptions()).problem
    theta = np.zeros(len(problem.coordinates.names))
    seen = expand(problem.linear(), theta[None])
    objective = problem.linear([np.asarray(m.line / m.power)[0] for m in seen.moments])
    drawings = [drawn(task, (SEGMENTS,), count, seed) for seed, task in enumerate(tasks.values())]
    data = tuple(
        eqx.tree_at(
            lambda d: d.target,
            jax.tree.map(lambda x: np.broadcast_to(x, (count, *np.shape(x))), one),
            powers,
        )
        for one, powers in zip(objective.data, drawings, strict=True)
    )
    found = least_squares(
        objective, np.tile(problem.coordinates.from_theta(theta), (count, 1)), 40, data=data
    )
    assert found.settled.mean() > 0.97
    reached = np.asarray(objective.theta(found.s))
    kept = [n for n in problem.coordinates.names if promised.quantities[n].determined]
    assert {"k_w", "k_z", "c_w", "c_z"} <= set(kept)
    chance = DOUBTFUL / 2 / len(kept)
    low, high = np.sqrt(scipy.stats.chi2.ppf([chance, 1 - chance], count - 1) / (count - 1))
    for name in kept:
        spread = reached[:, problem.coordinates.names.index(name)].std(ddof=1)
        # Least squares of log powers scatters more than the information allows: ν/2 ψ'(ν/2) = 1.03
        # in variance, and 1.13 for not weighing the correlation; the prior takes a tenth of the
        # variance at most.
        assert 0.95 * low < spread / promised.quantities[name].left < 1.1 * high, name


def test_a_joint_fit_reports_the_promised_errors():
    held, promised = displaced()
    moved = jm.Target("x", spectrum_of(held), segments=SEGMENTS, quantity="displacement")
    targets = {"force": fitted().target, "displacement": moved}
    joint = jm.fit({"force": TRUTH, "displacement": held}, targets, starts=4, seeds=0)
    for name in BASES:
        assert joint.derived[name].stderr == pytest.approx(
            promised.quantities[name].stderr, rel=0.1
        )
