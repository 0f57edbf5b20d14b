"""Studies: comparisons are those of scipy, corrections those of their papers, a folder is whole or
as it was."""

import csv
import dataclasses
import functools
import json
from types import SimpleNamespace

import matplotlib.pyplot as plt
import numpy as np
import pages
import pytest
import scipy.stats
from refits import without_intervals
from test_result import made_result

import jaxmuscle as jm
from jaxmuscle.data._study_table import Cell
from jaxmuscle.fits import Estimate, StudyResult
from jaxmuscle.fits._differences import corrected
from jaxmuscle.fits._study import USUAL, _checked

PEOPLE, CONDITIONS = 5, ("rest", "tired")
OPTIONS = {
    "rung": "auto",
    "noise": None,
    "quantities": ["corner_frequency"],
    "alpha": 0.05,
    "correction": "holm",
    "starts": 8,
    "key": 0,
    "reading": {},
}


def values(seed=0):
    """Corner frequency of every person in every condition; the old are slower, and tire more."""
    rng = np.random.default_rng(seed)
    found = {}
    for group, base, tired in (("young", 1.0, 0.1), ("old", 0.7, 0.3)):
        for number in range(PEOPLE):
            own = base + 0.1 * rng.standard_normal()
            found[f"{group}{number}", group] = (own, own - tired + 0.05 * rng.standard_normal())
    return found


def made_study(numbers=None, left_out=(), **options):
    """A study whose fits have these corner frequencies; those of `left_out` do not determine
    them."""
    cells, results = [], {}
    rng = np.random.default_rng(3)
    for (person, group), both in (values() if numbers is None else numbers).items():
        for condition, value in zip(CONDITIONS, both, strict=True):
            name = f"{person}, {condition}"
            power = np.exp(0.1 * rng.standard_normal((2, 30))) / (1 + np.arange(1, 31) ** 2)
            target = jm.Target(
                name,
                power.mean(axis=0),
                segments=[6, 6],
                unit="N",
                trial_power=power,
                mean=[5.0, 5.1],
            )
            error = None if name in left_out else 0.02
            other = Estimate(9 + value + 0.1 * rng.standard_normal(), "Hz", 0.5)
            derived = {"corner_frequency": Estimate(value, "Hz", error), "tremor_frequency": other}
            result = made_result(target=target, derived=derived)
            cells.append(Cell(person, group, condition, 2, (100.0, 100.0), target))
            results[name] = result
    labels = {cell.target.name: f"{cell.group}, {cell.condition}" for cell in cells}
    cohort = jm.fits.CohortResult(results, labels, {})
    return StudyResult(cohort, tuple(cells), {0: 10.0, 1: -3.5}, OPTIONS | options, "study.csv")


def of(study, kind):
    return [d for d in study.differences() if d.kind == kind]


def column(group, condition):
    return [both[condition] for (_, g), both in values().items() if g == group]


def test_groups_are_compared_by_welch_in_each_condition():
    found = of(made_study(), "groups")
    assert [(d.where, d.a, d.b, d.members, d.unit) for d in found] == [
        (condition, "young", "old", (PEOPLE, PEOPLE), "Hz") for condition in CONDITIONS
    ]
    for number, d in enumerate(found):
        test = scipy.stats.ttest_ind(
            column("old", number), column("young", number), equal_var=False
        )
        interval = test.confidence_interval(0.95)
        np.testing.assert_allclose(
            (d.p, d.low, d.high), (test.pvalue, interval.low, interval.high), rtol=1e-9
        )


def test_conditions_are_compared_within_people():
    (d,) = of(made_study(), "conditions")
    rest, tired = ([both[i] for both in values().values()] for i in (0, 1))
    test = scipy.stats.ttest_rel(tired, rest)
    interval = test.confidence_interval(0.95)
    expected = (test.pvalue, interval.low, interval.high, np.mean(tired) - np.mean(rest))
    np.testing.assert_allclose((d.p, d.low, d.high, d.difference), expected, rtol=1e-9)
    assert (d.a, d.b, d.members, d.left_out) == ("rest", "tired", (2 * PEOPLE, 2 * PEOPLE), 0)


def test_the_interaction_is_the_difference_of_changes():
    (d,) = of(made_study(alpha=0.1), "interaction")
    old, young = (np.subtract(column(g, 1), column(g, 0)) for g in ("old", "young"))
    test = scipy.stats.ttest_ind(old, young, equal_var=False)
    interval = test.confidence_interval(0.9)
    np.testing.assert_allclose(
        (d.p, d.low, d.high), (test.pvalue, interval.low, interval.high), rtol=1e-9
    )
    assert (d.a, d.b, d.where) == ("young", "old", "tired - rest")


