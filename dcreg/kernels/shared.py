"""Vertex values shared between boxes, and the DC bound at its best linearisation point.

Boxes made by bisection have their vertices on a dyadic lattice of the start box. A vertex is stored
once under its integer coordinates, whichever boxes it belongs to.
"""

from __future__ import annotations

import math

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
from dcreg.kernels.norm_bound import norm_curvature
from dcreg.kernels.selection import least, smallest_sum, total
from dcreg.kernels.vertices import objectives

LATTICE = 2.0**30  # cells per axis; finer boxes are not told apart
_FAR = 1e6  # an estimate's handicap against solved vertices
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
def find_or_add(table, keys, thetas, met, call, used, origin, width, lower, upper, slots):
    """Slot of every distinct vertex of every box (-1 beyond the last); new ones are appended.

    `met` notes the call that met a slot last. Returns the number of slots in use. The caller guarantees
    room.
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
            met[slot] = call
    return used


@jit
def best_linearisation(vertices, values, weights, cutoff, enough, point):
    """Value and place (in `point`) of the theta0 with the greatest
    ``min_v [E(v) - sum_a weights_a (v_a - theta0_a)^2]``.

    The dual is the least of ``sum_v w_v (E(v) - Q(v)) + Q(sum_v w_v v)`` over weights w on the
    vertices. Pairwise Frank-Wolfe steps with exact line search; theta0 is the weighted vertex and every
    iterate is valid, so the best one is kept. Given up where the dual shows that `cutoff` is out of
    reach, and ended where `enough` is reached.
    """
    count, dim = vertices.shape
    w = np.full(count, 1.0 / count)
    centre = np.zeros(dim)
    for v in range(count):
        for a in range(dim):
            centre[a] += w[v] * vertices[v, a]
    best = -np.inf
    for _ in range(_STEPS):
        low, high, ceiling = np.inf, -np.inf, 0.0
        toward, away = 0, 0
        for v in range(count):
            term = values[v]
            for a in range(dim):
                d = vertices[v, a] - centre[a]
                term -= weights[a] * d * d
            ceiling += w[v] * term
            if term < low:
                low, toward = term, v
            if w[v] > 0.0 and term > high:
                high, away = term, v
        if low > best:
            best = low
            point[:] = centre
        if ceiling < cutoff or low >= enough or high - low <= 1e-3 * (abs(low) + 1e-12):
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
def solve_vertices(
    kind, source, target, k, warm, slots, thetas, lows, values, levels, profiles, duals
):
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
        _, levels[slot] = _dual_profile(cost, k, duals[slot], profiles[slot])
    return slots.size


@jit
def estimate_vertices(
    kind, source, target, k, slots, thetas, lows, values, levels, profiles, duals
):
    """Lower bounds on E and profiles at the vertices `slots` from the prices blended there.

    One pass over the costs instead of an assignment. `values` stays infinite: no upper bound is known.
    """
    moved, _, cost = allocate(kind, source.shape[0], target.shape[1])
    for slot in slots:
        move(kind, source, thetas[slot], moved)
        pair_costs(moved, target, cost)
        lows[slot], levels[slot] = _dual_profile(cost, k, duals[slot], profiles[slot])
        values[slot] = np.inf


@jit
def _dual_profile(cost, k, b, profile):
    """Fill r_i = min_j (c_ij + b_j) - (sum b) / k; sum and greatest of its k smallest entries."""
    row_minima(cost, b, profile)
    profile -= total(b) / k
    mean = total(profile) / profile.size
    return smallest_sum(profile, k, mean, (mean - least(profile)) / profile.size)


@jit
def boxes_of(slots, which):
    """Boxes that have the vertex ``which[at]``: ``boxes[start[at] : start[at + 1]]``."""
    first = which.min()
    place = np.full(which.max() - first + 1, -1)
    for at in range(which.size):
        place[which[at] - first] = at
    owner = np.full(slots.shape, -1)
    start = np.zeros(which.size + 1, np.int64)
    for box in range(slots.shape[0]):
        for v in range(slots.shape[1]):
            at = slots[box, v] - first
            if 0 <= at < place.size and place[at] >= 0:
                owner[box, v] = place[at]
                start[place[at] + 1] += 1
    start = np.cumsum(start)
    boxes, filled = np.empty(start[-1], np.int64), start[:-1].copy()
    for box in range(slots.shape[0]):
        for at in owner[box]:
            if at >= 0:
                boxes[filled[at]] = box
                filled[at] += 1
    return start, boxes


@jit
def blend_prices(slots, which, start, boxes, settled, thetas, values, weights, duals, found):
    """Prices at the vertices `which` from the other vertices of all boxes that have them (`boxes_of`).

    A mean with weights ``distance^-6``: optimal prices are continuous and piecewise linear in the costs,
    so the mean of the nearest on all sides lies closer than any one of them. Estimates count only where
    no neighbour is solved, and only those of slots below `settled`. `found` tells which have any.
    """
    mean = np.empty(duals.shape[1])
    for at in range(which.size):
        slot, whole = which[at], 0.0
        mean[:] = 0.0
        for box in boxes[start[at] : start[at + 1]]:
            for other in slots[box]:
                if other < 0 or other == slot:
                    continue
                solved = values[other] < np.inf
                if not solved and other >= settled:
                    continue
                distance = 0.0 if solved else _FAR
                for a in range(weights.size):
                    distance += weights[a] * (thetas[slot, a] - thetas[other, a]) ** 2
                weight = 1.0 / (distance * distance * distance)
                whole += weight
                for j in range(mean.size):
                    mean[j] += weight * duals[other, j]
        found[at] = whole > 0.0
        if found[at]:
            duals[slot] = mean / whole


@jit
def charged_value(kind, axes, k, low, level, profile, delta, missed):
    """Lower bound on min_P sum p_ij [E_ij(v) - R_i(delta)] from a vertex's value and profile."""
    if profile.size == 0:  # all R_i alike
        return low - k * (delta[0] ** 2 + delta[1] ** 2 + delta[2] ** 2)
    curvature(kind, axes, delta, missed)
    level -= total(missed) / missed.size
    for i in range(missed.size):
        missed[i] = profile[i] - missed[i]
    return smallest_sum(missed, k, level, 2.0 * abs(low) / (k * k))[0]


