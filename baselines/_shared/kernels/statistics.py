"""Compiled statistics of matchings, and the concave function of them; see `baselines._shared.concave`."""

from __future__ import annotations

import math

import numpy as np

from dcreg.assignment.kernels.dense import k_assignment
from dcreg.jit import jit

N_STATISTICS = 7


@jit
def statistics(clouds, col_of):
    """Return u and L of a matching."""
    u = np.zeros(N_STATISTICS)
    fixed = 0.0
    for i in range(col_of.size):
        j = col_of[i]
        if j < 0:
            continue
        a, b = clouds.source[i, 0], clouds.source[i, 1]
        c, d = clouds.target[j, 0], clouds.target[j, 1]
        u[0] += a * a + b * b
        u[1] += a
        u[2] += b
        u[3] += c
        u[4] += d
        u[5] += a * c + b * d
        u[6] += a * d - b * c
        fixed += c * c + d * d
    return u, fixed


@jit
def minimum_linear(clouds, weights, weight_fixed):
    """Minimise ``weights . u(P) + weight_fixed L(P)`` over matchings; return value and columns."""
    n, m = len(clouds.source), len(clouds.target)
    cost = np.empty((n, m))
    col = np.empty(m)
    for j in range(m):
        c, d = clouds.target[j, 0], clouds.target[j, 1]
        col[j] = weights[3] * c + weights[4] * d + weight_fixed * (c * c + d * d)
    for i in range(n):
        a, b = clouds.source[i, 0], clouds.source[i, 1]
        row = weights[0] * (a * a + b * b) + weights[1] * a + weights[2] * b
        c_weight = weights[5] * a - weights[6] * b
        d_weight = weights[5] * b + weights[6] * a
        for j in range(m):
            cost[i, j] = (
                row + col[j] + c_weight * clouds.target[j, 0] + d_weight * clouds.target[j, 1]
            )
    return k_assignment(cost, clouds.k, np.zeros(1, np.uint8))


@jit
def concave(clouds, u):
    """Return f(u), which is finite for every u."""
    k, low, high = clouds.k, clouds.low, clouds.high
    spread = u[0] - (u[1] * u[1] + u[2] * u[2]) / k
    dot = u[5] - (u[1] * u[3] + u[2] * u[4]) / k
    cross = u[6] - (u[1] * u[4] - u[2] * u[3]) / k
    r = math.sqrt(dot * dot + cross * cross)
    value = min(low * (low * spread - 2.0 * r), high * (high * spread - 2.0 * r))
    if spread > 0.0 and low * spread < r < high * spread:
        value = min(value, -r * r / spread)
    return value - (u[3] * u[3] + u[4] * u[4]) / k
