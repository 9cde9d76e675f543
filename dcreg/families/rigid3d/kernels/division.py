"""Divide regions of congruent triples until dual variables exclude their parts.

A region is seen in its own coordinates: the source in the principal frame of its triple, and the target
from the pose at the centre of the region. There a part of it is a box of Gibbs vectors and shifts, which
the bounds of `dcreg.families.rigid3d.bound` take as a box of quaternions (1, x, y, z).
"""

from __future__ import annotations

import math

import numpy as np

from dcreg.assignment.kernels.selection import total
from dcreg.families.kernels import Clouds
from dcreg.families.rigid3d.kernels.boxes import bound_boxes_by_duals
from dcreg.families.rigid3d.kernels.dual_bounds import keep_duals, raise_duals, region_rounding
from dcreg.families.rigid3d.kernels.exclusion import (
    Ellipsoid,
    allocate_rows,
    fill_displacements,
    jointly_excluded,
)
from dcreg.families.rigid3d.kernels.regions import box_chord, product
from dcreg.families.rigid3d.kernels.stationary import Limits
from dcreg.families.rigid3d.kernels.tuples import copy_region
from dcreg.families.rotation3d.kernels.geometry import chord_matrix
from dcreg.jit import jit

_WIDEST = 1.6  # maximum |w| of a region that is divided here; wider ones are left to the search
_WIDE = 0.6  # tangent of parts that are divided without a bound, as in `bound_boxes`
# A part is left to the search if its centre value is below _NEAR cutoffs and its longest edge is at most
# _SMALL: many regions meet around the optimum, and the search divides each place only once. With 1.9 and
# 0.25, 200 points with 30 % mixed outliers take a third longer; with 9, separate ones do.
_NEAR, _SMALL = 4.0, 0.5
_ROUNDS = 8  # of auction steps at the centre of a region
_DEPTH = 24  # maximum size of the stack of parts


@jit
def _rotate_back(M, offset, points, out):
    """Write M^T (points - offset) to `out`, both (3, n)."""
    for i in range(points.shape[1]):
        x, y, z = points[0, i] - offset[0], points[1, i] - offset[1], points[2, i] - offset[2]
        for c in range(3):
            out[c, i] = M[0, c] * x + M[1, c] * y + M[2, c] * z


@jit
def _excluded_at_centre(own, thresholds, radii, shift_radius, work, rows, kept):
    """Tell whether the dual variables at the centre of a region exclude it; fill `kept` with them.

    `radii` and `shift_radius` are those of `Regions`.
    """
    inverse, widest, level, cutoff = np.empty(3), 0.0, 0.0, thresholds.cutoff
    for c in range(3):
        inverse[c] = radii[c] * radii[c]
        widest = max(widest, inverse[c])
    fill_displacements(rows, inverse)
    region = Ellipsoid(shift_radius * shift_radius, 1.0, inverse)
    goal = cutoff + widest * math.sqrt(cutoff * thresholds.inertia)
    is_excluded = False
    for attempt in range(_ROUNDS + 1):
        found, level = raise_duals(own, attempt, level, kept, work)
        duals = total(work.columns[4])
        off = duals + region_rounding(own, shift_radius, math.sqrt(widest), found + duals, duals)
        for i in range(rows.squares.size):
            rows.squares[i] = work.rows[0, i]
        if attempt % 2 == 0 and jointly_excluded(rows, own.k, goal + off, region):
            is_excluded = True
            break
    keep_duals(work.columns[4], kept)
    return is_excluded


@jit
def _is_outside(lower, upper, shift_radius, radii):
    """Tell whether a box of (1, Gibbs vector, shift) lies outside the ellipsoid of a region."""
    shift = rotation = most = 0.0
    for c in range(3):
        least = max(0.0, lower[4 + c], -upper[4 + c])
        shift += least * least
        least = max(0.0, lower[1 + c], -upper[1 + c])
        rotation += (2.0 * least / radii[c]) ** 2
        most += max(abs(lower[1 + c]), abs(upper[1 + c])) ** 2
    return shift / (shift_radius * shift_radius) + rotation / (1.0 + most) > 1.0


@jit
def _longest_edge(low, high, weights):
    """Return the axis along which a box displaces points most, by how much, and half its rotation."""
    axis, longest, square = 4, 0.0, 0.0
    for c in range(3):
        width = high[1 + c] - low[1 + c]
        square += 0.25 * width * width
        if high[4 + c] - low[4 + c] > longest:
            axis, longest = 4 + c, high[4 + c] - low[4 + c]
        if weights[c] * width > longest:
            axis, longest = 1 + c, weights[c] * width
    return axis, longest, math.sqrt(square)


@jit
def _store_part(low, high, region, left, count):
    """Store a part as a separate region; `region` is (triple, rotation, centroid)."""
    triple, rotation, centroid = region
    part, M = np.empty(4), chord_matrix(rotation, rotation)
    chord, square, place = box_chord(part, low, high), 0.0, np.empty(3)
    for c in range(3):
        square += 0.25 * (high[4 + c] - low[4 + c]) ** 2
        place[c] = centroid[c]
        for d in range(3):
            place[c] += M[c, d] * 0.5 * (low[4 + d] + high[4 + d])
    if count < left.triple.size:
        left.triple[count], left.shift_radius[count] = triple, math.sqrt(square)
        product(rotation, part, left.rotation[count])
        for c in range(3):
            left.centroid[count, c], left.rotation_radii[count, c] = place[c], 2.0 * chord
    return count + 1


