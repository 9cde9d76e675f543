"""Prove that no pose matches k feasible pairs with a small objective, from distances alone.

Suppose that a pose has k one-to-one feasible pairs with a sum of squared residuals of at most V. The
k - h + 1 largest residuals are at least the h-th smallest one, so the h smallest are at most

    rho = sqrt(V / (k - h + 1)).

A pose multiplies distances by its scale s. The distances within two pairs (x, y) and (x', y') of these h
therefore satisfy | s |x - x'| - |y - y'| | <= 2 rho. Call two feasible pairs *consistent* if they share
no point and satisfy this for some admissible s. The h pairs are mutually consistent: they are a clique in
the graph of consistent pairs. If there is no clique of h pairs, for any one h, then the objective of
every pose exceeds V.

A pair of a clique of h has at least h - 1 neighbours, and two pairs of it have at least h - 2 common
neighbours. Pairs and edges that have fewer are removed until none is left to remove. If at least h
pairs remain, some pair is in the clique or not: the search continues among its neighbours for a clique
of h - 1, and then without it.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np

from dcreg.search import Budget

# Shares h / k that are tried, each with the number of graphs after which it is given up. A larger h needs
# a larger clique, but more pairs are consistent.
ATTEMPTS = (0.6, 2_000), (2.0 / 3.0, 40_000)
DENSEST = 0.5  # share of consistent pairs; with more, large cliques are common and none is searched
_MARGIN = 1e-9  # relative; covers rounding


class Undecided(Exception):  # noqa: N818 (not an error: `refutes` catches it)
    """The search for a clique has taken too long."""


def refutes(
    source: np.ndarray,
    target: np.ndarray,
    candidates: np.ndarray,
    n_inliers: int,
    scale_range: tuple[float, float],
    limit: float,
    budget: Budget,
) -> bool:
    """Tell whether every pose is proven to have an objective above `limit`; False is no statement.

    Memory grows with the square of the number of feasible pairs.

    Parameters
    ----------
    source, target : (n, d), (m, d) arrays
    candidates : (n, m) bool array
        The feasible pairs.
    n_inliers : int
    scale_range : (low, high)
        Of the poses.
    limit : float
    budget : Budget
    """
    pairs = np.argwhere(candidates)
    for share, most in ATTEMPTS:
        size = max(1, round(share * n_inliers))
        reach = 2.0 * np.sqrt(limit / (n_inliers - size + 1))
        graph = consistent(source[pairs[:, 0]], target[pairs[:, 1]], pairs, scale_range, reach)
        if graph.mean() > DENSEST:
            continue
        try:
            if not has_clique(graph, size, _turns(most, budget)):
                return True
        except Undecided:
            continue
    return False


def _turns(most: int, budget: Budget) -> Iterator[int]:
    """Yield `most` turns, fewer if the time is over."""
    return itertools.takewhile(lambda _: not budget.is_over, range(most))


def consistent(
    source: np.ndarray,
    target: np.ndarray,
    pairs: np.ndarray,
    scale_range: tuple[float, float],
    reach: float,
) -> np.ndarray:
    """Return the (N, N) adjacency matrix of N consistent pairs, as 0 and 1 in single precision.

    Parameters
    ----------
    source, target : (N, d) arrays
        The points of the pairs.
    pairs : (N, 2) int array
        Which points they are.
    scale_range : (low, high)
    reach : float
        How far a scaled distance in the source may be from that in the target.
    """
    before, after = _distances(source), _distances(target)
    reach += _MARGIN * (reach + scale_range[1] * before.max() + after.max())
    near = (scale_range[0] * before - after <= reach) & (after - scale_range[1] * before <= reach)
    for side in pairs.T:
        near &= side[:, None] != side
    return near.astype(np.float32)


def _distances(points: np.ndarray) -> np.ndarray:
    # row by row, without an array of all differences
    return np.array([np.sqrt(((points - point) ** 2).sum(axis=1)) for point in points])


def has_clique(graph: np.ndarray, size: int, turns: Iterator[object]) -> bool:
    """Tell whether the graph of an (N, N) adjacency matrix has a clique of `size` vertices.

    Every graph on the way takes one of the `turns`; without one it raises `Undecided`.
    """
    if next(turns, None) is None:
        raise Undecided
    graph = _reduced(graph, size)
    if len(graph) < size or size <= 2:
        return len(graph) >= size
    alive = np.ones(len(graph), dtype=bool)
    for vertex in np.argsort(graph.sum(axis=1), kind="stable"):
        near = np.flatnonzero((graph[vertex] > 0.0) & alive)
        if len(near) >= size - 1 and has_clique(graph[np.ix_(near, near)], size - 1, turns):
            return True
        alive[vertex] = False
    return False


def _reduced(graph: np.ndarray, size: int) -> np.ndarray:
    """Return the graph without vertices and edges that have too few neighbours for a clique of `size`."""
    while len(graph) >= size:
        kept = graph.sum(axis=1) >= size - 1
        if not kept.all():
            graph = graph[np.ix_(kept, kept)]
            continue
        rare = (graph > 0.0) & (graph @ graph < size - 2)
        if not rare.any():
            break
        graph = np.where(rare, np.float32(0.0), graph)
    return graph
