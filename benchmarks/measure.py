"""Time programs side by side, and keep what was measured as rows."""

import dataclasses
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

Program = Callable[[], Any]
DTYPES = ("float64", "float32")


class Unequal(Exception):
    """Two programs that must compute the same did not."""


@dataclasses.dataclass(frozen=True)
class Row:
    """One number; a ratio says to what (`ratio_to`); `target`, if anything is asked, is to be
    reached, or kept `at_most`."""

    name: str
    value: float
    unit: str
    ratio_to: str | None = None
    target: float | None = None
    at_most: bool = False

    @property
    def met(self) -> bool | None:
        """Whether the target was reached; None without one."""
        if self.target is None:
            return None
        return self.value <= self.target if self.at_most else self.value >= self.target

    @property
    def figure(self) -> str:
        """The name, with what it is compared to."""
        return self.name if self.ratio_to is None else f"{self.name} of {self.ratio_to}"

    def as_dict(self) -> dict[str, Any]:
        """The row as the JSON file holds it."""
        return dataclasses.asdict(self) | {"met": self.met}

    def __str__(self) -> str:
        asked = f"  {'<=' if self.at_most else '>='} {self.target}: "
        verdict = {None: "", True: asked + "met", False: asked + "MISSED"}[self.met]
        versus = "" if self.ratio_to is None else f"  of {self.ratio_to}"
        return f"{self.name:<64}{self.value:>10.4g}  {self.unit}{versus}{verdict}"


class Taken(NamedTuple):
    """Wall and processor times [s] of the repetitions of one program."""

    wall: np.ndarray
    processor: np.ndarray


def seconds(programs: Mapping[str, Program], repetitions: int) -> dict[str, Taken]:
    """Times of each program, run in turn after a warm-up; every round starts with another one."""
    names = list(programs)
    for name in names:
        jax.block_until_ready(programs[name]())
    taken: dict[str, list[tuple[float, float]]] = {name: [] for name in names}
    for turn in range(repetitions):
        first = turn % len(names)
        for name in names[first:] + names[:first]:
            wall, processor = time.perf_counter(), time.process_time()
            jax.block_until_ready(programs[name]())
            taken[name].append((time.perf_counter() - wall, time.process_time() - processor))
    return {name: Taken(*np.array(times).T) for name, times in taken.items()}


def speeds(group: str, taken: Mapping[str, Taken], steps: Mapping[str, int]) -> list[Row]:
    """Median million steps per second of each program."""
    return [
        Row(f"{group}: {name}", float(steps[name] / np.median(times.wall) / 1e6), "million steps/s")
        for name, times in taken.items()
    ]


def speed_ratio(
    group: str,
    taken: Mapping[str, Taken],
    steps: Mapping[str, int],
    pair: tuple[str, str],
    target: float | None = None,
) -> list[Row]:
    """Speed of the first of a pair over that of the second, by wall time and, without target, by
    processor time.

    Each the median over rounds of the ratio within a round, so that drift cancels.
    """
    ours, other = taken[pair[0]], taken[pair[1]]
    size = steps[pair[0]] / steps[pair[1]]
    wall, processor = (float(size * np.median(b / a)) for a, b in zip(ours, other, strict=True))
    return [
        Row(f"{group}: speed of {pair[0]}", wall, "times", pair[1], target),
        Row(f"{group}: speed by processor time", processor, "times", pair[1]),
    ]


def require_equal(what: str, ours: Any, other: Any, tolerance: float) -> float:
    """Largest difference of two arrays of states, each state relative to its largest value. Raises
    `Unequal`."""
    ours, other = np.asarray(ours, dtype=float), np.asarray(other, dtype=float)
    if ours.shape != other.shape:
        raise Unequal(f"{what}: shapes {ours.shape} and {other.shape} differ")
    axes = tuple(range(ours.ndim - 1))
    difference = float(np.max(np.abs(ours - other).max(axes) / np.abs(other).max(axes)))
    if not difference <= tolerance:
        raise Unequal(f"{what}: relative difference {difference:.2g} exceeds {tolerance:.2g}")
    return difference
