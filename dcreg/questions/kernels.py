"""Upper bounds on the number of one-to-one pairs within a distance, over boxes of poses.

At a pose of a box, a moved source point lies in a set around its place at the centre of the box. A pair
is possible if this set comes within the distance of the target point. No pose of the box has more pairs
than the largest matching of possible pairs.
"""

from __future__ import annotations

import math

import numpy as np

from dcreg.families.rigid3d.kernels.poses import relative_vertices
from dcreg.families.rotation3d.kernels.geometry import chord_matrix
from dcreg.jit import jit, jit_inner


@jit
def rigid_counts(lower, upper, clouds, reach, goal, counts):
    """Write bounds for B boxes of quaternions and translations; a bound of at most `goal` is rounded up.

    A box stops as soon as its bound is at most `goal`.
    """
    n, m = clouds.source.shape[1], clouds.target.shape[1]
    moved, extents, balls = np.empty((n, 3)), np.empty((n, 3)), np.empty(n)
    half, buffer, centre = np.empty(3), np.empty((8, 3)), np.empty(7)
    sets, work = (moved, extents, balls), _allocate(n, m)
    order = np.argsort(clouds.target[0])
    for k in range(lower.shape[0]):
        for c in range(7):
            centre[c] = 0.5 * (lower[k, c] + upper[k, c])
        for c in range(3):
            half[c] = 0.5 * (upper[k, 4 + c] - lower[k, 4 + c])
        _rigid_sets(lower[k], upper[k], centre, half, clouds.source, buffer, sets)
        counts[k] = _largest(sets, half, clouds, order, reach, goal, work)


@jit
def similar_counts(lower, upper, clouds, reach, goal, counts):
    """As `rigid_counts`, for boxes of similarities in 2D."""
    n, m = clouds.source.shape[1], clouds.target.shape[1]
    moved, extents, balls = np.empty((n, 2)), np.empty((n, 2)), np.full(n, np.inf)
    half = np.zeros(2)
    sets, work = (moved, extents, balls), _allocate(n, m)
    order = np.argsort(clouds.target[0])
    for k in range(lower.shape[0]):
        a, b = 0.5 * (lower[k, 0] + upper[k, 0]), 0.5 * (lower[k, 1] + upper[k, 1])
        s, t = 0.5 * (lower[k, 2] + upper[k, 2]), 0.5 * (lower[k, 3] + upper[k, 3])
        ha, hb = upper[k, 0] - a, upper[k, 1] - b
        hs, ht = upper[k, 2] - s, upper[k, 3] - t
        for i in range(n):
            x, y = clouds.source[0, i], clouds.source[1, i]
            moved[i, 0], moved[i, 1] = a * x - b * y + s, b * x + a * y + t
            extents[i, 0] = ha * abs(x) + hb * abs(y) + hs
            extents[i, 1] = hb * abs(x) + ha * abs(y) + ht
        counts[k] = _largest(sets, half, clouds, order, reach, goal, work)


@jit_inner
def _allocate(n, m):
    """Allocate the possible pairs (lists of rows), the matching, marks and a queue of paths."""
    return (
        np.empty((n, m), np.int32), np.empty(n, np.int32), np.empty(n, np.int32),
        np.empty(m, np.int32), np.empty(m, np.int32), np.empty(n, np.int32), np.empty(m, np.int32),
    )  # fmt: skip


