"""The DC bound of one box in norm space, from the curvature of E inside the box.

For a fixed matching the Hessian of E(t) = sum (|x_i + t| - r_i)^2 is

    2 sum [I - r_i / z_i (I - u_i u_i^T)],    z_i = |x_i + t|, u_i the direction of x_i + t.

The paper's decomposition takes 2 k I, the most that it can be anywhere. Where the radii fit (r_i = z_i)
the Hessian is ``2 sum u_i u_i^T``, a third of that on average.

Let M be diagonal and twice M above the Hessian throughout the box, for the matching P* that is optimal at
the box's minimiser t*. Then E_P* - |.|_M^2 is concave on the box, and

    E(t*) = E_P*(t*) >= min_v [E_P*(v) - |v - theta0|_M^2] >= min_v [E(v) - |v - theta0|_M^2].

How far the radii are from fitting is known wherever it matters. Take any number c. Where the minimum of
the box is not below c, c is a bound; otherwise sum (z_i(t*) - r_i)^2 < c. So the lesser of this bound and
c always is a bound. A search takes the cutoff, above which boxes are discarded anyway. Derived in this
project, not in the paper.
"""

from __future__ import annotations

import math

import numpy as np

from dcreg.jit import jit, jit_reduction

# Points nearer than this, in radii of the box, turn too far within it: their directions are not used.
_NEAREST = 5.0


@jit_reduction
def _directions(axes, centre, radius, sums):
    """Sums over the points that are far enough.

    Of I - u u^T the diagonal and the absolute values beside it, then how much its entries may change
    within the ball: one part that only depends on the points, one in proportion to the misfit.
    """
    x, y, z = axes[0], axes[1], axes[2]
    x0, y0, z0 = centre[0], centre[1], centre[2]
    xx = yy = zz = xy = xz = yz = bent = moved = inverse = 0.0
    for i in range(x.size):
        a, b, c = x[i] + x0, y[i] + y0, z[i] + z0
        square = a * a + b * b + c * c
        counts = 1.0 if square > (_NEAREST * radius) ** 2 else 0.0
        norm = math.sqrt(square + (1.0 - counts))
        share, near = counts / (square + (1.0 - counts)), counts / (norm - counts * radius)
        xx += share * (square - a * a)
        yy += share * (square - b * b)
        zz += share * (square - c * c)
        xy += share * a * b
        xz += share * a * c
        yz += share * b * c
        bent += counts / norm
        moved += near
        inverse += near * near
    sums[0], sums[1], sums[2] = xx, yy, zz
    sums[3], sums[4], sums[5] = abs(xy), abs(xz), abs(yz)
    sums[6] = radius * (bent + 2.0 * moved)
    sums[7] = inverse


@jit
def norm_curvature(axes, k, centre, radius, misfit, weights):
    """Fill `weights` with a diagonal M: E_P - |t|_M^2 is concave in the ball for every P within `misfit`.

    Parameters
    ----------
    axes : (3, n) array
        The source, one row per axis.
    centre, radius
        A ball that holds the box.
    misfit : float
        sqrt of the sum of squared residuals that P has somewhere in the ball, at most.
    """
    sums = np.empty(8)
    _directions(axes, centre, radius, sums)
    # directions turn by asin(radius / z) at most; |z_i(t) - r_i| <= 2 radius + |z_i(t*) - r_i|
    loss = sums[6] + misfit * math.sqrt(sums[7])
    outside = axes.shape[1] - k  # rows that P leaves out lack at most I each
    for a in range(3):
        crossed = sums[3] + sums[4] + sums[5] - sums[5 - a]  # Gershgorin
        lacks = sums[a] - crossed - loss - outside
        weights[a] = max(k - lacks, 0.0)
