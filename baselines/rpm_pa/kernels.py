"""Compiled evaluation of the concave function along rays from the inner point."""

from __future__ import annotations

import numpy as np

from baselines._shared.kernels.statistics import concave, minimum_linear, statistics
from dcreg.jit import jit


@jit
def value_at(clouds, origin, axes, point):
    """Return F = L + f(u) at coordinates z, where ``(u, L) = origin + axes z``."""
    full = origin + axes @ point
    return full[-1] + concave(clouds, full[:-1])


@jit
def extensions(clouds, origin, axes, inner, directions, level, reach):
    """Return for every direction the farthest ``tau * direction`` with ``F(inner + .) >= level``.

    No component exceeds `reach`. Bisection keeps its inner end, so the points are never outside the level
    set.
    """
    out = np.empty_like(directions)
    for d in range(len(directions)):
        direction = directions[d] * (reach / np.abs(directions[d]).max())
        inside, outside = 0.0, 1.0
        if value_at(clouds, origin, axes, inner + direction) >= level:
            inside = 1.0
        else:
            for _ in range(60):
                middle = 0.5 * (inside + outside)
                if value_at(clouds, origin, axes, inner + middle * direction) >= level:
                    inside = middle
                else:
                    outside = middle
                if outside - inside < 1e-12 * outside:
                    break
        out[d] = inside * direction
    return out


@jit
def test_facets(clouds, origin, axes, inverse, inner, vertices, members, normals, best_col):
    """Compute how far the polytope D of all matchings exceeds facets ``normal . x <= 1``.

    Returns for every facet the passage ``max normal . x``, the point of D that attains it, and the
    minimum of F over the simplex of the facet stretched by the passage, which contains the part of D
    in its cone; then the minimum E found (its matching in `best_col`).
    """
    count, dim = normals.shape
    passage, bounds = np.empty(count), np.empty(count)
    farthest = np.empty((count, dim))
    best = np.inf
    at_inner = value_at(clouds, origin, axes, inner)
    for f in range(count):
        weights = -(inverse.T @ normals[f])
        _, col_of = minimum_linear(clouds, weights[:-1], weights[-1])
        u, fixed = statistics(clouds, col_of)
        value = fixed + concave(clouds, u)
        if value < best:
            best = value
            best_col[:] = col_of
        farthest[f] = inverse @ (np.append(u, fixed) - origin) - inner
        # the normal solves its equations up to rounding: use the worst vertex
        reached = np.inf
        for c in range(dim):
            reached = min(reached, normals[f] @ vertices[members[f, c]])
        passage[f] = max(0.0, normals[f] @ farthest[f] / reached)
        bounds[f] = at_inner
        for c in range(dim):
            corner = inner + passage[f] * vertices[members[f, c]]
            bounds[f] = min(bounds[f], value_at(clouds, origin, axes, corner))
    return passage, farthest, bounds, best
