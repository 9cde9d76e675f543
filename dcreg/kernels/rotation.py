"""Bounds over boxes of rotations, the k-assignment at one rotation, and its local descent.

A rotation is a quaternion q = (w, x, y, z) of any length but zero: q, -q and 2q are the same one.
Point sets are stored by component, (3, n) and (3, m): every pass over the pairs is a plain sweep.
Why the bounds hold is written in `dcreg.rotation`.
"""

from __future__ import annotations

import math

import numpy as np

from dcreg.kernels.assignment import k_assignment_duals
from dcreg.kernels.compiling import jit

_MAX_ROUNDS = 100


@jit
def lift_matrix(Q):
    """Linear map from symmetric 4x4 matrices to 3x3 ones that takes q q^T (|q| = 1) to R(q)."""
    M = np.empty((3, 3))
    M[0, 0] = Q[0, 0] + Q[1, 1] - Q[2, 2] - Q[3, 3]
    M[0, 1] = 2.0 * (Q[1, 2] - Q[0, 3])
    M[0, 2] = 2.0 * (Q[1, 3] + Q[0, 2])
    M[1, 0] = 2.0 * (Q[1, 2] + Q[0, 3])
    M[1, 1] = Q[0, 0] - Q[1, 1] + Q[2, 2] - Q[3, 3]
    M[1, 2] = 2.0 * (Q[2, 3] - Q[0, 1])
    M[2, 0] = 2.0 * (Q[1, 3] - Q[0, 2])
    M[2, 1] = 2.0 * (Q[2, 3] + Q[0, 1])
    M[2, 2] = Q[0, 0] - Q[1, 1] - Q[2, 2] + Q[3, 3]
    return M


@jit
def chord_matrix(q, r):
    """Image of (q r^T + r q^T) / (2 q.r): R(q) if q = r, else a point outside the rotations."""
    Q = np.empty((4, 4))
    scale = 0.5 / (q * r).sum()
    for a in range(4):
        for b in range(4):
            Q[a, b] = (q[a] * r[b] + q[b] * r[a]) * scale
    return lift_matrix(Q)


@jit
def rotation_matrix(q):
    return chord_matrix(q, q)


@jit
def box_corners(lower, upper):
    """Distinct corners of a box of quaternions, numbered so that i and j ^ i differ in bits j."""
    free = np.flatnonzero(upper > lower)
    corners = np.empty((1 << free.size, 4))
    for v in range(len(corners)):
        corners[v] = lower
        for bit in range(free.size):
            if (v >> bit) & 1:
                corners[v, free[bit]] = upper[free[bit]]
    return corners


@jit
def box_angle(centre, corners):
    """Largest angle (at most pi) between the rotation `centre` and any rotation of the box."""
    unit = centre / math.sqrt((centre**2).sum())
    chord = 0.0
    for v in range(len(corners)):
        gap = corners[v] / math.sqrt((corners[v] ** 2).sum()) - unit
        chord = max(chord, (gap**2).sum())
    # a chord c between unit quaternions is an angle 2 asin(c / 2), half that of the rotation
    return min(math.pi, 4.0 * math.asin(min(1.0, 0.5 * math.sqrt(chord))))


@jit
def pair_costs(M, source, target):
    """|a_i|^2 + |y_j|^2 - 2 y_j.(M a_i): affine in M, the squared residual if M is a rotation."""
    moved = M @ source
    out = np.empty((source.shape[1], target.shape[1]))
    for i in range(source.shape[1]):
        x, y, z = moved[0, i], moved[1, i], moved[2, i]
        own = source[0, i] ** 2 + source[1, i] ** 2 + source[2, i] ** 2
        for j in range(target.shape[1]):
            u, v, w = target[0, j], target[1, j], target[2, j]
            out[i, j] = own + u * u + v * v + w * w - 2.0 * (x * u + y * v + z * w)
            if target.shape[0] > 3:
                out[i, j] += target[3 + i, j]
    return out


