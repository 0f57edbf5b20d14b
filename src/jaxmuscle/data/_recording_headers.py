"""What stands above the numbers of a text: the header of a laboratory's program, or names, units
and rates."""

import re
from collections.abc import Sequence

from ._recording_body import is_value
from ._text_tables import is_number, number_in, width_remedy
from ._units import known_unit, seconds
from .dialects._delsys import rates_in
from .dialects._dialect import Above, Head
from .dialects._dialects import DIALECTS

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


def head_of(above: Above) -> Head:
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
