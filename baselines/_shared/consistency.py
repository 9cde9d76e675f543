"""What pairs of correspondences say of each other: lengths, the graph of consistent ones, votes.

A rigid motion keeps distances. Two correspondences can both be right only if the distance between
their sources, times the scale, is that between their targets, up to the noise of both.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from scipy.spatial.distance import cdist

from baselines._shared.cliques import set_bit

MOST_VOTERS = 1500  # correspondences that vote on the scale, spread evenly over more


def length_differences(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """``| |y_i - y_j| - |x_i - x_j| |`` for all i and j."""
    return np.abs(cdist(source, source) - cdist(target, target))


def sharing(pairs: np.ndarray) -> np.ndarray:
    """Which correspondences share a point, hence are not both right in a one-to-one matching."""
    return (pairs[:, None, 0] == pairs[None, :, 0]) | (pairs[:, None, 1] == pairs[None, :, 1])


@njit(cache=True)
def consistency_graph(source, target, pairs, tolerance, scale):
    """Rows of bits: ``| |y_i - y_j| - scale |x_i - x_j| | <= tolerance`` and no point shared."""
    n, d = source.shape
    rows = np.zeros((n, (n + 63) >> 6), dtype=np.uint64)
    for i in range(n):
        for j in range(i):
            if pairs[i, 0] == pairs[j, 0] or pairs[i, 1] == pairs[j, 1]:
                continue
            a, b = 0.0, 0.0
            for k in range(d):
                a += (source[i, k] - source[j, k]) ** 2
                b += (target[i, k] - target[j, k]) ** 2
            if abs(np.sqrt(b) - scale * np.sqrt(a)) <= tolerance:
                set_bit(rows[i], j)
                set_bit(rows[j], i)
    return rows


@njit(cache=True)
def length_ratios(source, target, tolerance, low, high):
    """Ratios ``|y_i - y_j| / |x_i - x_j|`` that can be a scale in [low, high], and their ranges.

    The range of a ratio is by how much noise can change it: tolerance / ``|x_i - x_j|``.
    """
    n, d = source.shape
    ratios = np.empty(n * (n - 1) // 2)
    ranges = np.empty(len(ratios))
    count = 0
    for i in range(n):
        for j in range(i):
            a, b = 0.0, 0.0
            for k in range(d):
                a += (source[i, k] - source[j, k]) ** 2
                b += (target[i, k] - target[j, k]) ** 2
            a = np.sqrt(a)
            if a > tolerance:  # shorter ones bound the scale by nothing
                ratio, reach = np.sqrt(b) / a, tolerance / a
                if ratio + reach >= low and ratio - reach <= high:
                    ratios[count], ranges[count] = ratio, reach
                    count += 1
    return ratios[:count], ranges[:count]


def vote(values: np.ndarray, ranges: np.ndarray) -> tuple[float, np.ndarray]:
    """Minimise ``sum(min((value - x)^2 / range^2, 1))`` over x, exactly.

    Adaptive voting: between two neighbouring ends of the intervals ``value ± range`` the set of
    voters is fixed and the best x is their weighted mean, so that trying all sets is trying all x.

    Returns
    -------
    x : float
    voters : (n,) bool
        Those within their range of x.
    """
    # The optimum is among the means; a mean outside of its own stretch only overstates its cost.
    centre = float(np.median(values))  # sums of squares lose digits far from zero
    shifted = values - centre
    ends = np.concatenate([shifted - ranges, shifted + ranges])
    order = np.argsort(ends, kind="stable")
    best = centre + _sweep(shifted, ranges, order)
    return best, np.abs(values - best) <= ranges


@njit(cache=True)
def _sweep(values, ranges, order):
    """The weighted mean of least truncated cost along the sorted ends of the intervals."""
    n = len(values)
    weight, first, second, voters = 0.0, 0.0, 0.0, 0
    best, least = 0.0, np.inf
    for k in order:
        entering = k < n
        i = k if entering else k - n
        w = 1.0 / (ranges[i] * ranges[i])
        if not entering:
            w = -w
        voters += 1 if entering else -1
        weight += w
        first += w * values[i]
        second += w * values[i] ** 2
        if voters > 0:
            mean = first / weight
            cost = second - first * mean + (n - voters)
            if cost < least:
                best, least = mean, cost
    return best


def vote_scale(
    source: np.ndarray, target: np.ndarray, tolerance: float, scale_range: tuple[float, float]
) -> float:
    """The scale that most distances between correspondences speak for, by adaptive voting."""
    low, high = scale_range
    if low == high:
        return low
    every = -(-len(source) // MOST_VOTERS)
    ratios, ranges = length_ratios(source[::every], target[::every], tolerance, low, high)
    if len(ratios) == 0:
        return float(np.clip(1.0, low, high))
    return float(np.clip(vote(ratios, ranges)[0], low, high))


def vote_translation(points: np.ndarray, target: np.ndarray, reach: float) -> np.ndarray:
    """``target - points`` by adaptive voting, axis by axis."""
    ranges = np.full(len(points), reach)
    return np.array([vote(column, ranges)[0] for column in (target - points).T])
