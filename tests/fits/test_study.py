"""Studies: comparisons are those of scipy, corrections those of their papers, a folder is whole or
as it was."""

import csv
import dataclasses
import functools
import json
from concurrent.futures import ThreadPoolExecutor

import matplotlib.pyplot as plt
import numpy as np
import pages
import pytest
import scipy
from elsewhere import Pickled
from refits import without_intervals
from test_result import made_result

import jaxmuscle as jm
from jaxmuscle.data._study_table import Cell, Trial
from jaxmuscle.fits import Estimate, StudyResult, _study
from jaxmuscle.fits._differences import corrected
from jaxmuscle.fits._result import Adequacy
from jaxmuscle.fits._study import USUAL, _checked
from jaxmuscle.reports import study_notices

PEOPLE, CONDITIONS = 5, ("rest", "tired")
REJECTED = Adequacy(60.0, 20.0, 0.001, "power from 4 to 6 Hz")
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


def read(count, chosen="given"):
    """So many recordings, of which 8 s were analysed."""
    time = np.arange(200) / 20
    return tuple(
        Trial(f"{i}.csv", str(i), "force", 100.0, 1.0, 9.0, chosen, time, np.sin(time) + i)
        for i in range(1, count + 1)
    )


def values(seed=0):
    """Corner frequency of every person in every condition; the old are slower, and tire more."""
    rng = np.random.default_rng(seed)
    found = {}
    for group, base, tired in (("young", 1.0, 0.1), ("old", 0.7, 0.3)):
        for number in range(PEOPLE):
            own = base + 0.1 * rng.standard_normal()
            found[f"{group}{number}", group] = (own, own - tired + 0.05 * rng.standard_normal())
    return found


def made_study(numbers=None, left_out=(), rejected=(), **options):
    """A study whose fits have these corner frequencies; those of `left_out` do not determine them,
    those of `rejected` do not describe the data."""
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
            more = {"adequacy": REJECTED} if name in rejected else {}
            derived = {
                "corner_frequency": Estimate(value, "Hz", error),
                "resonance_frequency": other,
            }
            result = made_result(target=target, derived=derived, **more)
            cells.append(Cell(person, group, condition, read(2), target, power.mean(axis=0) / 25))
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
    words = " ".join(str(study).split())
    assert "corner_frequency, tired: old - young" in words and " 5+4 of 10 " in words
    assert study.missing() == {"corner_frequency": 1}
    assert "NOT KNOWN  corner_frequency in 1 of 20" in str(study)
    assert "were left out: in 3 of 4 comparisons, of at most 1 person." in study.methods()


def test_the_numbers_of_a_rejected_model_are_left_out_and_what_is_measured_is_not():
    names = ["corner_frequency", "median_frequency"]
    study = made_study(rejected=("old1, tired",), quantities=names)
    groups = {(d.quantity, d.where): d for d in of(study, "groups")}
    assert groups["corner_frequency", "tired"].members == (PEOPLE, PEOPLE - 1)
    assert groups["corner_frequency", "tired"].left_out == 1
    assert groups["median_frequency", "tired"].members == (PEOPLE, PEOPLE)
    assert groups["median_frequency", "tired"].left_out == 0
    told = " ".join(str(study).split())
    assert "it does not describe old1, tired, so the model's numbers of these are left out" in told
    assert "Table 1 and the measured differences need no model: they stay." in told
    assert "need no model" not in str(made_study())
    # what is measured is corrected by itself, whatever is compared beside it
    alone = {d.where: d for d in of(made_study(quantities=names[1:]), "groups")}
    for where in CONDITIONS:
        assert groups["median_frequency", where].p_corrected == alone[where].p_corrected


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
    study = made_study(quantities=["corner_frequency", "resonance_frequency"])
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
    asked = ["activation_time", "contraction_time", "corner_frequency"]
    assert _checked(USUAL | {"quantities": asked})["quantities"] == [
        "contraction_time",
        "corner_frequency",
    ]


