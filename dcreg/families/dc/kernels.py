"""Kernels of the DC bounds, for similarities in 2D and translations in norm space."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dcreg.assignment.kernels.dense import k_assignment
from dcreg.assignment.kernels.selection import cleared
from dcreg.families.kernels import add_penalty, weigh
from dcreg.jit import jit, jit_inner, jit_part

# --- Costs of all pairs at a parameter, the curvature of the costs, and their range over a box ----
# Similarities match points in 2D, and translations in norm space match norms ``|x + t|``. Both are called
# *features*. The residual of a pair is a squared distance of features, so both problems share the bounds.
# A one-dimensional target holds norms. Kernels that receive the target as a separate argument are
# compiled for only one of the two problems.


@jit
def pair_costs(clouds, theta, cost):
    """Fill cost_ij: the squared distance of the features at `theta`, with penalty and weight."""
    squared_distances(clouds.source, clouds.target, theta, cost)
    add_penalty(clouds.infeasibility_penalty, cost)
    weigh(clouds.weights, cost)


@jit_inner
def squared_distances(source, target, theta, cost):
    """Fill the squared distances between features of the moved source and of the target."""
    if target.ndim == 1:
        for i in range(source.shape[1]):
            a, b, c = source[0, i] + theta[0], source[1, i] + theta[1], source[2, i] + theta[2]
            x = math.sqrt(a * a + b * b + c * c)
            for j in range(target.size):
                dx = x - target[j]
                cost[i, j] = dx * dx
    else:
        for i in range(source.shape[1]):
            a, b = source[0, i], source[1, i]
            x = theta[0] * a - theta[1] * b + theta[2]
            y = theta[1] * a + theta[0] * b + theta[3]
            for j in range(target.shape[1]):
                dx, dy = x - target[0, j], y - target[1, j]
                cost[i, j] = dx * dx + dy * dy


@jit
def curvature(target, clouds, delta, out):
    """Return R_i(delta) = |J_i delta|^2: the error of the tangent at theta0 in theta0 + delta.

    It is multiplied by the maximum weight of the source point.
    """
    if target.ndim == 1:
        r = delta[0] ** 2 + delta[1] ** 2 + delta[2] ** 2
        for i in range(out.size):
            out[i] = r
    else:
        plane_curvature(clouds, delta, out)


@jit_part
def plane_curvature(clouds, delta, out):
    """Return `curvature` for similarities in 2D."""
    x, y, heaviest = clouds.source[0], clouds.source[1], clouds.heaviest
    cos, sin, right, up = delta[0], delta[1], delta[2], delta[3]
    for i in range(out.size):
        u = cos * x[i] - sin * y[i] + right
        v = sin * x[i] + cos * y[i] + up
        out[i] = heaviest[i] * (u * u + v * v)


@jit
def interval_costs(source, target, lower, upper, cost):
    """Fill cost_ij: squared distance of the target's feature from the interval of x_i over the box."""
    if target.ndim == 1:
        for i in range(source.shape[1]):
            near = far = 0.0
            for a in range(3):
                low, high = source[a, i] + lower[a], source[a, i] + upper[a]
                gap, reach = max(low, -high, 0.0), max(-low, high)
                near += gap * gap
                far += reach * reach
            near, far = math.sqrt(near), math.sqrt(far)
            centre, radius = 0.5 * (near + far), 0.5 * (far - near)
            for j in range(target.size):
                d = max(abs(centre - target[j]) - radius, 0.0)
                cost[i, j] = d * d
    else:
        c0, c1 = 0.5 * (lower[0] + upper[0]), 0.5 * (lower[1] + upper[1])
        c2, c3 = 0.5 * (lower[2] + upper[2]), 0.5 * (lower[3] + upper[3])
        h0, h1 = 0.5 * (upper[0] - lower[0]), 0.5 * (upper[1] - lower[1])
        h2, h3 = 0.5 * (upper[2] - lower[2]), 0.5 * (upper[3] - lower[3])
        for i in range(source.shape[1]):
            a, b = source[0, i], source[1, i]
            x, y = c0 * a - c1 * b + c2, c1 * a + c0 * b + c3
            wide, high = abs(a) * h0 + abs(b) * h1 + h2, abs(b) * h0 + abs(a) * h1 + h3
            for j in range(target.shape[1]):
                dx = max(abs(x - target[0, j]) - wide, 0.0)
                dy = max(abs(y - target[1, j]) - high, 0.0)
                cost[i, j] = dx * dx + dy * dy


