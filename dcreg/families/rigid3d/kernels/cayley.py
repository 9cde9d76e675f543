"""The linearised bound over a box of poses, by Cayley's form of the rotations.

A step from the centre of the box is delta = (r, s): the Gibbs vector of the rotation and a shift.
"""

from __future__ import annotations

import numpy as np

from dcreg.assignment.kernels.dense import k_assignment_duals
from dcreg.assignment.kernels.selection import cleared, least, place_of_least, sum_of_smallest
from dcreg.families.rigid3d.kernels.poses import add_penalty_by_target
from dcreg.jit import jit, jit_inner, jit_part

_REFITS = 2
_SWEEPS = 30


@jit_inner
def residuals(view, delta, terms):
    """Fill the terms of each pair at delta = (r, s): |e|^2, 2e and 2 m x e, as (7, m, n).

    e = x - y + s + r x m with m = x + y is the residual that bounds the true one from below. The
    penalty of an infeasible pair is added to |e|^2, and all terms are multiplied by the weights.
    """
    moved, shifted = view.source, view.target
    r0, r1, r2, s0, s1, s2 = delta[0], delta[1], delta[2], delta[3], delta[4], delta[5]
    for j in range(shifted.shape[1]):
        u, v, w = shifted[0, j], shifted[1, j], shifted[2, j]
        for i in range(moved.shape[1]):
            x, y, z = moved[0, i], moved[1, i], moved[2, i]
            a, b, c = x + u, y + v, z + w
            e = x - u + s0 + r1 * c - r2 * b
            f = y - v + s1 + r2 * a - r0 * c
            g = z - w + s2 + r0 * b - r1 * a
            terms[0, j, i] = e * e + f * f + g * g
            terms[1, j, i] = 2.0 * (b * g - c * f)
            terms[2, j, i] = 2.0 * (c * e - a * g)
            terms[3, j, i] = 2.0 * (a * f - b * e)
            terms[4, j, i] = 2.0 * e
            terms[5, j, i] = 2.0 * f
            terms[6, j, i] = 2.0 * g
    add_penalty_by_target(view.infeasibility_penalty, terms[0])
    for i in range(view.weights.shape[0]):
        for j in range(view.weights.shape[1]):
            for p in range(7):
                terms[p, j, i] *= view.weights[i, j]


@jit_inner
def fit_delta(view, col_of, lower, upper, delta):
    """Fit (r, s) in a box to given pairs: bounded least squares by coordinate descent."""
    moved, shifted = view.source, view.target
    # sums in single variables compile in half the time of sums in arrays
    aa = ab = ac = bb = bc = cc = a_sum = b_sum = c_sum = count = 0.0
    g0 = g1 = g2 = g3 = g4 = g5 = 0.0
    for i in range(col_of.size):
        j = col_of[i]
        if j < 0:
            continue
        a = moved[0, i] + shifted[0, j]
        b = moved[1, i] + shifted[1, j]
        c = moved[2, i] + shifted[2, j]
        e = moved[0, i] - shifted[0, j]
        f = moved[1, i] - shifted[1, j]
        h = moved[2, i] - shifted[2, j]
        aa += b * b + c * c
        bb += a * a + c * c
        cc += a * a + b * b
        ab -= a * b
        ac -= a * c
        bc -= b * c
        a_sum += a
        b_sum += b
        c_sum += c
        g0 += b * h - c * f
        g1 += c * e - a * h
        g2 += a * f - b * e
        g3 += e
        g4 += f
        g5 += h
        count += 1.0
    H, g = cleared(np.empty((6, 6))), np.array((g0, g1, g2, g3, g4, g5))
    H[0, 0], H[1, 1], H[2, 2] = aa, bb, cc
    H[0, 1], H[0, 2], H[1, 2] = ab, ac, bc
    # rows of r against s: m x (.) applied to the residual's shift
    H[0, 4], H[0, 5], H[1, 3] = -c_sum, b_sum, c_sum
    H[1, 5], H[2, 3], H[2, 4] = -a_sum, -b_sum, a_sum
    for d in range(3, 6):
        H[d, d] = count
    for p in range(6):
        for q in range(p):
            H[p, q] = H[q, p]
    for p in range(6):
        delta[p] = min(max(0.0, lower[p]), upper[p])
    for _ in range(_SWEEPS):
        for p in range(6):
            if H[p, p] > 0.0:
                slope = g[p]
                for q in range(6):
                    slope += H[p, q] * delta[q]
                delta[p] = min(max(delta[p] - slope / H[p, p], lower[p]), upper[p])


