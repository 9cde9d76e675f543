"""Bounds over boxes of similarities in 3D.

The objective and the boxes are those of `dcreg.families.similarity3d.space`. The bounds are lower bounds
on the minimum of E over a box of quaternions, of translations and of scales. They follow the bounds of
`dcreg.families.rigid3d.bound`, whose notation is used here. Let s_c be the scale that represents the box,
R_c and t_c its centre. Below, x_i stands for s_c R_c x_i and y_j for y_j - t_c. The poses of the box are
x -> sigma R x + t with sigma in [a, b], where a <= 1 <= b, with rotations R of Gibbs vectors in the
convex hull of the r_a, which contains 0, and with |t| <= rho.

All points match
----------------
If only rotations are searched, E = S_yy + s^2 S_xx - 2 s G, and the maximum of G decides. For a fixed
scale s_0, let L be the bound over rigid poses for the source s_0 x. The pair (R*, P*) of an optimum
maximises G, so it is also an optimum of that rigid problem. Therefore, if R* is in the box,

    s_0^2 S_xx + S_yy - 2 s_0 G  >=  L,    G  <=  (s_0^2 S_xx + S_yy - L) / (2 s_0) = G_L,

and E* >= min over the scales s of the range of S_yy + s^2 S_xx - 2 s G_L.

Spherical shells
----------------
Turned by at most an angle and scaled by [a, b], x_i stays on a part of a spherical shell. With d_ij the
distance of y_j from it, |sigma R x_i + t - y_j| >= d_ij - rho everywhere. Because the best translation
for a scale, a rotation and a matching is a mean, E* + k rho^2 >= min_P sum p_ij d_ij^2, as for caps. For
d_ij, the largest inner product of y_j with a turned x_i is the best one for every scale. The squared
distance is then a parabola in the scale, and the best scale is that of its vertex, clipped to [a, b].

Displacements
-------------
Let (sigma, R, t) be an optimum in the box with matching P and residuals e_i = sigma R x_i + t - y_i, and
x'_i = R x_i. It is stationary in translation and rotation, so sum p e = 0 and sum p x' x e = 0. Let G' =
sum p e.x', which is proportional to the derivative of E with respect to the scale. G' = 0 if the scale
is inside its range.

Conversely x_i = Q x'_i, where Q is a rotation by the angle w about a unit vector v, and Q = cos w Id +
sin w [v] + (1 - cos w) v v^T. Let u_i = x_i - sigma x'_i - t be the displacement of the point from the
optimum to the centre of the box. As the first two sums vanish,

    sum p e.u  =  (cos w - sigma) G' + (1 - cos w) sum p (e.v)(x'.v).

s_c is the middle of the scales of the box. If the box contains one end of the range, s_c is this end
instead. Then either G' = 0, or the optimum is at this end and sigma = 1. In the second case both terms
together are -(1 - cos w) sum p e.(Id - v v^T) x'. So in both cases sum p e.u <= (1 - cos w) sqrt(E*)
sqrt(sum p |x|^2), and with c_ij = |x_i - y_j|^2,

    sum p c  =  sum p |e + u|^2  <=  E* + sum p |u|^2 + 2 (1 - cos w) sqrt(E*) sqrt(sum p |x|^2).

A box that contains both ends of a range with low < high is bounded by shells only. If low = high, sigma
is 1 and the second case holds.

For a Gibbs vector r, x - sigma R x has the squared norm (1 - sigma)^2 |x|^2 + 4 sigma |r x x|^2 / (1 +
|r|^2). Its inner product with t differs from that of -(sigma - 1) x - 2 sigma r x x by at most 2 sigma
|r|^2 (1 + |r|^2)^(-1/2) |t| |x|, also for sums over pairs. With X = sum p x, therefore,

    sum p |u|^2  <=  sum p [(sigma - 1)^2 |x|^2 + |2 sqrt(sigma) r x x + t|^2]
                     + |t| |X| [2 |sigma - 1| + 4 |sigma - sqrt(sigma)| |r| + 4 sigma |r|^2 / sqrt(1 +
                     |r|^2)].

sqrt(sigma) r lies in the convex hull of the sqrt(b) r_a, and the squared norm is convex, so its maximum
is at one of the 8 x 8 vertices. The matching enters by rows only, and the dual variables of an
assignment at the centre serve all vertices. The bound is of second order in all seven dimensions.

Feasible pairs and weights are handled as in `dcreg.families.rigid3d.bound`. With weights, G' = sum p w
e.x' is the derivative with respect to the scale, so all steps hold with p w instead of p.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dcreg.families.protocol import SpaceBound
from dcreg.families.rigid3d.bound import RigidBound
from dcreg.families.rigid3d.kernels.stationary import Limits
from dcreg.families.rigid3d.space import Rigid3D, largest_subset_mean_3d
from dcreg.families.similarity3d.kernels.boxes import bound_similarities
from dcreg.families.similarity3d.space import SCALE, Similarity3D
from dcreg.search import Box, Boxes, Evaluation, Stored

_ROUNDING = 8.0 * np.finfo(float).eps  # relative, of sums of squares that are subtracted


class SimilarityBound(SpaceBound[Similarity3D]):
    """The maximum of the bounds in the module's docstring, over boxes of similarities."""

    name = "similarity"
    space_type = Similarity3D
    max_round = 512

    def __init__(
        self, space: Similarity3D, roots: Sequence[Box] | None = None, threads: int = 1
    ) -> None:
        super().__init__(space, roots, threads)
        self._rotations = _Rotations(space, threads) if space.only_rotates else None
        self.stored = None if self._rotations is None else self._rotations.stored
        k, points = space.n_inliers, space.clouds.source
        source = points * np.sqrt(space.clouds.heaviest)
        self._limits = Limits(
            inertia=float(np.sort((source**2).sum(axis=0))[-k:].sum()),
            drift=k * largest_subset_mean_3d(points.T, k, space.lightest),
            spread=0.0,  # not used
        )

    def _evaluate(self, boxes: Boxes, cutoff: float | None) -> Evaluation:
        if self._rotations is not None:
            known = self._rotations.n_assignments
            found = self._rotations.evaluate(boxes, cutoff)
            self.n_assignments += self._rotations.n_assignments - known
            return found
        found, enough = Evaluation.empty(boxes), np.inf if cutoff is None else cutoff
        scales = self._scales(boxes)
        found.thetas[:, SCALE] = np.where(np.isnan(scales), found.thetas[:, SCALE], scales)

        def work(part: slice) -> int:
            spent: int = bound_similarities(
                boxes.lower[part], boxes.upper[part], enough, self.space.clouds, self._limits,
                scales[part], found.lower_bounds[part], found.values[part],
            )  # fmt: skip
            return spent

        self.map_slices(len(boxes), work)
        return found

    def _scales(self, boxes: Boxes) -> np.ndarray:
        """Return the scale that represents each box; NaN if it contains both ends of the range."""
        low, high = self.space.scale_range
        least, most = boxes.lower[:, SCALE], boxes.upper[:, SCALE]
        at_low, at_high = least <= low, most >= high
        scales = np.where(at_low, least, np.where(at_high, most, 0.5 * (least + most)))
        return np.where(at_low & at_high & (low < high), np.nan, scales)


