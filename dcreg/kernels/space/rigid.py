"""Bounds over boxes of rigid poses.

A box has seven axes: four of a quaternion, three of the translation of y = R x + t. Point sets are
stored by axis, (3, n) and (3, m). Why the bounds hold is written in `dcreg.bounds.rigid3d`.
"""

from __future__ import annotations

import math

import numpy as np

from dcreg.kernels.assignment.dense import improve_assignment, k_assignment, row_minima
from dcreg.kernels.assignment.selection import kth_smallest, total
from dcreg.kernels.compiling import jit
from dcreg.kernels.space.caps import cap_costs
from dcreg.kernels.space.cayley import vertex_bound
from dcreg.kernels.space.geometry import extent, matched_cost
from dcreg.kernels.space.poses import View, look_from, nearest_sums, pair_costs, relative_corners
from dcreg.kernels.space.priced import keep_prices, priced_bound, room_for_prices
from dcreg.kernels.space.stationary import least_at_corners, loss_of, needed, proven

# Boxes with rotations farther than this from the middle, as tangents of half the angle, are left to caps:
# what a matching loses by the square of the angle is more there than all there is.
_WIDE = 0.6
# As many pairs take no longer to assign than to price: their boxes are left to caps too.
_FEW = 1000
# A sum of nearest costs below this share of what closes the box is not worth an assignment.
_WORTH_ASSIGNMENT = 0.35


@jit
def bound_boxes(lower, upper, cutoff, clouds, limits, prices, bounds, values):
    """Bound every box, cheapest test first; returns the assignments solved.

    Parameters
    ----------
    lower, upper : (B, 7) arrays
    cutoff : float
        A bound above it is of no use.
    clouds : Clouds
    limits : (inertia, drift)
        Of any k sources: the greatest sum of their squares, and the greatest length of their sum.
    prices : (B, m) uint16 array
        Those of the box that each is a part of; replaced by its own.
    bounds, values : (B,) arrays
        Receive the bounds, and upper bounds on E at the centres, +inf where no matching was sought.
    """
    n, m, k = clouds.source.shape[1], clouds.target.shape[1], clouds.k
    view = View(np.empty((3, n)), np.empty((3, m)), clouds.prices, k, clouds.stop)
    radius, farthest = extent(clouds.source)
    few = n * m <= _FEW
    room, costs, b = room_for_prices(n, m), np.empty((n, m)), np.empty(m)
    corners, centre, half = np.empty((8, 3)), np.empty(7), np.empty(3)
    spent = 0
    for box in range(lower.shape[0]):
        if clouds.stop[0]:
            break
        values[box] = np.inf
        for c in range(7):
            centre[c] = 0.5 * (lower[box, c] + upper[box, c])
        for c in range(3):
            half[c] = 0.5 * (upper[box, 4 + c] - lower[box, 4 + c])
        count = relative_corners(centre, lower[box], upper[box], corners)
        tangent = extent(corners[:count].T)[1] if count > 0 else np.inf
        slack = math.sqrt(half[0] ** 2 + half[1] ** 2 + half[2] ** 2)
        angle = 2.0 * math.atan(tangent)
        look_from(clouds, centre, view)
        # however low their bounds, the poses of a small box are alike and must be told from others
        small = k * (angle * radius + slack) ** 2 < cutoff
        if few or tangent > _WIDE:
            bounds[box], solved = _capped(view, angle, slack, cutoff, small, costs)
            spent += solved
            if bounds[box] >= cutoff or not small or tangent > _WIDE:
                continue
        loss = loss_of(tangent, slack, limits[0], limits[1])
        if not few:
            goal = needed(loss, cutoff)
            found, in_vain = priced_bound(
                view, corners[:count], half, farthest, goal, prices[box], room
            )
            bounds[box] = proven(loss, found)
            if bounds[box] >= cutoff or not (small or in_vain):
                continue
        pair_costs(view.moved, view.shifted, view.prices, costs)
        for j in range(m):
            b[j] = room.b[j]  # 0 where pairs are few
        _, col_of = improve_assignment(costs, k, b, clouds.stop)
        keep_prices(b, prices[box])
        spent += 1
        values[box] = matched_cost(view.moved, view.shifted, col_of)
        row_minima(costs, b, room.exact_low)
        level = kth_smallest(room.exact_low, k - 1)
        found = least_at_corners(
            view.moved, room.exact_low, k, corners[:count], half, level, room.ways
        )
        found -= total(b)
        bounds[box] = max(bounds[box], proven(loss, found))
        if bounds[box] >= cutoff or not small:
            continue
        value, solved = vertex_bound(view, corners[:count], half, bounds[box], cutoff, col_of)
        bounds[box] = max(bounds[box], value)
        spent += solved
    return spent


@jit
def _capped(view, angle, slack, cutoff, small, costs):
    """The bound by caps, and the assignments solved for it."""
    cap_costs(view.moved, angle, view.shifted, view.prices, costs)
    nearest, narrowed = nearest_sums(costs, slack, view.k)
    shift = view.k * slack * slack
    bound = max(narrowed, nearest - shift)
    if bound >= cutoff or not (small or nearest > _WORTH_ASSIGNMENT * (cutoff + shift)):
        return bound, 0
    value, _ = k_assignment(costs, view.k, view.stop)
    return max(bound, value - shift), 1
