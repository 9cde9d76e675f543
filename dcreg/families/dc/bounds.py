"""DC bounds over shared vertex values: one assignment a lattice vertex instead of one a box vertex.

For any linearisation point theta0 the DC bound of a box is

    LB(M; theta0) = min_{v in V(M)} min_P sum p_ij [ E_ij(v) - R_i(v - theta0) ].

The costs E_ij(v) do not depend on the box, and R_i charges whole rows. So one exact assignment at a
vertex, kept with its dual profile r (`dcreg.families.similarity2d.kernels.profiles`), bounds the inner minimum for every
box that has the vertex and for every theta0. A bisection needs its new vertices only, and theta0 may be
moved to where the bound is greatest without any assignment. Most vertices need no assignment either: the
mean of the neighbours' duals gives a profile nearly as good, and only where such a vertex limits a box
that is not yet pruned is it solved. Derived in this project, not in the paper.

In norm space R_i is the same for all i, so that the values alone give every bound exactly; they are
cheap, and all are solved.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dcreg.families.dc.kernels.bounds import edge_bound, paper_bound
from dcreg.families.dc.space import FeatureSpace
from dcreg.families.dc.vertex_cache import VertexCache
from dcreg.families.protocol import SpaceBound
from dcreg.families.similarity2d.kernels.bounds import Boxes, Effort, exact_bounds, shared_bounds
from dcreg.families.similarity2d.kernels.profiles import (
    blend_prices,
    boxes_of,
    estimate_vertices,
    solve_vertices,
)
from dcreg.families.translation3d.kernels.bounds import centre_bounds, tight_bounds
from dcreg.families.translation3d.space import Translation3D
from dcreg.search import Box, Evaluation


class PaperBound(SpaceBound[FeatureSpace]):
    """Tangent of the convex part at the box centre, minimised over all 2^d vertices.

    E_ij is convex minus convex; replacing its convex part by the tangent at the centre theta0 leaves

        LB(M) = min_{v in V(M)} min_P sum p_ij [ E_ij(v) - R_i(v - theta0) ],

    because the tangent misses exactly R_i = |J_i delta|^2 and a concave function is least at a
    vertex. One k-assignment a vertex; the loss is of second order in the box width.
    """

    def _evaluate(
        self, lower: np.ndarray, upper: np.ndarray, cutoff: float, thorough: bool
    ) -> Evaluation:
        found = Evaluation(np.empty(len(lower)), np.empty_like(lower), np.empty(len(lower)))

        def work(part: slice) -> int:
            return paper_bound(
                self.space.points,
                lower[part],
                upper[part],
                found.lower_bounds[part],
                found.thetas[part],
                found.values[part],
            )

        self._run(work, len(lower))
        return found


class EdgeBound(SpaceBound[FeatureSpace]):
    """``min_P sum p_ij d(feature interval of x_i over the box, y_j)^2``; never negative.

    Interval arithmetic on each feature (as in Go-ICP and GoTS, but one-to-one). First order in the box
    width, yet on large boxes stronger than the DC bound, which is very negative there. Its candidate
    is the box centre.
    """

    def _evaluate(
        self, lower: np.ndarray, upper: np.ndarray, cutoff: float, thorough: bool
    ) -> Evaluation:
        space = self.space
        bounds, values = np.empty(len(lower)), np.empty(len(lower))
        centres = 0.5 * (lower + upper)

        def work(part: slice) -> int:
            spent = edge_bound(space.points, lower[part], upper[part], bounds[part])
            return spent + space.objectives(centres[part], values[part])

        self._run(work, len(lower))
        return Evaluation(bounds, centres, values)


class SharedBound(SpaceBound[FeatureSpace]):
    """The paper's linearisation at the box centre, over shared vertex values."""

    moves = 0

    def __init__(
        self, space: FeatureSpace, roots: Sequence[Box] | None = None, threads: int = 1
    ) -> None:
        super().__init__(space, roots, threads)
        self.in_norm_space = isinstance(space, Translation3D)
        sizes = (0, 0) if self.in_norm_space else (space.n_source, space.n_target)
        self.cache = VertexCache(self.roots, *sizes)
        self.loss_weights = space.n_inliers * space.axis_weights**2

    def _evaluate(
        self, lower: np.ndarray, upper: np.ndarray, cutoff: float, thorough: bool
    ) -> Evaluation:
        slots, before = self.cache.find(lower, upper)
        if self.in_norm_space:
            bounds = self._bound_norms(slots, before, lower, upper, cutoff, thorough)
        else:
            bounds = self._bound_plane(slots, before, lower, upper, cutoff, thorough)
        best = np.where(slots >= 0, self.cache.values[slots], np.inf).argmin(axis=1)
        best = slots[np.arange(len(slots)), best]
        return Evaluation(bounds, self.cache.thetas[best], self.cache.values[best])

    def _bound_norms(
        self,
        slots: np.ndarray,
        before: int,
        lower: np.ndarray,
        upper: np.ndarray,
        cutoff: float,
        thorough: bool,
    ) -> np.ndarray:
        cache, space, bounds = self.cache, self.space, np.empty(len(lower))

        def solve(part: slice) -> int:
            new = slice(before + part.start, before + part.stop)
            return space.objectives(cache.thetas[new], cache.values[new])

        def bound(part: slice) -> int:
            boxes = lower[part], upper[part], slots[part]
            if self.moves == 0:
                return centre_bounds(cache.values, space.n_inliers, *boxes, bounds[part])
            known = cache.thetas, cache.values
            return tight_bounds(space.points, known, *boxes, cutoff, thorough, bounds[part])

        self._run(solve, cache.used - before)
        self._run(bound, len(lower))
        return bounds

    def _bound_plane(
        self,
        slots: np.ndarray,
        before: int,
        lower: np.ndarray,
        upper: np.ndarray,
        cutoff: float,
        thorough: bool,
    ) -> np.ndarray:
        self._estimate(slots, before)
        boxes = Boxes(
            lower, upper, slots, 0.5 * (lower + upper),
            np.empty(len(lower)), np.empty(len(lower), np.int64),
        )  # fmt: skip
        floor = -np.inf if thorough else cutoff
        effort = Effort(self.loss_weights, self.moves, floor, cutoff)
        rows = np.arange(len(lower))
        while rows.size:
            self._bound(boxes, rows, effort)
            # where an estimate limits a box that is not pruned yet, the vertex is solved
            estimated = np.isinf(self.cache.values[boxes.binding[rows]])
            rows = rows[(boxes.bounds[rows] < cutoff) & estimated]
            which = np.unique(boxes.binding[rows])
            self._blend(slots, which, settled=0)
            self._solve(which, warm=True)
        self._tighten(slots, boxes.points, cutoff, boxes.bounds)
        return boxes.bounds

    def _estimate(self, slots: np.ndarray, before: int) -> None:
        """Lower bounds at the vertices from `before` on; values where no neighbour is known."""
        new = np.arange(before, self.cache.used)
        known = self._blend(slots, new, settled=before)
        self._solve(new[~known], warm=False)
        new, vertices = new[known], self.cache.vertices

        def work(part: slice) -> int:
            estimate_vertices(self.space.points, vertices, new[part])
            return 0

        self._run(work, new.size)

    def _blend(self, slots: np.ndarray, which: np.ndarray, settled: int) -> np.ndarray:
        """Prices from neighbours; False where there are none."""
        known = np.zeros(which.size, np.bool_)
        if not which.size:
            return known
        start, boxes = boxes_of(slots, which)
        vertices = self.cache.vertices

        def work(part: slice) -> int:
            known[part] = blend_prices(
                vertices, self.loss_weights, slots, which[part], start[part.start :], boxes, settled
            )
            return 0

        self._run(work, which.size)
        return known

    def _solve(self, which: np.ndarray, warm: bool) -> None:
        """Exact values at the vertices `which`."""
        vertices = self.cache.vertices

        def work(part: slice) -> int:
            return solve_vertices(self.space.points, vertices, warm, which[part])

        self._run(work, which.size)

    def _bound(self, boxes: Boxes, rows: np.ndarray, effort: Effort) -> None:
        """Bounds of some of the boxes."""
        some = Boxes(*(array[rows] for array in boxes))
        vertices = self.cache.vertices

        def work(part: slice) -> int:
            return shared_bounds(
                self.space.points, vertices, effort, Boxes(*(array[part] for array in some))
            )

        self._run(work, rows.size)
        boxes.points[rows], boxes.bounds[rows] = some.points, some.bounds
        boxes.binding[rows] = some.binding

    def _tighten(
        self, slots: np.ndarray, points: np.ndarray, cutoff: float, bounds: np.ndarray
    ) -> None:
        """Nothing: profiles are all this bound uses."""


class TightBound(SharedBound):
    """Shared vertex values and the linearisation point that makes the bound greatest.

    In norm space also with the curvature of E in the box (`dcreg.families.translation3d.kernels.curvature`).
    """

    moves = 2


class TightExactBound(TightBound):
    """`TightBound`, then the exact assignment of ``E_ij(v) - R_i`` at the vertices that limit a box.

    A profile charges the rows of one matching; where few of many points are matched (k < n) another
    matching may suffer less from the charge, and only an assignment of its own tells. In norm space there
    is nothing to gain.
    """

    def _tighten(
        self, slots: np.ndarray, points: np.ndarray, cutoff: float, bounds: np.ndarray
    ) -> None:
        weak = np.flatnonzero(bounds < cutoff)
        raised, vertices = bounds[weak], self.cache.vertices

        def work(part: slice) -> int:
            rows = weak[part]
            return exact_bounds(
                self.space.points, vertices, cutoff, slots[rows], points[rows], raised[part]
            )

        self._run(work, weak.size)
        bounds[weak] = raised
