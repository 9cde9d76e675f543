"""Bounds over boxes of rotations.

Point sets are stored by axis, (3, n) and (3, m), so every pass over the pairs is contiguous.
`dcreg.families.rotation3d.bound` proves the bounds.
"""

from __future__ import annotations

import math

import numpy as np

from dcreg.assignment.kernels.dense import k_assignment_duals
from dcreg.assignment.kernels.selection import least, place_of_least, sum_of_smallest
from dcreg.families.kernels import add_penalty
from dcreg.families.rotation3d.kernels.caps import cap_costs
from dcreg.families.rotation3d.kernels.geometry import chord_matrix, matched_cost, transform
from dcreg.jit import jit, jit_inner, jit_part


@jit_inner
def box_corners(lower, upper, corners):
    """Write the distinct vertices of a box of quaternions to `corners`; return their number.

    They are numbered such that i and j ^ i differ in bits j.
    """
    count = 1
    for c in range(4):
        corners[0, c] = lower[c]
    for axis in range(4):
        if upper[axis] > lower[axis]:
            for v in range(count):
                for c in range(4):
                    corners[count + v, c] = corners[v, c]
                corners[count + v, axis] = upper[axis]
            count *= 2
    return count


@jit_inner
def box_angle(centre, corners):
    """Return the maximum angle (at most pi) between the rotation `centre` and those of the box."""
    own, chord = _length(centre), 0.0
    for v in range(corners.shape[0]):
        length, square = _length(corners[v]), 0.0
        for c in range(4):
            square += (corners[v, c] / length - centre[c] / own) ** 2
        chord = max(chord, square)
    # a chord c between unit quaternions is an angle 2 asin(c / 2), half that of the rotation
    return min(math.pi, 4.0 * math.asin(min(1.0, 0.5 * math.sqrt(chord))))


@jit
def _length(q):
    return math.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)


@jit
def pair_costs(M, clouds, out):
    """Fill |a_i|^2 + |y_j|^2 - 2 y_j.(M a_i), with the penalties.

    The cost is affine in M, and the squared residual if M is a rotation.
    """
    source, target, penalty = clouds.source, clouds.target, clouds.infeasibility_penalty
    moved = np.empty(source.shape)
    transform(M, source, moved)
    for i in range(source.shape[1]):
        x, y, z = moved[0, i], moved[1, i], moved[2, i]
        own = source[0, i] ** 2 + source[1, i] ** 2 + source[2, i] ** 2
        for j in range(target.shape[1]):
            u, v, w = target[0, j], target[1, j], target[2, j]
            out[i, j] = own + u * u + v * v + w * w - 2.0 * (x * u + y * v + z * w)
    add_penalty(penalty, out)


@jit_inner
def nearest_bound(costs, k):
    """Return the larger sum of the k smallest row or column minima: a bound on the k-assignment."""
    n, m = costs.shape
    rows, cols = np.empty(n), np.empty(m)
    for j in range(m):
        cols[j] = np.inf
    for i in range(n):
        for j in range(m):
            cols[j] = min(cols[j], costs[i, j])
        rows[i] = least(costs[i])
    return max(sum_of_smallest(rows, k), sum_of_smallest(cols, k))


@jit_inner
def dual_bound_at(M, clouds, b):
    """Return the dual bound on the k-assignment of `pair_costs` at M, without forming the matrix."""
    source, target, penalty = clouds.source, clouds.target, clouds.infeasibility_penalty
    n = source.shape[1]
    moved, low = np.empty(source.shape), np.empty(n)
    transform(M, source, moved)
    for i in range(n):
        low[i] = np.inf
        for c in range(3):
            moved[c, i] *= -2.0
    xs, ys, zs = moved[0], moved[1], moved[2]
    whole = 0.0
    for j in range(target.shape[1]):
        u, v, w = target[0, j], target[1, j], target[2, j]
        own = u * u + v * v + w * w + b[j]
        whole += b[j]
        if penalty.size > 0:
            for i in range(n):
                cost = own + xs[i] * u + ys[i] * v + zs[i] * w + penalty[i, j]
                low[i] = cost if cost < low[i] else low[i]
        else:
            for i in range(n):
                cost = own + xs[i] * u + ys[i] * v + zs[i] * w
                low[i] = cost if cost < low[i] else low[i]
    for i in range(n):
        low[i] += source[0, i] ** 2 + source[1, i] ** 2 + source[2, i] ** 2
    return sum_of_smallest(low, clouds.k) - whole


