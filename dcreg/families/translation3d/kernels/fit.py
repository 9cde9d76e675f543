"""The best translation for given pairs of norms."""

from __future__ import annotations

import math

from dcreg.jit import jit, jit_reduction


@jit
def fit_norm3d(axes, lengths, steps, theta):
    """Decrease ``sum (|x_i + t| - r_i)^2`` from `theta`, in place, by majorise-minimise steps.

    A step moves each x_i + t to its length along its direction and takes the mean of the translations.
    `axes` is the matched source, one row per axis; `lengths` are the norms of its partners.
    """
    for _ in range(steps):
        x, y, z = _missing(axes, lengths, theta)
        theta[0] += x
        theta[1] += y
        theta[2] += z


@jit_reduction
def _missing(axes, lengths, theta):
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
    return to_x / x.size, to_y / x.size, to_z / x.size
