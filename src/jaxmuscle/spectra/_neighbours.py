"""How many templates lie near each template of a record, counted exactly in O(N log² N) steps
instead of N²."""

import numpy as np
import scipy
from jaxtyping import Float, Int

DIGIT = 4  # bits that a level looks at together
LEAF = 6  # bits of rank below which points are compared one by one
FEW = 4000  # templates for which the tree is as quick


def neighbours(
    templates: Float[np.ndarray, "templates m"], radius: float
) -> Int[np.ndarray, " templates"]:
    """For each template how many lie within `radius` of it in the maximum norm, itself included.

    Long records of templates of two or three samples are counted by rank: the points with first
    coordinate below a bound are the union of log N blocks of points in the order of that
    coordinate; in each block, a wavelet matrix counts those whose other two coordinates lie within
    bounds.
    """
    n, m = templates.shape
    if n <= FEW or m not in (2, 3):
        # Counting without listing the neighbours: memory grows with the number of samples, not its
        # square.
        tree = scipy.spatial.KDTree(templates)
        return np.asarray(tree.query_ball_point(templates, radius, p=np.inf, return_length=True))
    ranks, low, high = zip(*(_ranked(column, radius) for column in templates.T), strict=True)
    if m == 2:
        order = np.argsort(ranks[0])
        return _within(ranks[1][order], low[0], high[0], low[1], high[1])
    twice = [tuple(np.concatenate((bound, bound)) for bound in bounds) for bounds in (low, high)]
    below = _below(ranks, np.concatenate((high[0], low[0])), *twice)
    return below[:n] - below[n:]


def _ranked(x: Float[np.ndarray, " n"], radius: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ranks of the values, all different, and the bounds of the ranks of values y with |y - x| <=
    radius."""
    order = np.argsort(x, kind="stable")
    ranks, ordered = np.empty(x.size, np.int32), x[order]
    ranks[order] = np.arange(x.size)
    low, high = (
        np.searchsorted(ordered, x - radius),
        np.searchsorted(ordered, x + radius, side="right"),
    )
    # x - radius is rounded: a value at the very bound is decided by the difference itself, as in a
    # tree.
    padded = np.concatenate(([-np.inf], ordered, [np.inf]))
    for _ in range(2):
        low = np.where(x - padded[low] <= radius, np.searchsorted(ordered, padded[low]), low)
        low = np.where(
            x - padded[low + 1] > radius,
            np.searchsorted(ordered, padded[low + 1], side="right"),
            low,
        )
        high = np.where(
            padded[high + 1] - x <= radius,
            np.searchsorted(ordered, padded[high + 1], side="right"),
            high,
        )
        high = np.where(padded[high] - x > radius, np.searchsorted(ordered, padded[high]), high)
    return ranks, low, high


def _within(
    values: Int[np.ndarray, " n"],
    first: Int[np.ndarray, " queries"],
    stop: Int[np.ndarray, " queries"],
    low: Int[np.ndarray, " queries"],
    high: Int[np.ndarray, " queries"],
) -> Int[np.ndarray, " queries"]:
    """How many of values[first:stop] lie in [low, high), for every query: a wavelet matrix, made
    and used level by level."""
    n, base, columns = values.size, 1 << DIGIT, (1 << DIGIT) + 1
    counts = np.zeros(first.size, np.int64)
    states = [(1, high, first, stop), (-1, low, first, stop)]
    for shift in reversed(range(0, n.bit_length(), DIGIT)):
        digit = ((values >> shift) & (base - 1)).astype(np.uint8)
        # [k, d]: how many of the first k have a digit below d
        table = np.zeros((n + 1, columns), np.int32)
        np.cumsum(digit[:, None] < np.arange(columns, dtype=np.uint8), axis=0, out=table[1:])
        flat, moved = table.ravel(), []
        for sign, bound, *ends in states:
            d = (bound >> shift) & (base - 1)
            places = [end * columns + d for end in ends]
            below = [flat[place] for place in places]
            counts += sign * (below[1] - below[0])
            moved.append(
                (
                    sign,
                    bound,
                    *(
                        table[n, d] + flat[p + 1] - less
                        for p, less in zip(places, below, strict=True)
                    ),
                )
            )
        states, values = moved, values[np.argsort(digit, kind="stable")]
    return counts


def _below(
    ranks: tuple[np.ndarray, ...],
    bounds: np.ndarray,
    low: tuple[np.ndarray, ...],
    high: tuple[np.ndarray, ...],
) -> Int[np.ndarray, " n"]:
    """For every template how many have a first rank below its bound and the other two within
    theirs."""
    order = np.argsort(ranks[1])
    a, c = ranks[0][order], ranks[2][order]
    n, counts = a.size, np.zeros(bounds.size, np.int64)
    first, stop = low[1], high[1]
    for shift in reversed(range(LEAF, n.bit_length())):
        one = (a >> shift) & 1
        zeros = np.concatenate(([0], np.cumsum(1 - one)))
        order = np.argsort(one.astype(np.uint8), kind="stable")
        a, c = a[order], c[order]
        ends, used = [zeros[first], zeros[stop]], ((bounds >> shift) & 1).astype(bool)
        there = np.flatnonzero(used & (ends[1] > ends[0]))
        counts[there] += _within(c, ends[0][there], ends[1][there], low[2][there], high[2][there])
        first, stop = (
            np.where(used, zeros[n] + end - moved, moved)
            for end, moved in zip((first, stop), ends, strict=True)
        )
    order = np.argsort(ranks[0])
    b, c = ranks[1][order], ranks[2][order]
    begin = bounds >> LEAF << LEAF
    for step in range(1 << LEAF):
        i = np.flatnonzero(begin + step < bounds)
        at = begin[i] + step
        counts[i] += (
            (b[at] >= low[1][i])
            & (b[at] < high[1][i])
            & (c[at] >= low[2][i])
            & (c[at] < high[2][i])
        )
    return counts