def test_what_a_fit_does_not_determine_is_left_out_and_counted():
    study = made_study(left_out=("old1, tired",))
    groups = {d.where: d for d in of(study, "groups")}
    assert groups["tired"].members == (PEOPLE, PEOPLE - 1) and groups["tired"].left_out == 1
    assert groups["rest"].members == (PEOPLE, PEOPLE) and groups["rest"].left_out == 0
    (within,) = of(study, "conditions")
    assert within.members == (2 * PEOPLE - 1,) * 2 and within.left_out == 1
    assert "left out" in str(study) and "selection" in study.methods()
    assert "differences" not in str(made_study(left_out=[cell.target.name for cell in study.cells]))


# Holm: 0.01 x 4, then the largest so far of 0.02 x 3, 0.03 x 2, 0.04 x 1; the p-values in another
# order.
@pytest.mark.parametrize(
    ("correction", "expected"),
    [
        ("holm", [0.06, 0.04, 0.06, 0.06]),
        ("fdr", [0.04, 0.04, 0.04, 0.04]),
        ("none", [0.03, 0.01, 0.04, 0.02]),
    ],
)
def test_corrections(correction, expected):
    (one,) = of(made_study(), "conditions")
    family = [dataclasses.replace(one, p=p) for p in (0.03, 0.01, 0.04, 0.02)]
    np.testing.assert_allclose(
        [d.p_corrected for d in corrected(family, correction)], expected, rtol=1e-12
    )
    assert corrected([], correction) == []


def test_every_kind_of_comparison_is_corrected_by_itself():
    study = made_study(quantities=None)  # the derived ones; the parameter c_w is not among them
    assert study.quantities == ("corner_frequency", "tremor_frequency")
    for kind, count in (("groups", 4), ("conditions", 2), ("interaction", 2)):
        family = of(study, kind)
        assert len(family) == count
        smallest = min(family, key=lambda d: d.p)
        assert smallest.p_corrected == pytest.approx(min(1.0, count * smallest.p))


def test_tables():
    study = made_study()
    rows = study.table()
    assert {
        "person",
        "group",
        "condition",
        "trials",
        "quantity",
        "value",
        "stderr",
        "adequate",
    } <= set(rows[0])
    assert len(study.to_dataframe()) == len(rows)
    frame = study.to_dataframe().query(
        "quantity == 'corner_frequency' and condition == 'tired' and group == 'old'"
    )
    np.testing.assert_array_equal(frame["value"], column("old", 1))
    assert {row["quantity"] for row in made_study(quantities=["corner_frequency"]).table()} == {
        "corner_frequency"
    }
    assert study.rung == 1 and study.people["old0"] == "old" and study.success


def test_a_quantity_is_asked_for_by_either_name():
    asked = ["resonance_frequency", "tremor_frequency", "corner_frequency"]
    assert _checked(USUAL | {"quantities": asked})["quantities"] == [
        "tremor_frequency",
        "corner_frequency",
    ]


