"""The DC bound of one box in norm space, from the curvature of E inside the box.

For a fixed matching the Hessian of E(t) = sum (|x_i + t| - r_i)^2 is

    2 sum [I - r_i / z_i (I - u_i u_i^T)],    z_i = |x_i + t|, u_i the direction of x_i + t.

The paper's decomposition uses 2 k I, the maximum that the Hessian can reach. If the norms fit (r_i =
z_i), the Hessian is ``2 sum u_i u_i^T``, on average a third of that.

Let M be a diagonal matrix such that 2 M is above the Hessian throughout the box, for the matching P*
that is optimal at the minimiser t* of the box. Then E_P* - |.|_M^2 is concave on the box, and

    E(t*) = E_P*(t*) >= min_v [E_P*(v) - |v - theta0|_M^2] >= min_v [E(v) - |v - theta0|_M^2].

The construction of M needs a bound on the misfit of the norms. Take any number c. If the minimum of the
box is at least c, then c is a bound; otherwise sum (z_i(t*) - r_i)^2 < c. So the minimum of this bound
and c is always a bound. A search takes the cutoff as c, because boxes above it are pruned. This bound
was derived in this project and is not in the paper.
"""

from __future__ import annotations

import math

import numpy as np

from dcreg.jit import jit, jit_reduction

# The directions of points nearer than this, in radii of the box, vary too much within it and are not
# used.
_NEAREST = 5.0


@jit_reduction
def _directions(axes, centre, radius, sums):
    """Fill sums over the points that are far enough.

    These are the diagonal of I - u u^T and the absolute values of its other entries, then the changes
    of the entries within the ball: a part that depends only on the points, and a part proportional to
    the misfit.
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
    """Fill `weights` with a diagonal M such that E_P - |t|_M^2 is concave in the ball.

    Parameters
    ----------
    axes : (3, n) array
        The source, one row per axis.
    centre, radius
        A ball that contains the box.
    misfit : float
        M is valid for each matching P whose root of the sum of squared residuals is at most this
        somewhere in the ball.
    """
    sums = np.empty(8)
    _directions(axes, centre, radius, sums)
    # directions change by at most asin(radius / z); |z_i(t) - r_i| <= 2 radius + |z_i(t*) - r_i|
    loss = sums[6] + misfit * math.sqrt(sums[7])
    outside = axes.shape[1] - k  # each row that P leaves unmatched reduces the sum by at most I
    for a in range(3):
        crossed = sums[3] + sums[4] + sums[5] - sums[5 - a]  # Gershgorin
        lacks = sums[a] - crossed - loss - outside
        weights[a] = max(k - lacks, 0.0)
