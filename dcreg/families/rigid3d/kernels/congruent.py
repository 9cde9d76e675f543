"""Poses from congruent triples: initial poses of a rigid search if many points have no partner.

A rigid motion preserves distances. For three source points, all target triples with the same three
distances, up to a tolerance, are tried. Each pair of triples determines a pose. Its score is the number
of source points near the target. Point sets are stored by row, (n, 3) and (m, 3).
"""

from __future__ import annotations

import math

import numpy as np

from dcreg.assignment.kernels.selection import cleared, place_of_least
from dcreg.families.kernels import overlap
from dcreg.jit import jit, jit_inner, jit_part

# Scores of all triples so far that a later one must exceed. The best distinct poses are nearly always
# among so many, unless most triples have found the same pose.
N_BEST = 60


@jit_inner
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
def place(F, G, scale, centroid, middle, R, t):
    """Fill the pose that moves a triangle's frame F and centroid to the frame G and to `middle`.

    R is `scale` times a rotation.
    """
    for a in range(3):
        t[a] = middle[a]
        for b in range(3):
            R[a, b] = scale * (G[a, 0] * F[b, 0] + G[a, 1] * F[b, 1] + G[a, 2] * F[b, 2])
            t[a] -= R[a, b] * centroid[b]


@jit_inner
def direction(p, q, out):
    """Fill the first column of the frame of a triangle that begins with p and q; False: p = q."""
    length = 0.0
    for a in range(3):
        out[a, 0] = q[a] - p[a]
        length += out[a, 0] * out[a, 0]
    length = math.sqrt(length)
    if length < 1e-12:
        return False
    for a in range(3):
        out[a, 0] /= length
    return True


@jit_inner
def complete(p, r, out):
    """Fill the other columns of the frame of a triangle, as `frame` does; False if degenerate."""
    along = length = 0.0
    for a in range(3):
        out[a, 1] = r[a] - p[a]
        along += out[a, 0] * out[a, 1]
    for a in range(3):
        out[a, 1] -= along * out[a, 0]
        length += out[a, 1] * out[a, 1]
    length = math.sqrt(length)
    if length < 1e-12:
        return False
    for a in range(3):
        out[a, 1] /= length
    out[0, 2] = out[1, 0] * out[2, 1] - out[2, 0] * out[1, 1]
    out[1, 2] = out[2, 0] * out[0, 1] - out[0, 0] * out[2, 1]
    out[2, 2] = out[0, 0] * out[1, 1] - out[1, 0] * out[0, 1]
    return True


@jit_inner
def frame(p, q, r, out):
    """Fill the frame of a triangle, as columns: along p q, in its plane, normal. False if degenerate."""
    return direction(p, q, out) and complete(p, r, out)


@jit_part
def offer(R, t, weight, looked, field, least, scores, poses):
    """Store a pose in place of the worst one if it scores more: its overlap times `weight`.

    Scores up to `least` do not count.
    """
    worst = 0
    for other in range(1, scores.size):
        if scores[other] < scores[worst]:
            worst = other
    floor = max(scores[worst], least) / weight
    score = weight * overlap(R, t, looked, field, floor)
    if score > scores[worst] and score > least:
        scores[worst] = score
        for a in range(3):
            poses[worst, a, 3] = t[a]
            for b in range(3):
                poses[worst, a, b] = R[a, b]


@jit_part
def keep_best(scores, best):
    """Replace the least of the best scores by better ones; return the least."""
    for score in scores:
        at = place_of_least(best)
        if score > best[at]:
            best[at] = score
    return best[place_of_least(best)]


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
    centroid, middle, best = np.empty(3), np.empty(3), cleared(np.empty(N_BEST))
    tried, least = 0, 0.0
    for at in range(triples.shape[0]):
        u, v, w = triples[at, 0], triples[at, 1], triples[at, 2]
        p, q, r = source[u], source[v], source[w]
        if at > 0:
            least = keep_best(scores[at - 1], best)
        if not frame(p, q, r, F):
            continue
        for a in range(3):
            centroid[a] = (p[a] + q[a] + r[a]) / 3.0
        near_pr, far_pr = sides[at, 0] - tolerance, sides[at, 0] + tolerance
        near_qr, far_qr = sides[at, 1] - tolerance, sides[at, 1] + tolerance
        for pair in range(int(sides[at, 2]), int(sides[at, 3])):
            if stop[0]:
                return tried
            i, j = first[pair], second[pair]
            if feasible.size > 0 and not (feasible[u, i] and feasible[v, j]):
                continue
            if not direction(target[i], target[j], G):
                continue
            for rank in range(first_at_least(ascending[i], near_pr), target.shape[0]):
                if ascending[i, rank] > far_pr:
                    break
                k = order[i, rank]
                if not near_qr <= distances[j, k] <= far_qr or k in (i, j):
                    continue
                if feasible.size > 0 and not feasible[w, k]:
                    continue
                if not complete(target[i], target[k], G):
                    continue
                tried += 1
                for a in range(3):
                    middle[a] = (target[i, a] + target[j, a] + target[k, a]) / 3.0
                place(F, G, 1.0, centroid, middle, R, t)
                offer(R, t, 1.0, looked, field, least, scores[at], poses[at])
    return tried
