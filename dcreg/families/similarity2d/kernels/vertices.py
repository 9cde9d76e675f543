"""Kernels of the 2D similarity: vertex profiles, bounds from them, and poses of point pairs."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dcreg.assignment.kernels.dense import first_duals, improve_assignment, row_minima
from dcreg.assignment.kernels.selection import cleared, least, smallest_sum, total
from dcreg.families.dc.kernels import best_linearisation, n_vertices, pair_costs, plane_curvature
from dcreg.families.kernels import overlap
from dcreg.jit import jit, jit_part

# --- Vertex values in 2D, and profiles that bound the k-assignment under any row charges ----------
# With duals b >= 0 let r_i = min_j (c_ij + b_j) - (sum b) / k, the *profile*. For any b and any charge
# R_i on the rows, the sum of the k smallest r_i - R_i is at most the k-assignment of c_ij - R_i. With
# optimal b the k smallest r_i add up to E(v).

# Added to the squared distance of a vertex that was not solved, so that any solved one has more weight.
_UNSOLVED = 1e6


@jit
def bound_vertices(clouds, known, solve, warm, slots):
    """Fill bounds on E and profiles at the vertices `slots`; return the number of vertices evaluated.

    With `solve`, E is computed with optimal duals; with `warm`, from the stored duals. Otherwise the
    stored duals give a lower bound in one pass over the costs. `values` then stays infinite, because no
    upper bound is known.
    """
    n, m = clouds.source.shape[1], clouds.target.shape[1]
    cost = np.empty((n, m))
    for at in range(slots.size):
        if clouds.stop[0]:
            break
        slot = slots[at]
        duals, value = known.duals[slot], np.inf
        pair_costs(clouds, known.thetas[slot], cost)
        if solve:
            if not warm:
                first_duals(cost, clouds.k, duals)
            value, _ = improve_assignment(cost, clouds.k, duals, clouds.stop)
        low, known.levels[slot] = _dual_profile(cost, clouds.k, duals, known.profiles[slot])
        known.lows[slot], known.values[slot] = value if solve else low, value
    return slots.size


@jit_part
def _dual_profile(cost, k, b, profile):
    """Fill r_i = min_j (c_ij + b_j) - (sum b) / k; return sum and maximum of its k smallest entries."""
    row_minima(cost, b, profile)
    share = total(b) / k
    for i in range(profile.size):
        profile[i] -= share
    mean = total(profile) / profile.size
    return smallest_sum(profile, k, mean, (mean - least(profile)) / profile.size)


@jit
def blend_duals(known, weights, slots, which, start, boxes, n_fixed):
    """Estimate dual variables at vertices from the other vertices of all their boxes (`boxes_of`).

    The estimate is a mean with weights ``distance^-6``. Optimal duals are continuous and piecewise
    linear in the costs, so the mean over the nearest vertices on all sides is better than any of them.
    Estimated neighbours count only if no neighbour is solved, and only in slots below `n_fixed`, whose
    estimates do not change.
    Returns which vertices have an estimate.
    """
    found, mean = np.empty(which.size, np.bool_), np.empty(known.duals.shape[1])
    for at in range(which.size):
        slot, whole = which[at], 0.0
        for j in range(mean.size):
            mean[j] = 0.0
        for place in range(start[at], start[at + 1]):
            for v in range(slots.shape[1]):
                other = slots[boxes[place], v]
                if other < 0 or other == slot:
                    continue
                solved = known.values[other] < np.inf
                if not solved and other >= n_fixed:
                    continue
                distance = 0.0 if solved else _UNSOLVED
                for a in range(weights.size):
                    step = known.thetas[slot, a] - known.thetas[other, a]
                    distance += weights[a] * step**2
                weight = 1.0 / (distance * distance * distance)
                whole += weight
                for j in range(mean.size):
                    mean[j] += weight * known.duals[other, j]
        found[at] = whole > 0.0
        if found[at]:
            for j in range(mean.size):
                known.duals[slot, j] = mean[j] / whole
    return found


# --- The DC bound of boxes from stored vertex profiles, at the best linearisation point -----------


class SharedBoxes(NamedTuple):
    """Boxes, the slots of their vertices, and their results.

    Attributes
    ----------
    lower, upper : (B, dim) arrays
    slots : (B, 2^dim) int array
        -1 beyond the last distinct vertex.
    points : (B, dim) array
        Linearisation points: initial ones, replaced by the best.
    bounds : (B,) array
    binding : (B,) int array
        Slot of the vertex that limits the bound.
    """

    lower: np.ndarray
    upper: np.ndarray
    slots: np.ndarray
    points: np.ndarray
    bounds: np.ndarray
    binding: np.ndarray


class Effort(NamedTuple):
    """Effort spent on each bound.

    Attributes
    ----------
    weights : (dim,) array
        Diagonal of the quadratic that models the loss.
    moves : int
        Maximum number of moves of the linearisation point.
    floor : float
        Bounds that cannot reach this value are not improved: the box will be divided in any case.
    enough : float
        Bounds above this value are not improved.
    """

    weights: np.ndarray
    moves: int
    floor: float
    enough: float


@jit_part
def charged_value(clouds, low, level, profile, delta, charged):
    """Return a lower bound on min_P sum p_ij [E_ij(v) - R_i(delta)] from the profile of a vertex."""
    plane_curvature(clouds, delta, charged)
    level -= total(charged) / charged.size
    for i in range(charged.size):
        charged[i] = profile[i] - charged[i]
    return smallest_sum(charged, clouds.k, level, 2.0 * abs(low) / (clouds.k * clouds.k))[0]


@jit
def shared_bounds(clouds, known, effort, boxes):
    """Bound each box by ``max_theta0 min_v min_P sum p_ij [E_ij(v) - R_i(v - theta0)]``.

    Uses shared vertex values. theta0 starts at ``boxes.points`` and moves to the optimum of a quadratic
    model of the loss. The bound itself is always evaluated with the true R_i.
    """
    dim, weights = boxes.lower.shape[1], effort.weights
    charges = np.empty(clouds.source.shape[1])
    corner, charged = np.empty((16, dim)), np.empty(16)
    delta, point = np.empty(dim), np.empty(dim)
    for box in range(boxes.lower.shape[0]):
        count = n_vertices(boxes.lower[box], boxes.upper[box])
        for a in range(dim):
            point[a] = boxes.points[box, a]
            for v in range(count):
                corner[v, a] = known.thetas[boxes.slots[box, v], a]
        best = -np.inf
        for step in range(effort.moves + 1):
            bound, at = np.inf, 0
            for v in range(count):
                for a in range(dim):
                    delta[a] = corner[v, a] - point[a]
                slot = boxes.slots[box, v]
                charged[v] = charged_value(
                    clouds,
                    known.lows[slot],
                    known.levels[slot],
                    known.profiles[slot],
                    delta,
                    charges,
                )
                if charged[v] < bound:
                    bound, at = charged[v], v
            previous = best
            if bound > best:
                best, boxes.binding[box] = bound, boxes.slots[box, at]
                for a in range(dim):
                    boxes.points[box, a] = point[a]
            if step == effort.moves or best >= effort.enough:
                break
            if step > 1 and bound <= previous + 1e-3 * abs(previous):
                break
            # the loss at theta0, modelled as a quadratic with these weights
            for v in range(count):
                for a in range(dim):
                    charged[v] += weights[a] * (corner[v, a] - point[a]) ** 2
            promise = best_linearisation(
                corner[:count], charged[:count], weights, effort.floor, np.inf, point
            )
            if promise < effort.floor:
                break
        boxes.bounds[box] = best
    return 0


# --- Similarities in 2D that map two source points onto two target points -------------------------
# Their score is the number of source points near the target. Point sets are stored by row, (n, 2) and (m,
# 2).


@jit
def pair_poses(pairs, source, target, feasible, search, thetas, scores):
    """Find the best poses of each source pair over the target pairs.

    Parameters
    ----------
    pairs : (P, 2) int array
        Rows of distinct source points.
    source, target : (n, 2), (m, 2) arrays
    feasible : (n, m) or (0, 0) bool array
        Feasible pairs; empty: all.
    search : (looked, field, low, high, stop)
        The (n, 3) source points used for the score, the `NearnessField` of the target, the range of
        scales, and the stop flag.
    thetas, scores : (P, K, 4), (P, K) arrays
        Receive the best poses of each pair; scores are initially zero.
    """
    looked, field, low, high, stop = search
    theta, R, t = np.empty(4), cleared(np.empty((3, 3))), cleared(np.empty(3))
    for at in range(pairs.shape[0]):
        i, j = pairs[at, 0], pairs[at, 1]
        x, y = source[j, 0] - source[i, 0], source[j, 1] - source[i, 1]
        square = x * x + y * y
        middle_x, middle_y = (
            0.5 * (source[i, 0] + source[j, 0]),
            0.5 * (source[i, 1] + source[j, 1]),
        )
        for p in range(target.shape[0]):
            if stop[0]:
                return
            if feasible.size > 0 and not feasible[i, p]:
                continue
            for q in range(target.shape[0]):
                if q == p or (feasible.size > 0 and not feasible[j, q]):
                    continue
                u, v = target[q, 0] - target[p, 0], target[q, 1] - target[p, 1]
                other = u * u + v * v
                if other < low * low * square or other > high * high * square:
                    continue
                # the complex number (u + iv) / (x + iy) rotates and scales one pair into the other
                a, b = (u * x + v * y) / square, (v * x - u * y) / square
                theta[0], theta[1] = a, b
                theta[2] = 0.5 * (target[p, 0] + target[q, 0]) - (a * middle_x - b * middle_y)
                theta[3] = 0.5 * (target[p, 1] + target[q, 1]) - (b * middle_x + a * middle_y)
                worst = 0
                for kept in range(1, scores.shape[1]):
                    if scores[at, kept] < scores[at, worst]:
                        worst = kept
                # a smaller source is near the target more often by chance
                weight = math.sqrt(math.sqrt(other / square))
                floor = scores[at, worst] / weight
                R[0, 0], R[0, 1], R[1, 0], R[1, 1] = a, -b, b, a
                t[0], t[1] = theta[2], theta[3]
                score = weight * overlap(R, t, looked, field, floor)
                if score > scores[at, worst]:
                    scores[at, worst] = score
                    for c in range(4):
                        thetas[at, worst, c] = theta[c]
