"""Spike2 (CED): text and .mat."""

import functools
import itertools
import math
import re
from typing import TYPE_CHECKING

import numpy as np

from .._recording_channels import Channel
from .._text_tables import is_number, number_in
from ._dialect import Content, Dialect, number, per_second, rate_of, texts

if TYPE_CHECKING:
    from .._recording_table import Table

_CHANNEL = re.compile(rb'^"?CHANNEL"?[\t ,]', re.MULTILINE)
STEP = 6553.6  # of the converter, for each unit of `scale`


def _table(data: bytes, file: str, read: object) -> "Table | None":
    """Spike2: `INFORMATION`, `SUMMARY`, and for each waveform `CHANNEL`, its type, name and unit,
    `START`, samples."""
    if not re.match(rb'\s*"?INFORMATION"?\s*\n', data):
        return None
    from .._recording_body import Body
    from .._recording_table import Table

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
        rate[name], units[name] = (
            rates.get(number) or rate_of(step, None, file),
            lines[4][0].strip(),
        )
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


def _mat(content: Content) -> tuple[list[Channel], list[str]] | None:
    """A struct for each channel: `title`, `interval`, `units`, `values`; others hold events."""
    structs = {
        key: value
        for key, value in content.items()
        if isinstance(value, dict) and {"title", "length"} <= value.keys()
    }
    found = []
    for key, struct in structs.items():
        rate, values = per_second(struct.get("interval")), np.asarray(struct.get("values"))
        if rate is None or values.ndim != 1 or values.dtype.kind not in "iuf":
            continue
        scale, offset = (number(struct.get(name)) for name in ("scale", "offset"))
        if values.dtype.kind in "iu" and scale is not None:
            values = values * (scale / STEP) + (offset or 0.0)
        name, unit = ("".join(texts(struct.get(word, ""))[:1]) for word in ("title", "units"))
        found.append(Channel(name or key, values, rate, unit, f"{key}.values"))
    return (found, list(structs)) if found else None


SPIKE2 = Dialect(table=_table, mat=_mat)
