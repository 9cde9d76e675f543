"""Compiled bounds over simplices of statistics."""

from __future__ import annotations

import numpy as np

from baselines._shared.kernels.statistics import concave, minimum_linear, statistics
from dcreg.jit import jit


@jit
def values_at(clouds, origin, axes, points):
    """Return f at points in coordinates z."""
    out = np.empty(len(points))
    for p in range(len(points)):
        out[p] = concave(clouds, origin + axes @ points[p])
    return out


@jit
def interpolating_slope(vertices, values):
    """Return the gradient of the affine interpolation; zero for a simplex of the size of rounding.

    Gauss elimination with partial pivoting is faster than a library call for few unknowns.
    """
    dim = vertices.shape[1]
    left = np.empty((dim, dim))
    right = np.empty(dim)
    for v in range(dim):
        left[v] = vertices[v + 1] - vertices[0]
        right[v] = values[v + 1] - values[0]
    for step in range(dim):
        pivot = step
        for row in range(step + 1, dim):
            if abs(left[row, step]) > abs(left[pivot, step]):
                pivot = row
        if abs(left[pivot, step]) < 1e-150:
            return np.zeros(dim)
        if pivot != step:
            for c in range(step, dim):
                left[pivot, c], left[step, c] = left[step, c], left[pivot, c]
            right[pivot], right[step] = right[step], right[pivot]
        for row in range(step + 1, dim):
            share = left[row, step] / left[step, step]
            if share != 0.0:
                for c in range(step, dim):
                    left[row, c] -= share * left[step, c]
                right[row] -= share * right[step]
    for step in range(dim - 1, -1, -1):
        for c in range(step + 1, dim):
            right[step] -= left[step, c] * right[c]
        right[step] /= left[step, step]
    return right


@jit
def bound_simplex(clouds, origin, inverse, vertices, values, cutoff, n_ascents, best_col):
    """Return a lower bound of ``L(P) + f(u(P))`` over matchings with u(P) in the simplex.

    An affine function ``c . z + c0`` with ``c0 = min over vertices of f - c . v`` lies below f at the
    vertices and hence on the simplex, for any c. The first c interpolates f; this is the published bound
    with one assignment over all matchings. Each ascent moves c along a supergradient of the bound
    (Polyak's step towards `cutoff`). This is the Lagrangian of the dropped ``u(P) in simplex``.

    Returns the bound, E of the best matching (copied to `best_col`), and the assignments.
    """
    dim = vertices.shape[1]
    slope = interpolating_slope(vertices, values)
    bound, best = -np.inf, np.inf
    spent = 0
    for ascent in range(n_ascents + 1):
        below, at = np.inf, 0
        for v in range(dim + 1):
            level = values[v] - slope @ vertices[v]
            if level < below:
                below, at = level, v
        weights = inverse.T @ slope
        least, col_of = minimum_linear(clouds, weights, 1.0)
        spent += 1
        # the terms of thin simplices are large: subtract their rounding
        size = np.abs(weights) @ np.abs(origin) + np.abs(slope).sum() + abs(least)
        found = least - weights @ origin + below - 1e-14 * size
        bound = max(bound, found)
        u, fixed = statistics(clouds, col_of)
        value = fixed + concave(clouds, u)
        if value < best:
            best = value
            best_col[:] = col_of
        if bound >= cutoff or ascent == n_ascents:
            break
        outward = inverse @ (u - origin) - vertices[at]
        square = outward @ outward
        if square < 1e-18:
            break
        slope = slope + (cutoff - found) / square * outward
    return bound, best, spent


@jit
def split_edge(clouds, origin, axes, vertices, values, by_gap):
    """Return the edge to bisect, and f at its midpoint.

    By gap: the edge at whose midpoint f exceeds its interpolation most, if this is a noticeable share of
    the gap of the longest edge; otherwise the longest edge (in ranges of z).
    """
    dim = vertices.shape[1]
    longest, most = -1.0, -1.0
    long_a = long_b = gap_a = gap_b = 0
    for a in range(dim + 1):
        for b in range(a):
            length = 0.0
            for c in range(dim):
                length += (vertices[a, c] - vertices[b, c]) ** 2
            if length > longest:
                longest, long_a, long_b = length, a, b
            if by_gap:
                middle = concave(clouds, origin + axes @ (0.5 * (vertices[a] + vertices[b])))
                gap = middle - 0.5 * (values[a] + values[b])
                if gap > most:
                    most, gap_a, gap_b = gap, a, b
    if not by_gap or most <= 1e-12 * (1.0 + np.abs(values).max()):
        gap_a, gap_b = long_a, long_b
    middle = concave(clouds, origin + axes @ (0.5 * (vertices[gap_a] + vertices[gap_b])))
    return gap_a, gap_b, middle


@jit
def bound_children(
    clouds, origin, axes, inverse, vertices, values, inherited, cutoff, n_ascents, by_gap, out_col
):
    """Bisect every simplex and bound its two halves.

    Returns child vertices (2 B, r+1, r), child values, child bounds, the minimum E found (its matching
    in `out_col`) and the assignments spent.
    """
    count, corners, dim = vertices.shape
    child_vertices = np.empty((2 * count, corners, dim))
    child_values = np.empty((2 * count, corners))
    bounds = np.empty(2 * count)
    col = np.empty(out_col.size, np.int64)
    best, spent = np.inf, 0
    for s in range(count):
        a, b, middle = split_edge(clouds, origin, axes, vertices[s], values[s], by_gap)
        for half in range(2):
            child = 2 * s + half
            moved = a if half == 0 else b
            child_vertices[child] = vertices[s]
            child_values[child] = values[s]
            child_vertices[child, moved] = 0.5 * (vertices[s, a] + vertices[s, b])
            child_values[child, moved] = middle
            if _outside(child_vertices[child]):
                bounds[child] = np.inf
                continue
            bound, value, used = bound_simplex(
                clouds,
                origin,
                inverse,
                child_vertices[child],
                child_values[child],
                cutoff,
                n_ascents,
                col,
            )
            spent += used
            bounds[child] = max(bound, inherited[s])
            if value < best:
                best = value
                out_col[:] = col
    return child_vertices, child_values, bounds, best, spent


@jit
def _outside(vertices):
    """Return whether a simplex is disjoint from the unit box, which contains z of every matching."""
    for c in range(vertices.shape[1]):
        if vertices[:, c].min() > 1.0 + 1e-9 or vertices[:, c].max() < -1e-9:
            return True
    return False
