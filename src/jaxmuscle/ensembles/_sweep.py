"""Many tasks in one ensemble: a grid of parameters, a design, draws from a posterior, or different
persons."""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from jaxmuscle._common.arrays import as_arrays, as_numbers, checked
from jaxmuscle._common.cards import Card, Shown, facts
from jaxmuscle.model._parameters import PARAMETERS, proper_values
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.simulation._trajectory import Trajectory

if TYPE_CHECKING:
    import xarray


class Sweep(Shown, eqx.Module):
    """Tasks of one kind with different numbers, as an axis `point` of an ensemble.

    `Sweep.grid(task, k_w=[...], c_w=[...])` is every combination, the last name fastest;
    `Sweep.design(task, {name: values})` one point for each row of equally long columns, such as
    `posterior.samples`; `Sweep.of(tasks)` any tasks that differ in numbers only, such as the fits
    of several persons. `len(sweep)` is the number of points, `sweep[i]` the task of point i;
    `labels` {name: values} say what differs; `task` holds the tasks of all points in one, each of
    its numbers an array with a leading axis of points.

    Seed i has the same noise at every point (common random numbers), so differences between points
    are sharp.
    """

    task: AbstractTask
    labels: dict[str, Float[np.ndarray, " points"] | np.ndarray]

    def _card(self) -> Card:
        leaves = jax.tree.leaves(self.task)
        if not leaves or not all(isinstance(leaf, np.ndarray) for leaf in leaves):
            return Card(eqx.tree_pformat(self))  # a tree that JAX or Equinox took apart
        count = f"{len(self)} point{'' if len(self) == 1 else 's'}"
        return _facts(f"sweep of {type(self.task).__name__}: {count}", _differing(self.labels))

    @staticmethod
    def of(tasks: Sequence[AbstractTask], names: Sequence[str] | None = None) -> "Sweep":
        """The given tasks, labelled by `names`, if you give them, and by the parameters that
        differ.

        **Raises:** `ValueError` for no task, and for tasks that differ in more than numbers.
        """
        if len(tasks) == 0:
            raise ValueError("a sweep needs at least one task")
        numbers = [as_numbers(task) for task in tasks]
        shape = _shape(numbers[0])
        for i, task in enumerate(numbers):
            if _shape(task) != shape:
                raise ValueError(
                    f"task {i} of the sweep differs from task 0 in more than numbers"
                    f" ({_parts(numbers[0])} against {_parts(task)}): simulate such tasks one"
                    " by one"
                )
        task = jax.tree.map(
            lambda *leaves: np.stack([np.asarray(x, dtype=float) for x in leaves]), *numbers
        )
        labels: dict[str, np.ndarray] = (
            {} if names is None else {"name": np.array([str(n) for n in names])}
        )
        if names is not None and len(names) != len(tasks):
            raise ValueError(f"names has {len(names)} entries for {len(tasks)} tasks")
        for name in numbers[0].parameter_names:
            values = np.array([float(task[name]) for task in numbers])
            if np.any(values != values[0]):
                labels[name] = values
        return Sweep(task, labels)

    @staticmethod
    def grid(task: AbstractTask, **values: Any) -> "Sweep":
        """Every combination of the values. Raises as `design` does."""
        rows = np.array(
            list(itertools.product(*(np.atleast_1d(v) for v in values.values()))), dtype=float
        )
        return Sweep.design(task, dict(zip(values, rows.reshape(-1, len(values)).T, strict=True)))

    @staticmethod
    def design(task: AbstractTask, values: Mapping[str, Any]) -> "Sweep":
        """One point for each entry of the columns, in the units of the table of parameters.

        Columns may have several axes (as chains and draws) if all have the same shape; the last
        axis runs fastest.

        **Raises:** `ValueError` for an unknown name, a value outside its bounds, columns of
        different lengths, no point.
        """
        columns = {
            name: np.asarray(column, dtype=float).ravel()
            for name, column in proper_values(values).items()
        }
        sizes = {name: column.size for name, column in columns.items()}
        if len(set(sizes.values())) != 1 or 0 in sizes.values():
            raise ValueError(f"a design needs columns of one length of at least 1, not {sizes}")
        for name, column in columns.items():
            row = PARAMETERS.get(name)
            low, high = (-np.inf, np.inf) if row is None else (row.lower, row.upper)
            bad = np.flatnonzero(~((column >= low) & (column <= high) & np.isfinite(column)))
            if bad.size:
                span = "a finite number" if row is None else row.range
                raise ValueError(
                    f"{name} = {column[bad[0]]:g} at point {bad[0]} is outside its range, {span}"
                )
        with jax.enable_x64(True):
            put = jax.jit(jax.vmap(lambda row: as_arrays(task).replace(**row)))
            made = Sweep(jax.tree.map(np.asarray, put(columns)), columns)
        for i in range(len(made)):
            checked(made[i])
        return made

    def __len__(self) -> int:
        return len(jax.tree.leaves(self.task)[0])

    def __getitem__(self, point: int) -> AbstractTask:
        if not -len(self) <= point < len(self):
            raise IndexError(f"point {point} of a sweep of {len(self)}")
        return as_numbers(jax.tree.map(lambda leaf: leaf[point], self.task))

    def __iter__(self) -> Iterator[AbstractTask]:
        return (self[i] for i in range(len(self)))