@jit
def cap_costs(R, angle, source, target):
    """Least squared residual of every pair when R a_i may turn by `angle` in any direction."""
    moved = R @ source
    cosine, sine = math.cos(angle), math.sin(angle)
    out = np.empty((source.shape[1], target.shape[1]))
    for i in range(source.shape[1]):
        x, y, z = moved[0, i], moved[1, i], moved[2, i]
        own = x * x + y * y + z * z
        for j in range(target.shape[1]):
            u, v, w = target[0, j], target[1, j], target[2, j]
            other = u * u + v * v + w * w
            reach = math.sqrt(own * other)
            dot = x * u + y * v + z * w
            turned = dot * cosine + math.sqrt(max(0.0, reach * reach - dot * dot)) * sine
            best = reach if dot >= reach * cosine else turned
            out[i, j] = max(0.0, own + other - 2.0 * best)
            if target.shape[0] > 3:
                out[i, j] += target[3 + i, j]
    return out


@jit
def matched_cost(R, source, target, col_of):
    """Sum of squared residuals of given pairs at one rotation: an upper bound on E there."""
    moved = R @ source
    total = 0.0
    for i in range(col_of.size):
        j = col_of[i]
        if j >= 0:
            for c in range(3):
                total += (moved[c, i] - target[c, j]) ** 2
    return total


@jit
def sum_of_smallest(values, k):
    return np.partition(values, k - 1)[:k].sum() if k < values.size else values.sum()


@jit
def nearest_bound(costs, k):
    """Sum of the k smallest row or column minima, the greater: no more than a k-assignment."""
    n, m = costs.shape
    rows, cols = np.full(n, np.inf), np.full(m, np.inf)
    for i in range(n):
        for j in range(m):
            cols[j] = min(cols[j], costs[i, j])
        rows[i] = costs[i].min()
    return max(sum_of_smallest(rows, k), sum_of_smallest(cols, k))


@jit
def dual_bound_at(M, source, target, k, b):
    """`dual_bound` of `pair_costs` at M, without forming the matrix."""
    n = source.shape[1]
    moved = -2.0 * (M @ source)
    low = np.full(n, np.inf)
    for j in range(target.shape[1]):
        u, v, w = target[0, j], target[1, j], target[2, j]
        own = u * u + v * v + w * w + b[j]
        for i in range(n):
            cost = own + moved[0, i] * u + moved[1, i] * v + moved[2, i] * w
            if target.shape[0] > 3:
                cost += target[3 + i, j]
            low[i] = cost if cost < low[i] else low[i]
    for i in range(n):
        low[i] += source[0, i] ** 2 + source[1, i] ** 2 + source[2, i] ** 2
    return sum_of_smallest(low, k) - b.sum()


