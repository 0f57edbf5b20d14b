"""What stands above the numbers of a text: names and units, or the header of a laboratory's
program."""

import functools
import itertools
import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path, PureWindowsPath
from typing import NamedTuple

import numpy as np

from jaxmuscle._common.inputs import read_bytes

from ._recording_body import Body, is_value
from ._recording_table import Table
from ._text_tables import Line, is_number, number_in, width_remedy
from ._units import known_unit, seconds

Rows = list[tuple[int, str]]
_PER_SAMPLE = re.compile(r"\s*([\d.,]+(?:e-?\d+)?)\s*([a-zµ]+)/sample", re.IGNORECASE)
_CHANNEL = re.compile(rb'^"?CHANNEL"?[\t ,]', re.MULTILINE)
_TYPES = {
    "REAL64": "<f8",
    "REAL32": "<f4",
    "INT16": "<i2",
    "INT32": "<i4",
    "WORD16": "<u2",
    "WORD8": "u1",
}


class Head(NamedTuple):
    """Names and units of the columns and the rate [Hz], as far as a header has them; `counts` rows
    follow that are none."""

    names: list[str] | None = None
    units: Sequence[str] = ()
    rate: float | None = None
    counts: int = 0


def head_of(
    lines: list[Line],
    above: Rows,
    cells: list[list[str]],
    width: int,
    delimiter: str | None,
    length: int,
    file: str,
) -> Head:
    """The header: `above` are its rows, `cells` those in cells and the first row of numbers; a text
    has `length` lines."""
    found = _labchart(above, width, file) or _acqknowledge(
        lines, cells[-1], above, width, length, file
    )
    return found or _names(above, cells[:-1], width, delimiter, file)


def _names(
    above: Rows, cells: list[list[str]], width: int, delimiter: str | None, file: str
) -> Head:
    """The last row of words, or the last but one if the last one holds units."""
    if not above:
        return Head()
    number, row = above[-1][0], cells[-1]
    if len(row) != width:
        raise ValueError(
            f"{file}, line {number + 1}: {width} of {len(row)} columns found;"
            f" {width_remedy(delimiter)}"
        )
    for name, cell in zip(row, row, strict=True):
        if cell and is_value(cell, delimiter):
            raise ValueError(
                f"{file}, line {number}: {name!r} cannot be the name of a column; `skip_rows`"
                " leaves lines out"
            )
    if (
        len(cells) > 1
        and len(cells[-2]) == width
        and any(known_unit(cell) or seconds(cell) for cell in row if cell)
    ):
        return Head(cells[-2], [cell.strip("[]() ") for cell in row])
    return Head(row)


def _rate(step: str, unit: str | None, file: str) -> float:
    """The rate [Hz] that follows from the time between two samples."""
    interval = number_in(step, None) * (seconds(unit) or 1.0) if is_number(step, None) else 0.0
    if not 1e-12 < interval < 1e12:
        raise ValueError(
            f"{file}: its header says {step!r} where the time between two samples belongs;"
            " correct it"
        )
    return 1 / interval


def _labchart(above: Rows, width: int, file: str) -> Head | None:
    """LabChart: `Interval=`, `ChannelTitle=`, `UnitName=` or the unit of `Range=`."""
    pairs = [body.strip().partition("=") for _, body in above]
    entries = {
        key: [cell.strip() for cell in re.sub(r"^ *\t?", "", rest).split("\t")]
        for key, _, rest in pairs
    }
    if "Interval" not in entries:
        return None
    titles = [title for title in entries.get("ChannelTitle", []) if title]
    titles = titles or [f"channel {i}" for i in range(1, width + 1)]
    ranges = [cell.partition(" ")[2].strip() for cell in entries.get("Range", [])]
    units = entries.get("UnitName", ["*"] * len(titles))
    units = [
        unit if unit != "*" else (ranges[i] if i < len(ranges) else "")
        for i, unit in enumerate(units)
    ]
    step, _, unit = entries["Interval"][0].partition(" ")
    timed = width == len(titles) + 1
    names, units = (["time", *titles], ["s", *units]) if timed else (titles, units)
    return Head(names[:width] if len(names) >= width else None, units, _rate(step, unit, file))


