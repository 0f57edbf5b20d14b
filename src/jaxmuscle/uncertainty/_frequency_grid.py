"""Grids of a harmonic's frequency, over which a posterior is summed, and the tables of their
lines."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmuscle._common.programs import kept
from jaxmuscle.model._signals import Constant
from jaxmuscle.objective._problem import FitProblem
from jaxmuscle.objective._scoring import Maximum
from jaxmuscle.objective._starts import distinct
from jaxmuscle.response._harmonic_line import LineTable, line_table
from jaxmuscle.spectra._bin_law import trial_samples
from jaxmuscle.spectra._settings import WINDOW, SpectrumSettings

PER_BIN = 3
BEYOND = 2.0  # bins
HIGHEST = 0.49  # of the sampling rate
MODES, FADED = 4, 8.0
# Standard deviations about a maximum, out to where a wide cell holds next to nothing.
AROUND = np.array([-5.5, -4.0, -3.0, -2.25, -1.5, -0.75, 0.0, 0.75, 1.5, 2.25, 3.0, 4.0, 5.5])
FILLED = 16
# 1/Hz in any bin of a line of mean square 1: white noise of that mean square has 0.02
UNSEEN = 3e-5


Numbers = Array | np.ndarray
Grid = Float[Numbers, " grid"]
Frequencies = Float[np.ndarray, " grid"]


class Band(eqx.Module):
    """A harmonic frequency that is summed over: its grid f_j, weights w_j (prior density times the
    width of the cell).

    `parts` are those that it acts on, each with the `tables` of its lines. Their levels end with
    the last frequency whose line shows in the bins.
    """

    frequency: Grid
    log_weight: Grid
    tables: tuple[LineTable, ...]
    name: str = eqx.field(static=True)
    parts: tuple[int, ...] = eqx.field(static=True)


@kept
def _tables(settings: SpectrumSettings, frequency: Numbers, samples: Numbers) -> LineTable:
    table = jax.vmap(lambda f: line_table(settings, WINDOW, f, samples))(jnp.asarray(frequency))
    return table._replace(level=jnp.moveaxis(table.level, 0, -1))


def band_about(problem: FitProblem, peak: Maximum, name: str) -> Band:
    """The grid of one frequency, and the tables of its lines in the spectra of the parts that it
    acts on."""
    column = problem.coordinates.names.index(name)
    acting = tuple(i for i, part in enumerate(problem.parts) if column in part.columns)
    parts = [problem.parts[i] for i in acting]
    if not all(isinstance(part.task.harmonic.envelope, Constant) for part in parts):
        raise ValueError(
            f"{name}: with an envelope that changes its posterior cannot be summed over a grid:"
            f" fix it (free= without {name})"
        )
    frequency = _grid(problem, peak, name)
    tables = []
    for part in parts:
        table = _tables(part.target.settings, frequency, np.asarray(trial_samples(part.target)))
        # A third of the time in single precision; 1e-5 in a log density moves no draw.
        precision = np.float64 if part.target.segments is None else np.float32
        level = np.asarray(table.level[:, part.chosen], precision)
        # nowhere in a part without bins
        shows = 2 * level[0].max(axis=0, initial=0.0) > UNSEEN * np.asarray(table.passed)
        last = int(np.max(np.flatnonzero(shows), initial=0))
        level = level[..., : FILLED * (1 + last // FILLED)]
        tables.append(jax.tree.map(np.asarray, table)._replace(level=level))
    return Band(frequency, _log_weight(problem, frequency, name), tuple(tables), name, acting)


def _grid(problem: FitProblem, peak: Maximum, name: str) -> Frequencies:
    """Frequencies three to a bin over the band, fewer beyond it, and close about every maximum that
    counts.

    The last is repeated, so that few sizes are compiled.
    """
    c, targets = problem.coordinates, [part.target for part in problem.acting(name)]
    column, width = c.names.index(name), min(target.settings.resolution for target in targets)

    def at(theta: Any) -> Any:
        """The frequency of this coordinate."""
        return c.centre[column] * np.exp(c.sd[column] * theta)

    low, high = at(np.array([c.low[column], c.high[column]]))
    high = min(high, HIGHEST * min(target.settings.rate for target in targets))
    edge = max(target.frequency[-1] for target in targets) + 2 * width
    parts = [
        np.arange(low, min(edge, high), width / PER_BIN),
        np.arange(edge, high, BEYOND * width),
        [high],
    ]
    for i in distinct(problem, peak.cost, peak.theta, 0.5 * width, FADED, MODES, [name]):
        f = float(at(peak.theta[i, column]))
        sd = f * c.sd[column] * np.sqrt(peak.covariance(i)[column, column])
        if sd * np.diff(AROUND).min() < width / PER_BIN:  # else the grid is fine enough
            parts.append(f + sd * AROUND)
    grid = np.unique(np.clip(np.concatenate(parts), low, high))
    grid = grid[np.append(True, np.diff(grid) > 1e-3 * width)]
    return np.append(grid, np.full(-len(grid) % FILLED, grid[-1]))


def edges_of(frequency: Frequencies) -> Float[np.ndarray, " edges"]:
    """Borders of the cells of a grid: half-way between its points, and its ends."""
    return np.concatenate([frequency[:1], 0.5 * (frequency[1:] + frequency[:-1]), frequency[-1:]])


def _log_weight(problem: FitProblem, frequency: Frequencies, name: str) -> Frequencies:
    """Prior density of every frequency times the width of its cell."""
    precision = problem.prior[problem.coordinates.names.index(name)]
    theta = problem.coordinates.theta_of(name, frequency)
    with np.errstate(divide="ignore"):  # what is repeated has no width
        width = np.log(np.diff(edges_of(frequency)))
    return -0.5 * precision * theta**2 - np.log(frequency) + width
