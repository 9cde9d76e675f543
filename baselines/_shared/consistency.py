"""What pairs of correspondences say of each other: lengths, the graph of consistent ones, votes.

A rigid motion keeps distances. Two correspondences can both be right only if the distance between
their sources, times the scale, is that between their targets, up to the noise of both.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.distance import cdist

from baselines._shared.kernels.lengths import length_ratios, sweep_ends

MOST_VOTERS = 1500  # correspondences that vote on the scale, spread evenly over more


def length_differences(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """``| |y_i - y_j| - |x_i - x_j| |`` for all i and j."""
    return np.abs(cdist(source, source) - cdist(target, target))


def sharing(pairs: np.ndarray) -> np.ndarray:
    """Which correspondences share a point, hence are not both right in a one-to-one matching."""
    return (pairs[:, None, 0] == pairs[None, :, 0]) | (pairs[:, None, 1] == pairs[None, :, 1])


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
    best = centre + sweep_ends(shifted, ranges, order)
    return best, np.abs(values - best) <= ranges


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
