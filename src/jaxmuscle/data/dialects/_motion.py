"""Motion capture as text: Qualisys (.tsv), OpenSim (.sto, .mot) and .trc."""

import functools
import re

from .._text_tables import cells_of
from ._dialect import Above, Block, Dialect, Head, frequency, triples

_LEAD = {0: [], 1: ["Sample"], 2: ["Frame", "Time"]}
_COUNTERS = ("frame", "sample")
_UNITS = (("time", "s"), ("force_", "N"), ("moment_", "N m"), ("cop_", "mm"))  # of a plate
# OpenSim writes SI units; what a column is stands in its name
_SI = (
    (re.compile(r".*force_?v?[xyz]|.*_v[xyz]"), "N"),
    (re.compile(r".*_(?:p|t)[xyz]|.*force_?p[xyz]"), "m"),
    (re.compile(r".*_(?:torque|moment)_?[xyz]?|.*_m[xyz]"), "N m"),
)


def _counters(names: list[str]) -> list[int]:
    return [j for j, name in enumerate(names) if name.casefold() in _COUNTERS]


def _qualisys(above: Above) -> Head | None:
    """`FREQUENCY`, `MARKER_NAMES` (three columns each) or `CHANNEL_NAMES`; a row of names may
    follow."""
    rows = [cells_of(body, "\t" if "\t" in body else above.delimiter) for _, body in above.rows]
    entries = {row[0]: row[1:] for row in rows if row}
    if "FREQUENCY" not in entries or not any(key.startswith("NO_OF_") for key in entries):
        return None
    rate = frequency("".join(entries["FREQUENCY"][:1]))
    stated = next((row for key, row in entries.items() if key.endswith("_NAMES")), [])
    labels = [label for label in stated if label]
    points = "3D" in entries.get("DATA_INCLUDED", []) or "MARKER_NAMES" in entries
    names = None
    last = rows[-1]
    if len(last) == above.width and (
        last[0].casefold() in _COUNTERS or not re.fullmatch(r"[A-Z_]{4,}", last[0])
    ):
        names = last
    for columns in (triples(labels), labels):
        lead = _LEAD.get(above.width - len(columns))
        if names is None and lead is not None and columns:
            names = [*lead, *columns]
    if names is None:
        return Head(rate=rate)
    counters = _counters(names)
    usual = ["mm" if points and j not in counters else "" for j in range(len(names))]
    units = [
        next((unit for start, unit in _UNITS if name.casefold().startswith(start)), other)
        for name, other in zip(names, usual, strict=True)
    ]
    return Head(names, units, rate, counters=counters)


def _opensim(above: Above) -> Head | None:
    """`inDegrees`, `endheader`, a row of names; the units are SI but for the degrees."""
    first = [row[0].replace(" ", "").casefold() if row else "" for row in above.cells[:-1]]
    if "endheader" not in first or len(above.cells[-2]) != above.width:
        return None
    names = above.cells[-2]
    angles = first[0] == "coordinates"
    turned = "deg" if "indegrees=yes" in first else "rad"
    units = []
    for name in map(str.casefold, names):
        unit = next((unit for pattern, unit in _SI if pattern.fullmatch(name)), "")
        units.append("s" if name == "time" else unit or (turned if angles else ""))
    return Head(names, units)


def _trc(data: bytes) -> list[Block] | None:
    """Two rows of settings, then the names of the points and of their coordinates."""
    if not data.startswith(b"PathFileType"):
        return None
    _, keys, values, *rest = [*data.split(b"\n", 3), b"", b"", b""][:4]
    stated = dict(
        zip(
            cells_of(keys.decode("utf-8", "replace"), "\t"),
            cells_of(values.decode("utf-8", "replace"), "\t"),
            strict=False,
        )
    )
    rate = frequency(stated.get("DataRate", ""))
    head = functools.partial(_points, rate, stated.get("Units", ""))
    return [Block(rest[0], 3, head)]


def _points(rate: float | None, unit: str, above: Above) -> Head | None:
    frame, time, *points = [*above.cells[0], "", ""] if above.cells else ["", ""]
    names = [frame, time, *triples(point for point in points if point)]
    if len(names) != above.width:
        return None
    return Head(names, ["", "s", *[unit] * (len(names) - 2)], rate, counters=[0])


QUALISYS, OPENSIM, TRC = Dialect(head=_qualisys), Dialect(head=_opensim), Dialect(blocks=_trc)
