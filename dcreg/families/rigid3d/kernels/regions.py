"""Groups of source points whose triples determine poses well, and boxes that meet regions of poses.

`dcreg.families.rigid3d.cover` uses both.
"""

from __future__ import annotations

import math

import numpy as np

from dcreg.families.rotation3d.kernels.geometry import chord_matrix
from dcreg.jit import jit, jit_inner

_THINNEST = 0.01  # moment added to that of a triple, so that one thin triple does not decide alone


@jit
def _badness(squares, group):
    """Return the sum of the inverse smaller second moments of all triples of a group."""
    found = 0.0
    for a in range(group.size):
        for b in range(a):
            for c in range(b):
                i, j, k = group[a], group[b], group[c]
                if min(i, j, k) < 0:
                    continue
                p, q, r = squares[i, j], squares[i, k], squares[j, k]
                trace = (p + q + r) / 3.0
                # the product of the moments is a twelfth of Heron's 16 area^2
                product = (2.0 * (p * q + q * r + p * r) - p * p - q * q - r * r) / 12.0
                root = math.sqrt(max(0.0, trace * trace - 4.0 * product))
                found += 1.0 / (0.5 * (trace - root) + _THINNEST)
    return found


@jit
def improve_groups(squares, groups, swaps):
    """Swap points of two groups where their triples become fatter.

    Parameters
    ----------
    squares : (n, n) array
        Squared distances of the points.
    groups : (g, s) int array
        Numbers of the points, -1 where a group is smaller. Improved in place.
    swaps : (S, 4) int array
        Swaps to try: group, place, group, place.
    """
    badness = np.empty(groups.shape[0])
    for a in range(badness.size):
        badness[a] = _badness(squares, groups[a])
    for at in range(swaps.shape[0]):
        a, i, b, j = swaps[at, 0], swaps[at, 1], swaps[at, 2], swaps[at, 3]
        if a == b:
            continue
        groups[a, i], groups[b, j] = groups[b, j], groups[a, i]
        one, other = _badness(squares, groups[a]), _badness(squares, groups[b])
        if one + other < badness[a] + badness[b]:
            badness[a], badness[b] = one, other
        else:
            groups[a, i], groups[b, j] = groups[b, j], groups[a, i]


@jit_inner
def product(a, b, out):
    """Fill the quaternion product a b."""
    out[0] = a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3]
    out[1] = a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2]
    out[2] = a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1]
    out[3] = a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0]


@jit_inner
def box_chord(centre, lower, upper):
    """Return the maximum distance of the unit quaternions of a box from that of its centre.

    Fills `centre`. The distance to a fixed unit quaternion is largest at a vertex, because the box is
    within a half-space of quaternions with positive products.
    """
    norm = 0.0
    for c in range(4):
        centre[c] = 0.5 * (lower[c] + upper[c])
        norm += centre[c] * centre[c]
    for c in range(4):
        centre[c] /= math.sqrt(norm)
    worst = 1.0
    for vertex in range(16):
        dot = square = 0.0
        for c in range(4):
            value = upper[c] if (vertex >> c) & 1 else lower[c]
            dot += value * centre[c]
            square += value * value
        worst = min(worst, dot / math.sqrt(square))
    return math.sqrt(max(0.0, 2.0 - 2.0 * worst))


@jit
def meeting_regions(lower, upper, starts, ids, frames, regions, out):
    """Find the regions that may meet each box, among those that meet its parent.

    Parameters
    ----------
    lower, upper : (B, 7) arrays
        Halves of B / 2 parents; the halves of a box are adjacent.
    starts : (B / 2 + 1,) int array
        Where the regions of each parent begin in `ids`.
    ids : (N,) int32 array
    frames : (T, 7) array
        The unit quaternions from the principal frames of the source triples, and their centroids.
    regions : Regions
    out : (2 N,) int32 array
        Receives the regions of the boxes, one box after the other.

    Returns
    -------
    (B + 1,) int array
        Where the regions of each box begin in `out`.
    """
    found = np.zeros(lower.shape[0] + 1, np.int64)
    centre, rotated, inverse, relative = np.empty(4), np.empty(4), np.empty(4), np.empty(4)
    count = 0
    for box in range(lower.shape[0]):
        chord = box_chord(centre, lower[box], upper[box])
        R = chord_matrix(centre, centre)
        for place in range(starts[box // 2], starts[box // 2 + 1]):
            at = ids[place]
            frame = frames[regions.triple[at]]
            meets = True
            reach = 0.0
            for c in range(3):
                reach += frame[4 + c] ** 2
            reach = 2.0 * chord * math.sqrt(reach) + regions.shift_radius[at]
            for c in range(3):
                moved = (
                    R[c, 0] * frame[4]
                    + R[c, 1] * frame[5]
                    + R[c, 2] * frame[6]
                    + 0.5 * (lower[box, 4 + c] + upper[box, 4 + c])
                )
                half = 0.5 * (upper[box, 4 + c] - lower[box, 4 + c])
                if abs(moved - regions.centroid[at, c]) > reach + half:
                    meets = False
                    break
            if not meets:
                continue
            product(centre, frame[:4], rotated)
            inverse[0] = regions.rotation[at, 0]
            for c in range(1, 4):
                inverse[c] = -regions.rotation[at, c]
            product(inverse, rotated, relative)
            for c in range(3):
                meets &= 2.0 * abs(relative[1 + c]) <= regions.rotation_radii[at, c] + 2.0 * chord
            if meets:
                out[count] = at
                count += 1
        found[box + 1] = count
    return found
