"""The linearisation point that maximises a DC bound with a fixed quadratic loss."""

from __future__ import annotations

import numpy as np

from dcreg.assignment.kernels.selection import cleared
from dcreg.jit import jit_part

_STEPS = 40


@jit_part
def best_linearisation(vertices, values, weights, floor, enough, point):
    """Return the maximum of ``min_v [E(v) - sum_a weights_a (v_a - theta0_a)^2]`` over theta0.

    The maximiser is written to `point`. The dual is the minimum of
    ``sum_v w_v (E(v) - Q(v)) + Q(sum_v w_v v)`` over weights w of the vertices. It is solved by pairwise
    Frank-Wolfe steps with exact line search; theta0 is the weighted mean of the vertices. Every iterate
    is valid, so the best one is kept. The search ends early if the dual shows that `floor` is out of
    reach, or if `enough` is reached.
    """
    count, dim = vertices.shape
    w, centre = np.empty(count), cleared(np.empty(dim))
    for v in range(count):
        w[v] = 1.0 / count
        for a in range(dim):
            centre[a] += w[v] * vertices[v, a]
    best = -np.inf
    for _ in range(_STEPS):
        low, high, ceiling = np.inf, -np.inf, 0.0
        toward, away = 0, 0
        for v in range(count):
            term = values[v]
            for a in range(dim):
                d = vertices[v, a] - centre[a]
                term -= weights[a] * d * d
            ceiling += w[v] * term
            if term < low:
                low, toward = term, v
            if w[v] > 0.0 and term > high:
                high, away = term, v
        if low > best:
            best = low
            for a in range(dim):
                point[a] = centre[a]
        if ceiling < floor or low >= enough or high - low <= 1e-3 * (abs(low) + 1e-12):
            break
        curve = 0.0
        for a in range(dim):
            d = vertices[toward, a] - vertices[away, a]
            curve += weights[a] * d * d
        step = w[away]
        if curve > 0.0:
            step = min(step, (high - low) / (2.0 * curve))
        w[toward] += step
        w[away] -= step
        for a in range(dim):
            centre[a] += step * (vertices[toward, a] - vertices[away, a])
    return best
