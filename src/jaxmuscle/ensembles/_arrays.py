"""What a store of trajectories holds."""

import jax
import numpy as np

from jaxmuscle._common.text import squared
from jaxmuscle.model._parameters import PARAMETERS

from ._layout import Chunk, Layout
from ._store import Variable
from ._sweep import Sweep


def variables_of(layout: Layout, *, states: bool) -> tuple[dict[str, Variable], list[str]]:
    """The arrays, and the names of those that are coordinates."""
    task, time_, swept = layout.task_of(0), layout.time, isinstance(layout.task, Sweep)
    lead, shape = (("point",), (layout.points,)) if swept else ((), ())
    cut = (layout.together,) if swept else ()
    width, seeds = min(layout.width, len(layout.seeds)), len(layout.seeds)
    dtype = np.dtype(jax.numpy.result_type(float))
    found = {
        "seed": Variable(("seed",), (seeds,), (seeds,), np.int64, "", np.asarray(layout.seeds)),
        "time": Variable(("time",), (time_.size,), (time_.size,), float, "s", time_),
        task.output_name: Variable(
            (*lead, "seed", "time"),
            (*shape, seeds, time_.size),
            (*cut, width, time_.size),
            dtype,
            task.output_unit,
        ),
    }
    units = zip(task.state_names, task.state_units, strict=True) if states else ()
    for name, unit in units:
        found.setdefault(name, found[task.output_name]._replace(units=unit))
    coordinates = ["seed", "time"]
    if layout.bins:
        bins, frequency = layout.bins, task.settings.frequency
        found["frequency"] = Variable(("frequency",), (bins,), (bins,), float, "Hz", frequency)
        found["power"] = Variable(
            (*lead, "seed", "frequency"),
            (*shape, seeds, bins),
            (*cut, width, bins),
            dtype,
            squared(task.output_unit) + "/Hz",
        )
        coordinates.append("frequency")
    if isinstance(layout.task, Sweep):
        for name, values in layout.task.labels.items():
            unit = PARAMETERS[name].unit if name in PARAMETERS else ""
            found[name] = Variable(
                ("point",), values.shape, values.shape, values.dtype, unit, values
            )
            coordinates.append(name)
    return found, coordinates


def region_of(
    layout: Layout, chunk: Chunk, found: dict[str, np.ndarray], *, states: bool
) -> tuple[tuple[slice, ...], dict[str, np.ndarray]]:
    """Where the results of a chunk belong, and what is written there."""
    task = layout.task_of(0)
    parts = {task.output_name: found["output"]} | ({"power": found["power"]} if layout.bins else {})
    if states:
        for i, name in enumerate(task.state_names):
            parts.setdefault(name, found["states"][..., i])
    region = (
        slice(chunk.points.start, chunk.points.stop),
        slice(chunk.seeds.start, chunk.seeds.stop),
    )
    if not isinstance(layout.task, Sweep):
        return region[1:], {name: values[0] for name, values in parts.items()}
    return region, parts
