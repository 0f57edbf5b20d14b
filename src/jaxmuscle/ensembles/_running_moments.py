"""Moments and quantiles of an ensemble that never is in memory: a tally, to which chunks are
added."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

LEVELS = (0.05, 0.25, 0.5, 0.75, 0.95)
CELLS = 512
AT_ONCE = 2**18  # numbers of the output that are counted at once
REACH = 8.0  # standard deviations of the first chunk


class RunningMoments(NamedTuple):
    """What is known of every point of a sweep (a leading axis, 1 long for one task).

    `seeds` that were finite; `mean` and `squares` (sums of squared deviations) of the values of a
    seed in a row: its output over time, then what else is averaged. Quantiles of the output are
    `exact` where the seeds of a point are few; else its values are counted in `cells` between
    `low` and `high` of every sample (the outermost ones open), and NaN where no chunk of the point
    was seen.
    """

    seeds: Int[np.ndarray, " points"]
    mean: Float[np.ndarray, "points values"]
    squares: Float[np.ndarray, "points values"]
    exact: Float[np.ndarray, "points levels samples"]
    low: Float[np.ndarray, "points samples"]
    high: Float[np.ndarray, "points samples"]
    cells: Int[np.ndarray, "points samples cells"]


def empty(points: int, values: int, samples: int, levels: int, *, whole: bool) -> RunningMoments:
    """Of nothing; `whole` if quantiles are exact, so that nothing has to be counted in cells."""
    rows, cells = np.zeros((points, values)), 0 if whole else CELLS
    unknown = np.full((points, samples), np.nan)
    exact = np.full((points, levels, samples), np.nan)
    return RunningMoments(
        np.zeros(points, int),
        rows,
        rows.copy(),
        exact,
        unknown,
        unknown.copy(),
        np.zeros((points, samples, cells), np.int32),
    )


class ChunkMoments(NamedTuple):
    """What a chunk adds to one point: finite `seeds`, `mean` and `squares` of their values; its
    `output`, where quantiles are exact."""

    seeds: int
    mean: Float[np.ndarray, " values"]
    squares: Float[np.ndarray, " values"]
    output: Float[np.ndarray, "seeds samples"] | None = None


def moments(rows: Float[np.ndarray, "seeds values"]) -> ChunkMoments:
    """Of the finite seeds of a chunk of one point."""
    if not len(rows):
        nothing = np.zeros(rows.shape[1])
        return ChunkMoments(0, nothing, nothing)
    mean = rows.mean(axis=0, dtype=float)
    return ChunkMoments(len(rows), mean, np.square(rows - mean).sum(axis=0))


def add(kept: RunningMoments, point: int, more: ChunkMoments) -> None:
    """Take a chunk of one point into what is kept, in place."""
    if more.seeds:
        found = _merged(
            (kept.seeds[point], kept.mean[point], kept.squares[point]),
            (more.seeds, more.mean, more.squares),
        )
        kept.seeds[point], kept.mean[point], kept.squares[point] = found


def _merged(a: tuple, b: tuple) -> tuple:
    """Moments of two sets together (Chan, Golub & LeVeque 1983,
    doi:10.1080/00031305.1983.10483115)."""
    count = a[0] + b[0]
    share = b[0] / np.maximum(count, 1)
    delta = b[1] - a[1]
    return count, a[1] + share * delta, a[2] + b[2] + delta**2 * (share * a[0])


Edges = tuple[Float[np.ndarray, " samples"], Float[np.ndarray, " samples"]]


def edges_of(output: Float[np.ndarray, "seeds samples"]) -> Edges:
    """Where the cells of a point begin and end, from the output of its first chunk."""
    mean, sd = output.mean(axis=0, dtype=float), output.std(axis=0, dtype=float)
    # what does not vary has its value for a quantile
    tiny = 1e-6 * np.abs(mean) + 1e3 * np.finfo(output.dtype).tiny
    reach = np.maximum(REACH * sd, 2 * np.abs(output - mean).max(axis=0)) + tiny
    return mean - reach, mean + reach


def count_cells(
    low: Float[np.ndarray, " samples"],
    high: Float[np.ndarray, " samples"],
    output: Float[np.ndarray, "seeds samples"],
) -> Int[np.ndarray, "samples cells"]:
    """How much of the output of a chunk lies in each cell of its point; few seeds at a time, which
    stay in the cache."""
    samples = output.shape[1]
    below, above = low.astype(output.dtype), high.astype(output.dtype)
    scale, first = CELLS / (above - below), CELLS * np.arange(samples, dtype=np.int32)
    found = np.zeros(samples * CELLS, np.int32)
    together = max(1, AT_ONCE // samples)
    for begin in range(0, len(output), together):
        place = output[begin : begin + together] - below
        place *= scale
        np.clip(place, 0, CELLS - 1, out=place)
        cell = place.astype(np.int32)
        cell += first
        found += np.bincount(cell.ravel(), minlength=found.size).astype(np.int32)
    return found.reshape(samples, CELLS)


def quantiles(
    kept: RunningMoments, levels: tuple[float, ...]
) -> Float[np.ndarray, "points levels samples"]:
    """Quantiles of the output: exact, or linear within their cell (1/32 of a standard deviation);
    NaN in an open cell."""
    found = kept.exact.copy()
    for point in np.flatnonzero((kept.cells.shape[2] > 0) & (kept.seeds > 0)):
        low, cells = kept.low[point], kept.cells[point]
        width = (kept.high[point] - low) / CELLS
        upto, rows = np.cumsum(cells, axis=1), np.arange(len(cells))
        for i, level in enumerate(levels):
            wanted = level * upto[:, -1]
            cell = np.minimum((upto < wanted[:, None]).sum(axis=1), CELLS - 1)
            inside = np.maximum(cells[rows, cell], 1)
            place = cell + (wanted - upto[rows, cell] + cells[rows, cell]) / inside
            closed = (cell > 0) & (cell < CELLS - 1)
            found[point, i] = np.where(closed, low + width * place, np.nan)
    return found
