"""Bounds over boxes of rotations, with a nested search for the translation over shrinking cubes.

With the rotation R at the centre of the box, a match (x, y) determines the translation y - R x. Another
rotation of the box moves x by at most the chord of the box's angle times |x|, its *displacement*. In a
cube of translations the residual is therefore at least the distance of y - R x from the cube, minus the
displacement. A cube is divided into eight if its bound may beat the best cube found. Its parts receive
only the matches that agree with it.
"""

from __future__ import annotations

import math

import numpy as np

from dcreg.families.matches.kernels.lists import agreement
from dcreg.families.rotation3d.kernels.geometry import chord_matrix
from dcreg.families.rotation3d.kernels.rotation import box_angle, box_corners
from dcreg.jit import jit

LISTS = 40  # capacity of the lists of waiting cubes, in multiples of the number of matches
CUBES = 400  # maximum number of waiting cubes
FINE = 0.5  # a cube is small enough if half its side is this share of the mean displacement


@jit
def rotation_bounds(matches, lower, upper, enough, bounds, poses):
    """Write upper bounds on the score over B boxes of quaternions, and a promising (3, 4) pose of each.

    A box with a bound below `enough` gets the bound `enough`.
    """
    n = matches.source.shape[0]
    corners = np.empty((16, 4))
    wanted, displacement = np.empty((n, 3)), np.empty(n)
    members = np.empty(LISTS * n, dtype=np.int32)
    cubes = np.empty((CUBES, 8))
    by_row, by_column = np.zeros(matches.n_rows), np.zeros(matches.n_columns)
    for k in range(lower.shape[0]):
        q = 0.5 * (lower[k] + upper[k])
        angle = box_angle(q, corners[: box_corners(lower[k], upper[k], corners)])
        chord = 2.0 * math.sin(0.5 * angle)
        R = chord_matrix(q, q)
        total = 0.0
        for j in range(n):
            x = matches.source[j]
            displacement[j] = chord * math.sqrt(x[0] ** 2 + x[1] ** 2 + x[2] ** 2)
            total += displacement[j]
            for a in range(3):
                wanted[j, a] = matches.target[j, a] - (
                    R[a, 0] * x[0] + R[a, 1] * x[1] + R[a, 2] * x[2]
                )
        for a in range(3):
            for b in range(3):
                poses[k, a, b] = R[a, b]
        fine = FINE * max(total / n, 0.01 * matches.reach)
        bounds[k] = _best_cube(
            matches, (wanted, displacement), fine, enough, (members, cubes, by_row, by_column),
            poses[k],
        )  # fmt: skip


@jit
def _best_cube(matches, demands, fine, enough, space, pose):
    """Return the maximum bound of cubes with half-side at most `fine`; write its centre to `pose`."""
    wanted, _ = demands
    members, cubes, _, _ = space
    n = wanted.shape[0]
    half = 0.0
    for a in range(3):
        low, high = wanted[:, a].min(), wanted[:, a].max()
        cubes[0, a] = 0.5 * (low + high)
        half = max(half, 0.5 * (high - low))
        pose[a, 3] = cubes[0, a]
    for j in range(n):
        members[j] = j
    # centre, half of the side, place of its list among `members`, bound, end of all lists until then
    cubes[0, 3], cubes[0, 4], cubes[0, 5], cubes[0, 6], cubes[0, 7] = half, 0, n, np.inf, n
    waiting, best = 1, enough
    while waiting > 0:
        waiting -= 1
        bound = cubes[waiting, 6]
        if bound <= best:
            continue
        size, end = cubes[waiting, 5] - cubes[waiting, 4], cubes[waiting, 7]
        is_full = end + 8 * size > members.size or waiting + 8 > cubes.shape[0]
        if cubes[waiting, 3] <= fine or (is_full and bound < np.inf):
            best = bound
            for a in range(3):
                pose[a, 3] = cubes[waiting, a]
            continue
        waiting = _divide(matches, demands, waiting, best, space)
    return best


@jit
def _divide(matches, demands, at, best, space):
    """Replace the waiting cube `at` by its parts with bounds above `best`, the maximum last."""
    wanted, displacement = demands
    members, cubes, by_row, by_column = space
    centre = cubes[at, :3].copy()
    half = 0.5 * cubes[at, 3]
    first, end = int(cubes[at, 4]), int(cubes[at, 5])
    waiting, place = at, int(cubes[at, 7])
    for part in range(8):
        x = centre[0] + (half if part & 1 else -half)
        y = centre[1] + (half if part & 2 else -half)
        z = centre[2] + (half if part & 4 else -half)
        start, of_rows, of_columns = place, 0.0, 0.0
        for u in range(first, end):
            j = members[u]
            a = max(abs(wanted[j, 0] - x) - half, 0.0)
            b = max(abs(wanted[j, 1] - y) - half, 0.0)
            c = max(abs(wanted[j, 2] - z) - half, 0.0)
            distance = a * a + b * b + c * c
            limit = matches.reach + displacement[j]
            if distance >= limit * limit:
                continue
            members[place] = j
            place += 1
            gain = agreement(max(math.sqrt(distance) - displacement[j], 0.0), matches.reach)
            row, column = matches.rows[j], matches.columns[j]
            if gain > by_row[row]:
                of_rows += gain - by_row[row]
                by_row[row] = gain
            if gain > by_column[column]:
                of_columns += gain - by_column[column]
                by_column[column] = gain
        for u in range(start, place):
            by_row[matches.rows[members[u]]] = 0.0
            by_column[matches.columns[members[u]]] = 0.0
        bound = min(of_rows, of_columns)
        if bound <= best:
            place = start
            continue
        slot = waiting
        while slot > at and cubes[slot - 1, 6] > bound:
            for entry in range(8):
                cubes[slot, entry] = cubes[slot - 1, entry]
            slot -= 1
        cubes[slot, 0], cubes[slot, 1], cubes[slot, 2], cubes[slot, 3] = x, y, z, half
        cubes[slot, 4], cubes[slot, 5], cubes[slot, 6] = start, place, bound
        waiting += 1
    for slot in range(at, waiting):
        cubes[slot, 7] = place
    return waiting
