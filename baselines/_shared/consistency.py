"""Consistency of pairs of correspondences: lengths, shared points, and votes on scale and translation.

A rigid motion preserves distances. Two correspondences can both be true only if the distance between
their sources, times the scale, equals that between their targets, up to the noise of both.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.distance import cdist

from baselines._shared.kernels.lengths import length_ratios, sweep_ends

MOST_VOTERS = 1500  # correspondences that vote on the scale; of more, an even subset


def length_differences(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return ``| |y_i - y_j| - |x_i - x_j| |`` for all i and j."""
    return np.abs(cdist(source, source) - cdist(target, target))


def sharing(pairs: np.ndarray) -> np.ndarray:
    """Return which correspondences share a point, so that a matching contains one of them at most."""
    return (pairs[:, None, 0] == pairs[None, :, 0]) | (pairs[:, None, 1] == pairs[None, :, 1])


def vote(values: np.ndarray, ranges: np.ndarray) -> tuple[float, np.ndarray]:
    """Minimise ``sum(min((value - x)^2 / range^2, 1))`` over x, exactly.

    Adaptive voting: between two adjacent ends of the intervals ``value ± range`` the set of voters is
    constant and the best x is their weighted mean. Trying all sets is therefore exact.

    Returns
    -------
    x : float
    voters : (n,) bool
        The values within their range of x.
    """
    # The optimum is among the means; the cost of a mean outside its own interval is overestimated.
    centre = float(np.median(values))  # sums of squares lose precision far from zero
    shifted = values - centre
    ends = np.concatenate([shifted - ranges, shifted + ranges])
    order = np.argsort(ends, kind="stable")
    best = centre + sweep_ends(shifted, ranges, order)
    return best, np.abs(values - best) <= ranges


def vote_scale(
    source: np.ndarray, target: np.ndarray, tolerance: float, scale_range: tuple[float, float]
) -> float:
    """Return the scale by adaptive voting over the distances between correspondences."""
    low, high = scale_range
    if low == high:
        return low
    every = -(-len(source) // MOST_VOTERS)
    ratios, ranges = length_ratios(source[::every], target[::every], tolerance, low, high)
    if len(ratios) == 0:
        return float(np.clip(1.0, low, high))
    return float(np.clip(vote(ratios, ranges)[0], low, high))


def vote_translation(points: np.ndarray, target: np.ndarray, reach: float) -> np.ndarray:
    """Return ``target - points`` by adaptive voting, axis by axis."""
    ranges = np.full(len(points), reach)
    return np.array([vote(column, ranges)[0] for column in (target - points).T])
