"""Bounds over boxes of rigid poses.

The objective and the boxes are those of `dcreg.spaces.rigid3d`. Bounded is, over a box of quaternions
times a box of translations with centres R_c, t_c, the least E. Below, x_i stands for R_c x_i and y_j for
y_j - t_c, so that the centre of the box is (R, t) = (I, 0); t lies within half-widths h, rho = |h|, and
r_a are the Gibbs vectors (axis times tan of half the angle) of the corners of the quaternion box, seen
from its centre.

Which rotations a box holds
---------------------------
Seen from the centre, quaternion corners v_a become p_a = v_a conj(q_c); q = sum c_a v_a, c >= 0,
becomes p = sum c_a p_a, and its Gibbs vector (p_x, p_y, p_z) / p_w is, when all p_a,w > 0, the
convex combination of the r_a with weights c_a p_a,w / p_w. So the r of the box lie in the convex
hull of the r_a, and no rotation turns by more than the angle 2 atan(max |r_a|). Else: pi.

First bound: caps
-----------------
Turned by at most that angle, x_i stays on a spherical cap. With d_ij the distance of y_j from the
cap, |R x_i + t - y_j| >= d_ij - rho, and |R x_i + t_c - y_j| >= d_ij.

The first holds at every pose: E is at least the sum of the k smallest squares of the rows' least
d_ij - rho, cut at 0 (`nearest_sums`). It is of first order in rho.

The second is of second order, and holds for the optima of the box, which is all that a search
needs. Let (R*, t*) in the box be the best pose for its matching P*. The best translation for R* and
P* is the mean of what R* leaves over, so away from it their sum grows by exactly k times the squared
distance. At t_c it is no less than E there, which every pair bounds by its cap:

    E* + k |t_c - t*|^2  =  E_P*(R*, t_c)  >=  min_P sum p_ij d_ij^2,
    so   E*  >=  min_P sum p_ij d_ij^2 - k rho^2.

The minimum is one k-assignment; it is at least the `dual_bound` of any prices b >= 0, for which a
rough auction (`bid`) is enough, and at least the sum of the k smallest row minima. With all
rotations in the box d_ij is the norm distance ||x_i| - |y_j|| of the paper's Case II.

Second bound: Cayley's form
---------------------------
R = (I - [r])^-1 (I + [r]) for Gibbs vector r. For any vector v, |(I - [r]) v|^2 = |v|^2 + |r x v|^2
<= (1 + |r|^2) |v|^2. With v = R x + t - y,

    (I - [r]) v = (I + [r]) x + (I - [r]) (t - y) = x - y + s + r x (x + y),    s = t - r x t,

    (1 + |r|^2) |R x + t - y|^2  >=  |x - y + s + r x (x + y)|^2:

a linear residual in delta = (r, s), with s in the box of half-widths h'_c = h_c + the largest
|r x t|_c. Nothing but |r|^2 times the residual is lost, which is small where E is. Squares are
convex: with e = x - y + s0 + r0 x (x + y) at any delta0 the right side is at least

    |e|^2 + 2 e.(s - s0) + 2 ((x + y) x e).(r - r0),

affine in delta. Its minimum over the matchings is concave, so over conv{r_a} times the box of s it
is least at one of 8 x 8 vertices; divided by 1 + max |r_a|^2 and cut at 0 it bounds E. All values
of delta0 are valid. Best is the least-squares fit of a good matching within the box: while that
matching stays the best one at the vertices, the bound is the exact minimum over the box of its sum,
and the curvature of E costs nothing. This is DC-Reg's linearisation, with the point chosen as in
its planar case. As in `dcreg.bounds.rotation3d`, a vertex is bounded by duals and solved only if binding.

A box is bounded by the greatest of these, cheapest first and only as far as it decides; the last
only where the box is small. At a single pose the first is E.

Feasible pairs
--------------
Pairs that may not be matched cost a constant more, in E and in every cost above. Feasible matchings
cost what they did, so the least over all matchings is still no more than the least over those: the
bounds hold whatever the constant. For E itself no other pair may be matched, so the constant exceeds
k squared residuals at any pose of the start box (`dcreg.problem.pairs.FeasiblePairs`).
"""

from __future__ import annotations

from dcreg.bounds.clouds import CloudBound
from dcreg.kernels.space.rigid import bound_boxes
from dcreg.spaces import Rigid3D


class RigidBound(CloudBound[Rigid3D]):
    """The greatest of the bounds in the module's docstring, over boxes of poses."""

    round_pairs, max_round = 1_000_000, 256
    bound_boxes = staticmethod(bound_boxes)
