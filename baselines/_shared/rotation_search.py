"""Most source points that one rotation can bring near target points: exact, by match lists.

For points about a common origin, R x can lie within a radius tau of y for some rotation only if
``||x| - |y|| <= tau`` (the shell test); it does for a given R exactly if the angle between R x and
y is at most eps, with ``cos eps = (|x|^2 + |y|^2 - tau^2) / (2 |x||y|)``. Rotation vectors of a cube
with half-width s lie within an angle delta = min(sqrt(3) s, pi) of its centre, so a pair is possible
in the cube only if the angle at the centre is at most eps + delta. Counting source points that have
a possible partner bounds the count from above. A cube tests only the pairs possible in its parent.
The published alternative, circle indices in a stereographic projection, answers the same test. Tried
as a tree of caps per source point (a projection maps caps to circles), with the same results, it
was slower than match lists but for wide radii from some 100 points on (1.2 times as fast there, twice
at 300), and in single searches at the radii of noise slower at all sizes up to 1000 points.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from numba import njit

from baselines._shared.cubes import OutOfTimeError

_TESTS_PER_SLICE = 2_000_000  # pair tests between two looks at the clock: some 20 ms
_LEAST_HALF_WIDTH = 1e-6  # radians; a smaller cube is not divided and keeps its upper bound
FINISHED, PAUSED = 0, 1
STACKED, BEST, GIVEN_UP, CUBES = range(4)  # places in a search's integer state


@dataclass(frozen=True)
class Found:
    """`upper_bound` on the count over all rotations, and the best rotation met with its count."""

    upper_bound: int
    count: int
    rotation: np.ndarray
    n_cubes: int


def most_matches(
    source: np.ndarray, target: np.ndarray, radius: float, cutoff: int, slack: int, deadline: float
) -> Found:
    """Bound the number of source points that a rotation brings within `radius` of a target point.

    Parameters
    ----------
    source, target : (n, 3), (m, 3) arrays
    radius : float
    cutoff : int
        Counts up to this one are of no interest: the bound is not made lower.
    slack : int
        The bound may exceed the best count by this much.
    deadline : float
        Moment of `time.perf_counter()` after which `OutOfTimeError` is raised.
    """
    norms, others = np.linalg.norm(source, axis=1), np.linalg.norm(target, axis=1)
    pairs = np.column_stack(np.nonzero(np.abs(norms[:, None] - others) <= radius))
    return _most_of(source, target, pairs, radius, cutoff, slack, deadline)


def most_correspondences(
    source: np.ndarray, target: np.ndarray, radius: float, cutoff: int, slack: int, deadline: float
) -> Found:
    """Bound the number of rows i whose source a rotation brings within `radius` of target i.

    Parameters and result are those of `most_matches`, but for `target`: (n, 3), row by row.
    """
    lengths = np.linalg.norm(source, axis=1) - np.linalg.norm(target, axis=1)
    rows = np.flatnonzero(np.abs(lengths) <= radius)
    return _most_of(source, target, np.column_stack([rows, rows]), radius, cutoff, slack, deadline)


def warm_up() -> None:
    """Compile the search; problems as easy as those of a warm-up end without it."""
    most_matches(np.eye(3), np.eye(3), 0.1, 0, 0, np.inf)


def _most_of(
    source: np.ndarray,
    target: np.ndarray,
    pairs: np.ndarray,
    radius: float,
    cutoff: int,
    slack: int,
    deadline: float,
) -> Found:
    """The search over `pairs` (by source index) that pass the shell test."""
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
        code = _search(
            *directions, pairs, cosines, cutoff, slack, stack, spans, lists, state, rotation,
            _TESTS_PER_SLICE,
        )  # fmt: skip
        if len(lists) < spans[state[STACKED] - 1].sum() + 8 * len(pairs):
            lists = np.concatenate([lists, np.empty_like(lists)])
        if code == PAUSED and time.perf_counter() > deadline:
            raise OutOfTimeError
    upper_bound = int(max(state[GIVEN_UP], state[BEST]))
    return Found(upper_bound, int(state[BEST]), rotation, int(state[CUBES]))


def _cosines(a: np.ndarray, b: np.ndarray, radius: float) -> np.ndarray:
    """cos and sin of the largest angle between points of length a and b within the radius."""
    gap = np.abs(a - b)
    # By sin^2(eps / 2): 1 - cos eps itself would lose half the digits of a small eps.
    with np.errstate(divide="ignore", invalid="ignore"):
        half = (radius - gap) * (radius + gap) / (4 * a * b)
    # A point in the origin, or both within the radius of it: every rotation will do.
    half = np.where(a + b <= radius, 1.0, np.clip(half, 0.0, 1.0))
    return np.column_stack([1.0 - 2.0 * half, 2.0 * np.sqrt(half * (1.0 - half))])


def _directions(points: np.ndarray) -> np.ndarray:
    norms = np.linalg.norm(points, axis=1, keepdims=True)
    return points / np.where(norms > 0, norms, 1.0)


@njit(cache=True)
def _search(
    source, target, pairs, cosines, cutoff, slack, stack, spans, lists, state, rotation, budget
):  # fmt: skip
    """Depth first, the most promising child first; pauses after `budget` pair tests."""
    children = np.empty((8, 5))
    sizes = np.empty(8, np.int64)
    centre_rotation = np.empty((3, 3))
    tests = 0
    while state[STACKED] > 0:
        top = state[STACKED] - 1
        start, size = spans[top]
        if tests > budget or start + 9 * size > len(lists) or state[STACKED] + 8 > len(stack):
            return PAUSED
        upper = int(stack[top, 4])
        state[STACKED] = top
        if upper <= max(cutoff, state[BEST] + slack) or stack[top, 3] < _LEAST_HALF_WIDTH:
            state[GIVEN_UP] = max(state[GIVEN_UP], upper)
            continue
        half = stack[top, 3] / 2
        delta = min(np.sqrt(3.0) * half, np.pi)
        kept = np.empty((8, size), np.int32)
        for octant in range(8):
            child = children[octant]
            for axis in range(3):
                child[axis] = stack[top, axis] + half * (1 if octant >> axis & 1 else -1)
            child[3], child[4], sizes[octant] = half, -1, 0
            angle = np.sqrt(child[0] ** 2 + child[1] ** 2 + child[2] ** 2)
            if angle - np.sqrt(3.0) * half > np.pi:
                continue  # the rotations of this cube are in others
            _rotation_of(child[0], child[1], child[2], angle, centre_rotation)
            bar = max(cutoff, state[BEST] + slack)
            sizes[octant], possible, matched = _match(
                source, target, pairs, cosines, lists[start : start + size], centre_rotation,
                np.cos(delta), np.sin(delta), upper, bar, kept[octant],
            )  # fmt: skip
            tests += size
            state[CUBES] += 1
            if matched > state[BEST]:
                state[BEST] = matched
                rotation[:] = centre_rotation
            child[4] = possible
        for octant in np.argsort(children[:, 4]):  # the best one on top
            possible = children[octant, 4]
            if possible <= max(cutoff, state[BEST] + slack):
                state[GIVEN_UP] = max(state[GIVEN_UP], int(possible))
                continue
            top = state[STACKED]
            stack[top] = children[octant]
            spans[top, 0], spans[top, 1] = start, sizes[octant]
            lists[start : start + sizes[octant]] = kept[octant, : sizes[octant]]
            start += sizes[octant]
            state[STACKED] = top + 1
    return FINISHED


@njit(cache=True)
def _match(
    source, target, pairs, cosines, listed, rotation, cos_delta, sin_delta, upper, bar, kept
):  # fmt: skip
    """(pairs kept, source points with a possible partner, those matched by `rotation` itself).

    Gives up, with a valid bound and matched = 0, once too many points are without a partner to
    exceed `bar`; `upper` points have pairs in the list.
    """
    n_kept = possible = matched = failed = 0
    position, last = 0, len(listed)
    while position < last:
        i = pairs[listed[position], 0]
        x = (
            rotation[0, 0] * source[i, 0]
            + rotation[0, 1] * source[i, 1]
            + rotation[0, 2] * source[i, 2]
        )
        y = (
            rotation[1, 0] * source[i, 0]
            + rotation[1, 1] * source[i, 1]
            + rotation[1, 2] * source[i, 2]
        )
        z = (
            rotation[2, 0] * source[i, 0]
            + rotation[2, 1] * source[i, 1]
            + rotation[2, 2] * source[i, 2]
        )
        is_possible = is_matched = False
        while position < last and pairs[listed[position], 0] == i:
            p = listed[position]
            j = pairs[p, 1]
            cosine = x * target[j, 0] + y * target[j, 1] + z * target[j, 2]
            c, s = cosines[p, 0], cosines[p, 1]
            # Rounding must not lose a pair that is possible, nor add one that is not matched.
            if c + cos_delta <= 0.0 or cosine >= c * cos_delta - s * sin_delta - 1e-12:
                kept[n_kept] = p
                n_kept += 1
                is_possible = True
                if cosine >= c:
                    is_matched = True
            position += 1
        possible += is_possible
        matched += is_matched
        failed += not is_possible
        if upper - failed <= bar:
            return 0, upper - failed, 0
    return n_kept, possible, matched


@njit(cache=True)
def _rotation_of(x, y, z, angle, rotation):
    """Rodrigues' formula for the rotation vector (x, y, z) of this length, into `rotation`."""
    if angle < 1e-12:
        rotation[:] = np.eye(3)
        return
    x, y, z = x / angle, y / angle, z / angle
    c, s = np.cos(angle), np.sin(angle)
    v = 1.0 - c
    rotation[0] = c + x * x * v, x * y * v - z * s, x * z * v + y * s
    rotation[1] = y * x * v + z * s, c + y * y * v, y * z * v - x * s
    rotation[2] = z * x * v - y * s, z * y * v + x * s, c + z * z * v