class _Rotations:
    """Bounds if only rotations are searched, from those over rigid poses at a fixed scale."""

    def __init__(self, space: Similarity3D, threads: int) -> None:
        source, target = space.clouds.source.T, space.clouds.target.T
        self._range, self._scale = space.scale_range, space.usual_scale
        rigid = Rigid3D(
            self._scale * source, target, space.n_inliers, space.candidates, space.stop_flag
        )
        self._bound = RigidBound(rigid, threads=threads)
        self._xx, self._yy = float((source**2).sum()), float((target**2).sum())
        self._sum = self._scale**2 * self._xx + self._yy

    @property
    def n_assignments(self) -> int:
        return self._bound.n_assignments

    @property
    def stored(self) -> Stored | None:
        """What the bounds over rigid poses remember."""
        return self._bound.stored

    def evaluate(self, boxes: Boxes, cutoff: float | None) -> Evaluation:
        rigid = Boxes(
            boxes.lower[:, :SCALE].copy(), boxes.upper[:, :SCALE].copy(), boxes.bounds,
            boxes.warm_start,
        )  # fmt: skip
        found = self._bound.evaluate(rigid, None if cutoff is None else self._rigid(cutoff))
        bounds, _ = self._best(found.lower_bounds)
        values, scales = self._best(found.values)
        # more than any pose costs: an infeasible pair, or a value that was not computed
        values[found.values > 2.0 * self._sum] = np.inf
        bounds = np.maximum(0.0, bounds - _ROUNDING * self._sum)
        return Evaluation(bounds, np.column_stack([found.thetas, scales]), values, found.warm_start)

    def _best(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the objectives and scales after the scale is fitted, from those at the fixed scale."""
        low, high = self._range
        gains = (self._sum - np.minimum(values, 1e6 * self._sum)) / (2.0 * self._scale)
        with np.errstate(over="ignore"):  # any scale fits points that coincide
            scales = np.clip(gains / max(self._xx, np.finfo(float).tiny), low, high)
        return scales * (scales * self._xx - 2.0 * gains) + self._yy, scales

    def _rigid(self, cutoff: float) -> float:
        """Return the objective at the fixed scale that corresponds to `cutoff`, rounded up."""
        (low, high), xx, yy = self._range, self._xx, self._yy
        gain = np.sqrt(max(0.0, yy - cutoff) * xx)
        if cutoff >= yy or gain < low * xx:
            gain = (yy + low * low * xx - cutoff) / (2.0 * low)
        elif gain > high * xx:
            gain = (yy + high * high * xx - cutoff) / (2.0 * high)
        return float(self._sum - 2.0 * self._scale * gain + 4.0 * _ROUNDING * self._sum)
