"""Costs of all pairs at a parameter, the curvature of the costs, and their range over a box.

Similarities match points in 2D, and translations in norm space match norms ``|x + t|``. Both are called
*features*. The residual of a pair is a squared distance of features, so both problems share the bounds.
A one-dimensional target holds norms. Kernels that receive the target as a separate argument are compiled
for only one of the two problems.
"""

from __future__ import annotations

import math

from dcreg.families.kernels import add_penalty
from dcreg.jit import jit, jit_part


@jit
def pair_costs(clouds, theta, cost):
    """Fill cost_ij: the squared distance of the features at `theta`, plus the penalty of the pair."""
    squared_distances(clouds.source, clouds.target, theta, cost)
    add_penalty(clouds.infeasibility_penalty, cost)


@jit
def squared_distances(source, target, theta, cost):
    """Fill the squared distances between features of the moved source and of the target."""
    if target.ndim == 1:
        for i in range(source.shape[1]):
            a, b, c = source[0, i] + theta[0], source[1, i] + theta[1], source[2, i] + theta[2]
            x = math.sqrt(a * a + b * b + c * c)
            for j in range(target.size):
                dx = x - target[j]
                cost[i, j] = dx * dx
    else:
        for i in range(source.shape[1]):
            a, b = source[0, i], source[1, i]
            x = theta[0] * a - theta[1] * b + theta[2]
            y = theta[1] * a + theta[0] * b + theta[3]
            for j in range(target.shape[1]):
                dx, dy = x - target[0, j], y - target[1, j]
                cost[i, j] = dx * dx + dy * dy


@jit
def curvature(target, axes, delta, out):
    """Return R_i(delta) = |J_i delta|^2: the error of the tangent at theta0 in theta0 + delta."""
    if target.ndim == 1:
        r = delta[0] ** 2 + delta[1] ** 2 + delta[2] ** 2
        for i in range(out.size):
            out[i] = r
    else:
        plane_curvature(axes, delta, out)


@jit_part
def plane_curvature(axes, delta, out):
    """Return `curvature` for similarities in 2D."""
    x, y = axes[0], axes[1]
    cos, sin, right, up = delta[0], delta[1], delta[2], delta[3]
    for i in range(out.size):
        u = cos * x[i] - sin * y[i] + right
        v = sin * x[i] + cos * y[i] + up
        out[i] = u * u + v * v


@jit
def interval_costs(source, target, lower, upper, cost):
    """Fill cost_ij: squared distance of the target's feature from the interval of x_i over the box."""
    if target.ndim == 1:
        for i in range(source.shape[1]):
            near = far = 0.0
            for a in range(3):
                low, high = source[a, i] + lower[a], source[a, i] + upper[a]
                gap, reach = max(low, -high, 0.0), max(-low, high)
                near += gap * gap
                far += reach * reach
            near, far = math.sqrt(near), math.sqrt(far)
            centre, radius = 0.5 * (near + far), 0.5 * (far - near)
            for j in range(target.size):
                d = max(abs(centre - target[j]) - radius, 0.0)
                cost[i, j] = d * d
    else:
        c0, c1 = 0.5 * (lower[0] + upper[0]), 0.5 * (lower[1] + upper[1])
        c2, c3 = 0.5 * (lower[2] + upper[2]), 0.5 * (lower[3] + upper[3])
        h0, h1 = 0.5 * (upper[0] - lower[0]), 0.5 * (upper[1] - lower[1])
        h2, h3 = 0.5 * (upper[2] - lower[2]), 0.5 * (upper[3] - lower[3])
        for i in range(source.shape[1]):
            a, b = source[0, i], source[1, i]
            x, y = c0 * a - c1 * b + c2, c1 * a + c0 * b + c3
            wide, high = abs(a) * h0 + abs(b) * h1 + h2, abs(b) * h0 + abs(a) * h1 + h3
            for j in range(target.shape[1]):
                dx = max(abs(x - target[0, j]) - wide, 0.0)
                dy = max(abs(y - target[1, j]) - high, 0.0)
                cost[i, j] = dx * dx + dy * dy