def test_the_folder(tmp_path):
    study = made_study()
    (tmp_path / "mine.txt").write_text("kept")
    study.save(tmp_path)
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {
        "people.csv",
        "differences.csv",
        "study.json",
        "methods.txt",
        "spectra.png",
        "quantities.png",
        "mine.txt",
    }
    with open(tmp_path / "differences.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    for row, d in zip(rows, study.differences(), strict=True):
        assert (row["kind"], row["quantity"], row["where"]) == (d.kind, d.quantity, d.where)
        assert float(row["p_corrected"]) == pytest.approx(d.p_corrected, rel=1e-7)
    table = json.loads((tmp_path / "study.json").read_text())
    assert (
        len(table["fits"]) == 4 * PEOPLE
        and table["model"]["rung"] == 1
        and table["aic"] == {"0": 10.0, "1": -3.5}
    )
    assert "nothing to compare" in str(made_study(alpha=0.05, quantities=["tremor_share"]))
    methods = " ".join((tmp_path / "methods.txt").read_text().split())
    for said in (
        "10 people in 2 groups (young 5, old 5) in 2 conditions",
        "40 recordings, 2 per person",
        "Holm",
        "paired t test",
        "Welch",
        "with activation",
        f"jaxmuscle {jm.__version__}",
    ):
        assert said in methods, said


def test_a_study_without_differences_leaves_none_of_an_earlier_one(tmp_path):
    made_study().save(tmp_path)
    (tmp_path / "mine.csv").write_text("kept")
    made_study(quantities=["tremor_share"]).save(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {
        "study.json",
        "methods.txt",
        "spectra.png",
        "mine.csv",
    }


def test_an_interrupted_save_leaves_an_earlier_study_as_it_was(tmp_path, monkeypatch):
    made_study(correction="fdr").save(tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    def interrupt(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(plt.Figure, "savefig", interrupt)
    with pytest.raises(KeyboardInterrupt):
        made_study().save(tmp_path)
    plt.close("all")
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_the_figure_of_spectra():
    study = made_study()
    figure = study.plot(proportional=False)
    try:
        assert [ax.get_title(loc="left") for ax in figure.axes] == list(CONDITIONS)
        assert figure.axes[0].get_ylabel() == "Power (N²/Hz)"
        legend = [text.get_text() for text in figure.legends[0].get_texts()]
        assert legend == [f"young ({PEOPLE} people)", f"old ({PEOPLE} people)"]
        thick = next(line for line in figure.axes[1].lines if line.get_label().startswith("old"))
        rows = [
            c.target.trial_power.mean(axis=0)
            for c in study.cells
            if (c.group, c.condition) == ("old", "tired")
        ]
        np.testing.assert_allclose(thick.get_ydata(), scipy.stats.gmean(rows), rtol=1e-12)
    finally:
        plt.close(figure)
    single = SimpleNamespace(target=SimpleNamespace(trial_power=None, unit="N"))
    with pytest.raises(ValueError, match="at least two trials"):
        jm.plot.study(SimpleNamespace(cells=[single]), proportional=False)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rung": 4}, r"rung = 4: give a rung of the ladder, 0 to 3, or \"auto\""),
        ({"rung": "high"}, "rung = 'high'"),
        ({"alpha": 5.0}, "alpha = 5.0: give a share between 0 and 1"),
        ({"correction": "bonferoni"}, "correction = 'bonferoni': .*holm"),
        ({"quantities": ["tremor"]}, "quantities: unknown 'tremor'; did you mean 'tremor_"),
    ],
)
def test_bad_options(options, message, recorded):
    with pytest.raises(ValueError, match=message):
        jm.run_study(recorded / "study.csv", **options)


@functools.cache
def forces():
    """Two people, two trials in two conditions: noise with a corner, in newtons."""
    rng = np.random.default_rng(5)
    low = scipy.signal.butter(1, 1.5, fs=100.0, output="sos")
    return 5 + 0.1 * scipy.signal.sosfilt(low, rng.standard_normal((16, 1500)))[:, 300:]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    folder = tmp_path_factory.mktemp("study")
    rows, whose = (
        [],
        [
            (p, g, c, t)
            for p, g in zip("abcd", "xxyy", strict=True)
            for c in CONDITIONS
            for t in "12"
        ],
    )
    for number, (force, (person, group, condition, trial)) in enumerate(
        zip(forces(), whose, strict=True)
    ):
        np.save(folder / f"{number}.npy", force)
        rows.append(f"{number}.npy,{person},{group},{condition},{trial}")
    (folder / "study.csv").write_text(
        "\n".join(["file,person,group,condition,trial", *rows]) + "\n"
    )
    (folder / "study.toml").write_text(
        'table = "study.csv"\nrate = 100.0\nunits = "N m"\nrung = 0\nquantities ='
        ' ["corner_frequency"]\n'
    )
    return folder


@pytest.mark.slow
def test_a_whole_study_as_the_page_does_it(recorded, monkeypatch):
    monkeypatch.chdir(recorded)
    with without_intervals():
        found = pages.run(
            "docs/study.md",
            smaller={'run_study("study.toml")': 'run_study("study.toml", starts=8)'},
        )["found"]
        alone = jm.fit_cohort([found.cells[3].target], starts=8).results["b, tired"]
    plt.close("all")
    assert (
        found.rung == 0
        and set(found.aic) == {0}
        and found.options["reading"] == {"rate": 100.0, "units": "N m"}
    )
    assert [(c.person, c.condition, c.trials) for c in found.cells] == [
        (p, c, 2) for p in "abcd" for c in CONDITIONS
    ]
    (rung,) = found.cohort.results["b, tired"].ladder
    assert rung.chosen and rung.aic == pytest.approx(alone.ladder[0].aic, abs=1e-3)
    assert np.isclose(found.aic[0], sum(r.ladder[0].aic for r in found.cohort.results.values()))
    assert "with the same model (base: noise and a harmonic)" in found.methods()
    assert "Study: 4 people in 2 groups (x 2, y 2) in 2 conditions (rest, tired)" in str(found)
    assert {"people.csv", "study.json", "spectra.png", "methods.txt"} <= {
        p.name for p in (recorded / "out/study").iterdir()
    }
    table = json.loads((recorded / "out/study/study.json").read_text())
    assert len(table["fits"]) == 8 and all(
        np.isfinite(fit["fitted"]).all() for fit in table["fits"]
    )
