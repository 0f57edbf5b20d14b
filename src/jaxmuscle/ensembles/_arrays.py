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
    task, seeds, swept = layout.task_of(0), len(layout.seeds), isinstance(layout.task, Sweep)
    lead, shape, cut = (("point",), (layout.points,), (layout.together,)) if swept else ((), (), ())
    dtype = np.dtype(jax.numpy.result_type(float))

    def of_seeds(dim: str, size: int, unit: str) -> Variable:
        return Variable(
            (*lead, "seed", dim),
            (*shape, seeds, size),
            (*cut, min(layout.width, seeds), size),
            dtype,
            unit,
        )

    labels = {
        "seed": Variable.whole(("seed",), np.asarray(layout.seeds, np.int64), ""),
        "time": Variable.whole(("time",), layout.time, "s"),
    }
    found = {task.output_name: of_seeds("time", layout.time.size, task.output_unit)}
    for name, unit in zip(task.state_names, task.state_units, strict=True) if states else ():
        found.setdefault(name, of_seeds("time", layout.time.size, unit))
    if layout.bins:
        frequency = np.asarray(task.settings.frequency, float)
        labels["frequency"] = Variable.whole(("frequency",), frequency, "Hz")
        found["power"] = of_seeds("frequency", layout.bins, squared(task.output_unit) + "/Hz")
    if isinstance(layout.task, Sweep):
        for name, values in layout.task.labels.items():
            unit = PARAMETERS[name].unit if name in PARAMETERS else ""
            labels[name] = Variable.whole(("point",), values, unit)
    return labels | found, list(labels)


def region_of(layout: Layout, chunk: Chunk) -> tuple[slice, ...]:
    """Where the results of a chunk belong."""
    points, seeds = (slice(part.start, part.stop) for part in (chunk.points, chunk.seeds))
    return (points, seeds) if isinstance(layout.task, Sweep) else (seeds,)


def parts_of(
    layout: Layout, found: dict[str, np.ndarray], *, states: bool
) -> dict[str, np.ndarray]:
    """What is written of the results of a chunk."""
    task = layout.task_of(0)
    parts = {task.output_name: found["output"]} | ({"power": found["power"]} if layout.bins else {})
    if states:
        for i, name in enumerate(task.state_names):
            parts.setdefault(name, found["states"][..., i])
    swept = isinstance(layout.task, Sweep)
    return {name: values if swept else values[0] for name, values in parts.items()}
