"""Differences between groups and between conditions, their intervals and p-values, corrected
for many comparisons. `_cohort.py` and `_study.py` call it.
"""

import dataclasses
import itertools
from collections.abc import Iterable, Iterator, Sequence

import equinox as eqx
import numpy as np
import scipy

from jaxmuscle._common.text import choices
from jaxmuscle.data._measure import Measure

from ._result import Estimate

Number = Estimate | Measure
CONFIDENCE = 0.95
CORRECTIONS = ("holm", "fdr", "none")


class Difference(eqx.Module):
    """Mean of `quantity` in group `b` minus that in group `a`, the `difference`, with its interval
    (`low`, `high`).

    The interval holds 95 %, or 1 - alpha in a study.

    All in `unit`; `members` is how many the groups have; `p`, how often chance alone would give as
    much. `basis` says what interval and p stand on: "people", the spread within the groups (Welch's
    t; the fits' own errors are part of that spread), or "fits", the standard errors of the fits,
    where a group has one member only.

    In a study also: `kind`, "groups" (at `where`, a condition), "conditions" (`b` minus `a` within
    people) or "interaction" (the change between two conditions in group `b` minus that in group
    `a`; with `where` "tired - rest" the change is the value in tired minus that in rest);
    `p_corrected` for all comparisons of that kind, measured ones and the model's apart; `left_out`,
    people of whom the quantity is not known: they show no tremor, or the data do not determine it,
    or the model does not describe them.
    """

    quantity: str
    a: str
    b: str
    difference: float
    low: float
    high: float
    unit: str
    basis: str
    members: tuple[int, int]
    p: float
    kind: str = "groups"
    where: str = ""
    p_corrected: float | None = None
    left_out: int = 0


def difference(
    quantity: str,
    a: tuple[str, Sequence[Number]],
    b: tuple[str, Sequence[Number]],
    confidence: float = CONFIDENCE,
) -> Difference:
    """Of the means of two groups of people, by Welch's t; by the fits' standard errors where one
    has a single member."""
    left, right = ([e.value for e in members] for _, members in (a, b))
    middle = float(np.mean(right) - np.mean(left))
    if len(left) > 1 and len(right) > 1:
        test = scipy.stats.ttest_ind(right, left, equal_var=False)
        interval, p, basis = test.confidence_interval(confidence), test.pvalue, "people"
    else:
        parts = [
            sum((e.stderr or 0.0) ** 2 for e in members) / len(members) ** 2
            for _, members in (a, b)
        ]
        law = scipy.stats.norm(middle, np.sqrt(sum(parts)))
        low, high = law.interval(confidence)
        interval, p, basis = (low, high), 2 * min(law.cdf(0.0), law.sf(0.0)), "fits"
    low, high = map(float, interval)
    return Difference(
        quantity,
        a[0],
        b[0],
        middle,
        low,
        high,
        a[1][0].unit,
        basis,
        (len(left), len(right)),
        float(p),
    )


def between_groups(
    quantity: str,
    groups: Iterable[str],
    numbers: Sequence[tuple[str, Number | None]],
    confidence: float = CONFIDENCE,
    *,
    kind: str = "groups",
    where: str = "",
    single: bool = False,
) -> Iterator[Difference]:
    """Every two groups that both have two members with a number; members without one, None among
    the `numbers`, are `left_out`.

    With `single` also a group of one, where all numbers have an error: that is then all there is.
    """
    for pair in itertools.combinations(groups, 2):
        a, b = ((group, [e for g, e in numbers if g == group and e is not None]) for group in pair)
        fewest = min(len(a[1]), len(b[1]))
        sure = single and fewest and all(e.stderr is not None for e in (*a[1], *b[1]))
        if fewest > 1 or sure:
            found = difference(quantity, a, b, confidence)
            left_out = sum(group in pair and e is None for group, e in numbers)
            yield dataclasses.replace(found, kind=kind, where=where, left_out=left_out)


def paired(
    quantity: str, a: str, b: str, changes: Sequence[Number], confidence: float = CONFIDENCE
) -> Difference:
    """Of two conditions, from every person's change from `a` to `b`, by the paired t."""
    values = [change.value for change in changes]
    test = scipy.stats.ttest_1samp(values, 0.0)
    low, high = map(float, test.confidence_interval(confidence))
    members = len(values), len(values)
    return Difference(
        quantity,
        a,
        b,
        float(np.mean(values)),
        low,
        high,
        changes[0].unit,
        "people",
        members,
        float(test.pvalue),
        "conditions",
    )


def change(a: Number, b: Number) -> Estimate:
    """What one person's quantity does from one condition to the other, the fits' errors taken as
    independent."""
    return Estimate(b.value - a.value, a.unit, float(np.hypot(a.stderr or 0.0, b.stderr or 0.0)))


def corrected(family: Sequence[Difference], correction: str) -> list[Difference]:
    """The same comparisons with `p_corrected` for all of them together.

    "holm" bounds the chance of any false positive (Holm 1979, Scand J Stat 6:65-70), "fdr" the
    expected share of false among the positive ones (Benjamini & Hochberg 1995, J R Stat Soc B
    57:289-300), "none" nothing.

    **Raises:** `ValueError` for another `correction`.
    """
    if correction not in CORRECTIONS:
        raise ValueError(f"correction = {correction!r}: {choices(str(correction), CORRECTIONS)}")
    if not family:
        return []
    p = np.nan_to_num([each.p for each in family], nan=1.0)  # no spread and no difference
    if correction == "holm":
        order = np.argsort(p)
        steps = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
        p[order] = np.minimum(steps, 1.0)
    elif correction == "fdr":
        p = scipy.stats.false_discovery_control(p)
    return [
        dataclasses.replace(each, p_corrected=float(value))
        for each, value in zip(family, p, strict=True)
    ]