# --- Vertices of a box of parameters --------------------------------------------------------------


@jit_part
def n_vertices(lower, upper):
    """Return the number of distinct vertices of a box: axes of zero width do not count."""
    count = 1
    for a in range(lower.size):
        if upper[a] > lower[a]:
            count *= 2
    return count


@jit_part
def vertex(lower, upper, index, out):
    """Write the index-th distinct vertex of a box; bit a of the index refers to the a-th wide axis."""
    for a in range(lower.size):
        out[a] = lower[a]
        if upper[a] > lower[a]:
            if index & 1:
                out[a] = upper[a]
            index >>= 1


# --- Vertices of bisected boxes, identified by their position on a dyadic lattice of the root box ---
# A vertex is stored once, under its integer coordinates, for all boxes that have it.

CELLS = 2.0**30  # per axis; finer boxes are not distinguished


class Lattice(NamedTuple):
    """The vertices seen so far, by slot, and a hash table to find them.

    Attributes
    ----------
    table : (T,) int array
        Slots by hash, -1 where empty; T is a power of two.
    keys : (S, 4) int array
        Coordinates on the lattice.
    thetas : (S, dim) array
    met : (S,) int array
        The last call that requested the vertex.
    origin, width : (dim,) arrays
        Of the root box.
    """

    table: np.ndarray
    keys: np.ndarray
    thetas: np.ndarray
    met: np.ndarray
    origin: np.ndarray
    width: np.ndarray


class Vertices(NamedTuple):
    """Values and bounds of the vertices, by slot.

    Attributes
    ----------
    thetas : (S, dim) array
    lows : (S,) array
        Lower bounds on E.
    values : (S,) array
        E if it was solved, otherwise infinite.
    levels : (S,) array
        Approximately the k-th smallest entry of the profile.
    profiles, duals : (S, n), (S, m) arrays
    """

    thetas: np.ndarray
    lows: np.ndarray
    values: np.ndarray
    levels: np.ndarray
    profiles: np.ndarray
    duals: np.ndarray


@jit_part
def _hash(q0, q1, q2, q3):
    h = np.uint64(q0) * np.uint64(0x9E3779B97F4A7C15)
    h = (h ^ np.uint64(q1)) * np.uint64(0xBF58476D1CE4E5B9)
    h = (h ^ (h >> np.uint64(29)) ^ np.uint64(q2)) * np.uint64(0x94D049BB133111EB)
    h = (h ^ (h >> np.uint64(32)) ^ np.uint64(q3)) * np.uint64(0x9E3779B97F4A7C15)
    return h ^ (h >> np.uint64(31))


@jit
def rebuild(table, keys, used):
    """Build the hash table of the first `used` keys."""
    for at in range(table.size):
        table[at] = -1
    mask = np.uint64(table.size - 1)
    for slot in range(used):
        at = _hash(keys[slot, 0], keys[slot, 1], keys[slot, 2], keys[slot, 3]) & mask
        while table[at] >= 0:
            at = (at + np.uint64(1)) & mask
        table[at] = slot


@jit
def find_or_add(lattice, used, call, lower, upper, slots):
    """Return the slot of each distinct vertex of each box (-1 beyond the last); append new ones.

    Returns the number of slots in use; before the call it was `used`. The caller provides enough slots.
    """
    table, keys, dim = lattice.table, lattice.keys, lattice.origin.size
    mask = np.uint64(table.size - 1)
    theta, q = np.empty(dim), cleared(np.empty(4, np.int64))
    for box in range(lower.shape[0]):
        slots[box, 0] = -1
        for index in range(n_vertices(lower[box], upper[box])):
            vertex(lower[box], upper[box], index, theta)
            for a in range(dim):
                if lattice.width[a] > 0.0:
                    place = (theta[a] - lattice.origin[a]) / lattice.width[a]
                    q[a] = np.int64(np.rint(place * CELLS))
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
                for a in range(4):
                    keys[slot, a] = q[a]
                for a in range(dim):
                    lattice.thetas[slot, a] = theta[a]
            slots[box, index] = slot
            lattice.met[slot] = call
    return used


