"""Local descent: alternate the exact matching with the best parameter for that matching."""

from __future__ import annotations

import math

import numpy as np

from dcreg.kernels.assignment import improve_assignment, k_assignment_duals
from dcreg.kernels.compiling import jit, jit_reduction
from dcreg.kernels.features import NORM3D, SIMILARITY2D, allocate, move, pair_costs
from dcreg.kernels.vertices import objective

_MAX_ROUNDS = 100


@jit
def fit_similarity2d(source, target, col_of, low, high, out):
    """Least-squares similarity of the matched pairs, its scale clipped to [low, high].

    The best rotation does not depend on the scale and the objective is a parabola in the scale, so
    clipping is exact.
    """
    count = 0
    mx = my = ux = uy = 0.0
    for i in range(col_of.size):
        j = col_of[i]
        if j >= 0:
            count += 1
            mx += source[i, 0]
            my += source[i, 1]
            ux += target[0, j]
            uy += target[1, j]
    mx, my, ux, uy = mx / count, my / count, ux / count, uy / count
    dot = cross = spread = 0.0
    for i in range(col_of.size):
        j = col_of[i]
        if j >= 0:
            x, y = source[i, 0] - mx, source[i, 1] - my
            u, v = target[0, j] - ux, target[1, j] - uy
            dot += x * u + y * v
            cross += x * v - y * u
            spread += x * x + y * y
    length = math.hypot(dot, cross)
    scale = min(max(length / spread if spread > 0.0 else low, low), high)
    if length > 0.0:
        out[0], out[1] = scale * dot / length, scale * cross / length
    else:
        out[0], out[1] = scale, 0.0
    out[2] = ux - (out[0] * mx - out[1] * my)
    out[3] = uy - (out[1] * mx + out[0] * my)


@jit
def refine_similarity2d(source, target, k, low, high, theta):
    """Admissible theta, its objective and the assignments spent, from any start `theta`.

    Every assignment starts from the prices of the one before.
    """
    moved, _, cost = allocate(SIMILARITY2D, source.shape[0], target.shape[1])
    best, trial = theta.copy(), np.empty(4)
    move(SIMILARITY2D, source, best, moved)
    pair_costs(moved, target, cost)
    _, col_of, prices = k_assignment_duals(cost, k)
    value, spent = np.inf, 1
    for _ in range(_MAX_ROUNDS):
        fit_similarity2d(source, target, col_of, low, high, trial)
        move(SIMILARITY2D, source, trial, moved)
        pair_costs(moved, target, cost)
        trial_value, trial_col = improve_assignment(cost, k, prices)
        spent += 1
        if trial_value >= value * (1.0 - 1e-9):
            break
        value, col_of = trial_value, trial_col
        best[:] = trial
    return best, value, spent


@jit_reduction
def fit_norm3d(axes, lengths, theta, out):
    """One majorise-minimise step for matched points: put x_i + t at its length along its direction.

    `axes` is the matched source with one row per axis, `lengths` the norms of its partners.
    """
    x, y, z = axes[0], axes[1], axes[2]
    right, up, ahead = theta[0], theta[1], theta[2]
    to_x = to_y = to_z = 0.0
    for i in range(x.size):
        a, b, c = x[i] + right, y[i] + up, z[i] + ahead
        length = math.sqrt(a * a + b * b + c * c)
        missing = (lengths[i] - length) / length if length > 0.0 else 0.0
        to_x += missing * a
        to_y += missing * b
        to_z += missing * c
    out[0], out[1], out[2] = right + to_x / x.size, up + to_y / x.size, ahead + to_z / x.size


@jit
def _matched(source, target, col_of, axes, lengths):
    found = 0
    for i in range(col_of.size):
        if col_of[i] >= 0:
            axes[:, found] = source[i]
            lengths[found] = target[0, col_of[i]]
            found += 1


@jit
def refine_norm3d(source, target, k, theta):
    """Better theta, its objective and the assignments spent, from any start `theta`."""
    best = theta.copy()
    value, col_of = objective(NORM3D, source, target, k, best)
    spent = 1
    trial, step = np.empty(3), np.empty(3)
    axes, lengths = np.empty((3, k)), np.empty(k)
    for _ in range(_MAX_ROUNDS):
        trial[:] = best
        _matched(source, target, col_of, axes, lengths)
        for _ in range(20):
            fit_norm3d(axes, lengths, trial, step)
            trial[:] = step
        trial_value, trial_col = objective(NORM3D, source, target, k, trial)
        spent += 1
        if trial_value >= value * (1.0 - 1e-9):
            break
        value, col_of = trial_value, trial_col
        best[:] = trial
    return best, value, spent
