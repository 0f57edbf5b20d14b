"""JSON and TOML that people may have changed: parsed strictly, and held against a schema that says
what each key is."""

import json
import math
import re
import tomllib
from collections.abc import Iterator
from typing import Any, Literal, TypeVar, get_args, get_origin

import msgspec
from msgspec import Meta

from .text import choices, listed

LARGEST = 2**63  # whole numbers from here on are none of anything that a file counts
WORDS = {
    "float": "a number",
    "int": "a whole number",
    "str": "a text",
    "bool": "true or false",
    "null": "nothing",
    "object": "a table",
    "array": "a list",
}
# A key of so many names is none of a file of ours, and tomllib takes room with the square of them.
DEEPEST = 32
KEY = r"""(?:[\w-]++|"(?:[^"\\\n]|\\.)*+"|'[^'\n]*+')[ \t]*+"""
DEEP = re.compile(rf"(?<![\w\\-])(?:{KEY}\.[ \t]*+){{{DEEPEST}}}")
NESTED = "is nested too deeply to be anything that jaxmuscle writes"

T = TypeVar("T")


class Table(msgspec.Struct, forbid_unknown_fields=True):
    """The schema of a table in a file: a field for each key, its type annotated with what it
    means."""


def says(meaning: str, *, missing: str | None = None, kind: str | None = None) -> Meta:
    """What a key of a table means; what its absence says, of one that may be `missing`; its type
    where code checks that."""
    return Meta(description=meaning, extra={"missing": missing, "kind": kind})


def parsed(text: str, file: str, kind: str, error: type[ValueError] = ValueError) -> dict[str, Any]:
    """The table of a JSON or TOML text (`kind`). Raises `error`, naming the file, also for a key
    that is there twice."""
    if kind != "JSON" and DEEP.search(text):
        raise error(f"{file}: {NESTED}")
    try:
        table = _json(text) if kind == "JSON" else tomllib.loads(text)
    except RecursionError:
        raise error(f"{file}: {NESTED}") from None
    except ValueError as wrong:
        raise error(f"{file}: is not valid {kind}: {_line(str(wrong))}") from None
    if not isinstance(table, dict):
        raise error(f"{file}: holds no table, but {_kind_of(table)}")
    for place, value in _leaves(table):
        problem = _impossible(value)
        if problem:
            raise error(f"{file}: {place} {problem}")
    return table


def checked(
    table: dict[str, Any], kind: type[T], file: str, error: type[ValueError] = ValueError
) -> T:
    """The table as its schema `kind` has it. Raises `error` naming file and key: one missing,
    unknown or of a wrong type."""
    fields = {field.encode_name: field.required for field in msgspec.structs.fields(kind)}  # pyright: ignore[reportArgumentType]
    for key in table:
        if key not in fields:
            raise error(f"{file}: unknown key {key!r}; {choices(key, fields)}")
    for key, required in fields.items():
        if required and key not in table:
            needed = listed([name for name, must in fields.items() if must])
            raise error(f"{file}: the key {key!r} is missing; needed are {needed}")
    try:
        return msgspec.convert(table, kind)
    except msgspec.ValidationError as wrong:
        raise error(f"{file}: {_in_words(str(wrong))}") from None
    except RecursionError:
        raise error(f"{file}: {NESTED}") from None


def converted(value: Any, kind: Any, where: str, error: type[ValueError] = ValueError) -> Any:
    """One value as its type `kind` has it. Raises `error` naming the place."""
    if get_origin(kind) is Literal and value not in get_args(kind):
        raise error(f"{where} = {_shown(value)}: {choices(str(value), get_args(kind))}")
    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError as wrong:
        raise error(
            f"{where} = {_shown(value)}: {_in_words(str(wrong)).removeprefix('the table ')}"
        ) from None


def _shown(value: Any) -> str:
    text = json.dumps(value, default=str)
    return text if len(text) < 60 else f"{text[:57]}..."


def _json(text: str) -> Any:
    return json.loads(text, object_pairs_hook=_once, parse_constant=_no_word)


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    table = dict(pairs)
    if len(table) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"the key {twice!r} is there twice")
    return table


def _no_word(word: str) -> Any:
    raise ValueError(f"{word} is no number in JSON")


def _leaves(value: Any) -> Iterator[tuple[str, Any]]:
    """Names and values, the names' own text too; without recursion, so that no depth is too
    much."""
    stack = [("", value)]
    while stack:
        place, value = stack.pop()
        if isinstance(value, dict):
            yield from (("a key", key) for key in value)
            stack += [(f"{place}.{key}" if place else key, entry) for key, entry in value.items()]
        elif isinstance(value, list):
            stack += [(f"{place}[{i}]", entry) for i, entry in enumerate(value)]
        else:
            yield place, value


def _impossible(value: Any) -> str | None:
    if isinstance(value, float) and not math.isfinite(value):
        return f"= {value} is not finite"
    if isinstance(value, int) and abs(value) >= LARGEST:
        return "is too large a number"
    if isinstance(value, str) and any("\ud800" <= letter <= "\udfff" for letter in value):
        return "holds half a character (a lone surrogate)"
    return None


def _in_words(message: str) -> str:
    """What msgspec says, as people say it."""
    said, _, way = message.partition(" - at `$")
    place = way.removesuffix("`").removeprefix(".") or "the table"
    said = re.sub(
        r"Object missing required field `(.*)`", r"has no key '\1', which is needed", said
    )
    said = re.sub(r"Object contains unknown field `(.*)`", r"has the unknown key '\1'", said)
    said = re.sub(
        r"^Expected `object` ", "must be a table ", said.replace("Expected", "must be", 1)
    )
    said = re.sub(
        r"`([^`]*)`",
        lambda found: " or ".join(WORDS.get(w, w) for w in found[1].split(" | ")),
        said,
    )
    return f"{place} {_line(said.replace(', got', ', not', 1))}"


def _kind_of(value: Any) -> str:
    return "a list" if isinstance(value, list) else "a single value"


def _line(text: str) -> str:
    return " ".join(text.split())
