"""The text of a fit, and its table in a notebook."""

import numpy as np
import pytest
from test_result import POWER, failed_result, made_result

import jaxmuscle as jm
from jaxmuscle.fits import Estimate
from jaxmuscle.fits._adequacy import Adequacy
from jaxmuscle.reports._fit_text import _table, fit_card


@pytest.mark.parametrize("whose", ["", "@a"])
@pytest.mark.parametrize("free", [True, False])
def test_a_tremor_is_listed_once_by_the_name_that_people_use(free, whose):
    frequency = Estimate(9.0, "Hz", 0.2 if free else None, free, free or None)
    result = made_result(
        parameters={
            f"resonance_frequency{whose}": frequency,
            "harmonic_frequency": frequency,
            "m_w": Estimate(1.0, "kg"),
        },
        derived={
            f"tremor_frequency{whose}": frequency,
            "harmonic_frequency": frequency,
            "mean": Estimate(2.5, "N"),
        },
    )
    kinds = result.to_dataframe().set_index("quantity")["kind"].to_dict()
    assert kinds == {
        "harmonic_frequency": "parameter",
        "m_w": "parameter",
        f"tremor_frequency{whose}": "parameter",
        "mean": "derived",
    }
    names = [row[0] for row in fit_card(result).rows]
    assert f"tremor_frequency{whose}" in names and f"resonance_frequency{whose}" not in names
    assert result[f"resonance_frequency{whose}"] == frequency  # by either name


def test_the_table_of_a_failed_fit_has_numbers_in_its_columns_of_numbers():
    table = failed_result().to_dataframe()
    assert list(table.dtypes[["value", "stderr", "low", "high"]]) == [float] * 4
    assert np.isnan(table.set_index("quantity")["value"]["mean"])


def test_text_shows_what_is_known_and_what_is_not():
    text = str(made_result())
    first, second, *_ = text.splitlines()
    assert first == "The model describes the data: chi2 per bin 0.90 (expected 0.86), p = 0.4"
    assert second == "  made (user), Isometric, BandLimitedNoise, method montecarlo"
    words = " ".join(text.split())
    for part in (
        "converged: 1 of 2 starts reach a fit as good as this (cost within 5 %)",
        "c_w 6.667 ± 0.013",  # 16.667 N over a mean of 2.5 N
        "corner_frequency 0.333 ± 0.010 above 0.31 Hz",
        "though not each factor alone (jaxmuscle identifiability has values): k_w / c_w",
        "not determined: do not interpret these values (per newton of mean force): k_w",
        "the data leave open: - all stiffness and damping can be multiplied by one number",
        (
            "stiffness and damping are stated here per newton of mean force. In fit.json (Python:"
            " result['K_w0'], to_dataframe()) they are those of a model muscle that pulls with 2.5"
            " N: divide by 2.5 N"
        ),
        "note: a notice",
    ):
        assert part in words
    assert words.index("determined by the data") < words.index("not determined: do not")
    assert made_result()["c_w"].value / made_result()["mean"].value == pytest.approx(
        6.667, abs=5e-4
    )
    assert str(failed_result()).startswith("Not fitted: no start has a finite spectrum")


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
        "Hann window, 256 samples, 50 % overlap",
        "from 0.39 to 11.72 Hz",
        "describes the data: chi2 per bin 0.90 (expected 0.86), p = 0.4",
        "(standard deviations): k_w 5e+05 N/m^3 (1).",
        "with activation (chi2 per bin 0.90, p = 0.3, AIC -260.0)",
        "Held fixed were",
        "m_w = 0.5 kg",
        "Software: jaxmuscle 0.1, jax 0.8",
    ):
        assert words in said, (words, said)
    assert "nan" not in said and "None" not in said
    assert "We analysed the force spectrum made" in made_result().methods()
    assert made_result(success=False).methods() is None