@jit
def vertex_bound(corners, source, target, k, b, floor, cutoff):
    """B2 as far as it decides: the least vertex value and the assignments solved.

    Every vertex has a lower bound on its assignment, at first from the duals `b`. The binding
    vertex is then solved, and its duals raise the others, until the least value is exact or reaches
    `cutoff`. -inf once the first pass shows that B2 will hardly exceed `floor`, or where B2 is
    undefined: a box that spans a right angle between quaternions.
    """
    size = len(corners)
    vertices = np.empty((size * (size + 1) // 2, 3, 3))
    values = np.empty(len(vertices))
    count = 0
    # far pairs of corners first: their matrices lie farthest outside, so a hopeless pass ends early
    for difference in range(size - 1, -1, -1):
        for u in range(size):
            v = u ^ difference
            if v < u:
                continue
            if (corners[u] * corners[v]).sum() <= 0.0:
                return -np.inf, 0
            vertices[count] = chord_matrix(corners[u], corners[v])
            values[count] = dual_bound_at(vertices[count], source, target, k, b)
            if values[count] <= floor:
                return -np.inf, 0
            count += 1
    spent = 0
    while values.min() < cutoff:
        low = values.argmin()
        exact, _, b = k_assignment_duals(pair_costs(vertices[low], source, target), k)
        values[low] = exact
        spent += 1
        if exact < cutoff:
            break
        for v in range(len(values)):
            if values[v] < cutoff:
                raised = dual_bound_at(vertices[v], source, target, k, b)
                values[v] = max(values[v], raised)
    return values.min(), spent


@jit
def bound_boxes(lower, upper, cutoff, source, target, k, bounds, values):
    """max(B1, B2) of every box, cheapest test first; returns the assignments solved.

    `values` receives an upper bound on E at the box centre, +inf where the box was closed before.
    """
    spent = 0
    for box in range(len(lower)):
        centre = 0.5 * (lower[box] + upper[box])
        corners = box_corners(lower[box], upper[box])
        R = rotation_matrix(centre)
        caps = cap_costs(R, box_angle(centre, corners), source, target)
        values[box] = np.inf
        bounds[box] = nearest_bound(caps, k)
        if bounds[box] >= cutoff:
            continue
        # the one assignment most boxes need: it gives B1, a matching for E and duals for B2
        bounds[box], col_of, b = k_assignment_duals(caps, k)
        values[box] = matched_cost(R, source, target, col_of)
        spent += 1
        if bounds[box] >= cutoff:
            continue
        lifted, solved = vertex_bound(corners, source, target, k, b, bounds[box], cutoff)
        bounds[box] = max(bounds[box], lifted)
        spent += solved
    return spent


@jit
def best_rotation(col_of, source, target):
    """Quaternion of the rotation that fits the matched pairs best, without centring (Horn 1987).

    The largest eigenvector of a symmetric 4x4 matrix; a quaternion is never a reflection.
    """
    G = np.zeros((3, 3))
    for i in range(col_of.size):
        j = col_of[i]
        if j >= 0:
            for r in range(3):
                for c in range(3):
                    G[r, c] += source[r, i] * target[c, j]
    N = np.empty((4, 4))
    N[0, 0] = G[0, 0] + G[1, 1] + G[2, 2]
    N[1, 1] = G[0, 0] - G[1, 1] - G[2, 2]
    N[2, 2] = G[1, 1] - G[0, 0] - G[2, 2]
    N[3, 3] = G[2, 2] - G[0, 0] - G[1, 1]
    N[0, 1] = N[1, 0] = G[1, 2] - G[2, 1]
    N[0, 2] = N[2, 0] = G[2, 0] - G[0, 2]
    N[0, 3] = N[3, 0] = G[0, 1] - G[1, 0]
    N[1, 2] = N[2, 1] = G[0, 1] + G[1, 0]
    N[1, 3] = N[3, 1] = G[0, 2] + G[2, 0]
    N[2, 3] = N[3, 2] = G[1, 2] + G[2, 1]
    _, vectors = np.linalg.eigh(N)
    return vectors[:, 3].copy()


@jit
def objective(q, source, target, k):
    """E(R(q)) and the column matched to every source point (-1: none)."""
    R = rotation_matrix(q)
    _, col_of, _ = k_assignment_duals(pair_costs(R, source, target), k)
    # summed anew: the expanded squares of `pair_costs` cancel and may leave a tiny negative sum
    return matched_cost(R, source, target, col_of), col_of


@jit
def refine(q, source, target, k):
    """Alternate matching and best rotation until E no longer falls: quaternion, E, assignments."""
    best = q
    value, col_of = objective(q, source, target, k)
    for spent in range(2, _MAX_ROUNDS + 2):
        trial = best_rotation(col_of, source, target)
        trial_value, trial_col = objective(trial, source, target, k)
        if trial_value >= value * (1.0 - 1e-12):
            return best, value, spent
        best, value, col_of = trial, trial_value, trial_col
    return best, value, spent


@jit
def nearest_scores(quaternions, source, target, k):
    """`nearest_bound` at every rotation: a cheap, one-sided guess of E."""
    scores = np.empty(len(quaternions))
    for at in range(len(quaternions)):
        R = rotation_matrix(quaternions[at])
        scores[at] = nearest_bound(pair_costs(R, source, target), k)
    return scores
