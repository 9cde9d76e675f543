"""Lower bounds over boxes of rigid poses.

A box has seven axes: four of a quaternion, three of the translation of y = R x + t. Point sets are
stored by axis, (3, n) and (3, m). `dcreg.families.rigid3d.bound` proves the bounds.

Two kernels share the work, so that a search over few pairs does not compile the first:
`bound_boxes_by_duals` bounds boxes by duals, `bound_boxes` by caps and by exact assignments.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dcreg.assignment.kernels.dense import improve_assignment, k_assignment, row_minima
from dcreg.assignment.kernels.selection import kth_smallest, total
from dcreg.families.kernels import weigh
from dcreg.families.rigid3d.kernels.cayley import vertex_bound
from dcreg.families.rigid3d.kernels.dual_bounds import dual_bound_of_box, keep_duals
from dcreg.families.rigid3d.kernels.poses import (
    empty_view,
    look_from,
    nearest_sums,
    pair_costs,
    relative_vertices,
)
from dcreg.families.rigid3d.kernels.stationary import (
    BoxGeometry,
    costs_at_vertices,
    joint_loss_of,
    loss_of,
    needed,
    proven,
)
from dcreg.families.rigid3d.kernels.vertices import VALUES_NEEDED, BoxStates, allocate_states
from dcreg.families.rotation3d.kernels.caps import cap_costs
from dcreg.families.rotation3d.kernels.geometry import extent
from dcreg.jit import jit, jit_inner, jit_part

# Boxes with rotations farther than this from the centre, as tangents of half the angle, are bounded by
# caps only: the second-order loss exceeds the objective there, so the other bounds are vacuous.
WIDE = 0.6
# An assignment of so many pairs takes as long as one bound by duals: such boxes are bounded by caps
# only.
FEW_PAIRS = 1000
# An assignment is worthwhile if the sum of nearest costs exceeds this share of the pruning threshold.
WORTH_ASSIGNMENT = 0.35
# Next step for a box: its first bound, an exact assignment, none.
_BEGIN, _SOLVE, _DONE = 0, 1, 2


class Found(NamedTuple):
    """Results for B boxes.

    Attributes
    ----------
    bounds, values : (B,) arrays
        Lower bounds on E, and upper bounds on E at the centres: +inf if no matching was computed.
    estimates : (B,) array
        Estimates of E at the centres, from below up to rounding: +inf if there is none.
    kept : (B, m) uint16 array
        Duals of the parent boxes; replaced by those of the boxes.
    duals : (B, m) float32 array
        Duals from which an exact assignment starts.
    steps : (B,) int8 array
        The next step for each box.
    boxes : BoxStates
        Of the boxes that values at their vertices may prune.
    """

    bounds: np.ndarray
    values: np.ndarray
    estimates: np.ndarray
    kept: np.ndarray
    duals: np.ndarray
    steps: np.ndarray
    boxes: BoxStates


def allocate_found(kept: np.ndarray) -> Found:
    """Allocate the results for boxes whose parents have these duals."""
    count, m = kept.shape
    return Found(
        np.empty(count), np.full(count, np.inf), np.full(count, np.inf), kept,
        np.zeros((count, m), np.float32), np.full(count, _BEGIN, np.int8), allocate_states(count),
    )  # fmt: skip


@jit_inner
def geometry(lower, upper, centre, half, buffer):
    """Express the box relative to its centre. Fills the next two; `buffer` is (8, 3)."""
    for c in range(7):
        centre[c] = 0.5 * (lower[c] + upper[c])
    for c in range(3):
        half[c] = 0.5 * (upper[4 + c] - lower[4 + c])
    vertices = buffer[: relative_vertices(centre, lower, upper, buffer)]
    tangent = np.inf if vertices.shape[0] == 0 else 0.0
    for a in range(vertices.shape[0]):
        square = vertices[a, 0] ** 2 + vertices[a, 1] ** 2 + vertices[a, 2] ** 2
        tangent = max(tangent, math.sqrt(square))
    shift_radius = math.sqrt(half[0] ** 2 + half[1] ** 2 + half[2] ** 2)
    return BoxGeometry(vertices, half, tangent, shift_radius)


@jit_part
def is_small(box, radius, k, limit):
    """Whether a box is so small that exact assignments pay: its displacements cost less than `limit`."""
    return k * (2.0 * math.atan(box.tangent) * radius + box.shift_radius) ** 2 < limit


@jit
def bound_boxes(lower, upper, cutoff, clouds, limits, found):
    """Bound the boxes that `bound_boxes_by_duals` leaves; return the number of assignments.

    Boxes without a bound are bounded by caps, small boxes by an exact assignment.

    Parameters
    ----------
    lower, upper : (B, 7) arrays
    cutoff : float
        Bounds above it are not improved.
    clouds : Clouds
    limits : Limits
    found : Found
    """
    n, m, k = clouds.source.shape[1], clouds.target.shape[1], clouds.k
    view = empty_view(clouds)
    radius, few = extent(clouds.source)[0], n * m <= FEW_PAIRS
    costs, b, work = np.empty((n, m)), np.empty(m), np.empty((5, n))
    low, buffer, centre, half = work[0], np.empty((8, 3)), np.empty(7), np.empty(3)
    bounds, steps = found.bounds, found.steps
    spent = 0
    for at in range(lower.shape[0]):
        if clouds.stop[0]:
            break
        if steps[at] == _DONE:
            continue
        box = geometry(lower[at], upper[at], centre, half, buffer)
        look_from(clouds, centre, view)
        if steps[at] == _BEGIN:
            steps[at] = _DONE
            small = is_small(box, radius, k, cutoff)
            bounds[at], solved = _capped(view, box, cutoff, small, costs)
            spent += solved
            if bounds[at] >= cutoff or not small or box.tangent > WIDE:
                continue
        steps[at] = _DONE
        pair_costs(view, costs)
        for j in range(m):
            b[j] = found.duals[at, j]
        _, col_of = improve_assignment(costs, k, b, clouds.stop)
        keep_duals(b, found.kept[at])
        spent += 1
        found.values[at] = _cost_of(costs, col_of)
        row_minima(costs, b, low)
        level = kth_smallest(low, k - 1)
        out = found.boxes.costs[at]
        duals = total(b)
        cost = costs_at_vertices(view, low, box, level, work, out) - duals
        for vertex in range(out.size):
            out[vertex] -= duals
        loss = loss_of(box, limits)
        bounds[at] = max(bounds[at], proven(loss.root, loss.rest, cost))
        if bounds[at] >= cutoff:
            continue
        value, solved = vertex_bound(view, box.vertices, half, bounds[at], cutoff, col_of)
        bounds[at] = max(bounds[at], value)
        spent += solved
        if bounds[at] < cutoff and not few:
            found.boxes.states[at] = VALUES_NEEDED
    return spent


@jit
def bound_boxes_by_duals(lower, upper, cutoff, small, clouds, limits, found, work):
    """Bound all but the wide boxes by duals, and leave small ones to `bound_boxes`.

    `work` is a `Workspace`. A box is small if its displacements cost less than the share `small` of the
    cutoff.
    """
    m, k = clouds.target.shape[1], clouds.k
    view = empty_view(clouds)
    radius, farthest = extent(clouds.source)
    buffer, centre, half = np.empty((8, 3)), np.empty(7), np.empty(3)
    bounds, steps, boxes = found.bounds, found.steps, found.boxes
    for at in range(lower.shape[0]):
        if clouds.stop[0]:
            break
        box = geometry(lower[at], upper[at], centre, half, buffer)
        if box.tangent > WIDE:
            continue
        steps[at] = _DONE
        look_from(clouds, centre, view)
        loss, joint = loss_of(box, limits), joint_loss_of(box, limits)
        goal = needed(joint.root, joint.rest, cutoff)
        cost, found.estimates[at] = dual_bound_of_box(
            view, box, farthest, goal, found.kept[at], work, boxes.costs[at]
        )
        bounds[at] = proven(loss.root, loss.rest, cost)
        if bounds[at] >= cutoff:
            continue
        boxes.losses[at, 0], boxes.losses[at, 1] = joint.root, joint.rest
        if is_small(box, radius, k, small * cutoff):
            steps[at] = _SOLVE
            for j in range(m):
                found.duals[at, j] = work.columns[3, j]
        else:
            boxes.states[at] = VALUES_NEEDED


@jit_part
def _cost_of(costs, col_of):
    """Return the sum of the costs of given pairs."""
    cost = 0.0
    for i in range(col_of.size):
        if col_of[i] >= 0:
            cost += costs[i, col_of[i]]
    return cost


@jit_part
def _capped(view, box, cutoff, small, costs):
    """Return the bound by caps, and the number of assignments solved for it."""
    cap_costs(
        view.source, 2.0 * math.atan(box.tangent), view.target, view.infeasibility_penalty, costs
    )
    weigh(view.weights, costs)
    return shifted_bound(costs, box.shift_radius, cutoff, small, view)


@jit_part
def shifted_bound(costs, shift_radius, cutoff, small, view):
    """Return a bound by costs for one translation, and the number of assignments solved for it.

    `costs` bound the squared residuals of all other parameters of a box; translations vary by at most
    `shift_radius`.
    """
    nearest, narrowed = nearest_sums(costs, shift_radius, view.k)
    loss = view.k * shift_radius * shift_radius
    bound, solved = max(narrowed, nearest - loss), 0
    if bound < cutoff and (small or nearest > WORTH_ASSIGNMENT * (cutoff + loss)):
        value, _ = k_assignment(costs, view.k, view.stop)
        bound, solved = max(bound, value - loss), 1
    return bound, solved
