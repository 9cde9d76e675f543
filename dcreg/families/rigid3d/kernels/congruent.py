"""Poses from congruent triples: initial poses of a rigid search if many points have no partner.

A rigid motion preserves distances. For three source points, all target triples with the same three
distances, up to a tolerance, are tried. Each pair of triples determines a pose. Its score is the number
of source points near the target. Point sets are stored by row, (n, 3) and (m, 3).
"""

from __future__ import annotations

import math

import numpy as np

from dcreg.families.kernels import overlap
from dcreg.jit import jit, jit_part


@jit
def frame(p, q, r, out):
    """Fill the frame of a triangle, as columns: along p q, in its plane, normal. False if degenerate."""
    for a in range(3):
        out[a, 0] = q[a] - p[a]
        out[a, 1] = r[a] - p[a]
    length = math.sqrt(out[0, 0] ** 2 + out[1, 0] ** 2 + out[2, 0] ** 2)
    if length < 1e-12:
        return False
    for a in range(3):
        out[a, 0] /= length
    along = out[0, 0] * out[0, 1] + out[1, 0] * out[1, 1] + out[2, 0] * out[2, 1]
    for a in range(3):
        out[a, 1] -= along * out[a, 0]
    length = math.sqrt(out[0, 1] ** 2 + out[1, 1] ** 2 + out[2, 1] ** 2)
    if length < 1e-12:
        return False
    for a in range(3):
        out[a, 1] /= length
    out[0, 2] = out[1, 0] * out[2, 1] - out[2, 0] * out[1, 1]
    out[1, 2] = out[2, 0] * out[0, 1] - out[0, 0] * out[2, 1]
    out[2, 2] = out[0, 0] * out[1, 1] - out[1, 0] * out[0, 1]
    return True


@jit
def first_at_least(values, least):
    """Return the index of the first of ascending values that is at least `least`."""
    low, high = 0, values.size
    while low < high:
        middle = (low + high) // 2
        if values[middle] < least:
            low = middle + 1
        else:
            high = middle
    return low


@jit_part
def align(F, G, scale, p, q, r, R, t):
    """Fill R with `scale` times the rotation from frame F to G; t is the centroid of the target triple.

    Afterwards x -> R x + t moves the centroid of p, q and r there.
    """
    for a in range(3):
        for b in range(3):
            R[a, b] = scale * (G[a, 0] * F[b, 0] + G[a, 1] * F[b, 1] + G[a, 2] * F[b, 2])
            t[a] -= R[a, b] * (p[b] + q[b] + r[b]) / 3.0


@jit_part
def offer(R, t, weight, looked, field, scores, poses):
    """Store a pose in place of the worst one if it scores more: its overlap times `weight`."""
    worst = 0
    for other in range(1, scores.size):
        if scores[other] < scores[worst]:
            worst = other
    floor = scores[worst] / weight
    score = weight * overlap(R, t, looked, field, floor)
    if score > scores[worst]:
        scores[worst] = score
        for a in range(3):
            poses[worst, a, 3] = t[a]
            for b in range(3):
                poses[worst, a, b] = R[a, b]


@jit
def triple_poses(triples, sides, clouds, feasible, pairs, search, poses, scores):
    """Find the best poses of each source triple; return the number of target triples tried.

    Parameters
    ----------
    triples : (T, 3) int array
    sides : (T, 4) array
        Distances of the first to the third point and of the second to the third; then the range of the
        target pairs as long as the distance of the first two points.
    clouds : (source, target), (n, 3) and (m, 3) arrays
    feasible : (n, m) or (0, 0) bool array
        Feasible pairs; empty: all.
    pairs : (first, second, distances, order, ascending)
        The ordered pairs of target points by length. Then the (m, m) distances of target points, and for
        every point the others by distance, and these distances.
    search : (tolerance, looked, field, stop)
        Tolerance of a distance, the source points used for the score, the `NearnessField` of the
        target, and the stop flag.
    poses, scores : (T, K, 3, 4), (T, K) arrays
        Receive the best poses of each triple; scores are initially zero.

    Returns
    -------
    int
        Target triples tried.
    """
    source, target = clouds
    first, second, distances, order, ascending = pairs
    tolerance, looked, field, stop = search
    F, G, R, t = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    tried = 0
    for at in range(triples.shape[0]):
        u, v, w = triples[at, 0], triples[at, 1], triples[at, 2]
        p, q, r = source[u], source[v], source[w]
        if not frame(p, q, r, F):
            continue
        near_pr, far_pr = sides[at, 0] - tolerance, sides[at, 0] + tolerance
        near_qr, far_qr = sides[at, 1] - tolerance, sides[at, 1] + tolerance
        for pair in range(int(sides[at, 2]), int(sides[at, 3])):
            if stop[0]:
                return tried
            i, j = first[pair], second[pair]
            if feasible.size > 0 and not (feasible[u, i] and feasible[v, j]):
                continue
            for place in range(first_at_least(ascending[i], near_pr), target.shape[0]):
                if ascending[i, place] > far_pr:
                    break
                k = order[i, place]
                if not near_qr <= distances[j, k] <= far_qr or k in (i, j):
                    continue
                if feasible.size > 0 and not feasible[w, k]:
                    continue
                if not frame(target[i], target[j], target[k], G):
                    continue
                tried += 1
                for a in range(3):
                    t[a] = (target[i, a] + target[j, a] + target[k, a]) / 3.0
                align(F, G, 1.0, p, q, r, R, t)
                offer(R, t, 1.0, looked, field, scores[at], poses[at])
    return tried
