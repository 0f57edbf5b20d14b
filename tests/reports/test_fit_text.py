"""The text of a fit, and its table in a notebook."""

import functools

import numpy as np
import pytest
from test_result import POWER, failed_result, made_result
from test_steadiness import trials

import jaxmuscle as jm
from jaxmuscle.fits import Estimate
from jaxmuscle.fits._result import Adequacy
from jaxmuscle.reports._fit_text import _table, fit_card, unknown_kinds


@pytest.mark.parametrize("whose", ["", "@a"])
@pytest.mark.parametrize("free", [True, False])
def test_what_is_parameter_and_derived_is_listed_once_by_the_name_that_people_use(free, whose):
    tremor = Estimate(9.0, "Hz", 0.2 if free else None, free, free or None)
    time = Estimate(0.05, "s", 0.01 if free else None, free, free or None)
    result = made_result(
        parameters={
            f"resonance_frequency{whose}": tremor,
            f"activation_time{whose}": time,
            "harmonic_frequency": tremor,
            "m_w": Estimate(1.0, "kg"),
        },
        derived={
            f"contraction_time{whose}": time,
            f"resonance_frequency{whose}": tremor,
            "harmonic_frequency": tremor,
            "model_mean": Estimate(2.5, "N"),
        },
    )
    table = result.to_dataframe()
    kinds = table[table["kind"] != "measured"].set_index("quantity")["kind"].to_dict()
    own = [f"contraction_time{whose}", f"resonance_frequency{whose}", "harmonic_frequency", "m_w"]
    assert kinds == dict.fromkeys(own, "parameter") | {"model_mean": "derived"}
    names = [row[0] for row in fit_card(result).rows]
    assert all(names.count(name) == 1 for name in own[:2])
    assert f"activation_time{whose}" not in names
    assert result[f"activation_time{whose}"] == result[f"contraction_time{whose}"] == time


def test_the_table_of_a_failed_fit_has_numbers_in_its_columns_of_numbers():
    table = failed_result().to_dataframe()
    assert list(table.dtypes[["value", "stderr", "low", "high"]]) == [float] * 4
    assert np.isnan(table.set_index("quantity")["value"]["model_mean"])


PER_NEWTON = "Forces, masses, stiffness and damping are stated per newton of mean force"
VERDICT = "MODEL slow part + regular rhythm: fits, p = 0.4"
CONVERGED = "converged: 1 of 2 starts reach a fit as good as this (cost within 5 %)"


def words_of(text):
    return " ".join(text.split())


def test_everything_shows_what_is_known_and_what_is_not():
    words = words_of(made_result().details())
    for part in (
        VERDICT,
        "chi2 per bin 0.90 (expected 0.86)",
        CONVERGED,
        "2 trials, 13 Welch segments",
        "c_w 6.667 ± 0.013",  # 16.667 N over a mean of 2.5 N
        "corner_frequency 0.333 ± 0.010 above 0.310 Hz",
        "not determined: do not interpret these values (per newton of mean force): k_w",
        "the data leave open: - all stiffness and damping can be multiplied by one number",
        PER_NEWTON,
        "note: a notice",
        "note: why a number is not stated",
    ):
        assert part in words
    assert words.index("determined by the data") < words.index("not determined: do not")
    assert "2.5 N" not in words  # nobody's force
    assert made_result()["c_w"].value == pytest.approx(16.667 / 2.5, rel=1e-4)


def test_the_text_of_a_spectrum_is_short():
    """What was read, what is measured, the verdict, what is known of the model, what is not, what
    to look at; and where the rest is."""
    text = str(made_result())
    in_order = (
        "made spectrum of force (user), 30 bins, 13 segments",
        "MEASURED 95 % interval",
        "coefficient of variation 2 %",
        "median frequency",
        VERDICT,
        "regular rhythm (harmonic) none seen, p = 0.08",
        "c_w 6.667 ± 0.013",
        "(per newton of mean force)",
        "NOT KNOWN from these data: active stiffness",
        "CHECK a notice",
        "All numbers: print(result.details())",
    )
    words = words_of(text)
    places = [words.index(part) for part in in_order]
    assert places == sorted(places)
    for absent in (
        "tried",
        "AIC",
        "leave open",
        "corner_frequency",
        "k_w",
        "why a number",
        "2.5 N",
    ):
        assert absent not in words
    assert words_of(str(failed_result())).count("not fitted: no start has a finite spectrum") == 1


