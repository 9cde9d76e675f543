"""Kernels that exclude boxes of similarities by distances to the nearest points.

`dcreg.families.similarity2d.cover` proves the tests. Point sets are stored by axis, (2, n) and (2, m). A
box of parameters is given by its centre and its half-widths: those of the scaled rotation first, then
those of the translation.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dcreg.assignment.kernels.selection import smallest_sum
from dcreg.jit import jit, jit_inner, jit_part

_DEPTH = 160  # maximum size of the stack of boxes


class Distances(NamedTuple):
    """Lower bounds on the squared distance to a point set, on a grid of cells around it.

    Attributes
    ----------
    origin : (2,) array
        The minimum vertex of the grid.
    density : float
        Cells per unit of length.
    squares : (a, b) float32 array
        Of every place in the cell. A place outside the grid is farther away than the nearest cell of it,
        because the points lie in the grid.
    """

    origin: np.ndarray
    density: float
    squares: np.ndarray


class Sides(NamedTuple):
    """The problem as the tests take it.

    Attributes
    ----------
    source, target : (2, n), (2, m) arrays
    norms : (n,) array
        Of the source points.
    to_target, to_source : Distances
    k : int
        Number of pairs to match.
    square_sum, sum : float
        The maxima, over k source points, of the sum of their squared norms and the norm of their sum.
    low, high : float
        Range of scales.
    """

    source: np.ndarray
    target: np.ndarray
    norms: np.ndarray
    to_target: Distances
    to_source: Distances
    k: int
    square_sum: float
    sum: float
    low: float
    high: float


@jit_inner
def fill_squares(points, pose, field, cells, squares):
    """Fill the squared distances of moved points, from below; `pose` is that of `Similarity2D`.

    Separate loops around the lookup let the compiler vectorise the rest. `cells` is scratch.
    """
    x, y, (n0, n1) = points[0], points[1], field.squares.shape
    a, b = pose[0] * field.density, pose[1] * field.density
    s0 = (pose[2] - field.origin[0]) * field.density
    s1 = (pose[3] - field.origin[1]) * field.density
    last0, last1 = n0 - 1.0, n1 - 1.0
    for i in range(cells.size):
        u = min(max(a * x[i] - b * y[i] + s0, 0.0), last0)
        v = min(max(b * x[i] + a * y[i] + s1, 0.0), last1)
        cells[i] = np.int32(u) * np.int32(n1) + np.int32(v)
    flat = field.squares.reshape(-1)
    for i in range(cells.size):
        squares[i] = flat[np.uintp(cells[i])]


@jit_part
def _clipped_loss(sides, centre, half, cutoff):
    """Return what a clipped scale can add to the objective at the centre of a box, from above."""
    reach = math.sqrt(half[0] * half[0] + half[1] * half[1])
    scale = math.sqrt(centre[0] * centre[0] + centre[1] * centre[1])
    slope = math.sqrt(cutoff * sides.square_sum)
    lost = 0.0
    if scale - reach <= sides.low * (1.0 + 1e-9):
        lost = 2.0 * slope * max(0.0, scale - sides.low)
    if scale + reach >= sides.high * (1.0 - 1e-9):
        over = sides.high * sides.high - scale * scale + reach * reach
        lost = max(lost, slope * max(0.0, over) / sides.high)
    return lost


@jit_inner
def joint_loss(weights, half):
    """Return the maximum of sum alpha_i |t + w x_i|^2 over a box of (w, t) around 0.

    `weights` holds the sums of alpha_i, alpha_i x_i (two numbers) and alpha_i |x_i|^2.
    """
    a, b, c, d = weights
    h0, h1, h2, h3 = half
    mixed = 0.0
    for sign in (-1.0, 1.0):
        mixed = max(mixed, h2 * abs(h0 * b - sign * h1 * c) + h3 * abs(h0 * c + sign * h1 * b))
    return a * (h2 * h2 + h3 * h3) + d * (h0 * h0 + h1 * h1) + 2.0 * mixed


@jit
def _sum_of_smallest(values, k, levels, side):
    """Return the sum of the k smallest numbers, beginning at the level of the last call of this side.

    The level becomes the k-th smallest number, up to rounding.
    """
    found, levels[side] = smallest_sum(values, k, levels[side], 0.05 * abs(levels[side]) / k)
    if k == values.size:  # the sum of all has no level of its own
        levels[side] = 0.0
        for value in values:
            levels[side] = max(levels[side], value)
    return found


@jit
def _target_sum(sides, centre, cells, squares, levels):
    """Return the sum of the k smallest squared distances from the target to the moved source."""
    square = centre[0] * centre[0] + centre[1] * centre[1]
    if square <= 0.0:
        return 0.0
    a, b, x, y = centre[0] / square, centre[1] / square, centre[2], centre[3]
    back = a, -b, -(a * x + b * y), b * x - a * y
    fill_squares(sides.target, back, sides.to_source, cells, squares)
    return square * _sum_of_smallest(squares, sides.k, levels, 1)


@jit
def _source_sum(sides, centre, cells, squares, levels):
    """Return the sum of the k smallest squared distances from the moved source to the target."""
    pose = centre[0], centre[1], centre[2], centre[3]
    fill_squares(sides.source, pose, sides.to_target, cells, squares)
    return _sum_of_smallest(squares, sides.k, levels, 0)


@jit
def _source_loss(sides, half, squares, tau):
    """Return what the source sum loses in a box: the joint displacement of points below tau."""
    reach = math.sqrt(half[0] * half[0] + half[1] * half[1])
    shift = math.sqrt(half[2] * half[2] + half[3] * half[3])
    s0 = s1 = s2 = s3 = 0.0
    for i in range(squares.size):
        over, move = squares[i] - tau, (shift + reach * sides.norms[i]) ** 2
        if over < move:
            share = 1.0 if over <= 0.0 else 1.0 - over / move
            s0, s1 = s0 + share, s1 + share * sides.source[0, i]
            s2, s3 = s2 + share * sides.source[1, i], s3 + share * sides.norms[i] ** 2
    return joint_loss((s0, s1, s2, s3), half)


@jit_part
def _target_loss(sides, reach, shift):
    """Return the maximum of sum |t + w x_i|^2 of k source points for |w| <= reach, |t| <= shift."""
    own = sides.k * shift * shift + sides.square_sum * reach * reach
    return own + 2.0 * shift * reach * sides.sum


@jit_inner
def is_excluded(sides, centre, half, cutoff, work, levels):
    """Tell whether no optimum below the cutoff lies in a box, and whether division is of no use.

    `work` has room for n and for m numbers, and for n and for m indices. `levels` are the k-th smallest
    squared distances of an earlier call from the source and from the target, and are replaced.
    """
    goal = cutoff + _clipped_loss(sides, centre, half, cutoff)
    reach = math.sqrt(half[0] * half[0] + half[1] * half[1])
    shift = math.sqrt(half[2] * half[2] + half[3] * half[3])
    to_source = _target_sum(sides, centre, work[3], work[1], levels)
    if to_source - _target_loss(sides, reach, shift) >= goal:
        return True, False
    to_target = _source_sum(sides, centre, work[2], work[0], levels)
    if to_target >= goal and to_target - _source_loss(sides, half, work[0], levels[0]) >= goal:
        return True, False
    return False, max(to_source, to_target) < cutoff


@jit_part
def _copy_box(low, high, to_low, to_high):
    """Copy a box by loops: an assignment of slices takes a second to compile, for its error message."""
    for c in range(low.size):
        to_low[c], to_high[c] = low[c], high[c]


@jit
def divide_boxes(boxes, sides, cutoff, weights, limits, stop, left):
    """Divide boxes until their parts are excluded, of no use to divide, or small.

    Parameters
    ----------
    boxes : (lower, upper), (B, 4) arrays
    sides : Sides
    cutoff : float
    weights : (4,) array
        RMS motion of the source per unit step along each axis.
    limits : (float, int)
        Motion at which a box is small, and the maximum number of boxes to test.
    stop : (1,) uint8 array
        When it is set, the function returns at once.
    left : (lower, upper), (R, 4) arrays
        Receives the boxes that are left, as far as there is room.

    Returns
    -------
    n_left, n_tested : int
    """
    small, most = limits
    lower, upper = boxes
    n_left = n_tested = 0
    low, high = np.empty((_DEPTH, 4)), np.empty((_DEPTH, 4))
    centre, half = np.empty(4), np.empty(4)
    n, m = sides.source.shape[1], sides.target.shape[1]
    work = np.empty(n), np.empty(m), np.empty(n, np.int32), np.empty(m, np.int32)
    levels = np.empty(2)
    levels[0] = levels[1] = 1.0
    for box in range(lower.shape[0]):
        depth = 1
        _copy_box(lower[box], upper[box], low[0], high[0])
        while depth > 0:
            depth -= 1
            if stop[0] or n_tested >= most:
                return n_left, n_tested
            near = far = 0.0
            for c in range(2):
                near += max(low[depth, c], -high[depth, c], 0.0) ** 2
                far += max(-low[depth, c], high[depth, c]) ** 2
            if near > (sides.high * (1.0 + 1e-9)) ** 2 or far < (sides.low * (1.0 - 1e-9)) ** 2:
                continue
            axis, longest = 0, -1.0
            for c in range(4):
                centre[c] = 0.5 * (low[depth, c] + high[depth, c])
                half[c] = 0.5 * (high[depth, c] - low[depth, c])
                if half[c] * weights[c] > longest:
                    axis, longest = c, half[c] * weights[c]
            n_tested += 1
            excluded, is_useless = is_excluded(sides, centre, half, cutoff, work, levels)
            if excluded:
                continue
            if is_useless or 2.0 * longest <= small or depth + 2 > _DEPTH:
                if n_left < left[0].shape[0]:
                    _copy_box(low[depth], high[depth], left[0][n_left], left[1][n_left])
                n_left += 1
                continue
            _copy_box(low[depth], high[depth], low[depth + 1], high[depth + 1])
            high[depth, axis] = low[depth + 1, axis] = centre[axis]
            depth += 2
    return n_left, n_tested
