"""Congruent triples that cover the poses with a small objective.

`dcreg.families.rigid3d.cover` proves the statements. Point sets are stored by row, (n, 3) and (m, 3). A
source triple is seen in its principal frame: its centroid is the origin, and its plane is spanned by its
principal axes u1 and u2. Its second moments along them are l1 >= l2.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dcreg.families.rigid3d.kernels.congruent import first_at_least, frame
from dcreg.families.rigid3d.kernels.exclusion import (
    Ellipsoid,
    allocate_rows,
    fill_displacements,
    fill_distances,
    jointly_excluded,
    rows_exclude,
)
from dcreg.jit import jit, jit_inner, jit_part

_THIN = 1e-3  # moment, or share of a moment, below which a triple excludes nothing
_MAX_CHORD = 2.0  # |w| = 2 sin(angle / 2) of a half-turn, the maximum of any rotation
_TINY = 1e-12  # minimum moment that is divided by
_ROUNDING = 1e-13  # of a sum of squares, relative
_WIDE = 1.2  # |w| about u1 from which a region is divided into quarters
_QUARTER = 3.0**0.5 * 2.0 * math.sin(math.pi / 8.0)  # |w| of an eighth of a turn, times sqrt(3)


class Thresholds(NamedTuple):
    """What is excluded.

    Attributes
    ----------
    triple : float
        Sum of squared residuals of a triple, up to which it is congruent.
    cutoff : float
        Poses with a smaller objective must not be excluded.
    k : int
    inertia : float
        The maximum sum of squared norms of k source points.
    """

    triple: float
    cutoff: float
    k: int
    inertia: float


class Regions(NamedTuple):
    """Regions of poses near the best pose of a pair of triples.

    A pose of the region moves the centroid of the source triple to within `shift_radius` of `centroid`.
    Relative to `rotation`, its rotation has the vector w = 2 sin(angle / 2) axis, seen in the principal
    frame, with components up to `rotation_radii`. Lengths are in RMS radii of the target.

    Attributes
    ----------
    triple : (B,) int32 array
        Of the source.
    rotation : (B, 4) array
        Unit quaternion from the principal frame to the target.
    centroid : (B, 3) array
    shift_radius : (B,) array
        A length.
    rotation_radii : (B, 3) array
        Without unit, at most 2: |w| of a half-turn.
    """

    triple: np.ndarray
    rotation: np.ndarray
    centroid: np.ndarray
    shift_radius: np.ndarray
    rotation_radii: np.ndarray


def allocate_regions(room: int) -> Regions:
    """Allocate `room` regions."""
    return Regions(
        np.empty(room, np.int32), np.empty((room, 4)), np.empty((room, 3)), np.empty(room),
        np.empty((room, 3)),
    )  # fmt: skip


@jit_part
def _in_plane(vertex, p, q, r, axes):
    """Return the coordinates of a vertex of a triple along the first two axes, from the centroid."""
    point = p if vertex == 0 else (q if vertex == 1 else r)
    u = v = 0.0
    for c in range(3):
        z = point[c] - (p[c] + q[c] + r[c]) / 3.0
        u += z * axes[c, 0]
        v += z * axes[c, 1]
    return u, v


@jit_part
def principal_frame(p, q, r, axes, local):
    """Fill the axes of a triple, as columns, and its coordinates (3, 2); return l1 and l2.

    l2 is 0 if the triple is degenerate.
    """
    if not frame(p, q, r, axes):
        for a in range(3):  # any frame serves, because nothing is excluded
            local[a, 0] = local[a, 1] = 0.0
            for b in range(3):
                axes[a, b] = 1.0 if a == b else 0.0
        return 0.0, 0.0
    s11 = s22 = s12 = 0.0
    for a in range(3):
        u, v = _in_plane(a, p, q, r, axes)
        local[a, 0], local[a, 1] = u, v
        s11, s22, s12 = s11 + u * u, s22 + v * v, s12 + u * v
    angle = 0.5 * math.atan2(2.0 * s12, s11 - s22)
    co, si = math.cos(angle), math.sin(angle)
    for a in range(3):
        u, v = local[a, 0], local[a, 1]
        local[a, 0], local[a, 1] = co * u + si * v, co * v - si * u
        u, v = axes[a, 0], axes[a, 1]
        axes[a, 0], axes[a, 1] = co * u + si * v, co * v - si * u
    l1 = s11 * co * co + 2.0 * s12 * co * si + s22 * si * si
    return l1, s11 + s22 - l1


@jit_inner
def quaternion(B, out):
    """Fill the unit quaternion of the rotation matrix B, by its largest component."""
    trace = B[0, 0] + B[1, 1] + B[2, 2]
    most, at = trace, 3
    for a in range(3):
        if B[a, a] > most:
            most, at = B[a, a], a
    root = math.sqrt(1.0 + 2.0 * most - trace)
    if at == 3:
        root = math.sqrt(1.0 + trace)
        out[0] = 0.5 * root
        for a in range(3):
            b, c = (a + 1) % 3, (a + 2) % 3
            out[1 + a] = 0.5 * (B[c, b] - B[b, c]) / root
        return
    b, c = (at + 1) % 3, (at + 2) % 3
    out[0] = 0.5 * (B[c, b] - B[b, c]) / root
    out[1 + at] = 0.5 * root
    out[1 + b] = 0.5 * (B[b, at] + B[at, b]) / root
    out[1 + c] = 0.5 * (B[c, at] + B[at, c]) / root


@jit_part
def _superpose(local, p, q, r, G, B):
    """Fit the triple to the target triple (p, q, r) with the frame G.

    Fills B, the rotation from the principal frame to the target, and returns the symmetric factor S of
    the fit as (S11, S22, S12), and the second moments of the target triple.
    """
    h11 = h12 = h21 = h22 = moments = 0.0
    for a in range(3):
        u, v = _in_plane(a, p, q, r, G)
        moments += u * u + v * v
        h11, h12 = h11 + local[a, 0] * u, h12 + local[a, 0] * v
        h21, h22 = h21 + local[a, 1] * u, h22 + local[a, 1] * v
    flip = 1.0
    if h11 * h22 < h12 * h21:  # the plane is turned over
        flip, h12, h22 = -1.0, -h12, -h22
    along, across = h11 + h22, h12 - h21
    root = math.sqrt(along * along + across * across)
    co, si = (along / root, across / root) if root > 0.0 else (1.0, 0.0)
    for c in range(3):
        B[c, 0] = co * G[c, 0] + si * flip * G[c, 1]
        B[c, 1] = co * flip * G[c, 1] - si * G[c, 0]
        B[c, 2] = flip * G[c, 2]
    return h11 * co + h12 * si, h22 * co - h21 * si, h12 * co - h11 * si, moments


@jit_inner
def store_region(regions, count, triple, B, centroid, shift_square, rotation_radii):
    """Store a region if there is room; return the number of regions."""
    if count < regions.triple.size:
        regions.triple[count] = triple
        regions.shift_radius[count] = math.sqrt(shift_square)
        quaternion(B, regions.rotation[count])
        for c in range(3):
            regions.centroid[count, c] = centroid[c]
            regions.rotation_radii[count, c] = min(_MAX_CHORD, rotation_radii[c])
    return count + 1


@jit_inner
def copy_region(regions, at, out, count):
    """Copy a region if there is room; return the number of regions."""
    if count < out.triple.size:
        out.triple[count], out.shift_radius[count] = regions.triple[at], regions.shift_radius[at]
        for c in range(3):
            out.centroid[count, c] = regions.centroid[at, c]
            out.rotation_radii[count, c] = regions.rotation_radii[at, c]
        for c in range(4):
            out.rotation[count, c] = regions.rotation[at, c]
    return count + 1


class Triple(NamedTuple):
    """A source triple in its principal frame.

    Attributes
    ----------
    axes : (3, 3) array
        The principal frame, as columns.
    local : (3, 2) array
        The points of the triple along u1 and u2.
    inverse : (3,) array
        Inverse moments of inertia: 1 / l2, 1 / l1, 1 / (l1 + l2).
    """

    axes: np.ndarray
    local: np.ndarray
    inverse: np.ndarray


@jit
def _begin(source, triple, frame_row, own, rows):
    """Fill the principal frame of a triple and the source in it; return l1 and l2."""
    p, q, r = source[triple[0]], source[triple[1]], source[triple[2]]
    l1, l2 = principal_frame(p, q, r, own.axes, own.local)
    quaternion(own.axes, frame_row[:4])
    own.inverse[0], own.inverse[1] = 1.0 / max(l2, _TINY), 1.0 / max(l1, _TINY)
    own.inverse[2] = 1.0 / max(l1 + l2, _TINY)
    for c in range(3):
        frame_row[4 + c] = (p[c] + q[c] + r[c]) / 3.0
    for i in range(source.shape[0]):
        for c in range(3):
            rows.points[c, i] = 0.0
            for d in range(3):
                rows.points[c, i] += (source[i, d] - frame_row[4 + d]) * own.axes[d, c]
    fill_displacements(rows, own.inverse)
    return l1, l2


@jit
def _cover(own, moments, corners, search, rows, regions, count):
    """Store the region of two triples unless it is excluded; return the number of regions, or -1.

    The result is -1 if the two are not congruent.

    Parameters
    ----------
    own : Triple
    moments : (l1, l2, number)
        Its moments, and its number.
    corners : (p, q, r)
        The points of the target triple.
    search : (Thresholds, Distances)
    rows : Rows
    regions : Regions
    count : int
    """
    thresholds, field = search
    l1, l2, number = moments
    p, q, r = corners
    limit, cutoff, k = thresholds.triple, thresholds.cutoff, thresholds.k
    G, B, centroid, radii = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3)
    for c in range(3):
        centroid[c], radii[c] = (p[c] + q[c] + r[c]) / 3.0, _MAX_CHORD
    if l2 <= _THIN or not frame(p, q, r, G):
        return store_region(regions, count, number, own.axes, centroid, limit / 3.0, radii)
    s11, s22, s12, others = _superpose(own.local, p, q, r, G, B)
    moments_sum = l1 + l2 + others
    square = limit - (moments_sum - 2.0 * (s11 + s22)) + _ROUNDING * moments_sum  # rho^2
    if square < 0.0:
        return -1
    # S in units of the moments of the triple, and its smaller eigenvalue
    determinant = s11 * s22 - s12 * s12
    trace, det = s11 / l1 + s22 / l2, determinant / (l1 * l2)
    phi = 0.5 * (trace - math.sqrt(max(0.0, trace * trace - 4.0 * det)))
    smallest = 0.5 * (s11 + s22 - math.sqrt((s11 - s22) ** 2 + 4.0 * s12 * s12))
    if phi > _THIN and smallest > _THIN:
        region = Ellipsoid(square / 3.0, square / phi, own.inverse)
        goal = cutoff + square / smallest * math.sqrt(cutoff * thresholds.inertia)
        fill_distances(rows, B, centroid, field)
        if rows_exclude(rows, k, goal, region) or jointly_excluded(rows, k, goal, region):
            return count
        if region.rotation_factor * own.inverse[0] < _WIDE * _WIDE:
            for c in range(3):
                radii[c] = math.sqrt(region.rotation_factor * own.inverse[c])
            return store_region(regions, count, number, B, centroid, region.shift_square, radii)
    if determinant <= 0.0:
        return store_region(regions, count, number, own.axes, centroid, square / 3.0, radii)
    # any rotation about u1, in quarters, whose ellipsoids have the axes times sqrt(3)
    radii[0] = _QUARTER
    radii[1] = radii[2] = math.sqrt(3.0 * square * (s22 / determinant + 1.0 / (s11 + s22)))
    for _ in range(4):
        count = store_region(regions, count, number, B, centroid, square, radii)
        for c in range(3):  # a quarter turn about u1
            B[c, 1], B[c, 2] = B[c, 2], -B[c, 1]
    return count


@jit
def cover_triples(triples, frames, clouds, feasible, pairs, search, stop, regions):
    """Find the congruent target triples whose regions cannot be excluded.

    Parameters
    ----------
    triples : (T, 4) int array
        Numbers of the source points, and the number of the triple.
    frames : (T, 7) array
        Receives the unit quaternions from the principal frames of the triples, and their centroids.
    clouds : (source, target), (n, 3) and (m, 3) arrays
    feasible : (n, m) or (0, 0) bool array
        Feasible pairs; empty: all.
    pairs : (first, second, lengths, distances)
        The ordered pairs of target points by length, and the (m, m) distances of target points.
    search : (Thresholds, Distances)
    stop : (1,) uint8 array
        When it is set, the function returns at once.
    regions : Regions
        Receives the regions, as far as there is room.

    Returns
    -------
    tried, count : int
        Congruent target triples, and regions that are not excluded.
    """
    source, target = clouds
    first, second, lengths, distances = pairs
    n, tried, count = source.shape[0], 0, 0
    own = Triple(np.empty((3, 3)), np.empty((3, 2)), np.empty(3))
    rows = allocate_rows(np.empty((3, n)))
    for at in range(triples.shape[0]):
        u, v, w = triples[at, 0], triples[at, 1], triples[at, 2]
        l1, l2 = _begin(source, triples[at], frames[at], own, rows)
        moments = l1, l2, triples[at, 3]
        limit = 3.0 * search[0].triple + _ROUNDING * (1.0 + l1 + l2)
        side = _length(source[u], source[v])
        other, last = _length(source[u], source[w]), _length(source[v], source[w])
        begin = first_at_least(lengths, side - math.sqrt(limit))
        for pair in range(begin, first_at_least(lengths, side + math.sqrt(limit))):
            if stop[0]:
                return tried, count
            i, j = first[pair], second[pair]
            left = limit - (lengths[pair] - side) ** 2
            if feasible.size > 0 and not (feasible[u, i] and feasible[v, j]):
                continue
            for h in range(target.shape[0]):
                off = (distances[i, h] - other) ** 2 + (distances[j, h] - last) ** 2
                if off > left or h in (i, j):
                    continue
                if feasible.size > 0 and not feasible[w, h]:
                    continue
                tried += 1
                corners = target[i], target[j], target[h]
                count = max(count, _cover(own, moments, corners, search, rows, regions, count))
    return tried, count


@jit_part
def _length(p, q):
    return math.sqrt((p[0] - q[0]) ** 2 + (p[1] - q[1]) ** 2 + (p[2] - q[2]) ** 2)
