"""Trigno Discover (Delsys): pairs of time and value, with a row of their rates."""

import re

from ._dialect import Above, Block, Dialect, Head, below_groups, first_columns

RATE = re.compile(r"([\d.,]+)\s*\(?Hz\)?", re.IGNORECASE)
_SERIAL = re.compile(r" *\(\d+\)$")
_FIRST = re.compile(rb'^"?Application:?"?[,;\t]"?Trigno Discover', re.IGNORECASE)
_NAMES = re.compile(rb"^[^\n]*(?:Time Series|EMG 1 \(|ACC X)[^\n]*", re.MULTILINE)


def _blocks(data: bytes) -> list[Block] | None:
    """The signals, without the table of markers that stands beside them."""
    if not _FIRST.match(data):
        return None
    names = _NAMES.search(data)
    if names is None:
        return None
    sign = next(sign for sign in (b"\t", b";", b",") if sign in names[0] or sign == b",")
    width = len(names[0].rstrip(sign).split(sign))
    return [Block(first_columns(data, sign, width), 0, _head)]


def _head(above: Above) -> Head | None:
    """Names with their units, rates below them; the row of the sensors is needed where two have a
    column of one name."""
    rows = [above.padded(i) for i in range(len(above.cells) - 1)]
    at = next((i for i, row in enumerate(rows) if rates_in(row)), None)
    if not at:
        return None
    names = rows[at - 1]
    sensors = next((row for row in rows[:at] if _SERIAL.search(row[0])), [""] * len(names))
    sensors = [_SERIAL.sub("", sensor) for sensor in sensors]
    whole = below_groups(names, sensors, lambda j: bool(names[j]) and names.count(names[j]) > 1)
    rates = rates_in(rows[at]) or []
    first = above.cells[-1]
    return Head(whole, rates=rates, counts=int(bool(first) and not first[0]))


def rates_in(row: list[str]) -> list[float | None] | None:
    """The rates in a row that holds nothing else."""
    found = [RATE.fullmatch(cell) for cell in row]
    if not any(found) or any(cell and not match for cell, match in zip(row, found, strict=True)):
        return None
    return [float(match[1].replace(",", ".")) if match else None for match in found]


DELSYS = Dialect(blocks=_blocks)
