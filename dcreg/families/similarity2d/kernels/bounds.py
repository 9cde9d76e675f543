"""The DC bound of boxes from stored vertex profiles, at the best linearisation point."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dcreg.assignment.kernels.selection import smallest_sum, total
from dcreg.families.dc.kernels.boxes import n_vertices
from dcreg.families.dc.kernels.linearisation import best_linearisation
from dcreg.families.dc.kernels.motion import plane_curvature
from dcreg.jit import jit, jit_part


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
def charged_value(axes, k, low, level, profile, delta, charged):
    """Return a lower bound on min_P sum p_ij [E_ij(v) - R_i(delta)] from the profile of a vertex."""
    plane_curvature(axes, delta, charged)
    level -= total(charged) / charged.size
    for i in range(charged.size):
        charged[i] = profile[i] - charged[i]
    return smallest_sum(charged, k, level, 2.0 * abs(low) / (k * k))[0]


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
                    clouds.source, clouds.k, known.lows[slot], known.levels[slot],
                    known.profiles[slot], delta, charges,
                )  # fmt: skip
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
