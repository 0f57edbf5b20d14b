"""LabChart (ADInstruments): text and .mat."""

import re

import numpy as np

from .._recording_channels import Channel
from ._dialect import Above, Content, Dialect, Head, rate_of, texts


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
    by blocks, from 1; below that for none) say where each stands."""
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


LABCHART = Dialect(head=_head, mat=_mat)