@jit_inner
def _rigid_sets(lower, upper, centre, half, source, buffer, sets):
    """Write the sets of moved points: boxes of half-width `extents`, and balls without translations."""
    moved, extents, balls = sets
    R = chord_matrix(centre, centre)
    count = relative_vertices(centre, lower, upper, buffer)
    gibbs = np.inf if count == 0 else 0.0
    for a in range(count):
        gibbs = max(gibbs, buffer[a, 0] ** 2 + buffer[a, 1] ** 2 + buffer[a, 2] ** 2)
    # a rotation by the angle w moves x by at most 2 sin(w / 2) |x|, and sin(w / 2)^2 = g / (1 + g)
    chord = 2.0 if count == 0 else 2.0 * math.sqrt(gibbs / (1.0 + gibbs))
    for i in range(source.shape[1]):
        u, v, w = source[0, i], source[1, i], source[2, i]
        length = math.sqrt(u * u + v * v + w * w)
        x = R[0, 0] * u + R[0, 1] * v + R[0, 2] * w
        y = R[1, 0] * u + R[1, 1] * v + R[1, 2] * w
        z = R[2, 0] * u + R[2, 1] * v + R[2, 2] * w
        moved[i, 0], moved[i, 1], moved[i, 2] = x + centre[4], y + centre[5], z + centre[6]
        balls[i] = chord * length
        p = q = r = 0.0
        for a in range(count):
            p = max(p, abs(buffer[a, 1] * z - buffer[a, 2] * y))
            q = max(q, abs(buffer[a, 2] * x - buffer[a, 0] * z))
            r = max(r, abs(buffer[a, 0] * y - buffer[a, 1] * x))
        # |R x - x - 2 r x x| <= 2 |r|^2 |x|
        bend = balls[i] if count == 0 else 2.0 * gibbs * length
        extents[i, 0] = min(2.0 * p + bend, balls[i]) + half[0]
        extents[i, 1] = min(2.0 * q + bend, balls[i]) + half[1]
        extents[i, 2] = min(2.0 * r + bend, balls[i]) + half[2]


@jit_inner
def _largest(sets, half, clouds, order, reach, goal, work):
    """Return the size of the largest matching of possible pairs, or `goal` if it is at most that.

    `order` sorts the targets along the first axis.
    """
    moved, extents, balls = sets
    lists, lengths, col_of, row_of, seen, queue, parent = work
    n, m, d = clouds.source.shape[1], clouds.target.shape[1], clouds.source.shape[0]
    target, penalty = clouds.target, clouds.infeasibility_penalty
    rows = columns = 0
    for j in range(m):
        row_of[j] = seen[j] = -1
    for i in range(n):
        length, far = 0, (reach + balls[i]) ** 2
        low, high = moved[i, 0] - extents[i, 0] - reach, moved[i, 0] + extents[i, 0] + reach
        for u in range(_first(target[0], order, low), m):
            j = order[u]
            if target[0, j] > high:
                break
            square = ball = 0.0
            for c in range(d):
                off = abs(target[c, j] - moved[i, c])
                gap, from_ball = max(off - extents[i, c], 0.0), max(off - half[c], 0.0)
                square += gap * gap
                ball += from_ball * from_ball
            if square > reach * reach or ball > far:
                continue
            if penalty.size > 0 and penalty[i, j] > 0.0:
                continue
            lists[i, length] = j
            length += 1
            if seen[j] < 0:
                seen[j] = 0
                columns += 1
        lengths[i], col_of[i] = length, -1
        rows += length > 0
    if min(rows, columns) <= goal:
        return goal
    # match greedily, then by alternating paths; a row that fails once fails always
    for i in range(n):
        for u in range(lengths[i]):
            j = lists[i, u]
            if row_of[j] < 0:
                row_of[j], col_of[i] = i, j
                break
    for j in range(m):
        seen[j] = -1
    most = rows
    for i in range(n):
        if col_of[i] < 0 and lengths[i] > 0:
            most -= not _augment(i, lists, lengths, col_of, row_of, seen, queue, parent)
            if most <= goal:
                return goal
    return most


@jit_inner
def _first(values, order, low):
    """Return the first place in the order from which values are at least `low`."""
    first, last = 0, order.size
    while first < last:
        middle = (first + last) // 2
        if values[order[middle]] < low:
            first = middle + 1
        else:
            last = middle
    return first


@jit_inner
def _augment(first, lists, lengths, col_of, row_of, seen, queue, parent):
    """Match the row `first` by a shortest alternating path; tell whether there is one."""
    head, tail = 0, 1
    queue[0] = first
    while head < tail:
        i = queue[head]
        head += 1
        for u in range(lengths[i]):
            j = lists[i, u]
            if seen[j] == first:
                continue
            seen[j], parent[j] = first, i
            if row_of[j] < 0:
                while True:
                    i = parent[j]
                    row_of[j] = i
                    j, col_of[i] = col_of[i], j
                    if i == first:
                        return True
            queue[tail] = row_of[j]
            tail += 1
    return False
