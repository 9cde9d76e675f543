"""Values at the vertices of boxes of poses: each is computed once for all boxes with the vertex.

`dcreg.families.rigid3d.bound` explains how they prune a box.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dcreg.assignment.kernels.selection import place_of_least
from dcreg.families.rigid3d.kernels.dual_bounds import dual_bound_at_pose
from dcreg.families.rigid3d.kernels.poses import empty_view, look_from
from dcreg.families.rigid3d.kernels.stationary import needed, proven
from dcreg.families.rotation3d.kernels.geometry import extent
from dcreg.jit import jit, jit_inner, jit_part

VERTICES = 64  # vertices of a box: rotations times shifts
# States of a box: vertex values may prune it; it remains open; vertex values have pruned it.
VALUES_NEEDED, OPEN, PRUNED = 0, 1, 2


class VertexTable(NamedTuple):
    """The vertices seen so far, by slot, and a hash table to find them.

    Attributes
    ----------
    table : (T,) int32 array
        Slots by hash, -1 where empty; T is a power of two.
    poses : (S, 7) array
    values : (S,) array
        Lower bounds on the minimum sum of costs; -inf if not yet computed.
    is_final : (S,) bool array
        Whether the value is being computed, or another request cannot improve it.
    """

    table: np.ndarray
    poses: np.ndarray
    values: np.ndarray
    is_final: np.ndarray


class VertexRequests(NamedTuple):
    """Requested vertices: their slots, the boxes that need them, and the values needed, (64 B,)
    arrays."""

    slots: np.ndarray
    boxes: np.ndarray
    goals: np.ndarray


class BoxStates(NamedTuple):
    """Vertex values and states of B boxes.

    Attributes
    ----------
    costs : (B, 64) array
        C of `dcreg.families.rigid3d.kernels.stationary.Loss` at the vertices of the boxes, from below.
    losses : (B, 2) array
        The `Loss` of the mean of C and the value at a vertex.
    slots : (B, 64) int32 array
        Slots of known vertices; -1 elsewhere.
    undecided : (B,) uint64 array
        A bit for each vertex whose value is needed.
    states : (B,) int8 array
        VALUES_NEEDED, OPEN or PRUNED.
    """

    costs: np.ndarray
    losses: np.ndarray
    slots: np.ndarray
    undecided: np.ndarray
    states: np.ndarray


def allocate_states(count: int) -> BoxStates:
    """Allocate the states of `count` open boxes."""
    return BoxStates(
        np.empty((count, VERTICES)), np.empty((count, 2)),
        np.full((count, VERTICES), -1, np.int32), np.zeros(count, np.uint64),
        np.full(count, OPEN, np.int8),
    )  # fmt: skip


@jit
def judge_boxes(known, lower, upper, boxes, cutoff):
    """Decide boxes by the known values: update their states, and which vertices are undecided."""
    theta = np.empty(7)
    for box in range(lower.shape[0]):
        if boxes.states[box] == VALUES_NEEDED:
            boxes.states[box] = _judged(known, lower[box], upper[box], boxes, box, cutoff, theta)


@jit
def request_values(known, used, lower, upper, boxes, cutoff, most, requests):
    """Request further vertex values for the boxes that the known values do not decide.

    Parameters
    ----------
    known : VertexTable
    used : int
        Slots taken.
    lower, upper : (B, 7) arrays
    boxes : BoxStates
    cutoff : float
        Boxes with at least this bound are pruned.
    most : int
        Maximum number of vertices requested per box, smallest C first.
    requests : VertexRequests

    Returns
    -------
    used, count : int
        Slots taken now, and the number of requests.
    """
    left, theta, count = np.empty(VERTICES), np.empty(7), 0
    for box in range(lower.shape[0]):
        if boxes.states[box] != VALUES_NEEDED:
            continue
        alone, together = _goals(boxes, box, cutoff)
        for vertex in range(VERTICES):
            is_open = (boxes.undecided[box] >> np.uint64(vertex)) & np.uint64(1)
            left[vertex] = boxes.costs[box, vertex] if is_open else np.inf
        limit = count + most
        while count < limit:
            at = place_of_least(left)
            cost, slot = left[at], boxes.slots[box, at]
            if cost >= alone:
                break
            left[at] = np.inf
            if slot < 0:
                vertex_pose(lower[box], upper[box], at, theta)
                slot = boxes.slots[box, at] = _slot_of(known, used, theta)
                used = max(used, slot + 1)
            goal = 2.0 * together - cost
            if _may_improve(known, slot, goal):
                known.is_final[slot] = True
                requests.slots[count], requests.boxes[count] = slot, box
                requests.goals[count] = goal
                count += 1
    return used, count


@jit_part
def _slot_of(known, used, theta):
    """Return the slot of a vertex; the first free slot if it has none."""
    rotation, shift = _hashes(theta)
    place = _place(known, theta, _joined(rotation, shift))
    slot = known.table[place]
    if slot < 0:
        slot = np.int32(used)
        known.table[place] = slot
        for axis in range(7):
            known.poses[slot, axis] = theta[axis]
        known.values[slot] = -np.inf
        known.is_final[slot] = False
    return slot


@jit
def _goals(boxes, box, cutoff):
    """Return the sufficient C at a vertex without a known value, and the sufficient mean with one."""
    root, rest = boxes.losses[box, 0], boxes.losses[box, 1]
    return needed(2.0 * root, 2.0 * rest, cutoff), needed(root, rest, cutoff)


@jit
def _may_improve(known, slot, goal):
    """Whether to request the value of a vertex that must reach `goal`."""
    return known.values[slot] < goal and not known.is_final[slot]


@jit
def _judged(known, lower, upper, boxes, box, cutoff, theta):
    """Return the state of a box by the known values; store which vertices are undecided."""
    alone, together = _goals(boxes, box, cutoff)
    rotations, shifts = np.empty(8, np.uint64), np.empty(8, np.uint64)
    for part in range(8):
        vertex_pose(lower, upper, 9 * part, theta)
        rotations[part], shifts[part] = _hashes(theta)
    undecided = np.uint64(0)
    for vertex in range(VERTICES):
        cost, slot = boxes.costs[box, vertex], boxes.slots[box, vertex]
        if cost >= alone:
            continue
        if slot < 0:
            vertex_pose(lower, upper, vertex, theta)
            place = _place(known, theta, _joined(rotations[vertex >> 3], shifts[vertex & 7]))
            slot = boxes.slots[box, vertex] = known.table[place]
        is_open = slot < 0
        if not is_open and known.values[slot] < 2.0 * together - cost:
            is_open = not known.is_final[slot]
            if not is_open and cutoff < np.inf:
                return OPEN
        if is_open:
            undecided |= np.uint64(1) << np.uint64(vertex)
    boxes.undecided[box] = undecided
    return VALUES_NEEDED if undecided else PRUNED


@jit
def bounds_by_vertices(known, boxes, cutoff, bounds):
    """Raise the bounds of the boxes that are pruned."""
    for box in range(bounds.size):
        if boxes.states[box] != PRUNED:
            continue
        root, rest = boxes.losses[box, 0], boxes.losses[box, 1]
        alone, _ = _goals(boxes, box, cutoff)
        single = both = np.inf
        for vertex in range(VERTICES):
            cost = boxes.costs[box, vertex]
            if cost >= alone:
                single = min(single, cost)
            else:
                both = min(both, 0.5 * (cost + known.values[boxes.slots[box, vertex]]))
        bound = np.inf
        if single < np.inf:
            bound = proven(2.0 * root, 2.0 * rest, single)
        if both < np.inf:
            bound = min(bound, proven(root, rest, both))
        bounds[box] = max(bounds[box], bound)


@jit
def bound_vertices_by_duals(known, requests, duals, clouds, work):
    """Compute the requested values from the duals (B, m) of the boxes that need them."""
    view, farthest = empty_view(clouds), extent(clouds.source)[1]
    for at in range(requests.slots.size):
        if clouds.stop[0]:
            break
        slot, kept = requests.slots[at], duals[requests.boxes[at]]
        look_from(clouds, known.poses[slot], view)
        value, is_final = dual_bound_at_pose(view, farthest, requests.goals[at], kept, work)
        known.values[slot], known.is_final[slot] = max(known.values[slot], value), is_final


@jit_inner
def vertex_pose(lower, upper, vertex, theta):
    """Return the pose of a vertex, in the order of `costs_at_vertices`."""
    rotation = vertex >> 3
    for axis in range(4):
        theta[axis] = lower[axis]
        if upper[axis] > lower[axis]:
            if rotation & 1:
                theta[axis] = upper[axis]
            rotation >>= 1
    for axis in range(3):
        theta[4 + axis] = lower[4 + axis] if (vertex >> axis) & 1 else upper[4 + axis]


@jit
def _hashes(theta):
    """Hash rotation and shift by their bits: shared vertices of boxes are equal to the last bit."""
    bits = theta.view(np.uint64)
    rotation = shift = np.uint64(0x9E3779B97F4A7C15)
    for axis in range(7):
        h = ((rotation if axis < 4 else shift) ^ bits[axis]) * np.uint64(0xBF58476D1CE4E5B9)
        h ^= h >> np.uint64(29)
        if axis < 4:
            rotation = h
        else:
            shift = h
    return rotation, shift


@jit_part
def _joined(rotation, shift):
    h = rotation ^ (shift >> np.uint64(23)) ^ (shift << np.uint64(41))
    h *= np.uint64(0x94D049BB133111EB)
    return h ^ (h >> np.uint64(31))


@jit
def _place(known, theta, at):
    """Return the position of a pose with hash `at` in the table, or the free one for it."""
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
