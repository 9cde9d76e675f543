"""Bounds over boxes of rigid poses.

The objective and the boxes are those of `dcreg.families.rigid3d.space`. The bounds are lower bounds on
the minimum of E over a box of quaternions times a box of translations with centres R_c and t_c. Below,
x_i stands for R_c x_i and y_j for y_j - t_c, so the centre of the box is (R, t) = (I, 0). The
translation lies within half-widths h, with rho = |h|. The r_a are the Gibbs vectors (axis times the
tangent of half the angle) of the vertices of the quaternion box, relative to its centre.

Rotations of a box
------------------
Relative to the centre, a quaternion vertex v_a becomes p_a = v_a conj(q_c), and q = sum c_a v_a with c
>= 0 becomes p = sum c_a p_a. If all p_a,w > 0, the Gibbs vector (p_x, p_y, p_z) / p_w of p is the
convex combination of the r_a with weights c_a p_a,w / p_w. The Gibbs vectors of the box therefore lie
in the convex hull of the r_a, and no rotation angle exceeds 2 atan(max |r_a|). Otherwise the angle is
at most pi.

First bound: displacements to the centre
----------------------------------------
This bound holds for the optima in the box, which is all that a search needs. Let (R*, t*) in the box be
the best pose for its matching P*, with residuals e_i = R* x_i + t* - y_i, and let u_i be the
displacement of x_i from there to the centre. The translation and the rotation are both stationary, so
sum p e = 0 and sum p x' x e = 0 for x' = R* x_i. Hence the inner product of the residuals with the
displacements vanishes up to terms of second order in the angle. With c_ij = |x_i - y_j|^2 and w the
angle between R* and R_c,

    sum p c  =  sum p |e + u|^2  <=  E* + sum p |u|^2 + 2 (1 - cos w) sqrt(E*) sqrt(sum p |x|^2).

For a Gibbs vector r and a shift s of the translation the displacement is 2 r x x + s up to second
order. The sum of its squares is at most that of |2 r x x + s|^2 plus 4 |r|^2 / sqrt(1 + |r|^2) |s| |sum
p x|. The former is convex in (r, s), so its maximum is attained at a vertex (r_a, +-h). Let C be the
minimum of sum p (c - |2 r x x + s|^2) over the matchings and the 8 x 8 vertices. Let I be the maximum
sum of squared norms of k source points, and D the maximum norm of their sum. Then

    E* + 4 |r|^2 / (1 + |r|^2) sqrt(I) sqrt(E*) + 4 |r|^2 / sqrt(1 + |r|^2) |s| D  >=  C.

The displacements belong to rows, so the dual variables b >= 0 of one matching serve all vertices: at
each, C is at least the sum of the k smallest min_j (c_ij + b_j) - |displacement_i|^2, minus the sum of
b. Good dual variables come from the parent box, as the warm start of the search. Each is multiplied by
a constant below 1, lowered as far as no row minimum decreases, and raised again by auction steps if it
is uncertain whether the bound suffices. Squares, minima and auction steps are computed in single
precision, and the bound is reduced by the possible rounding error.

Second bound: values at the vertices
------------------------------------
Balls around the centres of cubes cover six dimensions badly. Balls around the vertices may have twice
the loss. Let v be the pose at a vertex, rotated by r_a and shifted by s_b, let C_v be C at that vertex
alone, and e_v the minimum sum of costs at v. With u_v the displacements to v and w_v the angle to R_v,

    e_v  <=  E* + sum p |u_v|^2 + 2 (1 - cos w_v) sqrt(E*) sqrt(sum p |x|^2)

as above. The optimum lies at (r, s), where r is a mean of the r_a and s a mean of the s_b. Take half of
the inequality at the centre and half of its mean over the vertices, weighted by the products of the
weights of these two means. If the displacements to v were 2 (r_a - r) x x + s_b - s, the mean of their
squares would be the mean of |2 r_a x x + s_b|^2 minus |2 r x x + s|^2, and the latter is the squared
displacement to the centre. Half the mean of |2 r_a x x + s_b|^2 would remain, whatever (r, s). The
remaining terms are as follows. With d = r_a - r, and x as seen from R*,

    |R_v x - R* x|^2  =  4 |(d - r x d) x x|^2 / ((1 + |r|^2) (1 + |r_a|^2)),

because conj(q*) q_v has the vector part d - r x d for quaternions (1, r) and (1, r_a). Summed over the
pairs this is at most 4 (d.J d + |r| |d|^2 S + |r|^2 |d|^2 I), where J is the tensor of inertia and S
the difference of two eigenvalues of sum p x x^T: the vector r x d matters only as far as J is not
isotropic. The mean of |d|^2 is at most tau^2 - |r|^2 with tau = max |r_a|. Shifts and rotations do not
mix, because the mean of s_b - s is 0, and 1 - cos w_v <= 2 |d|^2. With u = |r| / tau therefore

    E* + 2 tau^2 sqrt(I) sqrt(E*)
       + max over u in [0, 1] of 2 tau^2 (|s| D u^2 + (tau S u + tau^2 I u^2) (1 - u^2))
        >=  min over v of (C_v + e_v) / 2,

where D and I are those of the first bound. The terms of S and I are 0 at the vertices, where that of D
is greatest. If e_v is unknown, E* may replace it, because no pose is
better for P*. C_v then has to reach the required value itself, with twice the loss. A value at a vertex
serves all boxes that have it, up to 64, and their children. It is computed like that of a centre, from
the dual variables of the first box that requests it. A box first requests the values at few vertices,
those of smallest C_v. It requests all of them only if none of the values decides.

Spherical caps
--------------
Caps serve wide boxes, whose rotations are too far from the centre for the bounds above. They come first
if there are so few pairs that an assignment takes no longer than the dual variables. Rotated by at most
an angle, x_i stays on a spherical cap. With d_ij the distance of y_j from the cap and rho = |h|, |R x_i
+ t - y_j| >= d_ij - rho holds everywhere. Because the best translation for R* and P* is a mean,

    E* + k |t_c - t*|^2  =  E_P*(R*, t_c)  >=  min_P sum p_ij d_ij^2.

Both sums are bounded by the minima of the rows (`nearest_sums`), the second also by an assignment. If
the box contains all rotations, d_ij is the norm distance ||x_i| - |y_j|| of the paper's Case II.

Third bound: Cayley's form
--------------------------
R = (I - [r])^-1 (I + [r]) for Gibbs vector r. For any vector v, |(I - [r]) v|^2 = |v|^2 + |r x v|^2 <=
(1 + |r|^2) |v|^2. With v = R x + t - y,

    (I - [r]) v = (I + [r]) x + (I - [r]) (t - y) = x - y + s + r x (x + y),    s = t - r x t,

    (1 + |r|^2) |R x + t - y|^2  >=  |x - y + s + r x (x + y)|^2.

The right side is the square of a residual that is linear in delta = (r, s), where s lies in the box of
half-widths h'_c = h_c + max |r x t|_c. The only loss is |r|^2 times the residual, which is small if E
is small. Squares are convex: with e = x - y + s0 + r0 x (x + y) at any delta0 the right side is at
least

    |e|^2 + 2 e.(s - s0) + 2 ((x + y) x e).(r - r0),

which is affine in delta. Its minimum over the matchings is concave, so over conv{r_a} times the box of
s it is attained at one of 8 x 8 vertices. Divided by 1 + max |r_a|^2 and clipped at 0 it bounds E, for
every delta0. The best delta0 is the least-squares fit of a good matching within the box: as long as
that matching remains the best one at the vertices, the bound is the exact minimum of its sum over the
box, and the curvature of E causes no loss. This is DC-Reg's linearisation, with the point chosen as in
its 2D case. As in `dcreg.families.rotation3d.bound`, a vertex is bounded by dual variables and solved
only if it is binding.

The bound of a box is the maximum of these bounds; the last one is evaluated for small boxes only. For a
single pose the first bound equals E.

Feasible pairs
--------------
The cost of an infeasible pair is increased by a constant, in E and in every cost above. The costs of
feasible matchings do not change, so the minimum over all matchings is no more than the minimum over the
feasible ones, and the bounds hold for any constant. E itself must use no infeasible pair, so the
constant exceeds k squared residuals at any pose of the start box
(`dcreg.families.pairs.infeasibility_penalty`).

Weighted points
---------------
Weights w_ij <= 1 multiply the cost of each pair, with the addition above. Stationary means sum p w e = 0
and sum p w x' x e = 0, and all inequalities hold with p w in place of p. Displacements and norms are
multiplied by the maximum weight of their row. See "Weighted points" in ``docs/bounds.md``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Self

import numpy as np

from dcreg.families.protocol import SpaceBound, rows_of
from dcreg.families.rigid3d.kernels.boxes import (
    FEW_PAIRS,
    Found,
    allocate_found,
    bound_boxes,
    bound_boxes_by_duals,
)
from dcreg.families.rigid3d.kernels.dual_bounds import allocate_workspace
from dcreg.families.rigid3d.kernels.stationary import Limits
from dcreg.families.rigid3d.space import Rigid3D, largest_subset_mean_3d
from dcreg.families.rigid3d.vertex_values import VertexValues
from dcreg.search import Box, Boxes, Evaluation

# A box gets an exact assignment at its centre if its displacements cost less than SMALL times the cutoff.
# This takes as long as dozens of bounds by duals. If less than PAYING of at least ENOUGH such boxes were
# pruned, as where many points have no partner, SMALLER replaces SMALL.
SMALL, SMALLER, ENOUGH, PAYING = 1.0, 0.03, 200, 0.2


class RigidBound(SpaceBound[Rigid3D]):
    """The maximum of the bounds in the module's docstring, over boxes of poses.

    The warm start of a box consists of the dual variables of its parent.
    """

    name = "rigid"
    space_type = Rigid3D
    # Each round solves an exact assignment in one thread, which takes as long as many bounds.
    round_pairs, max_round = 64_000_000, 1024

    def __init__(
        self, space: Rigid3D, roots: Sequence[Box] | None = None, threads: int = 1
    ) -> None:
        super().__init__(space, roots, threads)
        k, points = space.n_inliers, space.clouds.source
        source = points * np.sqrt(space.clouds.heaviest)
        self._limits = Limits(
            inertia=float(np.sort((source**2).sum(axis=0))[-k:].sum()),
            drift=k * largest_subset_mean_3d(points.T, k, space.lightest),
            spread=float(np.linalg.eigvalsh(source @ source.T)[-1]),
        )
        few = space.n_pairs <= FEW_PAIRS
        self._vertices = None if few else VertexValues(space.clouds, self.map_slices)
        # boxes with an exact assignment at their centre, and those of them that were pruned
        self._solved = self._pruned = 0
        self.stored = None if few else self

    def fresh(self) -> Self:
        """Return the same bound with its present choice of boxes for exact assignments."""
        fresh = super().fresh()
        fresh._solved, fresh._pruned = self._solved, self._pruned
        return fresh

    def state(self) -> dict[str, Any]:
        """Return what is remembered about boxes; see `dcreg.search.Stored`."""
        assert self._vertices is not None
        return {"solved": (self._solved, self._pruned), "vertices": self._vertices.state()}

    def restore(self, state: dict[str, Any]) -> None:
        assert self._vertices is not None
        self._solved, self._pruned = state["solved"]
        self._vertices.restore(state["vertices"])

    def _evaluate(self, boxes: Boxes, cutoff: float | None) -> Evaluation:
        count = len(boxes)
        most = max(1, count) if self._vertices is None else self._vertices.most_boxes
        duals = boxes.warm_start
        if duals is None:
            duals = np.zeros((count, self.space.n_target), np.uint16)
        result = Evaluation(np.empty(count), boxes.centres, np.empty(count), duals)
        enough = np.inf if cutoff is None else cutoff
        for part in (slice(at, at + most) for at in range(0, count, most)):
            found = self._evaluate_part(boxes[part], enough, duals[part])
            result.lower_bounds[part] = np.maximum(found.bounds, 0.0)
            result.values[part] = found.values
        return result

    def _evaluate_part(self, boxes: Boxes, cutoff: float, duals: np.ndarray) -> Found:
        """Bound as many boxes as fit into the cache; update `duals` in place."""
        space, vertices, found = self.space, self._vertices, allocate_found(duals)
        clouds, limits = space.clouds, self._limits
        pays = self._solved < ENOUGH or self._pruned >= PAYING * self._solved
        small = SMALL if pays else SMALLER

        def work(part: slice) -> int:
            lower, upper, rows = boxes.lower[part], boxes.upper[part], rows_of(found, part)
            if vertices is not None:
                workspace = allocate_workspace(space.n_source, space.n_target)
                bound_boxes_by_duals(lower, upper, cutoff, small, clouds, limits, rows, workspace)
            spent: int = bound_boxes(lower, upper, cutoff, clouds, limits, rows)
            return spent

        self.map_slices(len(boxes), work)
        if vertices is not None:
            if cutoff < np.inf:
                solved = np.isfinite(found.values)
                self._solved += int(solved.sum())
                self._pruned += int((found.bounds[solved] >= cutoff).sum())
            vertices.raise_bounds(boxes, cutoff, found)
        self._look_at_best(boxes.centres, found.estimates, found.values)
        return found

    def _look_at_best(self, thetas: np.ndarray, estimates: np.ndarray, values: np.ndarray) -> None:
        """Compute the objective where its estimate is smallest."""
        best = int(np.argmin(estimates))
        if estimates[best] < values.min():
            values[best] = self.space.objective(thetas[best])[0]
            self.n_assignments += 1
