"""Cohorts: many targets at once are each what a fit alone gives, differences of groups have honest
intervals."""

import functools
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import jax
import matplotlib.pyplot as plt
import numpy as np
import pytest
import scipy.stats
from elsewhere import Pickled
from refits import without_intervals
from test_fit import true_derived
from test_result import made_result
from typer.testing import CliRunner

import jaxmuscle as jm
from jaxmuscle.commands.main import app
from jaxmuscle.fits import Estimate
from jaxmuscle.fits._result import Adequacy

PEOPLE, SEEDS = 6, 20


def person(number):
    """Two groups that differ in the rhythm's frequency; within a group its frequency and the
    damping vary."""
    rng = np.random.default_rng(number)
    old = number % 2
    return jm.Isometric().replace(
        c_w=60 * np.exp(0.1 * rng.normal()),
        harmonic_frequency=4.5 + 2 * old + 0.2 * rng.normal(),
        harmonic_amplitude=0.012,
    )


@functools.cache
def people():
    """Absolute spectra averaged over seeds of the nonlinear simulator; six Welch segments of
    each."""
    targets = []
    for number in range(PEOPLE):
        runs = jm.ensemble(
            person(number).settled(),
            jax.random.key(100 + number),
            seeds=SEEDS,
            dt=2.5e-3,
            control=False,
        )
        power = np.asarray(runs.spectrum().mean().proportional)
        targets.append(
            jm.Target(
                f"person{number}",
                power,
                segments=(6,) * SEEDS,
                mvc_fraction=0.1 + 0.1 * (number // 2),
            )
        )
    return targets


GROUPS = {f"person{n}": "old" if n % 2 else "young" for n in range(PEOPLE)}


SHARES: list[float] = []


@functools.cache
def cohort():
    return jm.fit_cohort(
        people(), groups=GROUPS, starts=16, progress=lambda _text, share: SHARES.append(share)
    )


@pytest.mark.slow
def test_what_the_data_determine_is_recovered():
    found = cohort()
    assert len(set(SHARES)) > PEOPLE and max(SHARES) <= 1 + 1e-9
    assert found.success and list(found.results) == [t.name for t in people()]
    deviations = []
    for number, result in enumerate(found.results.values()):
        with jax.enable_x64(True):
            truth = true_derived(person(number))
        assert (
            abs(result.derived["harmonic_frequency"].value - truth["harmonic_frequency"])
            < 0.25 * 0.390625
        )
        for name in ("corner_frequency", "harmonic_share", "band_8_12"):
            estimate = result.derived[name]
            assert estimate.stderr is not None
            deviations.append((estimate.value - truth[name]) / estimate.stderr)
    # Šidák bound at 1 % for 18 comparisons, and their spread: its square is a mean of 18,
    # correlated within a person.
    assert np.abs(deviations).max() < 3.45
    assert np.sqrt(np.mean(np.square(deviations))) < 1.8


def test_each_target_is_fitted_as_if_alone():
    with without_intervals():
        alone = jm.fit(people()[3].task(), people()[3], starts=16, check_seeds=0, rungs=0)
    together = cohort().results["person3"]
    for name, estimate in alone.derived.items():
        if estimate.stderr is not None:
            # Alone, the nonlinear correction moves the answer, and it settles within a thousandth
            # of the cost.
            assert abs(together.derived[name].value - estimate.value) < 0.2 * estimate.stderr, name
            # the simulated seeds of a fit alone are part of its error
            assert together.derived[name].stderr == pytest.approx(estimate.stderr, rel=0.2), name


def test_groups_differ_by_what_they_were_given():
    found = {d.quantity: d for d in cohort().differences()}
    d = found["harmonic_frequency"]
    assert (d.a, d.b, d.unit, d.basis, d.members) == ("young", "old", "Hz", "people", (3, 3))
    assert 1.0 < d.low < d.difference < d.high < 3.0
    values = [
        [
            r.derived["harmonic_frequency"].value
            for n, r in cohort().results.items()
            if GROUPS[n] == g
        ]
        for g in (d.b, d.a)
    ]
    interval = scipy.stats.ttest_ind(*values, equal_var=False).confidence_interval(0.95)
    np.testing.assert_allclose((d.low, d.high), (interval.low, interval.high), rtol=1e-12)


def test_a_member_says_what_was_not_done():
    member = cohort().results["person0"]
    assert (member.settings["seeds"], member.settings["check_seeds"]) == (0, 0)
    assert any(notice.startswith("fitted by the formula alone") for notice in member.notices)
    figure = member.plot()
    try:
        assert len(figure.axes) == 2 and not any(ax.texts for ax in figure.axes)
    finally:
        plt.close(figure)


def test_the_verdict_names_what_is_missed_and_what_cannot_be_judged():
    def verdict(*fits: tuple[bool, bool | None]) -> str:
        results = {
            f"t{i}": SimpleNamespace(success=found, adequate=fine)
            for i, (found, fine) in enumerate(fits)
        }
        return jm.fits.CohortResult.verdict.fget(SimpleNamespace(results=results))

    assert verdict((True, True), (True, True)) == "the model describes 2 of 2 targets"
    assert (
        verdict((True, True), (True, False), (True, None))
        == "the model describes 1 of 2 targets; it does not describe t1, so the model's numbers of"
        " these are left out of comparisons"
    )
    assert verdict((True, None), (False, None)).startswith(
        "whether the model describes the targets cannot be judged"
    )
    assert verdict((False, None)) == verdict() == "no target could be fitted"


def test_a_cohort_has_one_method():
    with pytest.raises(TypeError, match="method"):
        jm.fit_cohort(["vastus-lateralis-26mvc"], method="montecarlo")


@pytest.mark.parametrize("by", ["person", "group", "level"])
def test_the_figure(by):
    figure = cohort().plot(by)
    try:
        if by == "person":
            assert {ax.get_xlim() for ax in figure.axes if ax.get_ylabel()} == {
                (-0.5, PEOPLE - 0.5)
            }
        assert {ax.get_ylabel().replace("\n", " ") for ax in figure.axes} >= {
            "harmonic frequency (Hz)",
            "corner frequency (Hz)",
        }
    finally:
        plt.close(figure)


def made_cohort(**groups):
    result = made_result()
    return jm.fits.CohortResult(
        {name: result for name in groups}, {name: g for name, g in groups.items() if g}, {}
    )


def test_tables_hold_every_quantity_of_every_target():
    found = made_cohort(a="one", b="two", c="")
    rows = found.table()
    quantities = {row["quantity"] for row in rows}
    assert len(rows) == 3 * len(quantities)
    assert {row["group"] for row in rows} == {"one", "two", ""}
    corner = next(row for row in rows if row["quantity"] == "corner_frequency")
    assert (corner["low"], corner["high"]) == made_result().derived["corner_frequency"].interval
    table = found.to_dataframe()
    assert list(table["value"]) == [row["value"] for row in rows] and list(table.columns) == list(
        rows[0]
    )


@pytest.mark.parametrize("whose", ["", "@a"])
def test_what_is_parameter_and_derived_is_listed_once_by_the_name_that_people_use(whose):
    frequency, time = Estimate(9.0, "Hz", 0.3), Estimate(0.05, "s", None, True, False)
    result = made_result(
        parameters={
            "c_w": Estimate(60.0, "N"),
            f"resonance_frequency{whose}": frequency,
            f"activation_time{whose}": time,
        },
        derived={
            f"resonance_frequency{whose}": frequency,
            f"contraction_time{whose}": time,
            "model_mean": Estimate(2.5, "N"),
        },
    )
    names = [f"{name}{whose}" for name in ("resonance_frequency", "contraction_time")]
    assert list(result.found) == ["c_w", *names, "model_mean"]
    rows = jm.fits.CohortResult({"a": result}, {}, {}).table()
    of_model = [row["quantity"] for row in rows if row["kind"] == "model"]
    assert [name for name in of_model if name != "model_mean"] == ["c_w", *names]
    measured = [row["quantity"] for row in rows if row["kind"] == "measured"]
    assert measured == list(result.measured) and len(rows) == len(measured) + len(of_model)


def test_single_members_are_compared_by_their_standard_errors():
    found = made_cohort(a="one", b="two")
    differences = found.differences()
    assert differences
    for d in differences:
        error = next(r["stderr"] for r in found.table() if r["quantity"] == d.quantity)
        assert (d.basis, d.difference, d.members) == ("fits", 0.0, (1, 1))
        np.testing.assert_allclose(
            (d.low, d.high), np.array([-1, 1]) * 1.959964 * np.sqrt(2) * error, rtol=1e-6
        )


def test_of_a_model_that_misses_the_data_only_what_is_measured_is_compared():
    missed = Adequacy(145.0, 25.0, 0.001, "the data have more power than the model")
    results = {"a": made_result(), "b": made_result(adequacy=missed)}
    found = jm.fits.CohortResult(results, {"a": "one", "b": "two"}, {})
    compared = {d.quantity for d in found.differences()}
    # of a single member its own error is all there is: a variation that is stated once has none
    sure = {n for n, m in results["a"].measured.items() if m.stderr is not None}
    assert compared == sure and "median_frequency" in sure
    assert {row["target"] for row in found.table() if row["quantity"] == "c_w"} == {"a", "b"}


def test_who_fits_does_not_change_a_bit():
    """Five in two blocks."""
    rng = np.random.default_rng(5)
    powers = np.exp(0.2 * rng.standard_normal((5, 30))) / (1 + np.arange(1, 31) ** 2)
    targets = [jm.Target(f"p{n}", power, segments=12) for n, power in enumerate(powers)]
    targets.append("nobody")
    options = {"starts": 3, "free": ("c_w", "k_w", "noise_K_w"), "max_steps": 6}
    told, pickled = [], Pickled()
    with without_intervals(), ThreadPoolExecutor(2) as threads:
        here, *others = (
            jm.fit_cohort(
                targets, executor=executor, progress=lambda *each: told.append(each), **options
            )
            for executor in (None, threads, pickled)
        )
    assert list(here.results) == [f"p{n}" for n in range(5)] and list(here.failed) == ["nobody"]
    assert pickled.count == 2
    assert [each for each in told if each[0].endswith(" fits")] == 2 * [
        ("4 of 5 fits", 0.8),
        ("5 of 5 fits", 1.0),
    ]
    for other in others:
        assert repr(other.table()) == repr(here.table()) and other.failed == here.failed
        assert [str(result) for result in other.results.values()] == [
            str(result) for result in here.results.values()
        ]


def test_one_bad_target_does_not_stop_the_rest(tmp_path):
    few = jm.Target("few", np.array([0.5, 0.3, 0.2]), bins=np.array([1, 2, 3]), segments=12)
    good = jm.load_target("fdi-abduction-45mvc")
    found = jm.fit_cohort([tmp_path / "none.csv", few, good], starts=8)
    assert list(found.results) == [good.name] and not found.success
    assert "no such file" in found.failed[str(tmp_path / "none.csv")]
    assert "3 bins cannot determine 8 free parameters" in found.failed["few"]


@pytest.mark.parametrize(
    ("targets", "options", "message"),
    [
        ([], {}, "no targets: give at least one"),
        (["fdi-abduction-45mvc"] * 2, {}, "two targets are called 'fdi-abduction-45mvc'"),
        (["fdi-abduction-45mvc"], {"groups": {"x": "y"}}, "groups: no target is called x"),
    ],
)
def test_bad_arguments(targets, options, message):
    with pytest.raises(ValueError, match=message):
        jm.fit_cohort(targets, **options)


def test_the_printed_table_fits_80_columns_and_shortens_no_number():
    """Numbers that the data do not determine, and those of a rejected model, are not in it."""
    small = jm.fits.Estimate(1.99e-4, "Hz", 6e-5, False, True)
    derived = {"corner_frequency": small, "harmonic_frequency": jm.fits.Estimate(7.0, "Hz", None)}
    names = {"vastus-lateralis-26mvc": "knee", "fdi-abduction-45mvc": "finger"}
    cohort = jm.fits.CohortResult(dict.fromkeys(names, made_result(derived=derived)), names, {})
    lines = str(cohort).splitlines()
    assert max(map(len, lines)) <= 80 and "harmonic" not in str(cohort)
    rows = [line for line in lines if line.startswith(tuple(f"  {name}" for name in names))]
    assert len(rows) == 2 and all("0.000199±0.000060" in row for row in rows)
    assert all(row.split()[-4:] == ["0.90", "(0.86)", "0.4", "described"] for row in rows)
    misses = made_result(derived=derived, adequacy=Adequacy(145.0, 25.0, 0.001, "too little"))
    rejected = str(jm.fits.CohortResult(dict.fromkeys(names, misses), names, {}))
    words = " ".join(rejected.split())
    assert "0.000199" not in words and "not described: too little" in words


def test_a_figure_needs_a_known_way_and_levels():
    found = made_cohort(a="", b="")
    with pytest.raises(ValueError, match="by = 'age': choose one of person, group, level"):
        found.plot("age")


def command(*arguments):
    result = CliRunner().invoke(app, ["fit", *map(str, arguments)], env={"COLUMNS": "200"})
    assert result.exception is None or isinstance(result.exception, SystemExit), repr(
        result.exception
    )
    return result


def test_the_command_writes_a_folder_for_each_and_the_table(tmp_path):
    groups = tmp_path / "groups.csv"
    groups.write_text("target,group\nvastus-lateralis-26mvc,knee\nfdi-abduction-45mvc,finger\n")
    out = tmp_path / "out"
    result = command(
        "vastus-lateralis-26mvc",
        "fdi-abduction-45mvc",
        tmp_path / "none.csv",
        "--groups",
        groups,
        "--starts",
        8,
        "--out",
        out,
    )
    assert result.exit_code == 2 and "none.csv: no such file" in result.stderr
    for name in ("vastus-lateralis-26mvc", "fdi-abduction-45mvc"):
        assert jm.load_result(out / name / "fit.json").success
        assert (out / name / "fit.png").stat().st_size > 0
    rows = (out / "cohort.csv").read_text().splitlines()
    assert rows[0].startswith("target,group,quantity,kind,value,stderr,low,high,unit,determined")
    assert (
        (out / "differences.csv")
        .read_text()
        .startswith("quantity,a,b,difference,low,high,unit,basis")
    )
    assert (out / "cohort.png").stat().st_size > 0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("person,group\na,b\n", "has no columns target and group"),
        ("target,group\n", "has no columns target and group"),
        ("target,group\na,\n", "line 2: a cell is empty; give a target and its group"),
        ("target,group\na,b\na,c\n", "line 3: a is in group b already"),
        ("target,group\nsomebody,b\n", "no target is called somebody"),
    ],
)
def test_bad_groups(text, message, tmp_path):
    path = tmp_path / "groups.csv"
    path.write_text(text)
    result = command(
        "vastus-lateralis-26mvc", "fdi-abduction-45mvc", "--groups", path, "--out", tmp_path / "out"
    )
    assert result.exit_code == 2 and message in result.stderr


def test_groups_and_seeds_do_not_go_with_everything(tmp_path):
    path = tmp_path / "groups.csv"
    path.write_text("target,group\na,b\n")
    assert (
        "--groups compares several spectra"
        in command("fdi-abduction-45mvc", "--groups", path).stderr
    )
    both = command("fdi-abduction-45mvc", "vastus-lateralis-26mvc", "--seeds", 8)
    assert both.exit_code == 2 and "leave out --method, --seeds and --quick" in both.stderr
