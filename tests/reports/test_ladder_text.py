"""Why a model was chosen, in words."""

from jaxmuscle.fits._result import Rung
from jaxmuscle.reports._ladder_text import explain_choice


def tried(*models: tuple[int, float], chosen: int) -> tuple[Rung, ...]:
    """Models of these numbers and chi²; only the last one describes the data."""
    last = models[-1][0]
    return tuple(
        Rung(n, f"model {n}", -10.0, 5.0, chi2, 0.3 if n == last else 0.002, n == chosen)
        for n, chi2 in models
    )


def test_a_tremor_that_is_seen_is_why_the_first_model_has_a_resonance():
    (said,) = explain_choice(tried((2, 1.0), chosen=2), tremor=True)
    assert said == "the spectrum shows a tremor, so the first model tried has a resonance"
    (said,) = explain_choice(tried((3, 1.0), chosen=3), tremor=True)
    assert said.endswith("and a slower peak, so the first model tried has two resonances")
    assert explain_choice(tried((0, 1.0), chosen=0)) == explain_choice(()) == ()


def test_a_line_is_said_to_be_tried_beside_a_narrow_resonance():
    said = explain_choice(tried((0, 1.0), (2, 1.2), chosen=0), tremor=True)
    assert [words.split(",")[0] for words in said] == [
        "the spectrum shows a tremor",
        "that came out narrower than a bin",
        "the model with the lowest AIC was taken",
    ]


def test_models_that_no_peak_asks_for_are_said_to_be_tried_for_the_description():
    for ladder, tremor, poorer in (
        (tried((0, 2.0), (1, 1.5), chosen=1), False, "model 0"),
        (tried((2, 2.0), (3, 1.5), chosen=3), True, "model 2"),
        (tried((0, 2.0), (1, 1.5), (2, 1.4), chosen=2), False, "model 0"),
    ):
        *_, said, last = explain_choice(ladder, tremor=tremor)
        assert said.startswith(f"{poorer} does not describe the data (p = 0.002). Richer models")
        assert "for the description alone" in said and "lowest AIC" in last


def test_a_richer_model_that_fits_worse_is_said_to_do_so():
    *_, said = explain_choice(tried((0, 2.0), (1, 1.5), (2, 1.75), chosen=2), "datum")
    assert said == "model 2 fits worse than model 1 (chi2 per datum 1.75 against 1.50)"
    better = explain_choice(tried((0, 2.0), (1, 1.5), (2, 1.75), chosen=1))
    assert not any("worse" in words for words in better)
