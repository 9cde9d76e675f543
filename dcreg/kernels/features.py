"""Where a model moves the source to, how curved that is, and how far it moves inside a box.

Both models match *features*: plane points in 2D, norms ``|x + t|`` in 3D. With features as columns
of ``out`` the residual of a pair is a squared distance in feature space, so every bound is written
once. ``kind`` selects the model.

``target`` holds the target's features, one row each. Where not every pair is feasible, n more rows
follow: what pair (i, j) costs beyond its residual, 0 or prohibitive.
"""

from __future__ import annotations

import math

import numpy as np

from dcreg.kernels.compiling import jit
from dcreg.kernels.sorting import COLUMNS

SIMILARITY2D = 0  # theta = (s cos, s sin, t_x, t_y)
NORM3D = 1  # theta = t, feature |x + t|


@jit
def move(kind, source, theta, out):
    """Features of the moved source: out[(n, 2)] in 2D, out[(n, 1)] in norm space."""
    n = source.shape[0]
    if kind == SIMILARITY2D:
        for i in range(n):
            x, y = source[i, 0], source[i, 1]
            out[i, 0] = theta[0] * x - theta[1] * y + theta[2]
            out[i, 1] = theta[1] * x + theta[0] * y + theta[3]
    else:
        for i in range(n):
            a, b, c = source[i, 0] + theta[0], source[i, 1] + theta[1], source[i, 2] + theta[2]
            out[i, 0] = math.sqrt(a * a + b * b + c * c)


@jit
def norm_columns(source, shifts, table):
    """``|x_i + t|`` for several t at once, the `COLUMNS` columns of `shifts` and of `table`."""
    for i in range(source.shape[0]):
        x, y, z = source[i, 0], source[i, 1], source[i, 2]
        for column in range(COLUMNS):
            a, b, c = x + shifts[0, column], y + shifts[1, column], z + shifts[2, column]
            table[i, column] = a * a + b * b + c * c
    numbers = table.reshape(-1)
    for at in range(numbers.size):  # a loop of its own: only so do the roots vectorise
        numbers[at] = math.sqrt(numbers[at])


@jit
def curvature(kind, axes, delta, out):
    """R_i(delta) = |J_i delta|^2: what the tangent at theta0 misses at theta0 + delta.

    `axes` is the source with one row per axis, so that the loop streams.
    """
    n = axes.shape[1]
    if kind == SIMILARITY2D:
        x, y = axes[0], axes[1]
        cos, sin, right, up = delta[0], delta[1], delta[2], delta[3]
        for i in range(n):
            u = cos * x[i] - sin * y[i] + right
            v = sin * x[i] + cos * y[i] + up
            out[i] = u * u + v * v
    else:
        r = delta[0] ** 2 + delta[1] ** 2 + delta[2] ** 2
        for i in range(n):
            out[i] = r


@jit
def enclose(kind, source, lower, upper, centre, radius):
    """Intervals centre +- radius that hold the features for every theta of the box."""
    n = source.shape[0]
    if kind == SIMILARITY2D:
        c0, c1 = 0.5 * (lower[0] + upper[0]), 0.5 * (lower[1] + upper[1])
        c2, c3 = 0.5 * (lower[2] + upper[2]), 0.5 * (lower[3] + upper[3])
        h0, h1 = 0.5 * (upper[0] - lower[0]), 0.5 * (upper[1] - lower[1])
        h2, h3 = 0.5 * (upper[2] - lower[2]), 0.5 * (upper[3] - lower[3])
        for i in range(n):
            x, y = source[i, 0], source[i, 1]
            centre[i, 0] = c0 * x - c1 * y + c2
            centre[i, 1] = c1 * x + c0 * y + c3
            radius[i, 0] = abs(x) * h0 + abs(y) * h1 + h2
            radius[i, 1] = abs(y) * h0 + abs(x) * h1 + h3
    else:
        for i in range(n):
            near = far = 0.0
            for a in range(3):
                low, high = source[i, a] + lower[a], source[i, a] + upper[a]
                gap = max(low, -high, 0.0)
                reach = max(-low, high)
                near += gap * gap
                far += reach * reach
            near, far = math.sqrt(near), math.sqrt(far)
            centre[i, 0] = 0.5 * (near + far)
            radius[i, 0] = 0.5 * (far - near)


@jit
def pair_costs(moved, target, cost):
    """cost_ij = squared distance of features; `target` is (q, m) so that the inner loop streams."""
    n, q = moved.shape
    m = target.shape[1]
    for i in range(n):
        if q == 2:
            x, y = moved[i, 0], moved[i, 1]
            for j in range(m):
                dx, dy = x - target[0, j], y - target[1, j]
                cost[i, j] = dx * dx + dy * dy
        else:
            x = moved[i, 0]
            for j in range(m):
                dx = x - target[0, j]
                cost[i, j] = dx * dx
        if target.shape[0] > q:
            for j in range(m):
                cost[i, j] += target[q + i, j]


@jit
def interval_costs(centre, radius, target, cost):
    """cost_ij = squared distance of the target feature from the source's interval."""
    n, q = centre.shape
    m = target.shape[1]
    for i in range(n):
        for j in range(m):
            total = 0.0
            for a in range(q):
                d = abs(centre[i, a] - target[a, j]) - radius[i, a]
                if d > 0.0:
                    total += d * d
            cost[i, j] = total
            if target.shape[0] > q:
                cost[i, j] += target[q + i, j]


@jit
def on_line(kind, target):
    """Whether the assignment is one-dimensional: scalar features, every pair feasible."""
    return kind == NORM3D and target.shape[0] == 1


@jit
def feature_dim(kind):
    return 2 if kind == SIMILARITY2D else 1


@jit
def n_vertices(lower, upper):
    """Distinct vertices of a box: axes of zero width do not count."""
    count = 1
    for a in range(lower.size):
        if upper[a] > lower[a]:
            count *= 2
    return count


@jit
def vertex(lower, upper, index, out):
    """The index-th distinct vertex of a box, bit a of the index choosing the a-th wide axis."""
    for a in range(lower.size):
        out[a] = lower[a]
        if upper[a] > lower[a]:
            if index & 1:
                out[a] = upper[a]
            index >>= 1


@jit
def allocate(kind, n, m):
    """Buffers one evaluation thread needs: features, curvature, costs."""
    return np.empty((n, feature_dim(kind))), np.empty(n), np.empty((n, m))
