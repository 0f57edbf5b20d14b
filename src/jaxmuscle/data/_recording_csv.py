"""Recordings as text: columns separated by comma, semicolon, tab or blanks, below headers of many
kinds."""

import functools
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from ._recording_body import Body, is_value
from ._recording_channels import numbered
from ._recording_table import Table, listed, merged, units_of
from ._recording_time import clock
from ._text_tables import SIGNS, Line, cells_of, is_number, lines_of, number_in, width_remedy
from ._units import known_unit, name_and_unit, seconds
from .dialects._delsys import rates_in
from .dialects._dialect import Above, Block, Head
from .dialects._dialects import DIALECTS

HEAD = 1 << 16  # bytes in which the first rows of numbers are expected
WIDEST = 20_000  # columns
NUMBERED = "columns of one name are numbered: "
_TIME_OF = re.compile(r" *(?:time series|time|\[?x\]?) *")


_RATE = re.compile(
    r"(?:(?:sampl(?:e|ing)|acquisition|scan|data|recording)[ _-]*)?(?:rate|frequency|freq)"
    r"|samples[ _]*(?:per|/)[ _]*s(?:ec(?:ond)?)?|fs|fsamp|sfreq|abtastrate|abtastfrequenz|messrate"
    r"|fréquence d.échantillonnage|frecuencia de muestreo|frequenza di campionamento"
)
_STEP = re.compile(
    r"(?:(?:sampl(?:e|ing)|scan|time)[ _-]*)?(?:interval|period)|(?:sampl(?:e|ing)|time)[ _-]*step"
    r"|sampl(?:e|ing)[ _-]*time"
    r"|dt|delta[ _]?t|abtastintervall"
)
_HERTZ = {
    1.0: ("", "hz", "s/s", "sps", "1/s", "samples/s", "samples/sec", "samples per second"),
    1e3: ("khz", "ks/s"),
}
_SURE = re.compile(r"sampl|^fs|^sfreq|abtast|chant|muestreo|campion")  # of no stimulus, say
_UNITLIKE = re.compile(r"[^\W\d_]{1,3}|[%°µ\[(].*|.*[/^²·*].*")


def read_csv(data: bytes, file: str, skip_rows: int = 0) -> Table:
    """The columns of a text file; `#` starts a comment.

    The delimiter is that of most lines: tab, semicolon, comma or blanks. Decimal commas are read
    where it is not the comma. What stands above the first row of numbers is the header: names,
    rows of units and rates, or what the programs of `dialects` write. The last comment before
    the data is one as well if it has a name for each column and one of them is the time (as
    `numpy.savetxt` writes it).

    **Raises:** `ValueError` naming file and line.
    """
    data = _plain(data, file)
    for dialect in DIALECTS:
        table = dialect.table and dialect.table(data, file, read_csv)
        if table:
            return table
        blocks = dialect.blocks and dialect.blocks(data)
        if blocks:
            # "Frame#" is the name of a column
            parts = [each._replace(data=each.data.replace(b"#", b"")) for each in blocks]
            return merged(file, [_block(each, file, skip_rows) for each in parts])
    return _block(Block(data, 0, _head_of), file, skip_rows)


