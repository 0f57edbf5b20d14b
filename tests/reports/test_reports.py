"""report.html: what the commands say in it, in which order, and that names out of files stay
words."""

import sys
from types import SimpleNamespace

import matplotlib.pyplot as plt
import numpy as np
import pytest
from test_html import HOSTILE, Seen
from test_result import POWER, failed_result, made_result
from test_study import made_study

import jaxmuscle as jm
from jaxmuscle._common.figures import pixels_of
from jaxmuscle.commands import cohort as cohort_command
from jaxmuscle.commands.console import write_fit
from jaxmuscle.reports import fit_report, posterior_report, study_report
from jaxmuscle.reports._ladder_text import format_p
from jaxmuscle.reports._pages import KINDS
from jaxmuscle.reports._study_text import difference_in_words, p_in_words


@pytest.fixture(autouse=True)
def closed(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["jaxmuscle", "fit", HOSTILE, "--out", "here"])
    yield
    plt.close("all")


def told(folder):
    """The words of the report, and its elements."""
    seen = Seen((folder / "report.html").read_text(encoding="utf-8"))
    assert not {"script", "iframe", "a", "link"} & {tag for tag, _ in seen.elements}
    assert not [name for _, given in seen.elements for name in given if name.startswith("on")]
    assert all(
        given["src"].startswith("data:image/") for _, given in seen.elements if "src" in given
    )
    return " | ".join(word for word in seen.words if word.strip()), seen


def test_of_a_fit(tmp_path):
    target = jm.Target(HOSTILE, POWER, segments=[6], notices=[HOSTILE])
    result = made_result(target=target, notices=(HOSTILE,))
    files = write_fit(result, tmp_path, ["png"], report=True)
    assert files == ["fit.json", "fit.png", "spectrum.csv", "report.html"]
    text, seen = told(tmp_path)
    assert [
        text.index(words)
        for words in ("What the data determine", "What the data do not determine", "What was fixed")
    ] == sorted(
        text.index(words)
        for words in ("What the data determine", "What the data do not determine", "What was fixed")
    )
    first, second = text.split("What the data do not determine", 1)
    assert "corner_frequency | 0.333 ± 0.010 | above 0.310 | Hz" in first
    assert (
        "What to know about this fit" in first
        and "k_w" not in first.split("What to know about this fit")[0]
    )
    assert "k_w" in second and "m_w" in second.split("What was fixed", 1)[1]
    # in the shell, too, it is one word
    assert text.count(HOSTILE) >= 4 and "jaxmuscle fit '<script>" in text
    assert "dt | 0.0025" in text and "jaxmuscle 0.1, jax 0.8" in text
    tried = text.split("Models tried", 1)[1]
    assert (
        "0 | slow part + regular rhythm | 1.90 | 0.002 | -250.1 |"
        " 1 | slow part + twitch + regular rhythm | 0.90 | 0.3 | -260.0 | the result" in tried
    )
    assert sum(tag == "img" for tag, _ in seen.elements) == 1
    assert (
        write_fit(result, tmp_path) == ["fit.json", "spectrum.csv"]
        and not (tmp_path / "report.html").exists()
    )


def test_measured_numbers_of_a_fit_have_words_and_percent(tmp_path):
    force = 5 + 0.1 * np.random.default_rng(1).standard_normal(3000)
    target = jm.data.Recording(force, 100.0, unit="N").target("held")
    fit_report(made_result(target=target), plt.figure(), tmp_path)
    text = told(tmp_path)[0].partition("What the data determine")[0]
    for name, words, scale in (
        ("coefficient_of_variation", "coefficient of variation (% of mean)", 100),
        ("relative_power_8_12", "power, 8 to 12\N{NO-BREAK SPACE}Hz (1e-6 mean²)", 1e6),
        ("share_8_12", "share of variance, 8 to 12\N{NO-BREAK SPACE}Hz (%)", 100),
    ):
        m = target.measured[name].times(scale)
        assert f"{words} | {m.in_words()} | {m.interval_in_words()} |" in text
        assert name not in text


def test_one_model_alone_was_not_tried_against_others(tmp_path):
    fit_report(made_result(ladder=()), plt.figure(), tmp_path)
    assert "Models tried" not in told(tmp_path)[0]


ADVICE = {
    "good": (made_result(), "yes", "jaxmuscle posterior"),
    "failed": (failed_result(), "no", "Do not use these numbers."),
    "unknown": (made_result(adequacy=None), "open", "--segments N"),
}


@pytest.mark.parametrize("case", ADVICE)
def test_what_to_do_depends_on_the_verdict(case, tmp_path):
    result, kind, words = ADVICE[case]
    fit_report(result, plt.figure(), tmp_path)
    text, seen = told(tmp_path)
    assert words in text.split("What to do next", 1)[1]
    assert [
        given["class"] for tag, given in seen.elements if "verdict" in given.get("class", "")
    ] == [f"verdict {kind}"]


