"""AcqKnowledge (BIOPAC): text and .mat."""

import re

import numpy as np

from .._recording_channels import Channel
from .._units import seconds
from ._dialect import Above, Content, Dialect, Head, columns_of, per_second, rate_of, texts

_PER_SAMPLE = re.compile(r"\s*([\d.,]+(?:e-?\d+)?)\s*([a-zµ]+)/sample", re.IGNORECASE)


def _head(above: Above) -> Head | None:
    """`0.5 msec/sample`, `2 channels`, name and unit of each on lines of their own, `CH1 CH2`,
    counts."""
    lines, width = above.lines, above.width
    found = next(
        (
            (i, match)
            for i, line in enumerate(lines[:20])
            if (match := _PER_SAMPLE.match(line.body))
        ),
        None,
    )
    if found is None or not above.rows or found[0] + 1 == len(lines):
        return None
    at, match = found
    last, row = above.rows[-1]
    count = int((re.match(r"\s*(\d{1,6})", lines[at + 1].body) or [0, width])[1])
    stated = [line.body.strip().strip('"') for line in lines[at + 2 : at + 2 + 2 * count]]
    names, units = stated[::2], stated[1::2]
    if width == count + 1:
        scale = re.split(r"[\t,;]", row)[0].strip()
        names, units = ["time", *names], [scale if seconds(scale) else "s", *units]
    first = above.cells[-1]
    numbers = [float(cell) for cell in first if cell and cell.isdigit()]
    counts = (
        bool(numbers)
        and all(not c or c.isdigit() for c in first)
        and abs(max(numbers) - (above.length - last)) <= 2
    )
    rate = rate_of(match[1], match[2], above.file)
    return Head(names if len(names) == width else None, units, rate, int(counts))


def _mat(content: Content) -> tuple[list[Channel], list[str]] | None:
    """`data` with a column for each of `labels` and `units`, `isi` milliseconds apart unless
    `isi_units` say otherwise."""
    if not {"data", "labels", "units", "isi"} <= content.keys():
        return None
    labels, units = texts(content["labels"]), texts(content["units"])
    data = np.asarray(content["data"])
    data = data.reshape(-1, 1) if data.ndim < 2 else data
    if not data.shape[1] == len(labels) == len(units):
        return None
    scale = "".join(texts(content.get("isi_units", "ms"))[:1])
    rate = per_second(content["isi"], scale)
    found = columns_of("data", [*data.T], rate, labels, units)
    return found, ["data", "labels", "units", "isi", "isi_units", "start_sample"]


ACQKNOWLEDGE = Dialect(head=_head, mat=_mat)