def _facts(heading: str, rows: list[tuple[str, str]]) -> Card:
    """Names of parameters may be long."""
    return facts(heading, rows, max([8, *(len(name) for name, _ in rows)]))


def _differing(labels: Mapping[str, np.ndarray]) -> list[tuple[str, str]]:
    """What differs between the points: how many values, from the smallest to the largest."""
    rows = []
    for name, values in labels.items():
        known, unit = np.unique(values), PARAMETERS[name].unit if name in PARAMETERS else ""
        first, last = (
            f"{end:.4g}" if values.dtype.kind == "f" else str(end) for end in (known[0], known[-1])
        )
        ends = f"{first} to {last} {unit}" if len(known) > 1 else f"{first} {unit}"
        rows.append(
            (
                name,
                ends.removesuffix(" 1").strip()
                + (f", {len(known)} values" if len(known) > 1 else ""),
            )
        )
    return rows


def _shape(task: AbstractTask) -> Any:
    return jax.tree.structure(task), [np.shape(leaf) for leaf in jax.tree.leaves(task)]


def _parts(task: AbstractTask) -> str:
    return ", ".join(type(part).__name__ for part in (task, task.muscle, task.noise))


class Population(Shown, eqx.Module):
    """Ensembles of every point of `sweep`: `population[i]`, which is `members[i]`, is the
    `Trajectory` of point i."""

    sweep: Sweep
    members: tuple[Trajectory, ...]

    def _card(self) -> Card:
        if not isinstance(self.sweep, Sweep) or not all(
            isinstance(member, Trajectory) for member in self.members
        ):
            return Card(eqx.tree_pformat(self))
        first = self.members[0]
        known = [
            ("task", type(first.task).__name__),
            ("time", f"0 to {first.time[-1]:g} s at {first.rate:g} Hz"),
            ("seeds", f"{np.size(first.seeds)} at every point"),
            *_differing(self.sweep.labels),
        ]
        what = f"{first.task.output_name} [{first.task.output_unit}]"
        return _facts(f"{len(self)} ensembles of {what}: [i] is that of point i", known)

    def __len__(self) -> int:
        return len(self.members)

    def __getitem__(self, point: int) -> Trajectory:
        return self.members[point]

    def __iter__(self) -> Iterator[Trajectory]:
        return iter(self.members)

    def to_xarray(self) -> "xarray.Dataset":
        """A Dataset with dimensions point, seed, time, labelled by what differs between the
        points."""
        import xarray

        joined = xarray.concat(
            [member.to_xarray() for member in self.members], "point", combine_attrs="drop_conflicts"
        )
        return joined.assign_coords(
            {name: ("point", values) for name, values in self.sweep.labels.items()}
        )
