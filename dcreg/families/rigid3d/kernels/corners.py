"""Values at the corners of boxes of poses: each is found once, for all boxes that have the corner.

How they close a box is written in `dcreg.families.rigid3d.bound`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dcreg.families.rigid3d.kernels.poses import View, look_from
from dcreg.families.rigid3d.kernels.priced import priced_value, room_for_prices
from dcreg.families.rigid3d.kernels.stationary import Loss, needed, proven
from dcreg.families.rotation3d.kernels.geometry import extent
from dcreg.jit import jit

CORNERS = 64  # of a box: rotations times shifts
# Boxes of which values at their corners may tell more, that they do not close, and that they do.
OPEN, LEFT, CLOSED = 0, 1, 2


class Known(NamedTuple):
    """The corners met so far, by slot, and a hash table to find them.

    Attributes
    ----------
    table : (T,) int32 array
        Slots by hash, -1 where empty; T is a power of two.
    poses : (S, 7) array
    values : (S,) array
        Lower bounds on the least sum of costs; NaN while one is asked for.
    is_final : (S,) bool array
        Whether asking for more is in vain.
    """

    table: np.ndarray
    poses: np.ndarray
    values: np.ndarray
    is_final: np.ndarray


class Asked(NamedTuple):
    """Corners to be priced: slots, the boxes that ask, and up to what value: (64 B,) arrays."""

    slots: np.ndarray
    boxes: np.ndarray
    goals: np.ndarray

    def part(self, which: slice) -> Asked:
        return Asked(*(array[which] for array in self))


class Prospects(NamedTuple):
    """What is left to do for B boxes.

    Attributes
    ----------
    least : (B, 64) array
        C of `dcreg.families.rigid3d.kernels.stationary.Loss` at the corners of the boxes, from below.
    losses : (B, 2) array
        The `Loss` of its mean with a value at the corner.
    slots : (B, 64) int32 array
        Of known corners; -1 elsewhere.
    states : (B,) int8 array
        OPEN, LEFT or CLOSED.
    """

    least: np.ndarray
    losses: np.ndarray
    slots: np.ndarray
    states: np.ndarray

    def part(self, which: slice) -> Prospects:
        return Prospects(*(array[which] for array in self))


@jit
def ask_for_values(known, used, boxes, prospects, cutoff, most, asked):
    """Judge boxes by the values known, and list what corners have to be priced to know more.

    Parameters
    ----------
    known : Known
    used : int
        Slots taken.
    boxes : (lower, upper)
        (B, 7) arrays.
    prospects : Prospects
        Boxes are settled where the values known tell.
    cutoff : float
        What boxes must be shown to reach.
    most : int
        Corners to be asked for per box, those of least C first.
    asked : Asked

    Returns
    -------
    used, count : int
        Slots taken now, and how many of them are asked for.
    """
    lower, upper = boxes
    open_corners, count = np.empty(CORNERS, np.int64), 0
    for box in range(lower.shape[0]):
        if prospects.states[box] == OPEN:
            prospects.states[box] = judge(known, lower[box], upper[box], prospects, box, cutoff)
        if prospects.states[box] != OPEN:
            continue
        least, slots = prospects.least[box], prospects.slots[box]
        alone, together = _goals(prospects, box, cutoff)
        n_open = 0
        for corner in range(CORNERS):
            is_short = least[corner] < alone
            if is_short and _may_tell_more(known, slots[corner], 2.0 * together - least[corner]):
                open_corners[n_open] = corner
                n_open += 1
        if most < n_open:
            _least_first(open_corners[:n_open], least, most)
        for turn in range(min(most, n_open)):
            at = open_corners[turn]
            goal = 2.0 * together - least[at]
            if slots[at] < 0:
                slots[at], used = _slot_of(known, used, lower[box], upper[box], at)
            if _may_tell_more(known, slots[at], goal):
                known.values[slots[at]] = np.nan
                asked.slots[count], asked.boxes[count], asked.goals[count] = slots[at], box, goal
                count += 1
    return used, count


@jit
def _least_first(corners, least, most):
    """Bring so many of the corners to the front, in order of C."""
    for turn in range(most):
        best = turn
        for other in range(turn + 1, corners.size):
            if least[corners[other]] < least[corners[best]]:
                best = other
        corners[turn], corners[best] = corners[best], corners[turn]


@jit
def _slot_of(known, used, lower, upper, corner):
    """The slot of a corner, taken now if it has none, and how many are taken then."""
    theta = np.empty(7)
    corner_pose(lower, upper, corner, theta)
    place = _place(known, theta, _joined(_hash(theta[:4]), _hash(theta[4:])))
    slot = known.table[place]
    if slot >= 0:
        return slot, used
    known.table[place] = used
    known.poses[used] = theta
    known.values[used] = -np.inf
    known.is_final[used] = False
    return used, used + 1


@jit
def _goals(prospects, box, cutoff):
    """The C that is enough at a corner whose value is not known, and the mean that is where it is."""
    root, rest = prospects.losses[box]
    return needed(Loss(2.0 * root, 2.0 * rest), cutoff), needed(Loss(root, rest), cutoff)


@jit
def _may_tell_more(known, slot, goal):
    """Whether to ask for the value of a corner that has to reach `goal`."""
    if slot < 0:
        return True
    value = known.values[slot]
    return not math.isnan(value) and value < goal and not known.is_final[slot]


@jit
def judge(known, lower, upper, prospects, box, cutoff):
    """What the values known say of a box: see `Prospects.states`."""
    least, slots, theta = prospects.least[box], prospects.slots[box], np.empty(7)
    alone, together = _goals(prospects, box, cutoff)
    turns, shifts = np.empty(8, np.uint64), np.empty(8, np.uint64)
    for part in range(8):
        corner_pose(lower, upper, 9 * part, theta)
        turns[part], shifts[part] = _hash(theta[:4]), _hash(theta[4:])
    state = CLOSED
    for corner in range(CORNERS):
        if least[corner] >= alone:
            continue
        slot = slots[corner]
        if slot < 0:
            corner_pose(lower, upper, corner, theta)
            place = _place(known, theta, _joined(turns[corner >> 3], shifts[corner & 7]))
            slot = slots[corner] = known.table[place]
        if slot < 0 or math.isnan(known.values[slot]):
            state = OPEN
        elif known.values[slot] < 2.0 * together - least[corner]:
            if not known.is_final[slot]:
                state = OPEN
            elif cutoff < np.inf:
                return LEFT
    return state


@jit
def bounds_by_corners(known, prospects, cutoff, bounds):
    """Raise the bounds of the boxes that are closed."""
    for box in range(bounds.size):
        if prospects.states[box] != CLOSED:
            continue
        loss = Loss(prospects.losses[box, 0], prospects.losses[box, 1])
        alone, _ = _goals(prospects, box, cutoff)
        single = both = np.inf
        for corner in range(CORNERS):
            least = prospects.least[box, corner]
            if least >= alone:
                single = min(single, least)
            else:
                both = min(both, 0.5 * (least + known.values[prospects.slots[box, corner]]))
        bound = np.inf
        if single < np.inf:
            bound = proven(Loss(2.0 * loss.root, 2.0 * loss.rest), single)
        if both < np.inf:
            bound = min(bound, proven(loss, both))
        bounds[box] = max(bounds[box], bound)


@jit
def price_corners(known, asked, prices, clouds):
    """Values of the corners asked for, from the prices of the boxes that ask: (B, m)."""
    n, m = clouds.source.shape[1], clouds.target.shape[1]
    view = View(np.empty((3, n)), np.empty((3, m)), clouds.prices, clouds.k, clouds.stop)
    room, farthest = room_for_prices(n, m), extent(clouds.source)[1]
    for at in range(asked.slots.size):
        if clouds.stop[0]:
            break
        slot, kept = asked.slots[at], prices[asked.boxes[at]]
        look_from(clouds, known.poses[slot], view)
        value, is_final = priced_value(view, farthest, asked.goals[at], kept, room)
        known.values[slot], known.is_final[slot] = value, is_final


@jit
def corner_pose(lower, upper, corner, theta):
    """The pose of a corner, in the order of `look_at_corners`."""
    turn = corner >> 3
    for axis in range(4):
        theta[axis] = lower[axis]
        if upper[axis] > lower[axis]:
            if turn & 1:
                theta[axis] = upper[axis]
            turn >>= 1
    for axis in range(3):
        theta[4 + axis] = lower[4 + axis] if (corner >> axis) & 1 else upper[4 + axis]


@jit
def _hash(values):
    """Of numbers, by their bits: boxes made by bisection have a corner in common to the last of them."""
    h = np.uint64(0x9E3779B97F4A7C15)
    for bits in values.view(np.uint64):
        h = (h ^ bits) * np.uint64(0xBF58476D1CE4E5B9)
        h ^= h >> np.uint64(29)
    return h


@jit
def _joined(turn, shift):
    h = (turn ^ (shift >> np.uint64(23)) ^ (shift << np.uint64(41))) * np.uint64(0x94D049BB133111EB)
    return h ^ (h >> np.uint64(31))


@jit
def _place(known, theta, at):
    """Where a pose with hash `at` stands in the table, or would stand."""
    table, poses = known.table, known.poses
    mask = np.uint64(table.size - 1)
    while True:
        at &= mask
        slot = table[at]
        if slot < 0:
            return at
        same = True
        for axis in range(7):
            same &= poses[slot, axis] == theta[axis]
        if same:
            return at
        at += np.uint64(1)