NOTICES = tuple(f"notice {i} of many. What to do about it" for i in range(9))


@pytest.mark.parametrize("case", ["describes", "misses"])
def test_the_text_of_a_fit_fits_a_small_terminal(case):
    """24 lines with the one that says what was written; 12 where the model misses."""
    derived = {
        "resonance_frequency": Estimate(9.28, "Hz", 0.11, interval=(9.1, 9.5)),
        "half_power_frequency": Estimate(0.94, "Hz", 0.12, interval=(0.7, 1.2)),
        "model_mean": Estimate(2.5, "N", None, True, False),
    }
    found = of_recordings(derived=derived, notices=NOTICES, **JUDGED[case])
    lines = str(found).splitlines()
    assert len(lines) < (12 if case == "misses" else 24) and max(map(len, lines)) <= 80
    said = [line for line in lines if line.startswith("CHECK  ")]
    hidden = len(NOTICES) + 1 - len(said)  # and that of a single recording
    assert len(said) == (0 if case == "misses" else 3) and f", {hidden} more notices: " in lines[-1]
    assert not any("What to do" in line for line in lines)


@pytest.mark.parametrize(
    ("notice", "words"),
    [
        ("the torque was divided. So it is a force", "the torque was divided"),
        ("2.80 s to 19.19 s. Give a window", "2.80 s to 19.19 s"),
        (f"K_w is negative for 20 % of the time, impossible: {'too strong ' * 6}", None),
        (f"held: {'word ' * 20}", None),
    ],
)
def test_a_check_is_the_first_sentence_and_of_a_long_one_what_stands_before_the_colon(
    notice, words
):
    long = notice.startswith("K_w")
    words = words or (notice.partition(": ")[0] if long else notice)
    text = words_of(str(made_result(notices=(notice,))))
    assert f"CHECK {words_of(words)} All numbers: " in text


def test_the_methods_paragraph_says_what_a_reader_needs_to_repeat_the_fit():
    source = (
        "2 trials: a.csv, column F, 1000 Hz, window 5.8 s to 23.5 s; b.csv, column F, 1000 Hz,"
        " window 5 s to 23.6 s"
    )
    settings = jm.SpectrumSettings(filter_direction="both", sampling="filtered")
    target = jm.Target("made", np.ones(30), segments=[12, 14], source=source, settings=settings)
    said = made_result(target=target).methods()
    for words in (
        (
            "2 recordings of force (26 Welch segments), sampled at 1000 Hz: a part of 17.7 to 18.6"
            " s of each"
        ),
        "Butterworth, order 9, 30 Hz, forwards and backwards",
        "Hann window, 256 samples or 2.56 s, 50 % overlap, mean of each segment removed",
        "from 0.39 to 11.72 Hz",
        "describes the data: chi2 per bin 0.90 (expected 0.86), p = 0.4",
        # over the mean of 2.5 N of the model, as in its table
        "(standard deviations): k_w 2e+05 1/m^3 (1).",
        "slow part + twitch + regular rhythm (chi2 per bin 0.90, p = 0.3, AIC -260.0)",
        "Held fixed were",
        "m_w = 0.2 kg/N",
        "Software: jaxmuscle 0.1 (The jaxmuscle developers; see its CITATION.cff), jax 0.8",
    ):
        assert words in said, (words, said)
    assert "nan" not in said and "None" not in said
    assert "We analysed the force spectrum made" in made_result().methods()
    assert made_result(success=False).methods() is None


def test_text_counts_trials_and_segments_and_tells_how_much_the_trials_differ():
    def printed(**given):
        return made_result(target=jm.Target("made", POWER, **given)).details().splitlines()

    assert "  2 trials, 13 Welch segments" in printed(segments=[6, 7])
    alike = "  2 trials, 13 Welch segments, dispersion 1.12 ± 0.08 (1 if they are alike)"
    assert alike in printed(segments=[6, 7], dispersion=[1.12, 0.08])
    assert not any(
        "trials" in line for given in ({}, {"segments": [12]}) for line in printed(**given)
    )


def test_the_text_and_the_report_say_why_a_richer_model_was_tried():
    said = "slow part + regular rhythm does not describe the data (p = 0.002). Richer models"
    found = made_result()
    assert said in " ".join(found.details().split())
    assert any(words.startswith(said) for words in found.summary().remarks)
    alone = made_result(ladder=())
    assert not any("Richer" in words for words in (alone.details(), *alone.summary().remarks))