def _block(block: Block, file: str, skip_rows: int) -> Table:
    data, before = block.data, block.lines
    notes = _lines(data[:HEAD], skip_rows - before)
    data = re.sub(rb"[\t ]*#[^\n]*", b"", data) if b"#" in data else data
    end = len(data) if len(data) <= HEAD else data.rfind(b"\n", 0, HEAD)
    lines = _lines(data[: end if end > 0 else len(data)], skip_rows - before)
    rows = [(line.number + before, line.body) for line in lines if line.body.strip()]
    if not rows:
        raise ValueError(f"{file}: holds no data, only comments")
    half = len(rows) // 2  # the later half of what is looked at is hardly header
    delimiter = _delimiter([body for _, body in rows[half:]])
    cells = [cells_of(body, delimiter) for _, body in rows]
    if delimiter is None and all(len(row) == 1 for row in cells[half:]):
        cells = [[body.strip().strip('"')] for _, body in rows]
    widths = [len(row) for row in cells[half:]]
    width = max(dict.fromkeys(widths), key=widths.count)
    if width > WIDEST:
        raise ValueError(
            f"{file}, line {rows[-1][0]}: has {width} columns; a recording has at most {WIDEST}"
        )
    trailing = width > 1 and all(not row[-1] for row in cells if len(row) == width)
    if trailing:
        cells, width = [row[:-1] if len(row) == width else row for row in cells], width - 1
    at = _start(cells, width, delimiter)
    if at is None:
        raise ValueError(f"{file}: holds a header (line {rows[0][0]}) but no data")
    above = Above(
        notes,
        rows[:at],
        cells[: at + 1],
        width,
        delimiter,
        rows[at][0] - before,
        block.data.count(b"\n"),
        file,
    )
    head = block.head(above) or _head_of(above)
    at += head.counts
    first = rows[at][0]
    start = 0
    for _ in range(first - before - 1):
        start = data.index(b"\n", start) + 1
    body = Body(data, start, file, first, delimiter, width, trailing, cells[at])
    names = head.names or _commented(notes, first - before, delimiter, width)
    return _table(file, names, head, body, _words(cells[at:], width, delimiter))


def _plain(data: bytes, file: str) -> bytes:
    """The text in an encoding in which digits are ASCII, with \\n at the ends of lines and nothing
    on blank ones."""
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        data = data.decode("utf-16", errors="replace").encode()
    if not re.search(rb"\S", data):
        raise ValueError(f"{file}: is empty")
    if b"\0" in data:
        raise ValueError(
            f"{file}: is not UTF-8 text (a binary file, or saved with another encoding)"
        )
    data = data.removeprefix(b"\xef\xbb\xbf").replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    blank = data[:1] in b" \t" or b"\n " in data or b"\n\t" in data
    return re.sub(rb"(?m)^[ \t]+$", b"", data) if blank else data


def _text(data: bytes) -> str:
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        # The end may be within a letter; other letters are those of Windows.
        if error.start > len(data) - 4:
            return data[: error.start].decode("utf-8")
        return data.decode("cp1252", errors="replace")


def _lines(data: bytes, skipped: int) -> list[Line]:
    return [line for line in lines_of(_text(data)) if line.number > skipped]


def _delimiter(bodies: list[str]) -> str | None:
    """Tab, semicolon or comma, the first that is in most lines; `None` for blanks or a single
    column."""
    return next(
        (sign for sign in SIGNS if sum(sign in body for body in bodies) >= len(bodies) / 2), None
    )


