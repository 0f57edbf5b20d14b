"""A cohort in words: a line for each target."""

from jaxmuscle._common.cards import Card, in_columns
from jaxmuscle._common.text import folded
from jaxmuscle.fits._cohort import CohortResult


def cohort_card(cohort: CohortResult) -> Card:
    """Every target with its verdict, or why it was not fitted."""
    columns = ("target", "group", "in words")
    rows = [
        (name, cohort.groups.get(name, ""), result.verdict)
        for name, result in cohort.results.items()
    ]
    rows += [
        (name, cohort.groups.get(name, ""), f"not fitted: {why}")
        for name, why in cohort.failed.items()
    ]
    heading = f"{len(rows)} targets: {cohort.verdict}"
    return Card(
        "\n".join([folded([heading]), *in_columns(columns, rows)]),
        heading,
        columns,
        tuple(rows),
    )
