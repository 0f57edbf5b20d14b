"""A statement of the papers beside our numbers: when the two agree, and what their agreement is
worth."""

import re
from collections.abc import Callable, Iterable
from typing import Literal, NamedTuple

from ._numbers import Reproduction

Verdict = Literal["agrees", "agrees within our resolution", "does not agree", "cannot be checked"]
AGREES, GRID, DIFFERS, UNCHECKED = (
    "agrees",
    "agrees within our resolution",
    "does not agree",
    "cannot be checked",
)
Kind = Literal["tests the model", "fitted", "put in", "arithmetic"]
TESTED, FITTED, GIVEN, ARITHMETIC = "tests the model", "fitted", "put in", "arithmetic"
KINDS: dict[Kind, str] = {
    TESTED: (
        "Nothing of it was put in, so it could have come out otherwise. Only these count for the"
        " model or against it."
    ),
    FITTED: (
        "The model was fitted to a curve made from it, or its parameters were chosen until it held."
        " Where it agrees, the model can do this; where it does not, it cannot."
    ),
    GIVEN: (
        "An input, a setting or a law that jaxmuscle assumes, or what follows from one whatever the"
        " muscle."
    ),
    ARITHMETIC: "It follows from the stated numbers alone, without a model.",
}
Numbers = tuple[float, ...]


class Claim(NamedTuple):
    """One statement: where it stands, what it says, our numbers and how they are shown, how they
    were obtained, the rule.

    `kind` is what an agreement is worth (`KINDS`). `why` is shown unless the verdict is a plain
    "agrees"; `words` and `why` are formats of the numbers.
    """

    key: str
    kind: Kind
    source: str
    says: str
    numbers: Callable[[Reproduction], Numbers]
    words: str
    how: str
    rule: Callable[..., Verdict]
    why: str = "because our numbers are outside what is stated"


class Row(NamedTuple):
    """A claim, checked."""

    key: str
    kind: Kind
    source: str
    says: str
    ours: str
    numbers: Numbers
    how: str
    verdict: Verdict
    why: str


def checked(claim: Claim, found: Reproduction) -> Row:
    """A claim with its numbers and its verdict."""
    numbers = tuple(float(x) for x in claim.numbers(found))
    verdict = claim.rule(*numbers)
    why = "" if verdict == AGREES else claim.why.format(*numbers)
    ours = re.sub(r"(?<=\d)%", " %", claim.words.format(*numbers))
    return Row(
        claim.key, claim.kind, claim.source, claim.says, ours, numbers, claim.how, verdict, why
    )


def counted(rows: Iterable[Row]) -> str:
    """How many statements there are, how many test the model, and what came of them, in one
    sentence."""
    rows = tuple(rows)
    tests = [row for row in rows if row.kind == TESTED]
    others = [(kind, [row for row in rows if row.kind == kind]) for kind in KINDS if kind != TESTED]
    beside = ", ".join(f"{len(some)} {kind}{_failed(some)}" for kind, some in others)
    return (
        f"Of {len(rows)} statements {len(tests)} test the model: {outcome(tests)}. Not counted for"
        f" it: {beside}."
    )


def outcome(rows: Iterable[Row]) -> str:
    """How many agree, how many do not, how many cannot be checked."""
    verdicts = [row.verdict for row in rows]
    agree, within, differ = (
        sum(v in (AGREES, GRID) for v in verdicts),
        verdicts.count(GRID),
        verdicts.count(DIFFERS),
    )
    told = f"{agree} {'agrees' if agree == 1 else 'agree'}" + (
        f" ({within} within our resolution)" if within else ""
    )
    return (
        f"{told}, {differ} {'does' if differ == 1 else 'do'} not, {verdicts.count(UNCHECKED)}"
        " cannot be checked"
    )


def _failed(rows: Iterable[Row]) -> str:
    count = sum(row.verdict == DIFFERS for row in rows)
    return f" ({count} of them not met)" if count else ""


def holds(condition: Callable[..., bool], otherwise: Verdict = DIFFERS) -> Callable[..., Verdict]:
    """The rule that a condition of the numbers makes."""
    return lambda *numbers: AGREES if condition(*numbers) else otherwise


def near(stated: float, half_bin: float) -> Callable[..., Verdict]:
    """The rule of a stated frequency that is not on the grid: all found ones within half a bin of
    it."""
    return lambda *found: GRID if all(abs(f - stated) <= half_bin for f in found) else DIFFERS


def unchecked(*_: float) -> Verdict:
    """The rule of a statement without numbers to compare with."""
    return UNCHECKED
