"""Lower bounds over boxes of similarities in 3D.

A box has eight axes: four of a quaternion, three of the translation, and the scale of y = s R x + t.
Point sets are stored by axis, (3, n) and (3, m). `dcreg.families.similarity3d.bound` proves the bounds.
"""

from __future__ import annotations

import math

import numpy as np

from dcreg.assignment.kernels.dense import k_assignment_duals, row_minima
from dcreg.assignment.kernels.selection import kth_smallest, total
from dcreg.families.kernels import add_penalty, weigh
from dcreg.families.rigid3d.kernels.boxes import WIDE, geometry, is_small, shifted_bound
from dcreg.families.rigid3d.kernels.poses import empty_view, look_from, pair_costs
from dcreg.families.rigid3d.kernels.stationary import BoxGeometry, costs_at_vertices, proven
from dcreg.families.rotation3d.kernels.geometry import extent
from dcreg.jit import jit, jit_inner, jit_part


@jit_inner
def shell_costs(moved, angle, least, most, target, penalty, out):
    """Fill (n, m) minimum squared residuals over turns up to `angle` and scales in [least, most].

    The penalties of infeasible pairs are added.
    """
    cosine, sine = math.cos(angle), math.sin(angle)
    for i in range(moved.shape[1]):
        x, y, z = moved[0, i], moved[1, i], moved[2, i]
        own = math.sqrt(x * x + y * y + z * z)
        for j in range(target.shape[1]):
            u, v, w = target[0, j], target[1, j], target[2, j]
            other = u * u + v * v + w * w
            reach = own * math.sqrt(other)
            dot = x * u + y * v + z * w
            # the maximum inner product of the target point with a turned source point
            best = dot * cosine + math.sqrt(max(0.0, reach * reach - dot * dot)) * sine
            best = reach if dot >= reach * cosine else best
            scale = best / (own * own) if own > 0.0 else least
            scale = min(max(scale, least), most)
            out[i, j] = max(0.0, scale * scale * own * own + other - 2.0 * scale * best)
    add_penalty(penalty, out)


@jit
def bound_similarities(lower, upper, cutoff, clouds, limits, scales, bounds, values):
    """Fill the bounds of boxes, and the objective at centres where it is computed, else inf.

    Parameters
    ----------
    lower, upper : (B, 8) arrays
    cutoff : float
        Bounds above it are not improved.
    clouds : Clouds
    limits : Limits
        Of the source as given, with scale 1.
    scales : (B,) array
        The scale of the pose that represents each box; NaN if the optima of the box need not be
        stationary.
    bounds, values : (B,) arrays

    Returns
    -------
    int
        Number of assignments.
    """
    n, m, k = clouds.source.shape[1], clouds.target.shape[1], clouds.k
    view = empty_view(clouds)
    radius, costs = extent(clouds.source)[0], np.empty((n, m))
    work, out = np.empty((5, n)), np.empty(64)
    buffer, centre, half = np.empty((8, 3)), np.empty(7), np.empty(3)
    spent = 0
    for at in range(lower.shape[0]):
        if clouds.stop[0]:
            break
        box = geometry(lower[at], upper[at], centre, half, buffer)
        is_stationary = not math.isnan(scales[at])
        scale = scales[at] if is_stationary else 0.5 * (lower[at, 7] + upper[at, 7])
        least, most = lower[at, 7] / scale, upper[at, 7] / scale
        look_from(clouds, centre, view)
        _resize(view.source, scale)
        stretch = max(1.0 - least, most - 1.0)
        values[at] = np.inf
        small = is_small(box, scale * radius, k, cutoff)
        small &= k * (stretch * scale * radius) ** 2 < cutoff
        shell_costs(
            view.source, 2.0 * math.atan(box.tangent), least, most, view.target,
            view.infeasibility_penalty, costs,
        )  # fmt: skip
        weigh(view.weights, costs)
        bounds[at], solved = shifted_bound(costs, box.shift_radius, cutoff, small, view)
        spent += solved
        if bounds[at] >= cutoff or not (small and is_stationary) or box.tangent > WIDE:
            continue
        pair_costs(view, costs)
        values[at], _, b = k_assignment_duals(costs, k, clouds.stop)
        spent += 1
        row_minima(costs, b, work[0])
        bounds[at] = max(
            bounds[at],
            _by_displacements(view, box, (scale, least, most), limits, work, out, total(b)),
        )
    return spent


@jit_inner
def _resize(points, scale):
    for c in range(points.shape[0]):
        for i in range(points.shape[1]):
            points[c, i] *= scale


@jit_part
def _by_displacements(view, box, scales, limits, work, out, duals):
    """Return the bound by displacements, for reduced row minima in ``work[0]`` and the sum of duals.

    `scales` are the scale that represents the box, and the ends of its scales relative to this one.
    """
    scale, least, most = scales
    low = work[0]
    stretch = max(1.0 - least, most - 1.0)
    for i in range(low.size):
        own = view.source[0, i] ** 2 + view.source[1, i] ** 2 + view.source[2, i] ** 2
        low[i] -= stretch * stretch * view.heaviest[i] * own
    root_of_most = math.sqrt(most)
    vertices = np.empty(box.vertices.shape)
    for a in range(vertices.shape[0]):
        for c in range(3):
            vertices[a, c] = root_of_most * box.vertices[a, c]
    larger = BoxGeometry(vertices, box.half, box.tangent, box.shift_radius)
    level = kth_smallest(low, view.k - 1)
    cost = costs_at_vertices(view, low, larger, level, work, out) - duals
    t = box.tangent
    uneven = max(abs(most - root_of_most), abs(least - math.sqrt(least)))
    crossed = 2.0 * stretch + 4.0 * uneven * t + 4.0 * most * t * t / math.sqrt(1.0 + t * t)
    root = 4.0 * t * t / (1.0 + t * t) * scale * math.sqrt(limits.inertia)
    return proven(root, crossed * box.shift_radius * scale * limits.drift, cost)