# --- The linearisation point that maximises a DC bound with a fixed quadratic loss ----------------

_STEPS = 40


@jit_part
def best_linearisation(vertices, values, weights, floor, enough, point):
    """Return the maximum of ``min_v [E(v) - sum_a weights_a (v_a - theta0_a)^2]`` over theta0.

    The maximiser is written to `point`. The dual is the minimum of
    ``sum_v w_v (E(v) - Q(v)) + Q(sum_v w_v v)`` over weights w of the vertices. It is solved by pairwise
    Frank-Wolfe steps with exact line search; theta0 is the weighted mean of the vertices. Every iterate
    is valid, so the best one is kept. The search ends early if the dual shows that `floor` is out of
    reach, or if `enough` is reached.
    """
    count, dim = vertices.shape
    w, centre = np.empty(count), cleared(np.empty(dim))
    for v in range(count):
        w[v] = 1.0 / count
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
            for a in range(dim):
                point[a] = centre[a]
        if ceiling < floor or low >= enough or high - low <= 1e-3 * (abs(low) + 1e-12):
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


# --- Bounds that solve their assignments box by box, and the objective at many parameters ---------


@jit
def objectives(clouds, thetas, values):
    """Write E at every row of `thetas` into `values`; return the number of assignments."""
    cost = np.empty((clouds.source.shape[1], clouds.target.shape[-1]))
    for row in range(thetas.shape[0]):
        if clouds.stop[0]:
            break
        pair_costs(clouds, thetas[row], cost)
        values[row], _ = k_assignment(cost, clouds.k, clouds.stop)
    return thetas.shape[0]


@jit
def dc_bound(clouds, lower, upper, bounds, thetas, values):
    """Compute the published DC bound: tangent at the box centre, one assignment at every vertex.

    Fills, for each box, the bound, the minimising vertex and the objective of the matching found there,
    which is an upper bound on E at that vertex. Returns the number of assignments.
    """
    n, m, dim = clouds.source.shape[1], clouds.target.shape[-1], lower.shape[1]
    missed, cost = np.empty(n), np.empty((n, m))
    theta, delta = np.empty(dim), np.empty(dim)
    n_assignments = 0
    for box in range(lower.shape[0]):
        bounds[box] = np.inf
        for index in range(n_vertices(lower[box], upper[box])):
            if clouds.stop[0]:
                break
            vertex(lower[box], upper[box], index, theta)
            for a in range(dim):
                delta[a] = theta[a] - 0.5 * (lower[box, a] + upper[box, a])
            pair_costs(clouds, theta, cost)
            curvature(clouds.target, clouds, delta, missed)
            for i in range(n):
                for j in range(m):
                    cost[i, j] -= missed[i]
            value, col_of = k_assignment(cost, clouds.k, clouds.stop)
            n_assignments += 1
            if value < bounds[box]:
                bounds[box] = value
                for a in range(dim):
                    thetas[box, a] = theta[a]
                for i in range(n):
                    if col_of[i] >= 0:
                        value += missed[i]
                values[box] = value
    return n_assignments


@jit
def interval_bound(clouds, lower, upper, bounds):
    """Bound each pair by its own best parameter in the box: k interval distances, never negative."""
    cost = np.empty((clouds.source.shape[1], clouds.target.shape[-1]))
    for box in range(lower.shape[0]):
        if clouds.stop[0]:
            break
        interval_costs(clouds.source, clouds.target, lower[box], upper[box], cost)
        add_penalty(clouds.infeasibility_penalty, cost)
        weigh(clouds.weights, cost)
        bounds[box], _ = k_assignment(cost, clouds.k, clouds.stop)
    return lower.shape[0]
