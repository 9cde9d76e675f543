"""Kernels that exclude boxes of similarities by distances to the nearest points.

`dcreg.families.similarity2d.cover` proves the tests. Point sets are stored by row, (n, 2) and (m, 2). A
box of parameters is given by its centre and its half-widths: those of the scaled rotation first, then
those of the translation.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dcreg.assignment.kernels.selection import smallest_sum
from dcreg.jit import jit, jit_part

_DEPTH = 160  # maximum size of the stack of boxes


class Distances(NamedTuple):
    """Lower bounds on the distance to a point set, on a grid of cells.

    Attributes
    ----------
    origin : (2,) array
        The minimum vertex of the grid.
    cell : float
        Side of a cell.
    values : (a, b) float32 array
        The distance of the centre of the cell from the nearest point.
    lower, upper : (2,) arrays
        The bounding box of the points, for places outside the grid.
    """

    origin: np.ndarray
    cell: float
    values: np.ndarray
    lower: np.ndarray
    upper: np.ndarray


class Sides(NamedTuple):
    """The problem as the tests take it.

    Attributes
    ----------
    source, target : (n, 2), (m, 2) arrays
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


@jit_part
def _distance(field, x, y):
    """Return a lower bound on the distance of a place from the points."""
    a, b = (x - field.origin[0]) / field.cell, (y - field.origin[1]) / field.cell
    if a < 0.0 or b < 0.0 or a >= field.values.shape[0] or b >= field.values.shape[1]:
        a = max(field.lower[0] - x, 0.0, x - field.upper[0])
        b = max(field.lower[1] - y, 0.0, y - field.upper[1])
        return math.sqrt(a * a + b * b)
    i, j = int(a), int(b)
    a, b = a - i - 0.5, b - j - 0.5
    return max(0.0, field.values[i, j] - field.cell * math.sqrt(a * a + b * b))


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


@jit
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
def smallest(values, k, levels, at):
    """Return the sum of the k smallest numbers, from the level of an earlier call, which is replaced."""
    found, levels[at] = smallest_sum(values, k, levels[at], 0.05 * abs(levels[at]) / k)
    return found


@jit
def source_sides(sides, centre, half, goal, work, levels):
    """Test a box from the source to the target.

    Returns whether the box is excluded, and the sum of the k smallest squared distances at its centre.
    """
    squares, moves, nets, _, _ = work
    a, b, x0, y0 = centre[0], centre[1], centre[2], centre[3]
    reach = math.sqrt(half[0] * half[0] + half[1] * half[1])
    shift = math.sqrt(half[2] * half[2] + half[3] * half[3])
    for i in range(squares.size):
        u, v = sides.source[i, 0], sides.source[i, 1]
        d = _distance(sides.to_target, a * u - b * v + x0, b * u + a * v + y0)
        move = shift + reach * sides.norms[i]
        squares[i], moves[i] = d * d, move * move
        nets[i] = squares[i] - moves[i]
    at_centre = smallest(squares, sides.k, levels, 0)
    if at_centre < goal:
        return False, at_centre
    if smallest(nets, sides.k, levels, 1) >= goal:
        return True, at_centre
    s0 = s1 = s2 = s3 = 0.0
    for i in range(squares.size):
        over = squares[i] - levels[0]
        if over < moves[i]:
            share = 1.0 if over <= 0.0 else 1.0 - over / moves[i]
            s0, s1 = s0 + share, s1 + share * sides.source[i, 0]
            s2, s3 = s2 + share * sides.source[i, 1], s3 + share * sides.norms[i] ** 2
    return at_centre - joint_loss((s0, s1, s2, s3), half) >= goal, at_centre


@jit
def target_sides(sides, centre, half, goal, work, levels):
    """Test a box from the target to the source; see `source_sides`."""
    squares, nets = work[3], work[4]
    a, b = centre[0], centre[1]
    reach = math.sqrt(half[0] * half[0] + half[1] * half[1])
    shift = math.sqrt(half[2] * half[2] + half[3] * half[3])
    square = a * a + b * b
    scale = math.sqrt(square)
    if scale <= reach * (1.0 + 1e-9):
        return False, 0.0
    turn = reach / scale
    for j in range(squares.size):
        x, y = sides.target[j, 0] - centre[2], sides.target[j, 1] - centre[3]
        u, v = (a * x + b * y) / square, (a * y - b * x) / square
        d = scale * _distance(sides.to_source, u, v)
        move = shift + reach * math.sqrt(u * u + v * v)
        squares[j], nets[j] = d * d, d * d - (move + turn * d) ** 2
        if nets[j] <= 0.0:
            nets[j] = -move * move / (1.0 - turn * turn)
    at_centre = smallest(squares, sides.k, levels, 2)
    loss = sides.k * shift * shift + sides.square_sum * reach * reach
    loss += 2.0 * shift * reach * sides.sum
    if at_centre - loss >= goal:
        return True, at_centre
    return at_centre >= goal and smallest(nets, sides.k, levels, 3) >= goal, at_centre


@jit
def is_excluded(sides, centre, half, cutoff, work, levels):
    """Tell whether no optimum below the cutoff lies in a box, and whether division is of no use."""
    goal = cutoff + _clipped_loss(sides, centre, half, cutoff)
    excluded, at_centre = source_sides(sides, centre, half, goal, work, levels)
    if excluded:
        return True, False
    excluded, other = target_sides(sides, centre, half, goal, work, levels)
    return excluded, max(at_centre, other) < cutoff


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
    n, m, levels = sides.source.shape[0], sides.target.shape[0], np.ones(4)
    work = np.empty(n), np.empty(n), np.empty(n), np.empty(m), np.empty(m)
    for box in range(lower.shape[0]):
        depth = 1
        low[0], high[0] = lower[box], upper[box]
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
                    left[0][n_left], left[1][n_left] = low[depth], high[depth]
                n_left += 1
                continue
            low[depth + 1], high[depth + 1] = low[depth], high[depth]
            high[depth, axis] = low[depth + 1, axis] = centre[axis]
            depth += 2
    return n_left, n_tested