def _acqknowledge(
    lines: list[Line], first: list[str], above: Rows, width: int, length: int, file: str
) -> Head | None:
    """AcqKnowledge: `0.5 msec/sample`, `2 channels`, name and unit of each on lines of their own,
    `CH1 CH2`, counts."""
    found = next(
        (
            (i, match)
            for i, line in enumerate(lines[:20])
            if (match := _PER_SAMPLE.match(line.body))
        ),
        None,
    )
    if found is None or not above or found[0] + 1 == len(lines):
        return None
    at, match = found
    count = int((re.match(r"\s*(\d{1,6})", lines[at + 1].body) or [0, width])[1])
    texts = [line.body.strip().strip('"') for line in lines[at + 2 : at + 2 + 2 * count]]
    names, units = texts[::2], texts[1::2]
    if width == count + 1:
        scale = re.split(r"[\t,;]", above[-1][1])[0].strip() if above else ""
        names, units = ["time", *names], [scale if seconds(scale) else "s", *units]
    numbers = [float(cell) for cell in first if cell and cell.isdigit()]
    counts = (
        bool(numbers)
        and all(not c or c.isdigit() for c in first)
        and abs(max(numbers) - (length - above[-1][0])) <= 2
    )
    return Head(
        names if len(names) == width else None, units, _rate(match[1], match[2], file), int(counts)
    )


def spike2(data: bytes, file: str) -> Table | None:
    """Spike2: `INFORMATION`, `SUMMARY`, and for each waveform `CHANNEL`, its type, name and unit,
    `START`, samples."""
    if not re.match(rb'\s*"?INFORMATION"?\s*\n', data):
        return None
    starts = [match.start() for match in _CHANNEL.finditer(data)]
    rates = _summary(data[: starts[0]].decode("utf-8", errors="replace")) if starts else {}
    columns, rate, units, places = {}, {}, {}, []
    for begin, end in itertools.pairwise([*starts, len(data)]):
        sign = data.find(b'"START"', begin, end)
        text = data[begin : max(sign, begin)].decode("utf-8", errors="replace").replace('"', "")
        lines = [re.split(r"[\t,]", line) for line in text.splitlines() if line.strip()]
        if len(lines) < 5 or lines[1][0] not in ("Waveform", "RealWave"):
            continue
        number, name = lines[0][1].strip(), lines[3][0].strip()
        name = name if name and name not in columns else f"{name or 'channel'} {number}"
        row = data.find(b"\n", sign, end) + 1
        if sign < 0 or row == 0:
            raise ValueError(
                f'{file}: {name} has no line "START" with values below it; export it again'
            )
        again, first = data.find(b'"START"', row, end), data.count(b"\n", 0, row) + 1
        if again > 0:
            place = f"line {first + data.count(bytes([10]), row, again)}"
            raise ValueError(
                f"{file}, {place}: {name} has a gap before it; export a stretch without one"
            )
        body = Body(data[row:end].rstrip(), 0, file, first, None, 1, False, ["0"])
        body.check()
        columns[name] = functools.partial(body.column, 0, name)
        step = data[sign:row].decode("utf-8", errors="replace").split()[-1]
        rate[name], units[name] = rates.get(number) or _rate(step, None, file), lines[4][0].strip()
        places.append(body.place)
    if not columns:
        raise ValueError(f"{file}: holds no waveform; export one from Spike2")
    return Table(
        file,
        columns,
        True,
        rate,
        {name: unit for name, unit in units.items() if unit},
        place=places[0],
    )


def _summary(text: str) -> dict[str, float]:
    """The rates [Hz] that a summary has for its channels: the ideal one, then the true one."""
    rows = [[cell.strip(' "') for cell in line.split("\t")] for line in text.splitlines()]
    stated = {
        row[0]: number_in(row[5], None) for row in rows if len(row) >= 6 and is_number(row[5], None)
    }
    return {number: rate for number, rate in stated.items() if 0 < rate < math.inf}


