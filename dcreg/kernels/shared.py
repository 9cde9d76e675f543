"""Vertex values shared between boxes, and the DC bound at its best linearisation point.

Boxes made by bisection have their vertices on a dyadic lattice of the start box. A vertex is stored
once under its integer coordinates, whichever boxes it belongs to.
"""

from __future__ import annotations

import numpy as np

from dcreg.kernels.assignment import improve_assignment, k_assignment_duals, row_minima
from dcreg.kernels.compiling import jit
from dcreg.kernels.features import (
    NORM3D,
    allocate,
    curvature,
    move,
    n_vertices,
    pair_costs,
    vertex,
)
from dcreg.kernels.selection import smallest_sum
from dcreg.kernels.vertices import objectives

LATTICE = 2.0**30  # cells per axis; finer boxes are not told apart
_STEPS = 40  # towards the best linearisation point


@jit
def _hash(q0, q1, q2, q3):
    h = np.uint64(q0) * np.uint64(0x9E3779B97F4A7C15)
    h = (h ^ np.uint64(q1)) * np.uint64(0xBF58476D1CE4E5B9)
    h = (h ^ (h >> np.uint64(29)) ^ np.uint64(q2)) * np.uint64(0x94D049BB133111EB)
    h = (h ^ (h >> np.uint64(32)) ^ np.uint64(q3)) * np.uint64(0x9E3779B97F4A7C15)
    return h ^ (h >> np.uint64(31))


@jit
def rebuild(table, keys, used):
    """Hash table over the first `used` keys."""
    table[:] = -1
    mask = np.uint64(table.size - 1)
    for slot in range(used):
        at = _hash(keys[slot, 0], keys[slot, 1], keys[slot, 2], keys[slot, 3]) & mask
        while table[at] >= 0:
            at = (at + np.uint64(1)) & mask
        table[at] = slot


@jit
def find_or_add(table, keys, thetas, used, origin, width, lower, upper, slots):
    """Slot of every distinct vertex of every box (-1 beyond the last); new ones are appended.

    Returns the number of slots in use. The caller guarantees room.
    """
    dim = origin.size
    mask = np.uint64(table.size - 1)
    theta = np.empty(dim)
    q = np.zeros(4, np.int64)
    for box in range(lower.shape[0]):
        slots[box] = -1
        for index in range(n_vertices(lower[box], upper[box])):
            vertex(lower[box], upper[box], index, theta)
            for a in range(dim):
                if width[a] > 0.0:
                    q[a] = np.int64(round((theta[a] - origin[a]) / width[a] * LATTICE))
            at = _hash(q[0], q[1], q[2], q[3]) & mask
            slot = table[at]
            while slot >= 0 and (
                keys[slot, 0] != q[0]
                or keys[slot, 1] != q[1]
                or keys[slot, 2] != q[2]
                or keys[slot, 3] != q[3]
            ):
                at = (at + np.uint64(1)) & mask
                slot = table[at]
            if slot < 0:
                slot = used
                used += 1
                table[at] = slot
                keys[slot] = q
                thetas[slot] = theta
            slots[box, index] = slot
    return used


@jit
def best_linearisation(vertices, values, weights, point):
    """Value and place (in `point`) of the theta0 with the greatest
    ``min_v [E(v) - sum_a weights_a (v_a - theta0_a)^2]``.

    The dual is the least of ``sum_v w_v (E(v) - Q(v)) + Q(sum_v w_v v)`` over weights w on the
    vertices. Pairwise Frank-Wolfe steps with exact line search; theta0 is the weighted vertex and every
    iterate is valid, so the best one is kept.
    """
    count, dim = vertices.shape
    w = np.full(count, 1.0 / count)
    centre = np.zeros(dim)
    for v in range(count):
        for a in range(dim):
            centre[a] += w[v] * vertices[v, a]
    best = -np.inf
    for _ in range(_STEPS):
        low, high = np.inf, -np.inf
        toward, away = 0, 0
        for v in range(count):
            term = values[v]
            for a in range(dim):
                d = vertices[v, a] - centre[a]
                term -= weights[a] * d * d
            if term < low:
                low, toward = term, v
            if w[v] > 0.0 and term > high:
                high, away = term, v
        if low > best:
            best = low
            point[:] = centre
        if high - low <= 1e-3 * (abs(low) + 1e-12):
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


@jit
def solve_vertices(kind, source, target, k, warm, slots, thetas, lows, values, profiles, duals):
    """E at the vertices `slots`, with optimal duals and dual profile. Returns the assignments spent.

    With duals b >= 0 let r_i = min_j (c_ij + b_j) - (sum b) / k. For any charge R_i on the rows the sum
    of the k smallest r_i - R_i is at most the k-assignment of c_ij - R_i, whatever b. With optimal b the
    k smallest r_i add up to E(v).
    """
    if kind == NORM3D:  # all R_i are alike, so values alone serve and no duals are kept
        found = np.empty(slots.size)
        objectives(kind, source, target, k, thetas[slots], found)
        values[slots] = found
        lows[slots] = found
        return slots.size
    moved, _, cost = allocate(kind, source.shape[0], target.shape[1])
    for slot in slots:
        move(kind, source, thetas[slot], moved)
        pair_costs(moved, target, cost)
        if warm:
            values[slot], _ = improve_assignment(cost, k, duals[slot])
        else:
            values[slot], _, duals[slot] = k_assignment_duals(cost, k)
        lows[slot] = values[slot]
        _dual_profile(cost, k, duals[slot], profiles[slot])
    return slots.size


