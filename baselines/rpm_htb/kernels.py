"""Compiled term-wise relaxations (reconstructed RPM-HTB, R1 and R2), in 2D and in norm space.

In 2D the objective is a sum of products, see `baselines._shared.kernels.products`. R1 relaxes the
products of aggregated features and parameters by the mean of two McCormick facets. R2 replaces each
monomial of each pair by its minimum over the box.

In norm space the objective is ``E = |x|^2 + 2 x.t - 2 |y| |x + t| + k |t|^2 + |y|^2``. Its product of the
matching with a length |x_i + t| belongs to a single row: R1 has the three aggregates of x, and one of
|y| for every row. The mean facet of such a row costs its error whether the row is matched or not. R1
therefore takes it only where all rows are matched, and R2's interval otherwise. With r_i the maximum
length in the box,

    |x_i + t| <= (r_i^2 + |x_i + t|^2) / (2 r_i) <= (r_i^2 + secants of the squares) / (2 r_i) <= r_i,

a linear function of t.
"""

from __future__ import annotations

import math

import numpy as np

from baselines._shared.kernels.products import (
    BILINEAR,
    N_FEATURES,
    minimum_product,
    product_range,
    relax_product,
    relax_square,
    relaxed_costs,
)
from dcreg.assignment.kernels.dense import k_assignment
from dcreg.jit import jit

# the trilinear terms of the 2D objective: feature, first parameter, second parameter, coefficient
TRILINEAR = np.array(
    [[0, 0, 0, 1], [0, 1, 1, 1], [1, 0, 2, 2], [1, 1, 3, 2], [2, 0, 3, 2], [2, 1, 2, -2]]
)


@jit
def aggregated_bound(features, ranges, k, stop, lower, upper, bounds, thetas, matchings):
    """R1: one assignment, written into `matchings`, and one separable QP per box.

    Returns the number of assignments.
    """
    n, m = features.shape[1], features.shape[2]
    low, high = ranges
    cost = np.empty((n, m))
    alpha, beta = np.empty(N_FEATURES), np.empty(4)
    for box in range(lower.shape[0]):
        if stop[0]:
            break
        lo, up = lower[box], upper[box]
        for f in range(N_FEATURES):
            alpha[f] = 0.0
        for a in range(4):
            beta[a] = 0.0
        constant = 0.0
        for row in range(TRILINEAR.shape[0]):
            f, a, b = TRILINEAR[row, 0], TRILINEAR[row, 1], TRILINEAR[row, 2]
            wl, wh = product_range(a, b, lo, up)
            cg, cw, c0 = relax_product(float(TRILINEAR[row, 3]), low[f], high[f], wl, wh)
            alpha[f] += cg
            constant += c0
            if a == b:
                c1, c0 = relax_square(cw, lo[a], up[a])
                beta[a] += c1
            else:
                ca, cb, c0 = relax_product(cw, lo[a], up[a], lo[b], up[b])
                beta[a] += ca
                beta[b] += cb
            constant += c0
        constant = relaxed_costs(features, ranges, (lo, up), constant, alpha, beta, cost)
        value, matchings[box] = k_assignment(cost, k, stop)
        value += constant
        for a in range(4):
            quadratic = 0.0 if a < 2 else float(k)
            if quadratic > 0.0:
                t = min(max(-beta[a] / (2.0 * quadratic), lo[a]), up[a])
            else:
                t = lo[a] if beta[a] > 0.0 else up[a]
            thetas[box, a] = t
            value += beta[a] * t + quadratic * t * t
        bounds[box] = value
    return lower.shape[0]


@jit
def entry_bound(features, k, stop, lower, upper, bounds, matchings):
    """R2: each monomial of each pair at its minimum over the box. One assignment a box."""
    n, m = features.shape[1], features.shape[2]
    cost = np.empty((n, m))
    product = np.empty((TRILINEAR.shape[0], 2))
    for box in range(lower.shape[0]):
        if stop[0]:
            break
        lo, up = lower[box], upper[box]
        for row in range(TRILINEAR.shape[0]):
            wl, wh = product_range(TRILINEAR[row, 1], TRILINEAR[row, 2], lo, up)
            product[row, 0], product[row, 1] = wl, wh
        for i in range(n):
            for j in range(m):
                total = features[7, i, j]
                for row in range(TRILINEAR.shape[0]):
                    c = TRILINEAR[row, 3] * features[TRILINEAR[row, 0], i, j]
                    total += minimum_product(c, product[row, 0], product[row, 1])
                for row in range(BILINEAR.shape[0]):
                    a = BILINEAR[row, 1]
                    total += minimum_product(-2.0 * features[BILINEAR[row, 0], i, j], lo[a], up[a])
                cost[i, j] = total
        value, matchings[box] = k_assignment(cost, k, stop)
        for a in (2, 3):
            near = max(lo[a], -up[a], 0.0)
            value += k * near * near
        bounds[box] = value
    return lower.shape[0]


@jit
def norm_bounds(clouds, low, high, averaged, lower, upper, bounds, thetas, matchings):
    """R1 (`averaged`) or R2 in norm space; `low` and `high` are the ranges of the aggregates of x.

    One assignment a box. R1 writes the t that minimises its quadratic into `thetas`.
    """
    source, norms, k = clouds.source.T, clouds.target, clouds.k
    n, m = source.shape[0], norms.size
    cost, alpha, beta = np.empty((n, m)), np.empty(3), np.empty(3)
    length_low, length_high = np.empty(n), np.empty(n)
    all_rows = averaged and k == n
    minimum, maximum = norms[0], norms[0]
    for j in range(m):
        minimum, maximum = min(minimum, norms[j]), max(maximum, norms[j])
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
                    alpha[a] * x if averaged else minimum_product(2.0 * x, lo[a], up[a])
                )
            if all_rows and length_high[i] > 0.0:
                slope, weight, c0 = relax_product(
                    -2.0, minimum, maximum, length_low[i], length_high[i]
                )
                constant += c0 + _add_length(source[i], lo, up, length_high[i], weight, beta)
            for j in range(m):
                cost[i, j] = charge + norms[j] * (slope + norms[j])
        value, matchings[box] = k_assignment(cost, k, clouds.stop)
        value += constant
        for a in range(3):
            t = min(max(-beta[a] / (2.0 * k), lo[a]), up[a])
            value += beta[a] * t + k * t * t
            if averaged:
                thetas[box, a] = t
        bounds[box] = value
    return lower.shape[0]


@jit
def lengths(source, lower, upper, low, high):
    """Range of |x_i + t| over the box of t."""
    for i in range(source.shape[0]):
        near = far = 0.0
        for a in range(3):
            p, q = source[i, a] + lower[a], source[i, a] + upper[a]
            near += max(p, -q, 0.0) ** 2
            far += max(-p, q) ** 2
        low[i], high[i] = math.sqrt(near), math.sqrt(far)


@jit
def _add_length(x, lower, upper, radius, weight, beta):
    """weight |x + t| for weight <= 0, bounded below: adds the slopes to `beta`, returns the constant."""
    constant = 0.5 * weight * radius
    for a in range(3):
        p, q = x[a] + lower[a], x[a] + upper[a]
        beta[a] += 0.5 * weight / radius * (p + q)
        constant += 0.5 * weight / radius * (x[a] * (p + q) - p * q)
    return constant
