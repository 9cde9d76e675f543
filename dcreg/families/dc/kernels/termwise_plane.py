"""Term-wise relaxations of the objective in the plane (reconstructed RPM-HTB, R1 and R2).

The objective as a sum of monomials in theta with pair features as coefficients:

    E = xx (t1^2 + t2^2) + 2 x1 (t1 t3 + t2 t4) + 2 x2 (t1 t4 - t2 t3) + k (t3^2 + t4^2)
        - 2 d t1 - 2 w t2 - 2 y1 t3 - 2 y2 t4 + yy.

R1 relaxes products of aggregated features and parameters by the average of two McCormick facets; R2
replaces each monomial of each pair by its least value over the box.
"""

from __future__ import annotations

import numpy as np

from dcreg.assignment.kernels.dense import k_assignment
from dcreg.families.dc.kernels.termwise_envelopes import (
    least_product,
    product_range,
    relax_product,
    relax_square,
)
from dcreg.jit import jit

N_FEATURES = 7  # xx, x1, x2, d, w, y1, y2

# the trilinear terms: feature, first parameter, second parameter, coefficient
TRILINEAR = np.array(
    [[0, 0, 0, 1], [0, 1, 1, 1], [1, 0, 2, 2], [1, 1, 3, 2], [2, 0, 3, 2], [2, 1, 2, -2]]
)
# the bilinear terms: feature and parameter, all with coefficient -2
BILINEAR = np.array([[3, 0], [4, 1], [5, 2], [6, 3]])


@jit
def pair_features(points, out):
    """out[f, i, j] for the seven features, then yy and the price of the pair as the eighth plane."""
    source, target, prices = points.source, points.target, points.prices
    for i in range(source.shape[0]):
        a, b = source[i, 0], source[i, 1]
        for j in range(target.shape[1]):
            u, v = target[0, j], target[1, j]
            out[0, i, j] = a * a + b * b
            out[1, i, j] = a
            out[2, i, j] = b
            out[3, i, j] = a * u + b * v
            out[4, i, j] = a * v - b * u
            out[5, i, j] = u
            out[6, i, j] = v
            out[7, i, j] = u * u + v * v
            if prices.size > 0:
                out[7, i, j] += prices[i, j]


@jit
def feature_ranges(features, k, stop, low, high):
    """Least and greatest aggregate of each feature over all k-matchings (14 assignments)."""
    n, m = features.shape[1], features.shape[2]
    cost = np.empty((n, m))
    for f in range(N_FEATURES):
        for sign in (1.0, -1.0):
            for i in range(n):
                for j in range(m):
                    cost[i, j] = sign * features[f, i, j]
            value, _ = k_assignment(cost, k, stop)
            if sign > 0.0:
                low[f] = value
            else:
                high[f] = -value


@jit
def aggregated_bound(features, ranges, k, stop, lower, upper, bounds, thetas):
    """R1: one assignment and one separable box QP a box. Returns the number of assignments."""
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
        for row in range(BILINEAR.shape[0]):
            f, a = BILINEAR[row, 0], BILINEAR[row, 1]
            cg, ct, c0 = relax_product(-2.0, low[f], high[f], lo[a], up[a])
            alpha[f] += cg
            beta[a] += ct
            constant += c0
        for i in range(n):
            for j in range(m):
                total = features[7, i, j]
                for f in range(N_FEATURES):
                    total += alpha[f] * features[f, i, j]
                cost[i, j] = total
        value, _ = k_assignment(cost, k, stop)
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
def entry_bound(features, k, stop, lower, upper, bounds):
    """R2: each monomial of each pair at its least value over the box. One assignment a box."""
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
                    total += least_product(c, product[row, 0], product[row, 1])
                for row in range(BILINEAR.shape[0]):
                    a = BILINEAR[row, 1]
                    total += least_product(-2.0 * features[BILINEAR[row, 0], i, j], lo[a], up[a])
                cost[i, j] = total
        value, _ = k_assignment(cost, k, stop)
        for a in (2, 3):
            near = max(lo[a], -up[a], 0.0)
            value += k * near * near
        bounds[box] = value
    return lower.shape[0]
