"""What an ensemble's numbers depend on, as attributes of its store."""

import hashlib
import json
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxmuscle._common.arrays import as_numbers
from jaxmuscle._common.environment import versions
from jaxmuscle.model._stream import VERSION as STREAM
from jaxmuscle.simulation._trajectory import run_attributes

from ._layout import Cut, Layout
from ._store import SETTINGS, description_of
from ._sweep import Sweep

CUT = "points at once", "chunk", "exact quantiles"


def begun_with(path: Path) -> Cut | None:
    """How an existing store was cut, so that it can be resumed with other devices; None if there is
    none."""
    if not path.exists():
        return None
    settings = json.loads(description_of(path)["attributes"][SETTINGS])
    return Cut(*(settings.get(name, 1) for name in CUT))


def identity(layout: Layout, kind: dict[str, Any]) -> dict[str, Any]:
    """The attribute by which a store is known again: all that its numbers depend on."""
    return {SETTINGS: json.dumps(settings_of(layout) | kind)}


def about(layout: Layout) -> dict[str, Any]:
    """What was run, as attributes."""
    plan, labels = layout.plan, layout.task.labels if isinstance(layout.task, Sweep) else ()
    made = run_attributes(
        layout.task_of(0), plan.rate, plan.grid.dt, plan.grid.substeps, plan.sampling, labels
    )
    return made | {"precision": str(jax.numpy.result_type(float))}


def settings_of(layout: Layout) -> dict[str, Any]:
    """All that the numbers depend on, for a store that is resumed to be compared with."""
    task, plan = layout.task_of(0), layout.plan
    numbers = layout.task.task if isinstance(layout.task, Sweep) else as_numbers(layout.task)
    everything = _digest(str(jax.tree.structure(numbers)), *jax.tree.leaves(numbers))
    seeds = layout.seeds
    given = (
        f"0 to {len(seeds) - 1}"
        if isinstance(seeds, range)
        else f"{len(seeds)}, digest {_digest(seeds)}"
    )
    parameters = {name: float(value) for name, value in as_numbers(task.parameters).items()}
    return {
        "task": type(task).__name__,
        "muscle": type(task.muscle).__name__,
        "noise": type(task.noise).__name__,
        "points": layout.points,
        "parameters": parameters,
        "inputs and everything else": everything,
        "key": np.asarray(jax.random.key_data(layout.key)).ravel().tolist(),
        "seeds": given,
        "duration": layout.duration,
        "dt": plan.grid.dt,
        "rate": plan.rate,
        "substeps": plan.grid.substeps,
        "sampling": plan.sampling,
        "spectrum": task.settings.to_dict(),
        "control": layout.linear is not None,
        **dict(zip(CUT, (layout.together, layout.width, layout.whole), strict=True)),
        "precision": str(jax.numpy.result_type(float)),
        "random numbers": layout.recipe.draws._asdict() | {"stream": STREAM},
        "versions": {name: versions()[name] for name in ("jaxmuscle", "jax")},
    }


def _digest(*values: Any) -> str:
    found = hashlib.sha256()
    for value in values:
        found.update(value.encode() if isinstance(value, str) else np.asarray(value).tobytes())
    return found.hexdigest()[:16]
