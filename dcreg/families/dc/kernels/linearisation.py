"""The linearisation point at which a DC bound is greatest, where its loss is a fixed quadratic."""

from __future__ import annotations

import numpy as np

from dcreg.jit import jit_part

_STEPS = 40


@jit_part
def best_linearisation(vertices, values, weights, floor, enough, point):
    """Value and place (in `point`) of the theta0 with the greatest
    ``min_v [E(v) - sum_a weights_a (v_a - theta0_a)^2]``.

    The dual is the least of ``sum_v w_v (E(v) - Q(v)) + Q(sum_v w_v v)`` over weights w on the
    vertices. Pairwise Frank-Wolfe steps with exact line search; theta0 is the weighted vertex and every
    iterate is valid, so the best one is kept. Given up where the dual shows that `floor` is out of
    reach, and ended where `enough` is reached.
    """
    count, dim = vertices.shape
    w, centre = np.empty(count), np.zeros(dim)
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