@jit
def _first_part(own, radii, shift_radius, stack):
    """Put the box around a region on the stack, and weigh its axes."""
    lower, upper, _, weights = stack
    widest = max(radii[0], radii[1], radii[2])
    lower[0, 0] = upper[0, 0] = 1.0
    for c in range(3):
        half = 0.5 * radii[c] / math.sqrt(1.0 - 0.25 * widest * widest)
        lower[0, 1 + c], upper[0, 1 + c] = -half, half
        lower[0, 4 + c], upper[0, 4 + c] = -shift_radius, shift_radius
        weights[c] = 0.0
        for i in range(own.source.shape[1]):
            weights[c] += own.source[(c + 1) % 3, i] ** 2 + own.source[(c + 2) % 3, i] ** 2
        weights[c] = 2.0 * math.sqrt(weights[c] / own.source.shape[1])


@jit
def _in_parts(own, bounds, region, extent, scratch, stack, left, count):
    """Divide a region until its parts are excluded or stored.

    Returns the number of stored parts, with `count`, and that of bounded parts. `bounds` is the cutoff,
    the `Limits` and the maximum number of parts to bound; `extent` is (radii, shift_radius).
    """
    cutoff, limits, most = bounds
    radii, shift_radius = extent
    found, work = scratch
    lower, upper, kept, weights = stack
    _first_part(own, radii, shift_radius, stack)
    depth, bounded = 1, 0
    while depth > 0:
        depth -= 1
        low, high = lower[depth], upper[depth]
        if _is_outside(low, high, shift_radius, radii):
            continue
        axis, longest, tangent = _longest_edge(low, high, weights)
        is_near = False
        if tangent < _WIDE:
            for j in range(kept.shape[1]):
                found.kept[0, j] = kept[depth, j]
            found.bounds[0] = 0.0
            low_high = lower[depth : depth + 1], upper[depth : depth + 1]
            # no part is left to exact assignments
            bound_boxes_by_duals(*low_high, cutoff, 0.0, own, limits, found, work)
            bounded += 1
            if found.bounds[0] >= cutoff:
                continue
            is_near = found.estimates[0] < _NEAR * cutoff and longest <= _SMALL
            for j in range(kept.shape[1]):
                kept[depth, j] = found.kept[0, j]
        if is_near or depth + 2 > _DEPTH or bounded >= most:
            count = _store_part(low, high, region, left, count)
            continue
        for c in range(7):
            lower[depth + 1, c], upper[depth + 1, c] = low[c], high[c]
        upper[depth, axis] = lower[depth + 1, axis] = 0.5 * (low[axis] + high[axis])
        for j in range(kept.shape[1]):
            kept[depth + 1, j] = kept[depth, j]
        depth += 2
    return count, bounded


@jit
def divide_regions(regions, frames, limits, clouds, thresholds, most, scratch, left):
    """Divide regions until dual variables exclude their parts, or the parts are left to the search.

    Parameters
    ----------
    regions : Regions
    frames : (T, 7) array
        See `cover_triples`.
    limits : (T, 3) array
        The `Limits` of the source around the centroid of each triple.
    clouds : Clouds
    thresholds : Thresholds
    most : (int, int)
        Maximum number of parts of a region that are bounded. The function returns early if all of them
        together exceed the second one.
    scratch : (Found, Workspace)
        For one box.
    left : Regions
        Receives parts that may contain an optimum below the cutoff, as far as there is room.

    Returns
    -------
    n_left, n_bounded : int
        Parts that are left, and parts that were bounded.
    """
    n, m = clouds.source.shape[1], clouds.target.shape[1]
    own = Clouds(
        np.empty((3, n)), np.empty((3, m)), clouds.infeasibility_penalty, clouds.weights,
        clouds.heaviest, clouds.k, clouds.stop,
    )  # fmt: skip
    rows = allocate_rows(own.source)
    stack = (
        np.empty((_DEPTH, 7)), np.empty((_DEPTH, 7)), np.empty((_DEPTH, m), np.uint16), np.empty(3)
    )  # fmt: skip
    count = n_bounded = 0
    for at in range(regions.triple.size):
        if clouds.stop[0] or n_bounded > most[1]:
            break
        triple, rotation, centroid = regions.triple[at], regions.rotation[at], regions.centroid[at]
        radii, shift_radius = regions.rotation_radii[at], regions.shift_radius[at]
        frame = frames[triple]
        if max(radii[0], radii[1], radii[2]) > _WIDEST:
            count = copy_region(regions, at, left, count)
            continue
        _rotate_back(chord_matrix(frame[:4], frame[:4]), frame[4:], clouds.source, own.source)
        _rotate_back(chord_matrix(rotation, rotation), centroid, clouds.target, own.target)
        if _excluded_at_centre(own, thresholds, radii, shift_radius, scratch[1], rows, stack[2][0]):
            continue
        around = Limits(limits[triple, 0], limits[triple, 1], limits[triple, 2])
        count, bounded = _in_parts(
            own, (thresholds.cutoff, around, most[0]), (triple, rotation, centroid),
            (radii, shift_radius), scratch, stack, left, count,
        )  # fmt: skip
        n_bounded += bounded
    return count, n_bounded