@jit_part
def vertex_bound(corners, clouds, b, floor, cutoff):
    """Return the bound B2, the minimum vertex value, and the number of assignments solved.

    Each vertex has a lower bound on its assignment, initially from the duals `b`. The vertex with the
    minimum is solved, and its duals raise the bounds of the others, until the minimum is exact or
    reaches `cutoff`. B2 is -inf if the first pass shows that it will hardly exceed `floor`, or if it is
    undefined because the box spans a right angle between quaternions.
    """
    size, count, spent = corners.shape[0], 0, 0
    values, ends = np.empty(size * (size + 1) // 2), np.empty((size * (size + 1) // 2, 2), np.int64)
    cannot_improve = False
    # distant vertices first: their matrices are farthest from rotations, so a vain pass ends early
    for difference in range(size - 1, -1, -1):
        for u in range(size):
            v = u ^ difference
            if v < u or cannot_improve or clouds.stop[0]:
                continue
            dot = 0.0
            for c in range(4):
                dot += corners[u, c] * corners[v, c]
            if dot > 0.0:
                values[count] = dual_bound_at(chord_matrix(corners[u], corners[v]), clouds, b)
                ends[count, 0], ends[count, 1] = u, v
            cannot_improve = dot <= 0.0 or values[count] <= floor
            count += 1
    cost = np.empty((clouds.source.shape[1], clouds.target.shape[1]))
    while not (cannot_improve or clouds.stop[0]) and least(values) < cutoff:
        low = place_of_least(values)
        pair_costs(chord_matrix(corners[ends[low, 0]], corners[ends[low, 1]]), clouds, cost)
        values[low], _, b = k_assignment_duals(cost, clouds.k, clouds.stop)
        spent += 1
        if values[low] < cutoff or clouds.stop[0]:
            break
        for v in range(values.size):
            if values[v] < cutoff:
                M = chord_matrix(corners[ends[v, 0]], corners[ends[v, 1]])
                values[v] = max(values[v], dual_bound_at(M, clouds, b))
    return -np.inf if cannot_improve else least(values), spent


@jit
def bound_boxes(lower, upper, cutoff, clouds, bounds, values):
    """Fill max(B1, B2) of each box, cheapest test first; return the number of assignments solved.

    `values` receives an upper bound on E at the box centre, +inf if the box was pruned before.
    """
    n, m = clouds.source.shape[1], clouds.target.shape[1]
    moved, caps = np.empty((3, n)), np.empty((n, m))
    corners, centre = np.empty((16, 4)), np.empty(4)
    spent = 0
    for box in range(lower.shape[0]):
        if clouds.stop[0]:
            break
        for c in range(4):
            centre[c] = 0.5 * (lower[box, c] + upper[box, c])
        count = box_corners(lower[box], upper[box], corners)
        transform(chord_matrix(centre, centre), clouds.source, moved)
        angle = box_angle(centre, corners[:count])
        cap_costs(moved, angle, clouds.target, clouds.infeasibility_penalty, caps)
        values[box] = np.inf
        bounds[box] = nearest_bound(caps, clouds.k)
        if bounds[box] >= cutoff:
            continue
        # most boxes need only this assignment: it gives B1, a matching for E, and duals for B2
        bounds[box], col_of, b = k_assignment_duals(caps, clouds.k, clouds.stop)
        values[box] = matched_cost(moved, clouds.target, col_of)
        spent += 1
        if bounds[box] >= cutoff:
            continue
        lifted, solved = vertex_bound(corners[:count], clouds, b, bounds[box], cutoff)
        bounds[box] = max(bounds[box], lifted)
        spent += solved
    return spent


@jit
def nearest_scores(quaternions, clouds, scores):
    """Fill `nearest_bound` at each rotation: a cheap lower bound on E."""
    costs = np.empty((clouds.source.shape[1], clouds.target.shape[1]))
    for at in range(quaternions.shape[0]):
        if clouds.stop[0]:
            break
        pair_costs(chord_matrix(quaternions[at], quaternions[at]), clouds, costs)
        scores[at] = nearest_bound(costs, clouds.k)
