"""What the models that were tried are said to gain."""

from jaxmuscle.comparison._comparison import NEEDED
from jaxmuscle.fits._ladder import Rung
from jaxmuscle.reports._ladder_text import gain_sentences, skipped_models


def tried(*aics: tuple[int, float], chosen: int) -> tuple[Rung, ...]:
    """Models of these numbers and AICs; the chi² of each is a tenth of the distance of its AIC from
    -100."""
    return tuple(Rung(n, f"{n}", aic, 5.0, (aic + 100) / 10, 0.3, n == chosen) for n, aic in aics)


def test_every_part_of_the_chosen_model_says_what_it_gains_over_the_poorer_one():
    said = gain_sentences(
        tried((0, -10.0), (1, -60.0), (2, -59.5), (3, -90.0), chosen=2), describes=True
    )
    assert said[:-1] == (
        "with activation the AIC falls by 50.0 (chi2 per bin 4.00 instead of 9.00)",
        (
            "with a resonance instead of the harmonic the AIC rises by 0.5 (chi2 per bin 4.05"
            " instead of 4.00)"
        ),
    )
    assert "A richer model can fit worse here" in said[-1]
    assert (
        f"2 or less says nothing. jaxmuscle compare is stricter: it needs at least {NEEDED:g}, and"
        in said[-1]
    )
    assert "no p-value" in said[-1] and "No model" not in said[-1]


def test_what_a_part_gains_is_counted_from_the_best_model_without_it():
    worse = gain_sentences(tried((0, -60.0), (1, -50.0), (2, -90.0), chosen=2), describes=True)
    assert worse[:-1] == (
        "with activation the AIC rises by 10.0 (chi2 per bin 5.00 instead of 4.00)",
        (
            "with a resonance instead of the harmonic the AIC falls by 30.0 against the best model"
            " before (0) (chi2 per bin 1.00 instead of 4.00)"
        ),
    )


def test_a_model_that_is_missing_in_the_table_is_explained():
    (said,) = skipped_models(tried((0, -10.0), (2, -60.0), chosen=2))
    assert (
        said
        == "model 0 already describes the data, so model 1 was not tried. But the harmonic of model"
        " 0 is significant (p < 0.05) and may be a tremor, so model 2 was tried as well"
    )
    assert skipped_models(tried((0, -10.0), (1, -20.0), chosen=1)) == ()
    failed = tuple(rung._replace(p=0.001) for rung in tried((0, -10.0), (2, -60.0), chosen=2))
    assert skipped_models(failed) == ()  # it was tried, and had no finite spectrum


def test_what_was_not_tried_is_counted_with_the_next_model():
    gain, _ = gain_sentences(tried((0, -10.0), (2, -60.0), chosen=2), describes=True)
    assert gain.startswith(
        "with activation and with a resonance instead of the harmonic the AIC falls by 50.0 ("
    )
    gain, _ = gain_sentences(tried((-1, -10.0), (0, -20.0), chosen=0), describes=True)
    assert gain.startswith("with a harmonic the AIC falls by 10.0 (")


def test_nothing_is_gained_where_the_simplest_model_was_chosen_or_only_one_was_fitted():
    assert gain_sentences(tried((0, -10.0), (2, -10.5), chosen=0), describes=True) == ()
    assert (
        gain_sentences(tried((2, -10.0), chosen=2), describes=True)
        == gain_sentences((), describes=None)
        == ()
    )


def test_where_no_model_describes_the_data_a_lower_aic_does_not_show_a_part():
    *_, meaning = gain_sentences(tried((0, -10.0), (1, -60.0), chosen=1), describes=False)
    assert (
        "No model that was tried describes the data" in meaning
        and "not that the muscle has this part" in meaning
    )