def test_the_folder(tmp_path):
    study = made_study()
    (tmp_path / "mine.txt").write_text("kept")
    study.save(tmp_path)
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {
        "table1.csv",
        "people.csv",
        "differences.csv",
        "trials.csv",
        "study.json",
        "methods.txt",
        "spectra.png",
        "quantities.png",
        "trials.png",
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
    told = str(made_study(quantities=["resonance_share"]))
    assert "DIFFERENCES  none: a comparison needs two people on each side" in told
    methods = " ".join((tmp_path / "methods.txt").read_text().split())
    for said in (
        "10 people in 2 groups (young 5; old 5) in 2 conditions (rest; tired)",
        "40 recordings, 2 per person and condition, sampled at 100 Hz",
        "Holm",
        "paired t test",
        "Welch",
        "slow part + twitch",
        f"jaxmuscle {jm.__version__}",
    ):
        assert said in methods, said


def test_a_study_without_differences_leaves_none_of_an_earlier_one(tmp_path):
    made_study().save(tmp_path)
    (tmp_path / "mine.csv").write_text("kept")
    made_study(quantities=["resonance_share"]).save(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {
        "table1.csv",
        "trials.csv",
        "study.json",
        "methods.txt",
        "spectra.png",
        "trials.png",
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
    cells = [c for c in study.cells if (c.group, c.condition) == ("old", "tired")]
    # of means of 5 N; where somebody's signal has no mean, shares of power
    floating = (study.cells[0]._replace(power=None), *study.cells[1:])
    none = StudyResult(study.cohort, floating, {}, OPTIONS, "s.csv")
    for one, ordinate, rows in (
        (study, "Power (1e-6 mean²/Hz)", [c.target.trial_power.mean(axis=0) * 4e4 for c in cells]),
        (none, "Power (fraction per bin)", [c.target.proportional_power for c in cells]),
    ):
        figure = one.plot()
        titles = [ax.get_title(loc="left") for ax in figure.axes]
        assert titles == [f"young ({PEOPLE} people)", f"old ({PEOPLE} people)"]
        assert figure.axes[0].get_ylabel() == ordinate
        legend = [text.get_text() for text in figure.legends[0].get_texts()]
        assert legend == [*CONDITIONS, "thick: geometric mean ± SE"]
        thick = next(line for line in figure.axes[1].lines if line.get_label() == "tired")
        np.testing.assert_allclose(thick.get_ydata(), scipy.stats.gmean(rows), rtol=1e-12)
        plt.close(figure)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rung": 4}, r"rung = 4: give a rung of the ladder, 0 to 3, or \"auto\""),
        ({"rung": "high"}, "rung = 'high'"),
        ({"alpha": 5.0}, "alpha = 5.0: give a share between 0 and 1"),
        ({"correction": "bonferoni"}, "correction = 'bonferoni': .*holm"),
        ({"quantities": ["tremor"]}, "quantities: unknown 'tremor'; did you mean 'tremor_p'"),
        ({"conditions": ["rest"]}, r"conditions = \['rest'\]: give all of rest, tired, once"),
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
    (folder / "mixed.csv").write_text(
        "file,person,units,rate\n0.npy,a,N,100\n1.npy,a,N,100\n4.npy,b,mN,100\n"
    )
    (folder / "study.toml").write_text(
        'table = "study.csv"\nrate = 100.0\nunits = "N m"\nrung = 0\nquantities ='
        ' ["corner_frequency"]\n'
    )
    return folder


def measure_by_scipy(trials):
    """What Table 1 says of a person, by numpy and scipy alone, of the trials' samples."""
    each = []
    for x in trials:
        mean, power = np.mean(x), scipy.fft.dct(x - np.mean(x), norm="ortho")[1:] ** 2 / len(x)
        f = np.arange(1, len(x)) * 100.0 / (2 * len(x))
        welch, p = scipy.signal.welch(x, 100.0, "hann", 256, 128, detrend="constant")
        total = np.concatenate([[0], np.cumsum(p[1:31])])
        each.append(
            {
                "mean": mean,
                "standard_deviation": np.std(x),
                "coefficient_of_variation": np.std(x) / mean,
                "coefficient_of_variation_without_drift": np.std(scipy.signal.detrend(x)) / mean,
                "relative_power_4_8": power[(f >= 4) & (f < 8)].sum() / mean**2,
                "relative_power_8_12": power[(f >= 8) & (f < 12)].sum() / mean**2,
                "power_0.5_1": power[(f >= 0.5) & (f < 1)].sum(),
                "share_above_12": power[f >= 12].sum() / np.var(x),
                "median_frequency": np.interp(total[-1] / 2, total, welch[1:32] - welch[1] / 2),
                "sample_entropy": sample_entropy(x),
            }
        )
    return {name: np.mean([one[name] for one in each]) for name in each[0]}


def sample_entropy(x):
    """-ln(A / B): pairs of templates of 2 samples within 0.2 σ, and those also alike in the
    next."""
    pairs = np.lib.stride_tricks.sliding_window_view(x, 3)
    two = scipy.spatial.cKDTree(pairs[:, :2]).query_pairs(0.2 * np.std(x), np.inf)
    alike = [i for i, k in two if abs(pairs[i, 2] - pairs[k, 2]) <= 0.2 * np.std(x)]
    return -np.log(len(alike) / len(two))


def test_table_1_is_what_scipy_says_of_the_same_samples(recorded):
    study = jm.run_study(recorded / "study.toml", fit=False, quantities=["mean"])
    assert not study.aic and study.success and "model" not in str(study)
    rows = {(r["group"], r["condition"], r["quantity"]): r for r in study.table_1()}
    files = dict(zip(((p, c) for p in "abcd" for c in CONDITIONS), range(0, 16, 2), strict=True))
    for group, people in (("x", "ab"), ("y", "cd")):
        for condition in CONDITIONS:
            known = []
            for person in people:
                number = files[person, condition]
                names = (recorded / f"{n}.npy" for n in (number, number + 1))
                trials = [jm.load_recording(name, rate=100.0).steady() for name in names]
                known.append(measure_by_scipy([trial.filtered() for trial in trials]))
            for name in known[0]:
                values, row = [one[name] for one in known], rows[group, condition, name]
                np.testing.assert_allclose(
                    (row["mean"], row["sd"]), (np.mean(values), np.std(values, ddof=1)), rtol=1e-9
                )
                assert (row["n"], row["people"]) == (2, 2)
    lines = str(study).splitlines()
    heads = [line.split()[0] for line in lines if not line.startswith(" ")]
    assert heads == ["STUDY", "MEASURED", "DIFFERENCES"] and len(lines) <= 22
    (seen,) = (line.split()[3:] for line in lines if line.startswith("  tremor seen in"))
    assert seen == 4 * ["0", "of", "2"] and "tremor frequency" not in str(study)
    methods = study.methods()
    assert "a peak from 6 to 12 Hz" in methods and "rheological" not in methods
    assert "Recordings were analysed as a whole. They were 12 s long." in methods


def test_a_study_of_two_groups_and_two_conditions_fits_a_terminal(recorded):
    """With the line that says what was written; a longer name is cut, and no line is longer."""
    study = made_study(left_out=("old1, tired",))
    cells = jm.run_study(recorded / "study.toml", fit=False).cells
    whole = StudyResult(study.cohort, cells, study.aic, OPTIONS | {"quantities": None}, "s.csv")
    lines = str(whole).splitlines()
    assert len(lines) <= 22 and max(map(len, lines)) <= 80
    assert sum("y, tired" in line for line in lines[:4]) == 1  # all four columns side by side
    long = [cell._replace(group=90 * "g") for cell in cells]
    named = StudyResult(study.cohort, tuple(long), study.aic, OPTIONS, "s.csv")
    assert max(map(len, str(named).splitlines()[3:])) <= 80
    after = [cell._replace(condition=cell.condition.replace("tired", 40 * "t")) for cell in cells]
    options = OPTIONS | {"quantities": ["mean"]}
    below = str(StudyResult(study.cohort, tuple(after), {}, options, "s.csv")).splitlines()
    row = below.index(f"  mean: {40 * 't'} - rest")  # its numbers are whole, in the next line
    assert below[row + 1].startswith("    ") and below[row + 1].endswith("  4")


def test_the_methods_say_what_was_subtracted():
    """A level at rest and a straight line, of a recording that had them; else nothing."""
    words = ("sensor at rest was subtracted", "straight line through the analysed part")
    study = made_study()
    assert not any(word in study.methods() for word in words)
    force = 3 + np.concatenate([0.001 * np.sin(np.arange(300.0)), forces()[0]])
    target = jm.data.Recording(force, 100.0, unit="N", detrend=True).steady().target("held")
    cells = (*study.cells, Cell("held", "old", "rest", read(1), target))
    held = StudyResult(study.cohort, cells, study.aic, study.options, "s.csv")
    assert all(word in held.methods() for word in words)


def test_every_recording_is_stated_with_what_was_analysed(recorded, tmp_path):
    """Part of it given in the table, in the options, or all of it; in the order of the table."""
    rows = (recorded / "study.csv").read_text().splitlines()
    edges = [",window_start,window_stop", ",2,9", *(",," for _ in rows[2:])]
    table = recorded / "windows.csv"
    table.write_text("\n".join(map(str.__add__, rows, edges)))
    options = {"rate": 100.0, "units": "N m", "fit": False}
    for window, whole in ((None, (0.0, 12.0, "all")), ((1, 11), (1.0, 11.0, "given"))):
        study = jm.run_study(table, window=window, **options)
        first, *others = [(r["start_s"], r["stop_s"], r["chosen"]) for r in study.trials()]
        assert first == (2.0, 9.0, "given") and others == [whole] * 15
    study.save(tmp_path)
    with open(tmp_path / "trials.csv", newline="") as file:
        written = list(csv.DictReader(file))
    assert [row["file"] for row in written] == [f"{i}.npy" for i in range(16)]
    assert (written[3]["person"], written[3]["condition"], written[3]["trial"]) == (
        "a",
        "tired",
        "2",
    )
    assert {row["rate_hz"] for row in written} == {"100"}
    assert json.loads((tmp_path / "study.json").read_text())["trials"] == study.trials()


def test_conditions_and_groups_are_shown_and_compared_as_they_are_asked_for(recorded):
    order = {"conditions": ["tired", "rest"], "groups": ["y", "x"]}
    study = jm.run_study(recorded / "study.toml", fit=False, quantities=["mean"], **order)
    assert study.conditions == ("tired", "rest") and study.groups == ("y", "x")
    assert [(d.a, d.b) for d in of(study, "conditions")] == [("tired", "rest")]
    assert {(d.a, d.b) for d in of(study, "groups")} == {("y", "x")}
    named = list(dict.fromkeys((row["group"], row["condition"]) for row in study.table_1()))
    assert named == [("y", "tired"), ("y", "rest"), ("x", "tired"), ("x", "rest")]
    spectra, quantities = (study.figures()[name] for name in ("spectra", "quantities"))
    assert [ax.get_title(loc="left")[:1] for ax in spectra.axes] == ["y", "x"]
    assert [text.get_text() for text in quantities.legends[0].get_texts()] == ["tired", "rest"]
    plt.close("all")


def test_names_that_differ_only_as_they_are_typed_are_noticed():
    study = made_study()
    assert not [said for said in study_notices(study) if "taken for different" in said]
    cells = [
        cell._replace(condition="Tired ")
        if (cell.person, cell.condition) == ("old1", "tired")
        else cell
        for cell in study.cells
    ]
    said, *_ = study_notices(StudyResult(study.cohort, tuple(cells), {}, OPTIONS, "s.csv"))
    assert said.startswith('condition "tired" and "Tired " are taken for different ones')


def test_one_chi2_is_stated_everywhere(tmp_path):
    """That of the verdict, over the data it counts, and not that of the drawn line."""
    study = made_study(rejected=("old1, tired",))
    for result in study.cohort.results.values():
        assert result.chi2_per_bin == 0.9  # of the drawn line
    rows = {(r["person"], r["condition"]): r for r in study.table() if r["kind"] == "model"}
    row = rows["old1", "tired"]
    assert row["chi2_per_bin"] == pytest.approx(REJECTED.chi2 / 29)
    assert row["chi2_expected"] == pytest.approx(REJECTED.expected / 29)
    assert f"chi2 per bin {row['chi2_per_bin']:.2f}" in study.cohort.results["old1, tired"].verdict


def test_all_recordings_of_a_study_have_one_unit(recorded):
    with pytest.raises(ValueError, match=r"line 4: unit = 'mN' here, 'N' at .*line 2: give all in"):
        jm.run_study(recorded / "mixed.csv")


@pytest.mark.parametrize(("trials", "rung"), [(4, 2), (5, 3)])
def test_five_trials_of_everybody_allow_two_resonances(trials, rung, recorded, monkeypatch):
    power = 1 / np.arange(1, 31) ** 2
    cells = [
        Cell(name, "", "", read(count), jm.Target(name, power, segments=5))
        for name, count in (("a", 7), ("b", trials))
    ]
    asked = []

    def fit_cohort(targets, **options):
        asked.append(options["rung"])
        return jm.fits.CohortResult({}, {}, {target.name: "not fitted" for target in targets})

    monkeypatch.setattr(_study, "cells_of_study", lambda *_: cells)
    monkeypatch.setattr(_study, "fit_cohort", fit_cohort)
    found = jm.run_study(recorded / "study.csv")
    assert asked == [rung] and found.options["rung"] == rung


def small_study(folder, executor=None):
    """The same study in any process, as text."""
    found = jm.run_study(folder / "study.toml", starts=1, executor=executor)
    return json.dumps(_study.to_table(found)), str(found)


def test_who_reads_and_fits_does_not_change_a_bit(recorded):
    pickled, told = Pickled(), []
    with without_intervals(), ThreadPoolExecutor(2) as threads:
        here = small_study(recorded)
        assert small_study(recorded, threads) == here
        assert small_study(recorded, pickled) == here
        jm.run_study(
            recorded / "study.toml",
            fit=False,
            executor=pickled,
            progress=lambda *each: told.append(each),
        )
    assert pickled.count == 8 + 2 + 8  # cells are read, blocks of four are fitted
    assert told[-1] == ("reading recordings", 1.0)


@pytest.mark.slow
def test_two_workers_are_one_process_to_the_last_bit(recorded, client):
    """Both with the compiler's options of a command."""
    alone = client.get_executor(pure=False).submit(small_study, recorded).result()
    assert small_study(recorded, client) == alone


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
    assert "with the same model (slow part + regular rhythm)" in found.methods()
    assert "STUDY  4 people in 2 groups (x 2; y 2) in 2 conditions (rest; tired)" in str(found)
    assert {"people.csv", "study.json", "spectra.png", "methods.txt"} <= {
        p.name for p in (recorded / "out/study").iterdir()
    }
    table = json.loads((recorded / "out/study/study.json").read_text())
    assert len(table["fits"]) == 8 and all(
        np.isfinite(fit["fitted"]).all() for fit in table["fits"]
    )
