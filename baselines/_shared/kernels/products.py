"""Compiled relaxations of products: the McCormick facets, and the 2D objective written in products.

The 2D objective is a sum of monomials in theta whose coefficients are features of the matched pairs,

    E = xx (t1^2 + t2^2) + 2 x1 (t1 t3 + t2 t4) + 2 x2 (t1 t4 - t2 t3) + k (t3^2 + t4^2)
        - 2 d t1 - 2 w t2 - 2 y1 t3 - 2 y2 t4 + yy.

RPM-HTB, RPM-BP and HBSP relax these products, each in its own way.
"""

from __future__ import annotations

import numpy as np

from dcreg.assignment.kernels.dense import k_assignment
from dcreg.jit import jit

N_FEATURES = 7  # xx, x1, x2, d, w, y1, y2

# the bilinear terms: feature and parameter, all with coefficient -2
BILINEAR = np.array([[3, 0], [4, 1], [5, 2], [6, 3]])


@jit
def pair_features(source, target, out):
    """Set out[f, i, j] to feature f of pair (i, j), and out[7, i, j] to yy."""
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


@jit
def feature_ranges(features, k, stop, low, high):
    """Compute the range of each feature's sum over all k-matchings (14 assignments)."""
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
def product_range(a, b, lower, upper):
    """Range of t_a t_b over the box."""
    if a == b:
        near = max(lower[a], -upper[a], 0.0)
        far = max(-lower[a], upper[a])
        return near * near, far * far
    p, q = lower[a] * lower[b], lower[a] * upper[b]
    r, s = upper[a] * lower[b], upper[a] * upper[b]
    return min(p, q, r, s), max(p, q, r, s)


@jit
def relax_product(c, ul, uh, vl, vh):
    """c u v >= cu u + cv v + c0 on the rectangle: the mean of the two active McCormick facets."""
    um, vm = 0.5 * (ul + uh), 0.5 * (vl + vh)
    corner = ul * vl + uh * vh if c >= 0.0 else ul * vh + uh * vl
    return c * vm, c * um, -0.5 * c * corner


@jit
def relax_square(c, low, high):
    """c t^2 >= c1 t + c0: the tangent at the centre if convex, the secant otherwise."""
    if c >= 0.0:
        centre = 0.5 * (low + high)
        return 2.0 * c * centre, -c * centre * centre
    return c * (low + high), -c * low * high


@jit
def minimum_product(c, low, high):
    """Minimum of c t for t in [low, high]."""
    return c * low if c >= 0.0 else c * high


@jit
def relaxed_costs(features, ranges, box, constant, alpha, beta, cost):
    """Relax the bilinear terms, and fill the costs of all pairs; return the constant with theirs.

    `alpha` and `beta`, the slopes in the features and in theta, receive those of the bilinear terms.
    """
    (low, high), (lo, up) = ranges, box
    for row in range(BILINEAR.shape[0]):
        f, a = BILINEAR[row, 0], BILINEAR[row, 1]
        cg, ct, c0 = relax_product(-2.0, low[f], high[f], lo[a], up[a])
        alpha[f] += cg
        beta[a] += ct
        constant += c0
    for i in range(cost.shape[0]):
        for j in range(cost.shape[1]):
            total = features[7, i, j]
            for f in range(N_FEATURES):
                total += alpha[f] * features[f, i, j]
            cost[i, j] = total
    return constant


@jit
def linearise(features, ranges, k, lower, upper, constants, beta, gamma, matchings):
    """Linearise each box: a constant with the best assignment, slopes in theta and in phi.

    See `baselines._shared.relaxations`.
    """
    (low, high), n, m = ranges, features.shape[1], features.shape[2]
    cost, alpha = np.empty((n, m)), np.empty(N_FEATURES)
    for box in range(lower.shape[0]):
        lo, up = lower[box], upper[box]
        alpha[:] = 0.0
        beta[box] = 0.0
        constant = 0.0
        for f in range(3):
            minimum, maximum = _phi_range(f, lo, up)
            cg, gamma[box, f], c0 = relax_product(
                1.0 if f == 0 else 2.0, low[f], high[f], minimum, maximum
            )
            alpha[f] += cg
            constant += c0
        constant = relaxed_costs(features, ranges, (lo, up), constant, alpha, beta[box], cost)
        value, matchings[box] = k_assignment(cost, k, np.zeros(1, np.uint8))
        constants[box] = value + constant
    return lower.shape[0]


@jit
def _phi_range(f, lower, upper):
    if f == 0:
        pl, ph = product_range(0, 0, lower, upper)
        ql, qh = product_range(1, 1, lower, upper)
    elif f == 1:
        pl, ph = product_range(0, 2, lower, upper)
        ql, qh = product_range(1, 3, lower, upper)
    else:
        pl, ph = product_range(0, 3, lower, upper)
        qh, ql = product_range(1, 2, lower, upper)
        ql, qh = -ql, -qh
    return pl + ql, ph + qh
