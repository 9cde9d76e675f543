"""Rigid poses relative to one of them, costs of pairs at a pose, and bounds by nearest points."""

from __future__ import annotations

import math

import numpy as np

from dcreg.assignment.kernels.selection import least, sum_of_smallest
from dcreg.families.kernels import Clouds, add_penalty, weigh
from dcreg.families.rotation3d.kernels.geometry import chord_matrix, transform
from dcreg.jit import jit, jit_inner, jit_part


@jit_inner
def relative_vertices(centre, lower, upper, out):
    """Return the Gibbs vectors from the rotation `centre` to the vertices of a quaternion box.

    Fills rows of `out` (8, 3) and returns their number; 0 if a vertex is a half-turn away or more.
    """
    count = 0
    a, b, c, d = centre[0], -centre[1], -centre[2], -centre[3]  # the inverse of the centre
    for v in range(16):
        flat = False
        for axis in range(4):
            flat |= (v >> axis) & 1 == 1 and upper[axis] <= lower[axis]
        if flat:  # duplicate of another vertex
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


@jit_part
def empty_view(clouds):
    """Allocate clouds that `look_from` fills."""
    source, target = np.empty(clouds.source.shape), np.empty(clouds.target.shape)
    return Clouds(
        source, target, clouds.infeasibility_penalty, clouds.weights, clouds.heaviest, clouds.k,
        clouds.stop,
    )  # fmt: skip


@jit_inner
def look_from(clouds, theta, view):
    """Fill `view` with R x and y - t for the pose `theta`, which becomes (I, 0)."""
    transform(chord_matrix(theta, theta), clouds.source, view.source)
    _shift(clouds.target, theta, view.target)


@jit
def _shift(target, theta, out):
    """Shift the targets by the translation of a pose."""
    for c in range(3):
        for j in range(target.shape[1]):
            out[c, j] = target[c, j] - theta[4 + c]


@jit_inner
def add_penalty_by_target(penalty, out):
    """Add the penalties of infeasible pairs to (m, n) costs."""
    for i in range(penalty.shape[0]):
        for j in range(penalty.shape[1]):
            out[j, i] += penalty[i, j]


@jit_inner
def nearest_sums(caps, shift_radius, k):
    """Sum the k smallest row minima: of squared distances, and of (distance - shift_radius)^2."""
    low = np.empty(caps.shape[0])
    for i in range(low.size):
        low[i] = least(caps[i])
    whole = sum_of_smallest(low, k)
    for i in range(low.size):
        low[i] = max(0.0, math.sqrt(low[i]) - shift_radius) ** 2
    return whole, sum_of_smallest(low, k)


@jit
def pose_costs(theta, clouds, out):
    """Fill (n, m) squared residuals at a pose, with penalties and weights."""
    view = empty_view(clouds)
    look_from(clouds, theta, view)
    pair_costs(view, out)


@jit_inner
def pair_costs(clouds, out):
    """Fill (n, m) squared distances, with penalties and weights."""
    source, target = clouds.source, clouds.target
    for i in range(out.shape[0]):
        a, b, c = source[0, i], source[1, i], source[2, i]
        for j in range(out.shape[1]):
            x, y, z = a - target[0, j], b - target[1, j], c - target[2, j]
            out[i, j] = x * x + y * y + z * z
    add_penalty(clouds.infeasibility_penalty, out)
    weigh(clouds.weights, out)


@jit
def nearest_scores(thetas, clouds, scores):
    """Sum the k smallest squared nearest distances at each pose: a cheap estimate of E."""
    n, m = clouds.source.shape[1], clouds.target.shape[1]
    costs = np.empty((n, m))
    for at in range(thetas.shape[0]):
        if clouds.stop[0]:
            break
        pose_costs(thetas[at], clouds, costs)
        scores[at] = nearest_sums(costs, 0.0, clouds.k)[0]
