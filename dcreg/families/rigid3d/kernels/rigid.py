"""Bounds over boxes of rigid poses.

A box has seven axes: four of a quaternion, three of the translation of y = R x + t. Point sets are
stored by axis, (3, n) and (3, m). Why the bounds hold is written in `dcreg.families.rigid3d.bound`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dcreg.assignment.kernels.dense import improve_assignment, k_assignment, row_minima
from dcreg.assignment.kernels.selection import kth_smallest, total
from dcreg.families.rigid3d.kernels.cayley import vertex_bound
from dcreg.families.rigid3d.kernels.corners import CORNERS, LEFT, Prospects, judge
from dcreg.families.rigid3d.kernels.poses import (
    View,
    look_from,
    nearest_sums,
    pair_costs,
    relative_corners,
)
from dcreg.families.rigid3d.kernels.priced import keep_prices, priced_bound, room_for_prices
from dcreg.families.rigid3d.kernels.stationary import (
    Surroundings,
    joint_loss_of,
    look_at_corners,
    loss_of,
    needed,
    proven,
)
from dcreg.families.rotation3d.kernels.caps import cap_costs
from dcreg.families.rotation3d.kernels.geometry import extent, matched_cost
from dcreg.jit import jit

# Boxes with rotations farther than this from the middle, as tangents of half the angle, are left to caps:
# what a matching loses by the square of the angle is more there than all there is.
_WIDE = 0.6
# As many pairs take no longer to assign than to price: their boxes are left to caps too.
_FEW = 1000
# A sum of nearest costs below this share of what closes the box is not worth an assignment.
_WORTH_ASSIGNMENT = 0.35


class Found(NamedTuple):
    """What is found out about B boxes.

    Attributes
    ----------
    bounds, values : (B,) arrays
        Lower bounds on E, and upper bounds on it at the centres: +inf where no matching was sought.
    guesses : (B,) array
        Guesses of it at the centres, from below but for rounding: +inf where none was made.
    prices : (B, m) uint16 array
        Those of the box that each is a part of; replaced by its own.
    prospects : Prospects
        Of the boxes that values at their corners may close.
    """

    bounds: np.ndarray
    values: np.ndarray
    guesses: np.ndarray
    prices: np.ndarray
    prospects: Prospects

    def part(self, which: slice) -> Found:
        bounds, values, guesses, prices, prospects = self
        some = prospects.part(which)
        return Found(bounds[which], values[which], guesses[which], prices[which], some)


def room_for_findings(prices: np.ndarray) -> Found:
    """What `bound_boxes` fills for boxes with these prices."""
    count = len(prices)
    prospects = Prospects(
        np.empty((count, CORNERS)), np.empty((count, 2)),
        np.full((count, CORNERS), -1, np.int32), np.empty(count, np.int8),
    )  # fmt: skip
    return Found(np.empty(count), np.empty(count), np.empty(count), prices, prospects)


@jit
def is_small(clouds):
    """Whether pairs are so few that no corners are looked at."""
    return clouds.source.shape[1] * clouds.target.shape[1] <= _FEW


@jit
def bound_boxes(lower, upper, cutoff, clouds, limits, known, found):
    """Bound every box, cheapest test first; returns the assignments solved.

    Parameters
    ----------
    lower, upper : (B, 7) arrays
    cutoff : float
        A bound above it is of no use.
    clouds : Clouds
    limits : Limits
    known : Known
    found : Found
    """
    n, m, k = clouds.source.shape[1], clouds.target.shape[1], clouds.k
    view = View(np.empty((3, n)), np.empty((3, m)), clouds.prices, k, clouds.stop)
    radius, farthest = extent(clouds.source)
    few = is_small(clouds)
    room, costs, b = room_for_prices(n, m), np.empty((n, m)), np.empty(m)
    buffer, centre, half = np.empty((8, 3)), np.empty(7), np.empty(3)
    bounds, values, guesses, prices, prospects = found
    spent = 0
    for at in range(lower.shape[0]):
        if clouds.stop[0]:
            break
        values[at] = guesses[at] = np.inf
        prospects.states[at] = LEFT
        for c in range(7):
            centre[c] = 0.5 * (lower[at, c] + upper[at, c])
        for c in range(3):
            half[c] = 0.5 * (upper[at, 4 + c] - lower[at, 4 + c])
        corners = buffer[: relative_corners(centre, lower[at], upper[at], buffer)]
        tangent = extent(corners.T)[1] if corners.shape[0] > 0 else np.inf
        slack = math.sqrt(half[0] ** 2 + half[1] ** 2 + half[2] ** 2)
        box = Surroundings(corners, half, tangent, slack)
        angle = 2.0 * math.atan(tangent)
        look_from(clouds, centre, view)
        # however low their bounds, the poses of a small box are alike and must be told from others
        small = k * (angle * radius + slack) ** 2 < cutoff
        if few or tangent > _WIDE:
            bounds[at], solved = _capped(view, angle, slack, cutoff, small, costs)
            spent += solved
            if bounds[at] >= cutoff or not small or tangent > _WIDE:
                continue
        loss, joint = loss_of(box, limits), joint_loss_of(box, limits)
        if not few:
            goal = needed(joint, cutoff)
            least, guesses[at] = priced_bound(
                view, box, farthest, goal, prices[at], room, prospects.least[at]
            )
            bounds[at] = proven(loss, least)
            if bounds[at] >= cutoff:
                continue
            prospects.losses[at, 0], prospects.losses[at, 1] = joint.root, joint.rest
            if not small:
                prospects.states[at] = judge(known, lower[at], upper[at], prospects, at, cutoff)
                continue
        pair_costs(view.moved, view.shifted, view.prices, costs)
        for j in range(m):
            b[j] = room.b[j]  # 0 where pairs are few
        _, col_of = improve_assignment(costs, k, b, clouds.stop)
        keep_prices(b, prices[at])
        spent += 1
        values[at] = matched_cost(view.moved, view.shifted, col_of)
        row_minima(costs, b, room.exact_low)
        level = kth_smallest(room.exact_low, k - 1)
        least = look_at_corners(
            view.moved, room.exact_low, k, box.corners, half, level, room.ways, prospects.least[at]
        )
        prospects.least[at] -= total(b)
        bounds[at] = max(bounds[at], proven(loss, least - total(b)))
        if bounds[at] >= cutoff:
            continue
        value, solved = vertex_bound(view, corners, half, bounds[at], cutoff, col_of)
        bounds[at] = max(bounds[at], value)
        spent += solved
        if bounds[at] < cutoff and not few:
            prospects.states[at] = judge(known, lower[at], upper[at], prospects, at, cutoff)
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