def _start(cells: list[list[str]], width: int, delimiter: str | None) -> int | None:
    """The first row with a number in each column that has numbers further on, or in the first of
    them below names."""

    def holds_value(row: list[str], j: int) -> bool:
        return bool(row[j]) and is_value(row[j], delimiter)

    later = [row for row in cells[len(cells) // 2 :] if len(row) == width]
    numeric = [j for j in range(width) if any(holds_value(row, j) for row in later)]
    above: list[str] = []
    for i, row in enumerate(cells):
        if len(row) == width and numeric:
            names = len(above) == width and not any(holds_value(above, j) for j in range(width))
            whole = all(is_value(row[j], delimiter) for j in numeric)
            if (whole and any(row[j] for j in numeric)) or (names and holds_value(row, numeric[0])):
                return i
        above = row
    return None


def _words(cells: list[list[str]], width: int, delimiter: str | None) -> list[int]:
    """Columns in which nothing is a number; empty ones only beside two others."""
    columns = zip(*(row for row in cells if len(row) == width), strict=True)
    filled = [[cell for cell in column if cell] for column in columns]
    numeric = [any(is_value(cell, delimiter) for cell in column) for column in filled]
    beside = sum(numeric) >= 2
    return [j for j in range(width) if not numeric[j] and (filled[j] or beside)]


def _commented(
    lines: list[Line], first: int, delimiter: str | None, width: int
) -> list[str] | None:
    """The header in the last comment before the data, if it looks like one."""
    notes = [line.note for line in lines if line.note is not None and line.number < first]
    # a single column may be called by several words
    names = cells_of(notes[-1], "\t" if width == 1 else delimiter) if notes else []
    if not len(names) == width == len(set(names)):
        return None
    units = units_of(names)
    columns: Any = dict.fromkeys(names, list)
    return names if units or clock(Table("", columns, rates={"": 1.0}, units=units)) else None


def _table(
    file: str, names: Sequence[str] | None, head: Head, body: Body, words: list[int]
) -> Table:
    given = [(names[j] if names else "") or str(j) for j in range(body.width)]
    known = numbered(given)
    body.check()
    stated = {name: unit for name, unit in zip(known, head.units, strict=False) if unit}
    units = units_of(known) | stated | {known[index]: "s" for index in body.moments}
    clocks = _clocks(given, known, units)
    twice = listed([name for name in dict.fromkeys(given) if given.count(name) > 1])
    notices = () if known == given else (f"{NUMBERED}{twice}",)
    table = Table(
        file,
        {name: functools.partial(_column, body, known, clocks.get(name), name) for name in known},
        names is not None,
        {},
        units,
        frozenset(known[j] for j in {*words, *head.counters}),
        body.place,
        notices,
        {name: time for name, time in clocks.items() if name != time},
    )
    rates = zip(known, head.rates or [head.rate] * len(known), strict=False)
    rates = {name: rate for name, rate in rates if rate is not None}
    # what a program states is its rate; a line of words gives way to times
    if not rates or (head.notices and clock(table) is not None):
        return table
    return table._replace(rates=rates, notices=(*notices, *head.notices))


def _column(
    body: Body, known: list[str], time: str | None, name: str
) -> Float[np.ndarray, " rows"]:
    """A column, which ends where times of its own do: other columns may be longer."""
    values = body.column(known.index(name), name)
    if time is None:
        return values
    there = np.flatnonzero(np.isfinite(body.column(known.index(time), time)))
    return values[: there[-1] + 1] if there.size else values


def _clocks(given: list[str], known: list[str], units: Mapping[str, str]) -> dict[str, str]:
    """The time of every column where there are several columns of times, each before its own: they
    have one name, or that of what follows, or are all called a time."""
    bares = [name_and_unit(name)[0] for name in given]
    times = [
        j
        for j, name in enumerate(known)
        if seconds(units.get(name)) is not None or bares[j] in ("time", "t")
    ]
    if len(times) < 2 or times[0] != 0:
        return {}
    alike = len({bares[j] for j in times}) == 1
    own = all(_TIME_OF.sub("", bares[j]) == "".join(bares[j + 1 : j + 2]) for j in times)
    followed = all("time" in bares[j] and j + 1 < len(known) and j + 1 not in times for j in times)
    if not (alike or own or followed):
        return {}
    return {name: known[max(t for t in times if t <= j)] for j, name in enumerate(known)}


def _head_of(above: Above) -> Head:
    """The header, as the first dialect that knows it, or as rows of names, units and rates."""
    for dialect in DIALECTS:
        found = dialect.head and dialect.head(above)
        if found:
            return found
    return _names(above)


def _names(above: Above) -> Head:
    """The last row of words, but for rows of units and of rates below it."""
    if not above.rows:
        return _with_rate(Head(), above)
    rows, width = above.cells[:-1], above.width
    number, row = above.rows[-1][0], rows[-1]
    if len(row) != width:
        raise ValueError(
            f"{above.file}, line {number + 1}: {width} of {len(row)} columns found;"
            f" {width_remedy(above.delimiter)}"
        )
    for cell in row:
        if cell and is_value(cell, above.delimiter):
            raise ValueError(
                f"{above.file}, line {number}: {cell!r} cannot be the name of a column; `skip_rows`"
                " leaves lines out"
            )
    units: Sequence[str] = ()
    rates: Sequence[float | None] = ()
    while len(rows) > 1 and len(before := _joined(rows[-2], width)) == width:
        found = rates_in(rows[-1]) or []
        if not rates and found and all(n for n, rate in zip(before, found, strict=True) if rate):
            rates = found
        elif not units and _are_units(rows[-1], before):
            units = [cell.strip("[]() ") for cell in rows[-1]]
        else:
            break
        rows = [*rows[:-2], before]
    head = Head(rows[-1], units or _units_as_names(rows[-1]))
    if not rates:
        return _with_rate(head, above)
    return head._replace(rates=rates, notices=("rates as the row below the names says",))


def _units_as_names(names: list[str]) -> Sequence[str]:
    """What a dynamometer calls its columns; the first alone if it can be nothing but a unit of
    times, as "min" and "s" can."""
    step = seconds(names[0])
    if step is None:
        return ()
    several = sum(map(_is_unit, names)) > len(names) / 2
    return names if several else names[:1] if step < 1 else ()


def _with_rate(head: Head, above: Above) -> Head:
    rate, line = _stated_rate(above)
    if not rate:
        return head
    return head._replace(rate=rate, notices=(f"rate {rate:g} Hz, as the header says: {line}",))


def _joined(row: list[str], width: int) -> list[str]:
    """Names in which a bracket was cut off by the blank before it."""
    if len(row) <= width:
        return row
    return re.sub("\0(?=[(])", " ", "\0".join(row)).split("\0")


def _is_unit(cell: str) -> bool:
    return bool(known_unit(cell) or seconds(cell))


def _are_units(row: list[str], names: list[str]) -> bool:
    """Whether a row below names holds their units: one is known, or it leaves the first out, as
    names do not."""
    there = [cell for cell in row if cell]
    alike = there and all(map(_UNITLIKE.fullmatch, there))
    return any(map(_is_unit, there)) or bool(alike and not row[0] and all(names))


def _stated_rate(above: Above) -> tuple[float | None, str]:
    """The rate [Hz] in a line `Sampling rate (Hz): 1000` or `Interval, 0.001 s`, also of comments,
    and this line; none where two such lines differ."""
    comments = [line.note for line in above.lines if line.note and line.number <= above.first]
    found: dict[bool, dict[float, str]] = {True: {}, False: {}}
    for line in [*(body for _, body in above.rows), *comments]:
        key, _, rest = re.sub(r"[\t;=:,]", "\0", line.strip(' "%'), count=1).partition("\0")
        value = re.fullmatch(r"([\d.,]*\d(?:[eE][+-]?\d+)?)[\s,;]*(.*?)", rest.strip('\t ,;:="'))
        name, _, unit = key.strip(' "').partition("[" if "[" in key else "(")
        if value and is_number(value[1], None):
            unit = value[2].strip(' ";,\t') or unit.strip(" )]")
            name = name.strip(" .").casefold()
            if rate := _rate(name, value[1], unit.casefold()):
                found[_SURE.search(name) is not None][rate] = " ".join(line.split())
    sure = found[True] or found[False]
    return next(iter(sure.items())) if len(sure) == 1 else (None, "")


def _rate(name: str, value: str, unit: str) -> float | None:
    scale = next((scale for scale, units in _HERTZ.items() if unit in units), None)
    number = number_in(value, None)
    if _RATE.fullmatch(name) and scale:
        thousands = scale * number < 24 and re.fullmatch(r"[1-9]\d{0,2}(,\d{3})+", value)  # 2,048
        return scale * (float(value.replace(",", "")) if thousands else number)
    step = seconds(unit) if unit else 1.0
    return 1 / (number * step) if _STEP.fullmatch(name) and step and number > 0 else None
