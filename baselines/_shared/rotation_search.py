"""Maximum number of source points that one rotation moves near target points: exact, by match lists.

For points about a common origin, R x lies within a radius tau of y for some rotation only if
``||x| - |y|| <= tau`` (the shell test). For a given R it does if and only if the angle between R x and y
is at most eps, with ``cos eps = (|x|^2 + |y|^2 - tau^2) / (2 |x||y|)``. Rotation vectors of a cube
with half-width s lie within an angle delta = min(sqrt(3) s, pi) of its centre, so a pair is possible
in the cube only if the angle at the centre is at most eps + delta. Counting source points that have
a possible partner bounds the count from above. A cube tests only the pairs possible in its parent.
The published alternative, circle indices in a stereographic projection, answers the same test. We tried
a tree of caps per source point (the projection maps caps to circles). It gave the same results and was
slower than match lists, except for wide radii with about 100 points or more (1.2 times as fast, twice at
300 points). In single searches at noise radii it was slower at all sizes up to 1000 points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from baselines._shared.cubes import OutOfTimeError
from baselines._shared.kernels.rotations import BEST, CUBES, GIVEN_UP, PAUSED, STACKED, divide_cubes
from dcreg.search import Budget

_TESTS_PER_SLICE = 2_000_000  # pair tests between two checks of the budget, about 20 ms


@dataclass(frozen=True)
class Found:
    """An upper bound on the count over all rotations, and the best rotation found with its count."""

    upper_bound: int
    count: int
    rotation: np.ndarray
    n_cubes: int


def most_matches(
    source: np.ndarray, target: np.ndarray, radius: float, cutoff: int, slack: int, budget: Budget
) -> Found:
    """Bound the number of source points that a rotation moves within `radius` of a target point.

    Parameters
    ----------
    source, target : (n, 3), (m, 3) arrays
    radius : float
    cutoff : int
        The bound is not refined below this count.
    slack : int
        The bound may exceed the best count by this much.
    budget : Budget

    Raises
    ------
    OutOfTimeError
        If the budget is over.
    """
    norms, others = np.linalg.norm(source, axis=1), np.linalg.norm(target, axis=1)
    pairs = np.column_stack(np.nonzero(np.abs(norms[:, None] - others) <= radius))
    return _most_of(source, target, pairs, radius, cutoff, slack, budget)


def most_correspondences(
    source: np.ndarray, target: np.ndarray, radius: float, cutoff: int, slack: int, budget: Budget
) -> Found:
    """Bound the number of rows i whose source a rotation moves within `radius` of target i.

    Parameters and result are those of `most_matches`, except `target`: (n, 3), row by row.
    """
    lengths = np.linalg.norm(source, axis=1) - np.linalg.norm(target, axis=1)
    rows = np.flatnonzero(np.abs(lengths) <= radius)
    return _most_of(source, target, np.column_stack([rows, rows]), radius, cutoff, slack, budget)


def warm_up() -> None:
    """Compile the search, which the easy problem of a warm-up does not reach."""
    most_matches(np.eye(3), np.eye(3), 0.1, 0, 0, Budget())


def _most_of(
    source: np.ndarray,
    target: np.ndarray,
    pairs: np.ndarray,
    radius: float,
    cutoff: int,
    slack: int,
    budget: Budget,
) -> Found:
    """Search over the `pairs` (sorted by source index) that pass the shell test."""
    n_possible = len(np.unique(pairs[:, 0]))
    if n_possible <= cutoff:
        return Found(n_possible, 0, np.eye(3), 0)
    norms, others = np.linalg.norm(source, axis=1), np.linalg.norm(target, axis=1)
    cosines = _cosines(norms[pairs[:, 0]], others[pairs[:, 1]], radius)
    pairs = pairs.astype(np.int32)
    directions = (_directions(source), _directions(target))
    stack = np.zeros((8 * 64 + 1, 5))  # centre, half-width and upper bound; depth is at most 64
    stack[0, 3:] = np.pi, n_possible
    spans = np.zeros((len(stack), 2), np.int64)  # of each cube's list in `lists`
    spans[0] = 0, len(pairs)
    lists = np.arange(max(64 * len(pairs), 1), dtype=np.int32)
    state = np.array([1, 0, 0, 0])
    rotation = np.eye(3)
    code = PAUSED
    while code == PAUSED:
        code = divide_cubes(
            *directions, pairs, cosines, cutoff, slack, stack, spans, lists, state, rotation,
            _TESTS_PER_SLICE,
        )  # fmt: skip
        if len(lists) < spans[state[STACKED] - 1].sum() + 8 * len(pairs):
            lists = np.concatenate([lists, np.empty_like(lists)])
        if code == PAUSED and budget.is_over:
            raise OutOfTimeError
    upper_bound = int(max(state[GIVEN_UP], state[BEST]))
    return Found(upper_bound, int(state[BEST]), rotation, int(state[CUBES]))


def _cosines(a: np.ndarray, b: np.ndarray, radius: float) -> np.ndarray:
    """Return cos and sin of the maximum angle between points of length a and b within the radius."""
    gap = np.abs(a - b)
    # Via sin^2(eps / 2): 1 - cos eps loses half of the digits of a small eps.
    with np.errstate(divide="ignore", invalid="ignore"):
        half = (radius - gap) * (radius + gap) / (4 * a * b)
    # A point at the origin, or both within the radius of it: every rotation matches.
    half = np.where(a + b <= radius, 1.0, np.clip(half, 0.0, 1.0))
    return np.column_stack([1.0 - 2.0 * half, 2.0 * np.sqrt(half * (1.0 - half))])


def _directions(points: np.ndarray) -> np.ndarray:
    norms = np.linalg.norm(points, axis=1, keepdims=True)
    return points / np.where(norms > 0, norms, 1.0)