@jit_inner
def linear_costs(terms, step, out):
    """Fill (n, m) linearised costs of all pairs, a `step` away from the point of `terms`."""
    _, m, n = terms.shape
    for j in range(m):
        for i in range(n):
            value = terms[0, j, i]
            for p in range(6):
                value += step[p] * terms[p + 1, j, i]
            out[i, j] = value


@jit_inner
def dual_bound_at(terms, step, k, b, low):
    """Return the dual bound on the k-assignment of `linear_costs`, without forming the matrix."""
    _, m, n = terms.shape
    p, q, r, u, v, w = step[0], step[1], step[2], step[3], step[4], step[5]
    for i in range(n):
        low[i] = np.inf
    for j in range(m):
        t0, t1, t2, t3 = terms[0, j], terms[1, j], terms[2, j], terms[3, j]
        t4, t5, t6 = terms[4, j], terms[5, j], terms[6, j]
        own = b[j]
        for i in range(n):
            cost = (
                own + t0[i] + p * t1[i] + q * t2[i] + r * t3[i] + u * t4[i] + v * t5[i] + w * t6[i]
            )
            low[i] = cost if cost < low[i] else low[i]
    bound = sum_of_smallest(low, k)
    for j in range(m):
        bound -= b[j]
    return bound


@jit_part
def vertex_bound(view, vertices, half, floor, cutoff, col_of):
    """Return the linearised vertex bound, and the number of assignments solved.

    `col_of` is a good matching at the centre. The result is -inf if a first pass shows that the bound
    will not exceed `floor`.
    """
    n, m = view.source.shape[1], view.target.shape[1]
    low_box, high_box, delta = np.empty(6), np.empty(6), cleared(np.empty(6))
    scale = _step_box(vertices, half, low_box, high_box)
    goal, cannot_improve, spent = cutoff * scale, False, 0
    terms, costs, low, b = np.empty((7, m, n)), np.empty((n, m)), np.empty(n), np.empty(m)
    for _ in range(_REFITS):
        fit_delta(view, col_of, low_box, high_box, delta)
        residuals(view, delta, terms)
        linear_costs(terms, cleared(np.empty(6)), costs)
        value, matching, b = k_assignment_duals(costs, view.k, view.stop)
        spent += 1
        cannot_improve = value <= floor * scale  # already at delta, which lies in the box
        if cannot_improve or view.stop[0] or _same(matching, col_of):
            break
        col_of = matching
    n_shifts = 1
    for c in range(3, 6):
        n_shifts *= 2 if high_box[c] > 0.0 else 1
    values = np.empty(vertices.shape[0] * n_shifts)
    steps = np.empty((values.size, 6))
    for at in range(values.size):
        if cannot_improve or view.stop[0]:
            break
        shift = at % n_shifts
        for c in range(3):
            steps[at, c] = vertices[at // n_shifts, c] - delta[c]
        for c in range(3, 6):
            steps[at, c] = -delta[c]
            if high_box[c] > 0.0:
                steps[at, c] += high_box[c] if shift & 1 else low_box[c]
                shift >>= 1
        values[at] = dual_bound_at(terms, steps[at], view.k, b, low)
        cannot_improve = values[at] <= floor * scale
    while not (cannot_improve or view.stop[0]) and least(values) < goal:
        at = place_of_least(values)
        linear_costs(terms, steps[at], costs)
        values[at], _, b = k_assignment_duals(costs, view.k, view.stop)
        spent += 1
        if values[at] < goal or view.stop[0]:
            break
        for v in range(values.size):
            if values[v] < goal:
                values[v] = max(values[v], dual_bound_at(terms, steps[v], view.k, b, low))
    return -np.inf if cannot_improve else max(0.0, least(values)) / scale, spent


@jit
def _step_box(vertices, half, low_box, high_box):
    """Fill a box of (r, s) that contains all poses of the box; return 1 + the maximum of |r|^2."""
    largest = 0.0
    for c in range(6):
        low_box[c] = high_box[c] = 0.0
    for a in range(vertices.shape[0]):
        square = 0.0
        for c in range(3):
            square += vertices[a, c] ** 2
            low_box[c] = min(low_box[c], vertices[a, c])
            high_box[c] = max(high_box[c], vertices[a, c])
        largest = max(largest, square)
    for c in range(3):
        d, e = (c + 1) % 3, (c + 2) % 3
        wide_d, wide_e = max(-low_box[d], high_box[d]), max(-low_box[e], high_box[e])
        high_box[3 + c] = half[c] + wide_d * half[e] + wide_e * half[d]
        low_box[3 + c] = -high_box[3 + c]
    return 1.0 + largest


@jit_part
def _same(a, b):
    same = True
    for i in range(a.size):
        same &= a[i] == b[i]
    return same