@jit
def shared_bound(
    kind,
    source,
    k,
    weights,
    thetas,
    lows,
    levels,
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

    Starts with theta0 at `points` (the centre: the shared bound) and moves it up to `moves` times to the
    best place of a quadratic model of the loss with diagonal `weights`; the bound itself is always
    evaluated with the true R_i. `binding` receives the slot of the limiting vertex, `points` theta0.
    """
    if kind == NORM3D and moves > 0:
        norm_bounds(source, k, weights, thetas, lows, slots, lower, upper, cutoff, bounds, points)
        binding[:] = slots[:, 0]  # all vertices are solved
        return
    dim, axes = lower.shape[1], source.T.copy()
    missed = np.empty(source.shape[0])
    corner, charged = np.empty((16, dim)), np.empty(16)
    delta, point = np.empty(dim), np.empty(dim)
    for box in range(lower.shape[0]):
        count = n_vertices(lower[box], upper[box])
        for v in range(count):
            corner[v] = thetas[slots[box, v]]
        point[:] = points[box]
        bounds[box] = -np.inf
        for step in range(moves + 1):
            bound, at = np.inf, 0
            for v in range(count):
                for a in range(dim):
                    delta[a] = corner[v, a] - point[a]
                slot = slots[box, v]
                charged[v] = charged_value(
                    kind, axes, k, lows[slot], levels[slot], profiles[slot], delta, missed
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
            promise = best_linearisation(
                corner[:count], charged[:count], weights, cutoff, np.inf, point
            )
            if promise < cutoff:
                break  # the box will be divided in any case: no use in a better bound


@jit
def norm_bounds(source, k, weights, thetas, lows, slots, lower, upper, cutoff, bounds, points):
    """`shared_bound` in norm space, where R_i = |v - theta0|^2 and the best theta0 is found in one go."""
    dim, axes = lower.shape[1], source.T.copy()
    corner, values = np.empty((8, dim)), np.empty(8)
    point, own = np.empty(dim), np.empty(dim)
    reach = 1.05 * cutoff  # bounds beyond the cutoff by more than rounding
    for box in range(lower.shape[0]):
        count = n_vertices(lower[box], upper[box])
        for v in range(count):
            corner[v] = thetas[slots[box, v]]
            values[v] = lows[slots[box, v]]
        bounds[box] = best_linearisation(
            corner[:count], values[:count], weights, cutoff, reach, points[box]
        )
        if not bounds[box] < cutoff < np.inf:
            continue
        radius = 0.0
        for a in range(dim):
            radius += 0.25 * (upper[box, a] - lower[box, a]) ** 2
        radius = math.sqrt(radius)
        norm_curvature(axes, k, 0.5 * (lower[box] + upper[box]), radius, math.sqrt(reach), own)
        bound = best_linearisation(corner[:count], values[:count], own, cutoff, reach, point)
        if bound > bounds[box]:
            bounds[box] = max(bounds[box], min(bound, reach))
            points[box] = point


@jit
def exact_bound(
    kind, source, target, k, thetas, lows, levels, profiles, duals, slots, points, cutoff, bounds
):
    """Raise `bounds` by exact minima over P at the vertices that limit them, theta0 in `points`.

    Vertices are taken from the lowest on, until the lowest is exact or above `cutoff`. Returns the
    assignments spent.
    """
    moved, missed, cost = allocate(kind, source.shape[0], target.shape[1])
    charged, exact = np.empty(slots.shape[1]), np.empty(slots.shape[1], np.bool_)
    axes = source.T.copy()
    spent = 0
    for box in range(slots.shape[0]):
        charged[:] = np.inf
        for v in range(slots.shape[1]):
            slot = slots[box, v]
            if slot >= 0:
                delta = thetas[slot] - points[box]
                charged[v] = charged_value(
                    kind, axes, k, lows[slot], levels[slot], profiles[slot], delta, missed
                )
        exact[:] = False
        while True:
            v = np.argmin(charged)
            if exact[v] or charged[v] >= cutoff:
                break
            slot = slots[box, v]
            move(kind, source, thetas[slot], moved)
            pair_costs(moved, target, cost)
            curvature(kind, axes, thetas[slot] - points[box], missed)
            for i in range(missed.size):
                for j in range(cost.shape[1]):
                    cost[i, j] -= missed[i]
            charged[v] = improve_assignment(cost, k, duals[slot].copy())[0]
            exact[v] = True
            spent += 1
        bounds[box] = max(bounds[box], charged[v])
    return spent
