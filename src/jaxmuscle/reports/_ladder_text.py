"""The models that a fit tried, as a table and in sentences."""

import itertools

from jaxmuscle._common.text import probability
from jaxmuscle.fits._adequacy import ADEQUATE
from jaxmuscle.fits._harmonic_evidence import SIGNIFICANT
from jaxmuscle.fits._ladder import ALIKE, Rung
from jaxmuscle.model._rungs import QUIET, rung_name


def ladder_table(ladder: tuple[Rung, ...], datum: str) -> list[str]:
    """A row for each model below a head, nothing of a single one; `datum`, what chi² is counted
    for: a bin, or else any number of the data."""
    if len(ladder) < 2:
        return []
    title = "models tried, by formula alone (-> the result)"
    rows = [
        f"{'->' if rung.chosen else '  '} {rung.number} {rung.model:<42}{rung.chi2_per_bin:>9.2f}"
        f"{format_p(rung.p):>9}{rung.aic:>9.1f}"
        for rung in ladder
    ]
    return [f"{title:<46}{f'chi2/{datum}':>10}{'p':>9}{'AIC':>9}", *rows]


def format_p(p: float) -> str:
    """A p-value as it stands in a table: "<= 0.001" for the least that replicates can show."""
    return probability(p).removeprefix("p ").removeprefix("= ")


def gain_sentences(
    ladder: tuple[Rung, ...], *, describes: bool | None, datum: str = "bin"
) -> tuple[str, ...]:
    """What every part of the chosen model gains over the best model without it, in sentences; and
    what such a number says.

    `describes`: whether the chosen model describes the data; `datum`, what chi² is counted for.
    """
    number = next((rung.number for rung in ladder if rung.chosen), QUIET)
    climbed = tuple(rung for rung in ladder if rung.number <= number)
    said = tuple(_gain(climbed[:i], after, datum) for i, after in enumerate(climbed) if i)
    if not said:
        return ()
    meaning = (
        "the AIC weighs how well a model fits against its number of parameters: lower is better. A"
        f" difference of {ALIKE:g} or less says nothing. jaxmuscle compare is stricter: it needs at"
        " least 6, and the richer model must also predict bins better that were left out of its"
        " fit. The AIC is no p-value"
    )
    if any(after.aic > before.aic for before, after in itertools.pairwise(climbed)) and number > 0:
        meaning += (
            ". A richer model can fit worse here, since models with activation or resonance keep"
            " stiffness and damping nearer to their usual values"
        )
    if describes is False:
        meaning += (
            ". No model that was tried describes the data: then a lower AIC says that a model"
            " misses less, not that the muscle has this part"
        )
    return (*said, meaning)


def skipped_models(ladder: tuple[Rung, ...]) -> tuple[str, ...]:
    """Which models between those of a table are missing there, and why, in sentences."""
    return tuple(
        f"model {before.number} already describes the data, so model {number} was not tried. But"
        f" the harmonic of model {before.number} is significant (p < {SIGNIFICANT:g}) and may be a"
        f" tremor, so model {after.number} was tried as well"
        for before, after in itertools.pairwise(ladder)
        if before.p >= ADEQUATE
        for number in range(before.number + 1, after.number)
    )


def _gain(poorer: tuple[Rung, ...], after: Rung, datum: str) -> str:
    """AIC and chi² of a model against those of the best of the poorer ones."""
    last, best = poorer[-1], min(poorer, key=lambda rung: rung.aic)
    added = " and ".join(
        "with a harmonic" if n == 0 else rung_name(n)
        for n in range(last.number + 1, after.number + 1)
    )
    change = after.aic - best.aic
    against = "" if best is last else f" against the best model before ({best.model})"
    return (
        f"{added} the AIC {'falls' if change < 0 else 'rises'} by {abs(change):.1f}{against} (chi2"
        f" per {datum} {after.chi2_per_bin:.2f} instead of {best.chi2_per_bin:.2f})"
    )
