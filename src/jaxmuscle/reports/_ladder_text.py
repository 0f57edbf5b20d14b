"""The models that a fit tried, as a table and in sentences."""

import itertools

from jaxmuscle._common.text import probability
from jaxmuscle.fits._result import Rung
from jaxmuscle.model._rungs import QUIET, REFLEX, RICHER


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


def explain_choice(
    ladder: tuple[Rung, ...], datum: str = "bin", *, tremor: bool = False
) -> tuple[str, ...]:
    """Why the models were tried, in sentences: for a `tremor` that is seen, or for the description
    alone; and where a richer one fits worse.

    `datum`, what chi² is counted for.
    """
    chosen = next((rung for rung in ladder if rung.chosen), None)
    if chosen is None:
        return ()
    numbers, said = [rung.number for rung in ladder], list[str]()
    first = next((n for n in numbers if tremor and n >= RICHER["resonance"]), numbers[0])
    if tremor and first >= RICHER["resonance"]:
        slower = first > RICHER["resonance"]
        said.append(
            f"the spectrum shows a tremor{' and a slower peak' * slower}, so the first model tried"
            f" has {'two resonances' if slower else 'a resonance'}"
        )
    if any(rung.model.endswith(REFLEX) for rung in ladder):
        said.append("the response shows a stretch reflex, so it was fitted, too")
    if numbers[0] == QUIET and numbers[-1] > QUIET:
        said.append("the slow part alone was fitted first. Its spectrum shows a line, or it misses")
        said[-1] += " the data: so richer models were tried"
    elif numbers[0] < first:
        said.append(
            "that came out narrower than a bin, so models with a line of zero width were tried, too"
        )
    elif numbers[-1] > first:
        poorer = next(rung for rung in ladder if rung.number == first)
        said.append(
            f"{poorer.model} does not describe the data ({probability(poorer.p)}). Richer models"
            " were tried for the description alone: no further peak asks for them"
        )
    if len(ladder) > 1:
        said.append("the model with the lowest AIC was taken")
    said += [
        f"{after.model} fits worse than {before.model} (chi2 per {datum} {after.chi2_per_bin:.2f}"
        f" against {before.chi2_per_bin:.2f})"
        for before, after in itertools.pairwise(ladder)
        if after.number <= chosen.number and after.chi2_per_bin > before.chi2_per_bin
    ]
    return tuple(said)
