"""Bounds over boxes of rigid poses.

A box has seven axes: four of a quaternion, three of the translation of y = R x + t. Point sets are
stored by axis, (3, n) and (3, m). Why the bounds hold is written in `dcreg.bounds.rigid3d`.
"""

from __future__ import annotations

import math

import numpy as np

from dcreg.kernels.assignment.dense import dual_bound, improve_assignment, row_minima
from dcreg.kernels.compiling import jit, jit_part
from dcreg.kernels.space.caps import cap_costs
from dcreg.kernels.space.cayley import vertex_bound
from dcreg.kernels.space.geometry import column_norms, matched_cost
from dcreg.kernels.space.poses import View, look_from, nearest_sums, relative_corners

_BIDS = 3
# Sums below these shares of what closes the box are not worth dearer bounds: it is divided.
_WORTH_PRICES = 0.35
_WORTH_ASSIGNMENT = 0.65


@jit_part
def bid(cost, k, b):
    """Raise duals `b` >= 0 by bids of the k rows that start cheapest: a rough auction.

    Whatever it ends at, `dual_bound` of the result is a valid bound. Costs about two passes over
    the pairs; an assignment costs dozens.
    """
    n, m = cost.shape
    low = np.empty(n)
    row_minima(cost, b, low)
    queue, owner = np.empty(k, np.int64), np.empty(m, np.int64)
    _cheapest_first(low, queue)
    for j in range(m):
        owner[j] = -1
    head, size, budget = 0, k, _BIDS * k
    while size > 0 and budget > 0:
        i = queue[head]
        head = (head + 1) % k
        size -= 1
        budget -= 1
        first, second, at = np.inf, np.inf, -1
        row = cost[i]
        for j in range(m):
            value = row[j] + b[j]
            if value < second:
                if value < first:
                    second, first, at = first, value, j
                else:
                    second = value
        loser = owner[at]
        owner[at] = i
        if (loser >= 0 or b[at] > 0.0) and second < np.inf:
            b[at] += second - first
        if loser >= 0:
            queue[(head + size) % k] = loser
            size += 1


@jit_part
def _cheapest_first(low, queue):
    """The places of the smallest numbers into `queue`, ascending (by insertion: rows are few)."""
    size = 0
    for i in range(low.size):
        if size == queue.size and low[i] >= low[queue[size - 1]]:
            continue
        at = min(size, queue.size - 1)
        size = min(size + 1, queue.size)
        while at > 0 and low[queue[at - 1]] > low[i]:
            queue[at] = queue[at - 1]
            at -= 1
        queue[at] = i


@jit
def bound_boxes(lower, upper, cutoff, clouds, bounds, values):
    """Bound every box, cheapest test first; returns the assignments solved.

    `values` receives an upper bound on E at the box centre, +inf where the box was decided before.
    """
    n, m, k = clouds.source.shape[1], clouds.target.shape[1], clouds.k
    view = View(np.empty((3, n)), np.empty(n), np.empty((3, m)), clouds.prices, k, clouds.stop)
    column_norms(clouds.source, view.reach)
    square = 0.0
    for i in range(n):
        square += view.reach[i] ** 2
    radius = math.sqrt(square / n)
    caps = np.empty((n, m))
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
        tangent = 0.0
        for a in range(count):
            square = corners[a, 0] ** 2 + corners[a, 1] ** 2 + corners[a, 2] ** 2
            tangent = max(tangent, math.sqrt(square))
        angle = 2.0 * math.atan(tangent) if count > 0 else math.pi
        slack = math.sqrt(half[0] ** 2 + half[1] ** 2 + half[2] ** 2)
        look_from(clouds, centre, view)

        cap_costs(view.moved, angle, view.shifted, view.prices, caps)
        nearest, narrowed = nearest_sums(caps, slack, k)
        shift = k * slack * slack
        bounds[box] = max(narrowed, nearest - shift)
        # however low their bounds, the poses of a small box are alike and must be told from others
        small = k * (angle * radius + slack) ** 2 < cutoff
        goal = cutoff + shift
        if bounds[box] >= cutoff or not (small or nearest > _WORTH_PRICES * goal):
            continue
        b = np.zeros(m)
        bid(caps, k, b)
        priced = dual_bound(caps, k, b)
        bounds[box] = max(bounds[box], priced - shift)
        if bounds[box] >= cutoff or not (small or priced > _WORTH_ASSIGNMENT * goal):
            continue
        value, col_of = improve_assignment(caps, k, b, clouds.stop)
        bounds[box] = max(bounds[box], value - shift)
        values[box] = matched_cost(view.moved, view.shifted, col_of)
        spent += 1
        if bounds[box] >= cutoff or count == 0 or not small:
            continue
        value, solved = vertex_bound(view, corners[:count], half, bounds[box], cutoff, col_of)
        bounds[box] = max(bounds[box], value)
        spent += solved
    return spent
