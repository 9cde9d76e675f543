"""Bounds over boxes of rigid poses.

The objective and the boxes are those of `dcreg.families.rigid3d.space`. Bounded is, over a box of
quaternions times a box of translations with centres R_c, t_c, the least E. Below, x_i stands for
R_c x_i and y_j for y_j - t_c, so that the centre of the box is (R, t) = (I, 0); t lies within
half-widths h, rho = |h|, and r_a are the Gibbs vectors (axis times tan of half the angle) of the
corners of the quaternion box, seen from its centre.

Which rotations a box holds
---------------------------
Seen from the centre, quaternion corners v_a become p_a = v_a conj(q_c); q = sum c_a v_a, c >= 0,
becomes p = sum c_a p_a, and its Gibbs vector (p_x, p_y, p_z) / p_w is, when all p_a,w > 0, the
convex combination of the r_a with weights c_a p_a,w / p_w. So the r of the box lie in the convex
hull of the r_a, and no rotation turns by more than the angle 2 atan(max |r_a|). Else: pi.

First bound: ways to the middle
-------------------------------
This holds for the optima of the box, which is all that a search needs. Let (R*, t*) in it be the
best pose for its matching P*, with residuals e_i = R* x_i + t* - y_i, and let u_i be the way of x_i
from there to the centre. Both the translation and the rotation are stationary, so sum p e = 0 and
sum p x' x e = 0 for x' = R* x_i: what the residuals at the centre have in common with the ways
vanishes but for terms of second order in the angle. With c_ij = |x_i - y_j|^2 and w the angle
between R* and R_c,

    sum p c  =  sum p |e + u|^2  <=  E* + sum p |u|^2 + 2 (1 - cos w) sqrt(E*) sqrt(sum p |x|^2).

For Gibbs vector r and a shift s of the translation the way is 2 r x x + s but for second order: the
sum of its squares is at most that of the |2 r x x + s|^2 plus 4 |r|^2 / sqrt(1 + |r|^2) |s| |sum p x|.
That square is convex in (r, s), so it is greatest at a corner (r_a, +-h). Hence, with C the least of sum
p (c - |2 r x x + s|^2) over the matchings and the 8 x 8 corners, and over any k sources I the
greatest sum of their squares and D the greatest length of their sum,

    E* + 4 |r|^2 / (1 + |r|^2) sqrt(I) sqrt(E*) + 4 |r|^2 / sqrt(1 + |r|^2) |s| D  >=  C.

The ways are those of rows: one matching's prices b >= 0 serve all corners. At each, C is at least
the sum of the k smallest min_j (c_ij + b_j) - |way_i|^2, less the sum of b. Good prices come from
the box that this one is a part of (the hints of the search): a share of them is taken over, lowered as
far as no row pays less, and raised again by bids where it is in doubt whether they are good enough.
Squares, minima and bids are computed in single precision, and what that may be off by is taken off.

Second bound: values at the corners
-----------------------------------
Balls about the middles of cubes cover six dimensions badly; with balls about their corners they may have
twice the loss. Let v be the pose at a corner, turned by r_a and shifted by s_b, C_v what C is at that
corner alone, and e_v the least sum of costs at v. With u_v the ways to v and w_v the angle to R_v, as
above

    e_v  <=  E* + sum p |u_v|^2 + 2 (1 - cos w_v) sqrt(E*) sqrt(sum p |x|^2).

The optimum lies at (r, s), r a mean of the r_a and s one of the s_b. Take the inequality half at the
centre and half at the corners, with the products of the weights of these two means. Were the ways to v
2 (r_a - r) x x + s_b - s, the mean of their squares would be that of the |2 r_a x x + s_b|^2 less
|2 r x x + s|^2, the square of the way to the centre: half the mean of the |2 r_a x x + s_b|^2 would be
all that remains, whatever (r, s). What else there is: with d = r_a - r, and x as seen from R*,

    |R_v x - R* x|^2  =  4 |(d - r x d) x x|^2 / ((1 + |r|^2) (1 + |r_a|^2)),

as conj(q*) q_v has the vector part d - r x d for quaternions (1, r) and (1, r_a). Summed over the pairs
that is at most 4 (d.J d + |r| |d|^2 S + |r|^2 |d|^2 I), J the moments of inertia and S the difference of
two eigenvalues of sum p x x^T: that r x d turns ways is felt as far as J is not round. The mean of |d|^2
is at most tau^2 - |r|^2, tau = max |r_a|, so that half the last two terms is at most 0.77 tau^3 S +
tau^4 I / 2. Shifts and turns do not mix, as the mean of s_b - s is 0; and 1 - cos w_v <= 2 |d|^2. So

    E* + 2 tau^2 sqrt(I) sqrt(E*) + 2 tau^2 / sqrt(1 + tau^2) |s| D + 0.77 tau^3 S + tau^4 I / 2
        >=  min over v of (C_v + e_v) / 2,

where D and I are those of the first bound. Where e_v is not known, E* itself may stand for it, as no pose
is better for P*: there C_v has to be as great as what is to be shown, with twice the loss. A value at a
corner serves all boxes that have it, up to 64, and those made from them. It is found like that of a
middle, by the prices of the first box that asks; a box asks for few at first, those of least C_v, and for
all only if none tells against it.

Caps are left for wide boxes, whose rotations are too far from the middle, and come first where pairs
are so few that an assignment takes no longer than prices. Turned by at most an angle, x_i stays on a
spherical cap. With d_ij the distance of y_j from the cap and rho = |h|, |R x_i + t - y_j| >= d_ij - rho
holds everywhere, and as the best translation for R* and P* is a mean,

    E* + k |t_c - t*|^2  =  E_P*(R*, t_c)  >=  min_P sum p_ij d_ij^2.

Both sums are bounded by the rows' least costs (`nearest_sums`), the second also by an assignment. With
all rotations in the box d_ij is the norm distance ||x_i| - |y_j|| of the paper's Case II.

Third bound: Cayley's form
--------------------------
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
its planar case. As in `dcreg.families.rotation3d.bound`, a vertex is bounded by duals and solved only if
binding.

A box is bounded by the greatest of these, the last only where the box is small. At a single pose
the first is E.

Feasible pairs
--------------
Pairs that may not be matched cost a constant more, in E and in every cost above. Feasible matchings
cost what they did, so the least over all matchings is still no more than the least over those: the
bounds hold whatever the constant. For E itself no other pair may be matched, so the constant
exceeds k squared residuals at any pose of the start box (`dcreg.problem.problem.FeasiblePairs`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dcreg.families.protocol import SpaceBound
from dcreg.families.rigid3d.corner_values import CornerValues
from dcreg.families.rigid3d.kernels.rigid import bound_boxes, room_for_findings
from dcreg.families.rigid3d.kernels.stationary import Limits
from dcreg.families.rigid3d.space import Rigid3D, largest_subset_mean_3d
from dcreg.search import Box, Evaluation


class RigidBound(SpaceBound[Rigid3D]):
    """The maximum of the bounds in the module's docstring, over boxes of poses.

    The warm start of a box is its dual variables: the boxes made from it begin with them.
    """

    name = "rigid"
    space_type = Rigid3D
    max_round = 512

    def __init__(
        self, space: Rigid3D, roots: Sequence[Box] | None = None, threads: int = 1
    ) -> None:
        super().__init__(space, roots, threads)
        source, k = space.clouds.source, space.n_inliers
        self._limits = Limits(
            inertia=float(np.sort((source**2).sum(axis=0))[-k:].sum()),
            drift=k * largest_subset_mean_3d(source.T, k),
            spread=float(np.linalg.eigvalsh(source @ source.T)[-1]),
        )
        self._corners = CornerValues(space.clouds, self.map_slices)

    def _evaluate(
        self,
        lower: np.ndarray,
        upper: np.ndarray,
        cutoff: float | None,
        warm_start: np.ndarray | None,
    ) -> Evaluation:
        count, most = len(lower), self._corners.most_boxes
        if warm_start is None:
            warm_start = np.zeros((count, self.space.n_target), np.uint16)
        enough = np.inf if cutoff is None else cutoff
        parts = [
            self._evaluate_part(lower[part], upper[part], enough, warm_start[part])
            for part in (slice(at, at + most) for at in range(0, count, most))
        ]
        bounds, thetas, values = map(np.concatenate, zip(*parts, strict=True))
        return Evaluation(bounds, thetas, values, warm_start)

    def _evaluate_part(
        self, lower: np.ndarray, upper: np.ndarray, cutoff: float, prices: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Bound boxes, as many as the cache has room for; `prices` is updated in place."""
        count, space, corners = len(lower), self.space, self._corners
        found = room_for_findings(prices)
        corners.make_room(count)
        self.map_slices(
            count,
            lambda part: bound_boxes(
                lower[part], upper[part], cutoff, space.clouds, self._limits, corners.known,
                found.part(part),
            ),
        )  # fmt: skip
        corners.raise_bounds(lower, upper, cutoff, found)
        thetas = 0.5 * (lower + upper)
        self._look_at_best(thetas, found.guesses, found.values)
        return found.bounds, thetas, found.values

    def _look_at_best(self, thetas: np.ndarray, guesses: np.ndarray, values: np.ndarray) -> None:
        """The objective where it may be least."""
        best = int(np.argmin(guesses))
        if guesses[best] < values.min():
            values[best] = self.space.objective(thetas[best])[0]
            self.n_assignments += 1
