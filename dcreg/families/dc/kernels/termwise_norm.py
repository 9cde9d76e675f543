"""Term-wise relaxations of the objective in norm space (reconstructed RPM-HTB, R1 and R2).

The objective is ``E = |x|^2 + 2 x.t - 2 |y| |x + t| + k |t|^2 + |y|^2``. Its product of the matching with
a length |x_i + t| belongs to one row each: R1 has the three aggregates of x, and one of |y| for every
row. The mean facet of such a row costs its error whether the row is matched or not, so R1 takes it only
where all rows are, and R2's interval otherwise. With r_i the greatest length in the box,

    |x_i + t| <= (r_i^2 + |x_i + t|^2) / (2 r_i) <= (r_i^2 + secants of the squares) / (2 r_i) <= r_i,

a linear function of t.
"""

from __future__ import annotations

import math

import numpy as np

from dcreg.assignment.kernels.dense import k_assignment
from dcreg.families.dc.kernels.termwise_envelopes import least_product, relax_product
from dcreg.jit import jit


@jit
def norm_bounds(points, low, high, averaged, lower, upper, bounds, thetas):
    """R1 (`averaged`) or R2 in norm space; `low` and `high` are the ranges of the aggregates of x.

    One assignment a box. R1 writes the t that minimises its quadratic into `thetas`.
    """
    source, norms, prices, k = points.source, points.target, points.prices, points.k
    n, m = source.shape[0], norms.size
    cost, alpha, beta = np.empty((n, m)), np.empty(3), np.empty(3)
    length_low, length_high = np.empty(n), np.empty(n)
    all_rows = averaged and k == n
    least, most = norms[0], norms[0]
    for j in range(m):
        least, most = min(least, norms[j]), max(most, norms[j])
    for box in range(lower.shape[0]):
        lo, up = lower[box], upper[box]
        lengths(source, lo, up, length_low, length_high)
        for a in range(3):
            alpha[a] = beta[a] = 0.0
        constant = 0.0
        if averaged:
            for a in range(3):
                alpha[a], beta[a], c0 = relax_product(2.0, low[a], high[a], lo[a], up[a])
                constant += c0
        for i in range(n):
            charge, slope = 0.0, -2.0 * length_high[i]
            for a in range(3):
                x = source[i, a]
                charge += x * x + (
                    alpha[a] * x if averaged else least_product(2.0 * x, lo[a], up[a])
                )
            if all_rows and length_high[i] > 0.0:
                slope, weight, c0 = relax_product(-2.0, least, most, length_low[i], length_high[i])
                constant += c0 + _add_length(source[i], lo, up, length_high[i], weight, beta)
            for j in range(m):
                cost[i, j] = charge + norms[j] * (slope + norms[j])
                if prices.size > 0:
                    cost[i, j] += prices[i, j]
        value, _ = k_assignment(cost, k, points.stop)
        value += constant
        for a in range(3):
            t = min(max(-beta[a] / (2.0 * k), lo[a]), up[a])
            value += beta[a] * t + k * t * t
            if averaged:
                thetas[box, a] = t
        bounds[box] = value
    return lower.shape[0]


@jit
def lengths(source, lower, upper, least, most):
    """Range of |x_i + t| over the box of t."""
    for i in range(source.shape[0]):
        near = far = 0.0
        for a in range(3):
            p, q = source[i, a] + lower[a], source[i, a] + upper[a]
            near += max(p, -q, 0.0) ** 2
            far += max(-p, q) ** 2
        least[i], most[i] = math.sqrt(near), math.sqrt(far)


@jit
def _add_length(x, lower, upper, radius, weight, beta):
    """weight |x + t| for weight <= 0, bounded below: adds the slopes to `beta`, returns the constant."""
    constant = 0.5 * weight * radius
    for a in range(3):
        p, q = x[a] + lower[a], x[a] + upper[a]
        beta[a] += 0.5 * weight / radius * (p + q)
        constant += 0.5 * weight / radius * (x[a] * (p + q) - p * q)
    return constant
