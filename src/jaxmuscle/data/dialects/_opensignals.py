"""OpenSignals (PLUX, BITalino): a header of JSON in comments."""

import json

from ._dialect import Above, Dialect, Head


def _head(above: Above) -> Head | None:
    """`column`, `sampling rate`; the samples are counts of the converter."""
    notes = [line.note.strip() for line in above.lines if line.note is not None]
    if not any(note.startswith("EndOfHeader") for note in notes):
        return None
    stated = next((note for note in notes if note.startswith("{")), "")
    try:
        devices = list(json.loads(stated).values())
        names = [str(name) for device in devices for name in device["column"]]
        rate = float(devices[0]["sampling rate"])
        sensors = [len(device.get("sensor", ())) for device in devices]
        converted = any(device.get("convertedValues") for device in devices)
    except (ValueError, TypeError, KeyError, AttributeError, IndexError, RecursionError):
        return None
    if len(names) != above.width or not rate > 0:
        return None
    counters, at = [], 0
    for device, count in zip(devices, sensors, strict=True):
        # the number of the sample and the digital lines stand before the sensors
        counters += range(at, at + len(device["column"]) - count)
        at += len(device["column"])
    counters = counters if len(counters) < len(names) else []
    if converted:
        return Head(names, [], rate, counters=counters)
    units = ["" if j in counters else "a.u." for j in range(len(names))]
    said = (
        "OpenSignals writes the counts of its converter, whose unit is a.u. until they are scaled"
    )
    return Head(names, units, rate, counters=counters, notices=(said,))


OPENSIGNALS = Dialect(head=_head)