def test_numbers_that_are_read_in_two_ways_are_said_in_both():
    """A variation also in percent; a share of the tremor with the frequency from which it
    counts."""
    derived = {
        "resonance_frequency": Estimate(9.28, "Hz", 0.11),
        "resonance_share": Estimate(0.0133, "1", 0.0033),
        "model_coefficient_of_variation": Estimate(0.02013, "1", 0.00078),
    }
    text = made_result(derived=derived).details()
    rows = {line.split()[0]: line for line in text.splitlines() if "±" in line}
    assert rows["resonance_share"].endswith("0.0133 ± 0.0033")
    assert "\n  resonance_share: counted from 4.6 Hz on, half of its frequency\n" in text
    assert rows["model_coefficient_of_variation"].endswith("= 2.01 %")
    assert rows["resonance_frequency"].endswith(" Hz")
    alone = {"resonance_share": Estimate(0.0133, "1", 0.0033)}  # the frequency is not determined
    text = made_result(derived=alone).details()
    assert not any(word in text for word in ("above", "counted from"))


def test_a_long_interval_is_set_apart_from_its_unit():
    rows = {"k_z": Estimate(3.27e6, "N/m^3", 3.8e5, interval=(2.85e6, 4.16e6))}
    assert _table("determined by the data", rows, "95 % interval")[1].endswith(
        " 2850000 to 4160000  N/m^3"
    )


def test_an_interval_that_is_wider_than_its_error_says_is_to_be_stated():
    wide = Estimate(0.94, "Hz", 0.12, interval=(0.3, 2.23))
    usual = Estimate(0.94, "Hz", 0.12, interval=(0.7, 1.2))
    half_open = Estimate(0.94, "Hz", 0.12, interval=(None, 2.23))
    words = (
        "half_power_frequency: the interval is much wider than two standard errors to both sides."
        " State the interval"
    )
    for found in (wide, usual, half_open):
        text = words_of(made_result(derived={"half_power_frequency": found}).details())
        assert (words in text) == (found is wide)


MISSED = Adequacy(
    145.0,
    25.0,
    0.001,
    "the data have more power than the model from 7 to 9 Hz (12.0 standard errors)",
)


def test_a_model_that_misses_the_data_prints_none_of_its_numbers():
    """But what is measured, and where the model fails."""
    found = made_result(adequacy=MISSED, chi2_per_bin=5.0, harmonic_p_value=None)
    assert found.adequate is False and found.adequacy_p == 0.001
    words = words_of(str(found))
    in_order = (
        "coefficient of variation 2 %",
        "MODEL slow part + regular rhythm: does NOT fit, p <= 0.001",
        "The data have more power than the model from 7 to 9 Hz (12.0 standard errors).",
        "Report only what is measured.",
    )
    places = [words.index(part) for part in in_order]
    assert places == sorted(places)
    names = {*found.parameters, *found.derived}
    assert not names & set(words.split())
    for absent in ("half-power", "NOT KNOWN", "AIC", "per newton"):
        assert absent not in words
    heading = "would be determined if the model held (per newton of mean force):"
    details = words_of(found.details())
    assert heading in details and "c_w" in found.details().split()
    assert f"standard errors are widened by a factor of {np.sqrt(145 / 25):.2g}:" in details


JUDGED = {
    "describes": {},
    "misses": {"adequacy": MISSED, "chi2_per_bin": 5.0},
    "unknown": {"adequacy": None, "chi2_per_bin": None},
    "failed": {"success": False, "adequacy": None, "chi2_per_bin": None},
}
VERDICTS = {
    "describes": "MODEL  slow part + regular rhythm: fits",
    "misses": "MODEL  slow part + regular rhythm: does NOT fit",
    "unknown": "MODEL  slow part + regular rhythm: cannot be judged",
    "failed": "MODEL  not fitted: ",
}
MEASURED = (
    "mean",
    "standard deviation",
    "coefficient of variation",
    "  without a straight drift",
    "median frequency",
    "sample entropy",
    "tremor, 6 to 12 Hz",
    "  size over the mean",
)


@functools.cache
def recorded():
    """One recording, its target, and what is measured of it."""
    (held,) = trials(1)
    return held.target(), jm.data.steadiness(held)


def of_recordings(**changes):
    target, _ = recorded()
    settings = made_result().settings | {"spectrum": target.settings.to_dict()}
    return made_result(target=target, settings=settings, **changes)


