"""A statement of the papers beside our numbers: when the two agree, and what their agreement is
worth."""

import re
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Literal, NamedTuple, get_args

from ._numbers import Reproduction

Verdict = Literal["agrees", "agrees within our resolution", "does not agree", "cannot be checked"]
AGREES, GRID, DIFFERS, UNCHECKED = get_args(Verdict)
Kind = Literal["tests the model", "fitted", "put in", "arithmetic"]
TESTED, FITTED, GIVEN, ARITHMETIC = get_args(Kind)
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


def check_claim(claim: Claim, found: Reproduction) -> Row:
    """A claim with its numbers and its verdict."""
    numbers = tuple(map(float, claim.numbers(found)))
    verdict = claim.rule(*numbers)
    ours = re.sub(r"(?<=\d)%", " %", claim.words.format(*numbers))
    why = "" if verdict == AGREES else claim.why.format(*numbers)
    return Row(*claim[:4], ours, numbers, claim.how, verdict, why)


def counted(rows: Iterable[Row]) -> str:
    """How many statements there are, how many test the model, and what came of them, in one
    sentence."""
    rows = tuple(rows)
    of: dict[Kind, list[Row]] = {kind: [row for row in rows if row.kind == kind] for kind in KINDS}
    tests = of.pop(TESTED)
    beside = ", ".join(f"{len(some)} {kind}{_failed(some)}" for kind, some in of.items())
    return (
        f"Of {len(rows)} statements {len(tests)} test the model: {outcome(tests)}. Not counted for"
        f" it: {beside}."
    )


def outcome(rows: Iterable[Row]) -> str:
    """How many agree, how many do not, how many cannot be checked."""
    count = Counter(row.verdict for row in rows)
    agree, within, differ = count[AGREES] + count[GRID], count[GRID], count[DIFFERS]
    resolved = f" ({within} within our resolution)" * bool(within)
    return (
        f"{agree} {'agrees' if agree == 1 else 'agree'}{resolved}, {differ}"
        f" {'does' if differ == 1 else 'do'} not, {count[UNCHECKED]} cannot be checked"
    )


def _failed(rows: Iterable[Row]) -> str:
    count = sum(row.verdict == DIFFERS for row in rows)
    return f" ({count} of them not met)" * bool(count)


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