def diadem(data: bytes, file: str, read: Callable[[bytes, str], Table]) -> Table | None:
    """DIAdem: a header of channels, each with its number of an entry (200 name, 202 unit, 211 file,
    241 step), and their values behind it or in the file that it names."""
    if b"#BEGINCHANNELHEADER" not in data[: 1 << 16]:
        return None
    *heads, rest = re.split(rb"#ENDCHANNELHEADER[^\n]*\n?", data)
    if not heads:
        raise ValueError(f"{file}: its header has no #ENDCHANNELHEADER; save the file again")
    texts = [
        head.partition(b"#BEGINCHANNELHEADER")[2].decode("cp1252", errors="replace")
        for head in heads
    ]
    channels = [
        dict(line.split(",", 1) for line in text.splitlines() if "," in line) for text in texts
    ]
    channels = [
        {key.strip(): value.strip() for key, value in channel.items()} for channel in channels
    ]
    steps = [c for c in channels if c.get("210", "").startswith("IMPLI")]
    rate = next((_rate(c.get("241", ""), c.get("202"), file) for c in steps), None)
    held = [channel for channel in channels if channel not in steps]
    # The last part of its name alone: the values lie beside the header, and no header points
    # anywhere else.
    sources = {
        Path(file).parent / PureWindowsPath(channel["211"]).name
        for channel in held
        if channel.get("211")
    }
    if Path(file) in sources:
        raise ValueError(
            f"{file}: its header names the file itself for the values; give the file that holds"
            " them"
        )
    if len(sources) == 1 and held[0].get("214", "ASCII") in _TYPES:
        found = [_binary(channel, len(held), next(iter(sources)), file) for channel in held]
        place, columns = (
            "sample {}".format,
            [functools.partial(np.asarray, column) for column in found],
        )
    else:
        text = _bytes(next(iter(sources)), file) if len(sources) == 1 else rest
        table = read(text, str(next(iter(sources))) if sources else file)
        place, columns = table.place, list(table.columns.values())
    if len(columns) != len(held):
        raise ValueError(
            f"{file}: its header has {len(held)} channels with values, but there are {len(columns)}"
            " columns"
        )
    names = [channel.get("200", str(i)) for i, channel in enumerate(held)]
    units = {
        name: unit
        for name, channel in zip(names, held, strict=True)
        if (unit := channel.get("202", "").strip("[] "))
    }
    rates = {} if rate is None else dict.fromkeys(names, rate)
    return Table(file, dict(zip(names, columns, strict=True)), True, rates, units, place=place)


def _bytes(source: Path, file: str) -> bytes:
    if not source.exists():
        raise ValueError(f"{file}: its values are in {source.name}, which is not beside it")
    return read_bytes(source, instead="the file that holds the values")


def _binary(channel: dict[str, str], count: int, source: Path, file: str) -> np.ndarray:
    """The values of a channel: one of several in every row (BLOCK), or all behind one another
    (CHANNEL)."""
    kind, data = np.dtype(_TYPES.get(channel.get("214", ""), "<f8")), _bytes(source, file)
    raw = np.frombuffer(data, kind, len(data) // kind.itemsize)
    stated = [
        channel.get(key) or usual
        for key, usual in (("221", "1"), ("220", "0"), ("241", "1"), ("240", "0"))
    ]
    if not all(is_number(entry, None) for entry in stated):
        raise ValueError(
            f"{file}: its header has {', '.join(stated)} where first row, length, factor and offset"
            " belong"
        )
    first, size, factor, offset = (number_in(entry, None) for entry in stated)
    if not (1 <= first <= max(raw.size, 1) and 0 <= size <= raw.size):
        raise ValueError(
            f"{file}: its header asks for {size:g} values from {first:g} on, {source.name} has"
            f" {raw.size}"
        )
    start = int(first) - 1
    return (
        raw[start::count] if channel.get("213") == "BLOCK" else raw[start : start + int(size)]
    ) * factor + offset
