"""Lower bounds over boxes of rigid poses that hold for every pose, stationary or not.

They are the bound by caps without its argument about the translation, and Cayley's form; see
`dcreg.families.rigid3d.bound`.
"""

from __future__ import annotations

import math

import numpy as np

from dcreg.assignment.kernels.dense import k_assignment
from dcreg.assignment.kernels.selection import least, sum_of_smallest
from dcreg.families.rigid3d.kernels.boxes import WIDE, WORTH_ASSIGNMENT, geometry, is_small
from dcreg.families.rigid3d.kernels.cayley import vertex_bound
from dcreg.families.rigid3d.kernels.poses import empty_view, look_from, pair_costs
from dcreg.families.rotation3d.kernels.caps import cap_costs
from dcreg.families.rotation3d.kernels.geometry import extent
from dcreg.jit import jit, jit_inner


@jit
def bound_boxes_anywhere(lower, upper, cutoff, clouds, bounds, values):
    """Fill the bounds of boxes, and the objective at centres where it is computed, else inf.

    Parameters
    ----------
    lower, upper : (B, 7) arrays
    cutoff : float
        Bounds above it are not improved.
    clouds : Clouds
    bounds, values : (B,) arrays

    Returns
    -------
    int
        Number of assignments.
    """
    n, m, k = clouds.source.shape[1], clouds.target.shape[1], clouds.k
    view = empty_view(clouds)
    radius, costs, low = extent(clouds.source)[0], np.empty((n, m)), np.empty(n)
    buffer, centre, half = np.empty((8, 3)), np.empty(7), np.empty(3)
    spent = 0
    for at in range(lower.shape[0]):
        if clouds.stop[0]:
            break
        box = geometry(lower[at], upper[at], centre, half, buffer)
        look_from(clouds, centre, view)
        angle, small = 2.0 * math.atan(box.tangent), is_small(box, radius, k, cutoff)
        cap_costs(view.source, angle, view.target, view.infeasibility_penalty, costs)
        _shrink(costs, box.shift_radius, low)
        bounds[at], values[at] = sum_of_smallest(low, k), np.inf
        if bounds[at] < cutoff and (small or bounds[at] > WORTH_ASSIGNMENT * cutoff):
            value, _ = k_assignment(costs, k, clouds.stop)
            bounds[at] = max(bounds[at], value)
            spent += 1
        if bounds[at] >= cutoff or not small or box.tangent > WIDE:
            continue
        pair_costs(view, costs)
        values[at], col_of = k_assignment(costs, k, clouds.stop)
        value, solved = vertex_bound(view, box.vertices, half, bounds[at], cutoff, col_of)
        bounds[at] = max(bounds[at], value)
        spent += solved + 1
    return spent


@jit_inner
def _shrink(costs, radius, low):
    """Shorten all distances by a radius; fill the minima of the rows of their squares."""
    for i in range(costs.shape[0]):
        for j in range(costs.shape[1]):
            costs[i, j] = max(0.0, math.sqrt(costs[i, j]) - radius) ** 2
        low[i] = least(costs[i])