@jit
def estimate_vertices(
    kind, source, target, k, slots, donors, thetas, lows, values, profiles, duals
):
    """Lower bounds on E and profiles at the vertices `slots` from the duals of nearby vertices.

    One pass over the costs instead of an assignment. `values` stays infinite: no upper bound is known.
    """
    moved, _, cost = allocate(kind, source.shape[0], target.shape[1])
    for at in range(slots.size):
        slot = slots[at]
        move(kind, source, thetas[slot], moved)
        pair_costs(moved, target, cost)
        duals[slot] = duals[donors[at]]
        lows[slot] = _dual_profile(cost, k, duals[slot], profiles[slot])
        values[slot] = np.inf


@jit
def _dual_profile(cost, k, b, profile):
    """Fill r_i = min_j (c_ij + b_j) - (sum b) / k and return the sum of its k smallest entries."""
    row_minima(cost, b, profile)
    profile -= b.sum() / k
    return smallest_sum(profile, k)


@jit
def nearest_solved(slots, before, thetas, values, weights, donors):
    """Of every slot from `before` on: the nearest solved vertex in the first box that has it, or -1."""
    donors[:] = -1
    for box in range(slots.shape[0]):
        for v in range(slots.shape[1]):
            slot = slots[box, v]
            if slot < before or donors[slot - before] >= 0:
                continue
            nearest = np.inf
            for other in slots[box]:
                if other < 0 or other >= before:
                    continue
                distance = 0.0 if values[other] < np.inf else 1e6
                for a in range(weights.size):
                    distance += weights[a] * (thetas[slot, a] - thetas[other, a]) ** 2
                if distance < nearest:
                    nearest = distance
                    donors[slot - before] = other


@jit
def charged_value(kind, source, k, low, profile, delta, missed):
    """Lower bound on min_P sum p_ij [E_ij(v) - R_i(delta)] from a vertex's value and profile."""
    curvature(kind, source, delta, missed)
    n = missed.size
    if profile.size == 0:  # all R_i alike
        return low - k * missed[0]
    for i in range(n):
        missed[i] = profile[i] - missed[i]
    return smallest_sum(missed, k)


@jit
def shared_bound(
    kind,
    source,
    k,
    weights,
    thetas,
    lows,
    profiles,
    slots,
    lower,
    upper,
    cutoff,
    moves,
    bounds,
    binding,
    points,
):
    """``max_theta0 min_v min_P sum p_ij [E_ij(v) - R_i(v - theta0)]`` per box, from shared values.

    Starts with theta0 at the centre (`moves` = 0: the shared bound) and moves it up to `moves` times to
    the best place of a quadratic model of the loss with diagonal `weights`; the bound itself is always
    evaluated with the true R_i. `binding` receives the slot of the limiting vertex, `points` theta0.
    """
    dim = lower.shape[1]
    missed = np.empty(source.shape[0])
    corner, charged = np.empty((16, dim)), np.empty(16)
    delta, point = np.empty(dim), np.empty(dim)
    for box in range(lower.shape[0]):
        count = n_vertices(lower[box], upper[box])
        for v in range(count):
            corner[v] = thetas[slots[box, v]]
        point[:] = 0.5 * (lower[box] + upper[box])
        bounds[box] = -np.inf
        for step in range(moves + 1):
            bound, at = np.inf, 0
            for v in range(count):
                for a in range(dim):
                    delta[a] = corner[v, a] - point[a]
                slot = slots[box, v]
                charged[v] = charged_value(
                    kind, source, k, lows[slot], profiles[slot], delta, missed
                )
                if charged[v] < bound:
                    bound, at = charged[v], slot
            previous = bounds[box]
            if bound > previous:
                bounds[box], binding[box] = bound, at
                points[box] = point
            if step == moves or bounds[box] >= cutoff:
                break
            if step > 1 and bound <= previous + 1e-3 * abs(previous):
                break
            # the loss at theta0 as if it were quadratic with these weights
            for v in range(count):
                for a in range(dim):
                    charged[v] += weights[a] * (corner[v, a] - point[a]) ** 2
            promise = best_linearisation(corner[:count], charged[:count], weights, point)
            if promise < cutoff:
                break  # the box will be divided in any case: no use in a better bound


@jit
def exact_bound(
    kind, source, target, k, thetas, lows, profiles, duals, slots, points, cutoff, bounds
):
    """Raise `bounds` by exact minima over P at the vertices that limit them, theta0 in `points`.

    Vertices are taken from the lowest on, until the lowest is exact or above `cutoff`. Returns the
    assignments spent.
    """
    moved, missed, cost = allocate(kind, source.shape[0], target.shape[1])
    charged, exact = np.empty(slots.shape[1]), np.empty(slots.shape[1], np.bool_)
    spent = 0
    for box in range(slots.shape[0]):
        charged[:] = np.inf
        for v in range(slots.shape[1]):
            slot = slots[box, v]
            if slot >= 0:
                delta = thetas[slot] - points[box]
                charged[v] = charged_value(
                    kind, source, k, lows[slot], profiles[slot], delta, missed
                )
        exact[:] = False
        while True:
            v = np.argmin(charged)
            if exact[v] or charged[v] >= cutoff:
                break
            slot = slots[box, v]
            move(kind, source, thetas[slot], moved)
            pair_costs(moved, target, cost)
            curvature(kind, source, thetas[slot] - points[box], missed)
            for i in range(missed.size):
                for j in range(cost.shape[1]):
                    cost[i, j] -= missed[i]
            charged[v] = improve_assignment(cost, k, duals[slot].copy())[0]
            exact[v] = True
            spent += 1
        bounds[box] = max(bounds[box], charged[v])
    return spent