def test_of_a_cohort(tmp_path):
    results = {
        HOSTILE: made_result(target=jm.Target(HOSTILE, POWER, segments=[6])),
        "b": failed_result(),
    }
    groups = {HOSTILE: "<b>old</b>", "b": "young"}
    found = jm.fits.CohortResult(results, groups, {"c": f"no file {HOSTILE}"})
    cohort_command._write(found, tmp_path, {HOSTILE: tmp_path / "a", "b": tmp_path / "b"}, ["png"])
    text, _ = told(tmp_path)
    assert f"{HOSTILE} | <b>old</b> | corner_frequency | 0.333 ± 0.01 | Hz" in text
    assert f"not fitted: no file {HOSTILE}" in text and "What differs between groups" in text
    result = results[HOSTILE]
    chi2 = result.adequacy.chi2 / result.data
    assert f"| {HOSTILE} | <b>old</b> | 0.333 ± 0.010 | {chi2:.2f} | 0.86 | 0.4 | described" in text
    printed = str(found).splitlines()
    assert printed[0].startswith("COHORT  3 targets (<b>old</b> 1; young 1)")
    assert any(line.endswith(f"{chi2:.2f} (0.86)  0.4  described") for line in printed)
    assert f"  not fitted: c: no file {HOSTILE}" in " ".join(str(found).split("\n    "))
    assert not (tmp_path / "a" / "report.html").exists()


def test_of_a_study(tmp_path):
    """The figures, then the tables; n and left out in every row; the clearest comparison first."""
    study = made_study(left_out=("old1, tired",))
    study_report(study, tmp_path)
    text, seen = told(tmp_path)
    tags = [tag for tag, _ in seen.elements]
    assert tags.index("img") < tags.index("table")
    assert "CV: coefficient of variation" in text and "| young, rest (n = 5) |" in text
    for kind in ("groups", "conditions", "interaction"):
        found = [d for d in study.differences() if d.kind == kind]
        first = min(found, key=lambda d: (d.p_corrected, d.p))
        number, interval = difference_in_words(first)
        where = [first.where] * bool(first.where)
        n = "9" if kind == "conditions" else "+".join(map(str, first.members))
        p = [p_in_words(p) for p in (first.p, first.p_corrected)]
        cells = [first.quantity, *where, f"{first.b} - {first.a}", number, interval, *p, n]
        row = " | ".join([*cells, str(first.left_out)])
        assert row in text.split(KINDS[kind][0])[1], row
    assert study.methods() in text and "differences.csv and trials.csv" in text
    row = "old1 | old, tired | 2 | 2.csv | force | 100 | 1.00 | 9.00 | given"
    assert "| 40 recordings |" in text and row in text


@pytest.mark.parametrize(
    ("rejected", "kind"), [((), "yes"), (("old1, tired",), "no")], ids=["all", "but one"]
)
def test_the_headline_of_a_study_has_the_colour_of_its_worst_fit(rejected, kind, tmp_path):
    study = made_study(rejected=rejected)
    study_report(study, tmp_path)
    text, seen = told(tmp_path)
    (headline,) = (g["class"] for _, g in seen.elements if "verdict" in g.get("class", ""))
    assert headline == f"verdict {kind}"
    result = study.cohort.results["old1, tired"]
    chi2, expected = (
        f"{x / result.data:.2f}" for x in (result.adequacy.chi2, result.adequacy.expected)
    )
    said = f"not described: {result.adequacy.misfit}" if rejected else "described"
    row = f"old1, tired | {chi2} | {expected} | {format_p(result.adequacy.p)} | {said}"
    assert row in text.split("The fits")[1]


@pytest.mark.parametrize(
    ("p", "words"), [(2e-5, "<0.001"), (0.0123, "0.012"), (0.5, "0.50"), (1.0, "1.00"), (None, "")]
)
def test_p_values_have_the_digits_of_a_paper(p, words):
    assert p_in_words(p) == words


def posterior(success):
    row = {
        "median": 1.25,
        "low": 0.5,
        "high": 2.0,
        "r_hat": 1.001,
        "ess_bulk": 900.0,
        "ess_tail": 800.0,
    }
    rows = {
        "k_w": row | {"unit": "N/m^3", "determined": False},
        "corner_frequency": row | {"unit": "Hz", "determined": True},
    }
    target = jm.Target(HOSTILE, POWER, segments=[6])
    return SimpleNamespace(
        success=success,
        message="4 chains mixed" if success else "R-hat 1.4",
        title=HOSTILE,
        settings={"chains": 4},
        seed=1,
        versions={"jaxmuscle": "0.1"},
        parts={"a": SimpleNamespace(target=target)},
        summary=lambda: SimpleNamespace(rows=rows),
    )


@pytest.mark.parametrize("success", [True, False])
def test_of_a_posterior(success, tmp_path):
    figure = plt.figure(figsize=(1, 1))
    posterior_report(
        posterior(success), {"chains": figure}, tmp_path, {"chains": pixels_of(figure)}
    )
    text, seen = told(tmp_path)
    assert f"Posterior of {HOSTILE}" in text
    if success:
        first, second = text.split("What the data do not determine")
        assert (
            "corner_frequency | 1.25 | 0.5 to 2 | Hz | 1.001 | 800" in first
            and "k_w | 1.25" in second
        )
    else:
        assert "Do not use these draws." in text and "corner_frequency |" not in text
    assert [given["src"][:22] for tag, given in seen.elements if tag == "img"] == [
        "data:image/png;base64,"
    ]