def test_text_counts_trials_and_segments_and_tells_how_much_the_trials_differ():
    def printed(**given):
        return str(made_result(target=jm.Target("made", POWER, **given))).splitlines()

    assert "  2 trials, 13 Welch segments" in printed(segments=[6, 7])
    alike = "  2 trials, 13 Welch segments, dispersion 1.12 ± 0.08 (1 if they are alike)"
    assert alike in printed(segments=[6, 7], dispersion=[1.12, 0.08])
    assert not any(
        "trials" in line for given in ({}, {"segments": [12]}) for line in printed(**given)
    )


def test_the_text_and_the_report_say_what_a_richer_model_gains():
    said = "with activation the AIC falls by 9.9 (chi2 per bin 0.90 instead of 1.90)"
    found = made_result()
    assert f"  {said}" in str(found).splitlines() and said in found.summary().remarks
    assert not any(
        "AIC" in words
        for words in (str(made_result(ladder=())), *made_result(ladder=()).summary().remarks)
    )


def test_numbers_that_are_read_in_two_ways_are_said_in_both():
    """A variation also in percent; a share of the tremor with the frequency from which it
    counts."""
    derived = {
        "tremor_frequency": Estimate(9.28, "Hz", 0.11),
        "tremor_share": Estimate(0.0133, "1", 0.0033),
        "coefficient_of_variation": Estimate(0.02013, "1", 0.00078),
    }
    text = str(made_result(derived=derived))
    rows = {line.split()[0]: line for line in text.splitlines() if "±" in line}
    assert rows["tremor_share"].endswith("0.0133 ± 0.0033")
    assert "\n  tremor_share: counted from 4.6 Hz on, half of the tremor's frequency\n" in text
    assert rows["coefficient_of_variation"].endswith("= 2.01 %")
    assert rows["tremor_frequency"].endswith(" Hz")
    alone = {"tremor_share": Estimate(0.0133, "1", 0.0033)}  # the frequency is not determined
    assert not any(word in str(made_result(derived=alone)) for word in ("above", "counted from"))


def test_a_long_interval_is_set_apart_from_its_unit():
    rows = {"k_z": Estimate(3.27e6, "N/m^3", 3.8e5, interval=(2.85e6, 4.16e6))}
    assert _table("determined by the data", rows, "95 % interval")[1].endswith(
        " 2.85e+06 to 4.16e+06 N/m^3"
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
        text = " ".join(str(made_result(derived={"half_power_frequency": found})).split())
        assert (words in text) == (found is wide)


def test_a_fit_that_misses_the_data_says_so_first():
    missed = Adequacy(
        145.0,
        25.0,
        0.001,
        "the data have more power than the model from 7 to 9 Hz (12.0 standard errors)",
    )
    found = made_result(adequacy=missed, chi2_per_bin=5.0)
    first, *rest = str(found).splitlines()
    assert found.adequate is False and found.adequacy_p == 0.001
    assert first.startswith(
        "The model does not describe the data: chi2 per bin 5.00 (expected 0.86), p"
    )
    words = " ".join(" ".join(rest).split())
    for part in (
        f"errors are widened by a factor of {np.sqrt(145 / 25):.2g}",
        "Not widened, since measured directly: coefficient of variation",
        "what to do: do not interpret",
        "would be determined if the model held (per newton of mean force):",
    ):
        assert part in words
    unknown = made_result(adequacy=None, chi2_per_bin=None)
    assert unknown.adequate is None and "the data cannot be judged: the target" in " ".join(
        str(unknown).split()
    )


def test_text_fits_a_terminal():
    """Also with long sentences: nothing is lost, and what goes on is further in."""
    text = str(made_result(notices=("word " * 40,), message="a long message " * 10))
    assert max(map(len, text.splitlines())) <= 80 and text.count("word") == 40
    assert all(
        line.startswith("    word") for line in text.splitlines() if line.strip().startswith("word")
    )
    for name in jm.list_targets():
        assert max(map(len, str(jm.load_target(name)).splitlines())) <= 80
