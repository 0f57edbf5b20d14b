"""LabChart (ADInstruments): text and .mat."""

import re

import numpy as np

from .._recording_channels import Channel
from ._dialect import Above, Content, Dialect, Head, columns_of, number, rate_of, texts


def _head(above: Above) -> Head | None:
    """`Interval=`, `ChannelTitle=`, `UnitName=` or the unit of `Range=`."""
    pairs = [body.strip().partition("=") for _, body in above.rows]
    entries = {
        key: [cell.strip() for cell in re.sub(r"^ *\t?", "", rest).split("\t")]
        for key, _, rest in pairs
    }
    if "Interval" not in entries or not any(mark for key, mark, _ in pairs if key == "Interval"):
        return None
    width = above.width
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
    rate = rate_of(step, unit, above.file)
    return Head(names[:width] if len(names) >= width else None, units, rate)


def _mat(content: Content) -> tuple[list[Channel], list[str]] | None:
    """`data` has all channels of all blocks behind one another; `datastart` and `dataend` (channels
    by blocks, from 1; below that for none) say where each stands. Or a table for each block."""
    if "data_block1" in content:
        return _tables(content)
    if not {"data", "datastart", "dataend", "samplerate", "titles"} <= content.keys():
        return None
    data, titles = np.ravel(content["data"]), texts(content["titles"])
    shape = (len(titles), -1)
    start, end = (np.reshape(content[key], shape) for key in ("datastart", "dataend"))
    rates, units = np.reshape(content["samplerate"], shape), texts(content.get("unittext", ""))
    which = np.reshape(content.get("unittextmap", np.zeros(start.shape)), shape)
    # of samples saved as whole numbers of the converter
    scale, offset = (
        np.broadcast_to(
            np.reshape(content.get(key, usual), (-1, 1))[: len(titles)], (len(titles), 1)
        )
        for key, usual in (("scaleunits", 1.0), ("scaleoffset", 0.0))
    )
    found, blocks = [], start.shape[1]
    for (i, block), first in np.ndenumerate(start):
        last, unit = int(end[i, block]), int(which[i, min(block, which.shape[1] - 1)])
        if not 1 <= first <= last <= data.size:
            continue
        samples = data[int(first) - 1 : last]
        if "scaleunits" in content:
            samples = (samples + offset[i, 0]) * scale[i, 0]
        name = titles[i] or f"channel {i + 1}"
        found.append(
            Channel(
                name if blocks == 1 else f"{name}, block {block + 1}",
                samples,
                float(rates[i, min(block, rates.shape[1] - 1)]),
                units[unit - 1] if 1 <= unit <= len(units) else "",
                "data" if start.size == 1 else "",
            )
        )
    return (found, list(content)) if found else None


def _tables(content: Content) -> tuple[list[Channel], list[str]]:
    """`data_block1` and so on, with a row for each channel, and what else there is of the block."""
    numbers = sorted(int(key[10:]) for key in content if re.fullmatch(r"data_block\d{1,6}", key))
    found = []
    for block in numbers:
        own = {key: content.get(f"{key}_block{block}", "") for key in _OF_BLOCK}
        rows = np.asarray(content[f"data_block{block}"])
        rows = rows.reshape(1, -1) if rows.ndim < 2 else rows
        ticks = np.ravel(own["ticktimes"]) if np.size(own["ticktimes"]) > 1 else np.zeros(2)
        span = float(ticks[-1] - ticks[0])
        rate = number(own["samplerate"]) or ((ticks.size - 1) / span if span > 0 else None)
        known = [texts(own[key]) for key in ("titles", "units")]
        titles, units = (each if len(each) == len(rows) else [""] * len(rows) for each in known)
        suffix = f", block {block}" if len(numbers) > 1 else ""
        names = [f"{title or f'channel {i}'}{suffix}" for i, title in enumerate(titles, 1)]
        found += columns_of(f"data_block{block}", [*rows], rate, names, units)
    return found, list(content)


_OF_BLOCK = ("titles", "units", "samplerate", "ticktimes")
LABCHART = Dialect(head=_head, mat=_mat)
