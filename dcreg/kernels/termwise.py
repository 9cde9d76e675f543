"""Term-wise relaxations of both objectives (reconstructed RPM-HTB, R1 and R2).

The 2D objective as a sum of monomials in theta with pair features as coefficients:

    E = xx (t1^2 + t2^2) + 2 x1 (t1 t3 + t2 t4) + 2 x2 (t1 t4 - t2 t3) + k (t3^2 + t4^2)
        - 2 d t1 - 2 w t2 - 2 y1 t3 - 2 y2 t4 + yy.

R1 relaxes products of aggregated features and parameters by the average of two McCormick facets; R2
replaces each monomial of each pair by its least value over the box.

In norm space the objective is ``E = |x|^2 + 2 x.t - 2 |y| |x + t| + k |t|^2 + |y|^2``. Its product of
the matching with a length |x_i + t| belongs to one row each: R1 has the three aggregates of x, and one of
|y| for every row. The mean facet of such a row costs its error whether the row is matched or not, so R1
takes it only where all rows are, and R2's interval otherwise. With r_i the greatest length in the box,

    |x_i + t| <= (r_i^2 + |x_i + t|^2) / (2 r_i) <= (r_i^2 + secants of the squares) / (2 r_i) <= r_i,

a linear function of t.
"""

from __future__ import annotations

import math

import numpy as np

from dcreg.kernels.assignment import k_assignment
from dcreg.kernels.compiling import jit

N_FEATURES = 7  # xx, x1, x2, d, w, y1, y2

# the trilinear terms: feature, first parameter, second parameter, coefficient
TRILINEAR = np.array(
    [[0, 0, 0, 1], [0, 1, 1, 1], [1, 0, 2, 2], [1, 1, 3, 2], [2, 0, 3, 2], [2, 1, 2, -2]]
)
# the bilinear terms: feature and parameter, all with coefficient -2
BILINEAR = np.array([[3, 0], [4, 1], [5, 2], [6, 3]])


@jit
def pair_features(source, target, out):
    """out[f, i, j] for the seven features, then yy and the price of the pair as the eighth plane."""
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
            if target.shape[0] > 2:
                out[7, i, j] += target[2 + i, j]


@jit
def feature_ranges(features, k, low, high):
    """Least and greatest aggregate of each feature over all k-matchings (14 assignments)."""
    for f in range(N_FEATURES):
        low[f], _ = k_assignment(features[f], k)
        value, _ = k_assignment(-features[f], k)
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
    """c t^2 >= c1 t + c0: the tangent at the middle when convex, the secant otherwise."""
    if c >= 0.0:
        middle = 0.5 * (low + high)
        return 2.0 * c * middle, -c * middle * middle
    return c * (low + high), -c * low * high


@jit
def aggregated_bound(features, low, high, k, lower, upper, bounds, thetas):
    """R1: one assignment and one separable box QP a box. Returns the number of assignments."""
    n, m = features.shape[1], features.shape[2]
    cost = np.empty((n, m))
    alpha, beta = np.empty(N_FEATURES), np.empty(4)
    for box in range(lower.shape[0]):
        lo, up = lower[box], upper[box]
        alpha[:] = 0.0
        beta[:] = 0.0
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
        value, _ = k_assignment(cost, k)
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
def _least(c, low, high):
    return c * low if c >= 0.0 else c * high


@jit
def entry_bound(features, k, lower, upper, bounds):
    """R2: each monomial of each pair at its least value over the box. One assignment a box."""
    n, m = features.shape[1], features.shape[2]
    cost = np.empty((n, m))
    product = np.empty((TRILINEAR.shape[0], 2))
    for box in range(lower.shape[0]):
        lo, up = lower[box], upper[box]
        for row in range(TRILINEAR.shape[0]):
            wl, wh = product_range(TRILINEAR[row, 1], TRILINEAR[row, 2], lo, up)
            product[row, 0], product[row, 1] = wl, wh
        for i in range(n):
            for j in range(m):
                total = features[7, i, j]
                for row in range(TRILINEAR.shape[0]):
                    c = TRILINEAR[row, 3] * features[TRILINEAR[row, 0], i, j]
                    total += _least(c, product[row, 0], product[row, 1])
                for row in range(BILINEAR.shape[0]):
                    a = BILINEAR[row, 1]
                    total += _least(-2.0 * features[BILINEAR[row, 0], i, j], lo[a], up[a])
                cost[i, j] = total
        value, _ = k_assignment(cost, k)
        for a in (2, 3):
            near = max(lo[a], -up[a], 0.0)
            value += k * near * near
        bounds[box] = value
    return lower.shape[0]


@jit
def norm_bounds(source, target, k, low, high, averaged, lower, upper, bounds, thetas):
    """R1 (`averaged`) or R2 in norm space; `low` and `high` are the ranges of the aggregates of x.

    One assignment a box. R1 writes the t that minimises its quadratic into `thetas`.
    """
    norms = target[0]
    n, m = source.shape[0], norms.size
    cost, alpha, beta = np.empty((n, m)), np.empty(3), np.empty(3)
    length_low, length_high = np.empty(n), np.empty(n)
    all_rows = averaged and k == n
    least, most = norms.min(), norms.max()
    for box in range(lower.shape[0]):
        lo, up = lower[box], upper[box]
        lengths(source, lo, up, length_low, length_high)
        alpha[:] = 0.0
        beta[:] = 0.0
        constant = 0.0
        if averaged:
            for a in range(3):
                alpha[a], beta[a], c0 = relax_product(2.0, low[a], high[a], lo[a], up[a])
                constant += c0
        for i in range(n):
            charge, slope = 0.0, -2.0 * length_high[i]
            for a in range(3):
                x = source[i, a]
                charge += x * x + (alpha[a] * x if averaged else _least(2.0 * x, lo[a], up[a]))
            if all_rows and length_high[i] > 0.0:
                slope, weight, c0 = relax_product(-2.0, least, most, length_low[i], length_high[i])
                constant += c0 + _add_length(source[i], lo, up, length_high[i], weight, beta)
            for j in range(m):
                cost[i, j] = charge + norms[j] * (slope + norms[j])
                if target.shape[0] > 1:
                    cost[i, j] += target[1 + i, j]
        value, _ = k_assignment(cost, k)
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
