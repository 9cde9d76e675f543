"""Rigid poses as seen from one of them, what pairs cost at one, and bounds by nearest points."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dcreg.assignment.kernels.selection import least, sum_of_smallest
from dcreg.families.kernels import add_prices
from dcreg.families.rotation3d.kernels.geometry import chord_matrix, transform
from dcreg.jit import jit


class View(NamedTuple):
    """A problem as seen from the centre of a box, which becomes the pose (I, 0).

    Attributes
    ----------
    moved : (3, n) array
        R_c x.
    shifted : (3, m) array
        y - t_c.
    prices : (n, m) array, or (0, 0) where every pair is feasible
    k : int
    stop : (1,) uint8 array
        Set when the search is over, wherever a kernel stands.
    """

    moved: np.ndarray
    shifted: np.ndarray
    prices: np.ndarray
    k: int
    stop: np.ndarray


@jit
def relative_vertices(centre, lower, upper, out):
    """Gibbs vectors from the rotation `centre` to the vertices of a quaternion box.

    Fills rows of `out` (8, 3), returns their number; 0 where a vertex lies a half-turn away or more.
    """
    count = 0
    a, b, c, d = centre[0], -centre[1], -centre[2], -centre[3]  # the inverse of the centre
    for v in range(16):
        flat = False
        for axis in range(4):
            flat |= (v >> axis) & 1 == 1 and upper[axis] <= lower[axis]
        if flat:  # the same vertex as another one
            continue
        w = upper[0] if v & 1 else lower[0]
        x = upper[1] if v & 2 else lower[1]
        y = upper[2] if v & 4 else lower[2]
        z = upper[3] if v & 8 else lower[3]
        real = w * a - x * b - y * c - z * d
        if real <= 0.0:
            return 0
        out[count, 0] = (w * b + x * a + y * d - z * c) / real
        out[count, 1] = (w * c - x * d + y * a + z * b) / real
        out[count, 2] = (w * d + x * c - y * b + z * a) / real
        count += 1
    return count


@jit
def look_from(clouds, theta, view):
    """Move the points of `view` to where they are seen from the pose `theta`."""
    transform(chord_matrix(theta, theta), clouds.source, view.moved)
    _shift(clouds.target, theta, view.shifted)


@jit
def _shift(target, theta, out):
    """Targets as seen from the translation of a pose."""
    for c in range(3):
        for j in range(target.shape[1]):
            out[c, j] = target[c, j] - theta[4 + c]


@jit
def add_prices_by_target(prices, out):
    """Add what pairs cost beyond their residual to (m, n) costs."""
    for i in range(prices.shape[0]):
        for j in range(prices.shape[1]):
            out[j, i] += prices[i, j]


@jit
def nearest_sums(caps, slack, k):
    """Sums of the k smallest row minima: of squared distances, and of squares of (distance - slack)."""
    low = np.empty(caps.shape[0])
    for i in range(low.size):
        low[i] = least(caps[i])
    whole = sum_of_smallest(low, k)
    for i in range(low.size):
        low[i] = max(0.0, math.sqrt(low[i]) - slack) ** 2
    return whole, sum_of_smallest(low, k)


@jit
def pose_costs(theta, clouds, out):
    """(n, m) squared residuals at a pose, and the prices."""
    moved, shifted = np.empty(clouds.source.shape), np.empty(clouds.target.shape)
    transform(chord_matrix(theta, theta), clouds.source, moved)
    _shift(clouds.target, theta, shifted)
    pair_costs(moved, shifted, clouds.prices, out)


@jit
def pair_costs(moved, shifted, prices, out):
    """(n, m) squared distances, and the prices."""
    for i in range(out.shape[0]):
        a, b, c = moved[0, i], moved[1, i], moved[2, i]
        for j in range(out.shape[1]):
            x, y, z = a - shifted[0, j], b - shifted[1, j], c - shifted[2, j]
            out[i, j] = x * x + y * y + z * z
    add_prices(prices, out)


@jit
def nearest_scores(thetas, clouds, scores):
    """Sum of the k smallest squared nearest distances at every pose: a cheap guess of E."""
    n, m = clouds.source.shape[1], clouds.target.shape[1]
    costs = np.empty((n, m))
    for at in range(thetas.shape[0]):
        if clouds.stop[0]:
            break
        pose_costs(thetas[at], clouds, costs)
        scores[at] = nearest_sums(costs, 0.0, clouds.k)[0]