@pytest.mark.parametrize("case", JUDGED)
def test_what_is_measured_is_told_whatever_the_model_says(case, tmp_path):
    """As steadiness prints it; no error is widened."""
    found, (_, steady) = of_recordings(**JUDGED[case]), recorded()
    printed = [line.removeprefix("  ") for line in str(steady).splitlines()]
    rows = [line for line in printed if line.startswith(MEASURED)]
    assert len(rows) == len(MEASURED)
    short, whole = str(found).splitlines(), found.details().splitlines()
    verdict = next(i for i, line in enumerate(whole) if line.startswith(VERDICTS[case]))
    assert all(whole.index(f"  {row}") < verdict for row in rows)
    verdict = next(i for i, line in enumerate(short) if line.startswith(VERDICTS[case]))
    kept = ("mean", "coefficient of variation")
    kept += ("tremor, ", *(("  without", "median", "sample", "  size") * (case != "misses")))
    assert all(short.index(f"  {row}") < verdict for row in rows if row.startswith(kept))
    found.save(tmp_path / "fit.json")
    for result in (found, jm.load_result(tmp_path / "fit.json")):
        assert result.measured == steady.measures
        assert all(result[name] == m for name, m in steady.measures.items())
    table = found.to_dataframe().set_index("quantity")
    for name, m in steady.measures.items():
        assert table.loc[name, "value"] == m.value and table.loc[name, "kind"] == "measured"
        assert m.stderr is None or table.loc[name, "stderr"] == m.stderr


def test_of_recordings_few_numbers_of_the_model_are_printed():
    """The rhythms and the half-power frequency, with what is known against it; and no parameters,
    since one of several models was chosen for this target alone."""
    derived = {
        "resonance_frequency": Estimate(9.28, "Hz", 0.11, interval=(9.1, 9.5)),
        "resonance_share": Estimate(0.0133, "1", 0.0033),
        "half_power_frequency": Estimate(0.94, "Hz", 0.12, interval=(0.7, 1.2)),
        "model_mean": Estimate(2.5, "N", None, True, False),
        "band_8_12": Estimate(0.03, "1", 0.003),
    }
    words = words_of(str(of_recordings(derived=derived)))
    for part in (
        "resonance of the drive 9.28 ± 0.11 Hz 9.10 to 9.50",
        "half-power frequency 0.94 ± 0.12 Hz 0.70 to 1.20",
        "± is from within one recording",
        "the model was chosen for these data alone",
        "NOT KNOWN from these data: active stiffness",
    ):
        assert part in words
    for absent in ("c_w", "resonance_share", "per newton", "band"):
        assert absent not in words
    quiet = of_recordings(derived={"model_mean": derived["model_mean"]}, ladder=())
    assert "half-power" not in str(quiet) and "chosen" not in str(quiet)


def test_what_is_known_in_one_way_is_not_called_unknown():
    """Without the passive stiffness that is stated, both are one word."""
    loose = ["k_w", "K_w0", "k_z", "c_z", "resonance_width", "model_mean", "fibre_length@a"]
    assert unknown_kinds(loose, ["K_z0", "resonance_frequency"]) == [
        "active stiffness",
        "passive damping",
        "fibre_length",
    ]
    assert sorted(unknown_kinds(["k_z", "c_w", "K_w0"], [])) == ["active damping", "stiffness"]


def test_where_the_scatter_is_unknown_there_is_no_verdict_but_there_are_numbers():
    unknown = made_result(adequacy=None, chi2_per_bin=None)
    words = words_of(str(unknown))
    assert unknown.adequate is None and "cannot be judged: the target" in words
    assert "c_w 6.667 ± 0.013" in words


def test_text_fits_a_terminal():
    """Also with long sentences: nothing is lost, and what goes on is further in."""
    text = made_result(notices=("word " * 40,), message="a long message " * 10).details()
    assert max(map(len, text.splitlines())) <= 80 and text.count("word") == 40
    assert all(
        line.startswith("    word") for line in text.splitlines() if line.strip().startswith("word")
    )
    for name in jm.list_targets():
        assert max(map(len, str(jm.load_target(name)).splitlines())) <= 80


def test_of_a_fit_that_failed_no_number_of_the_model_is_printed():
    text = str(failed_result())
    assert "not fitted" in text.lower()
    assert "half-power" not in text and "NOT KNOWN" not in text
