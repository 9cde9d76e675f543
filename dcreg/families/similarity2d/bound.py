"""DC bounds over similarities in 2D, from shared vertex values.

A vertex is kept with a dual profile (`dcreg.families.similarity2d.kernels.vertices`), which bounds the
inner minimum of `dcreg.families.dc.bounds` for every box that has the vertex and for every linearisation
point. A bisection then needs only its new vertices, and the linearisation point can be moved to the
maximum of the bound without any assignment. Most vertices need no assignment either: the mean of their
neighbours' dual variables gives a profile that is nearly as good. A vertex is solved only if it limits a
box that has not been pruned.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dcreg.families.dc.bounds import SharedVertexBound
from dcreg.families.similarity2d.kernels.vertices import (
    Effort,
    SharedBoxes,
    blend_duals,
    bound_vertices,
    shared_bounds,
)
from dcreg.families.similarity2d.space import Similarity2D
from dcreg.search import Box, Boxes


def boxes_of(slots: np.ndarray, which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the boxes that have each of the vertices `which`, which ascend.

    Those of ``which[at]`` are ``boxes[start[at] : start[at + 1]]``.
    """
    place = np.minimum(np.searchsorted(which, slots), which.size - 1)
    box, vertex = np.nonzero(which[place] == slots)
    place = place[box, vertex]
    start = np.zeros(which.size + 1, np.int64)
    np.cumsum(np.bincount(place, minlength=which.size), out=start[1:])
    return start, box[np.argsort(place, kind="stable")]


class SharedBound(SharedVertexBound[Similarity2D]):
    """The paper's linearisation at the box centre, over shared vertex values."""

    name = "shared"
    space_type = Similarity2D

    def __init__(
        self, space: Similarity2D, roots: Sequence[Box] | None = None, threads: int = 1
    ) -> None:
        super().__init__(space, roots, threads, space.n_source, space.n_target)
        self.loss_weights = (
            space.n_inliers * float(space.clouds.heaviest.mean()) * space.axis_weights**2
        )

    def _bound_boxes(
        self, boxes: Boxes, slots: np.ndarray, first_new: int, cutoff: float | None
    ) -> np.ndarray:
        self._estimate(slots, first_new)
        count = len(boxes)
        shared = SharedBoxes(
            boxes.lower,
            boxes.upper,
            slots,
            boxes.centres,
            np.empty(count),
            np.empty(count, np.int64),
        )
        floor, enough = (-np.inf, np.inf) if cutoff is None else (cutoff, cutoff)
        effort = Effort(self.loss_weights, self.moves, floor, enough)
        rows = np.arange(count)
        while rows.size:
            self._bound(shared, rows, effort)
            # an estimated vertex that limits a box which is not pruned yet is solved
            estimated = np.isinf(self.cache.values[shared.binding[rows]])
            rows = rows[(shared.bounds[rows] < enough) & estimated]
            which = np.unique(shared.binding[rows])
            self._blend(slots, which, n_fixed=0)
            self._solve(which, warm=True)
        return shared.bounds

    def _estimate(self, slots: np.ndarray, first_new: int) -> None:
        """Bound E at the vertices from `first_new` on; solve those without a known neighbour."""
        new = np.arange(first_new, self.cache.used)
        known = self._blend(slots, new, n_fixed=first_new)
        self._solve(new[~known], warm=False)
        new, clouds, vertices = new[known], self.space.clouds, self.cache.vertices

        def work(part: slice) -> int:
            bound_vertices(clouds, vertices, False, True, new[part])
            return 0

        self.map_slices(new.size, work)

    def _blend(self, slots: np.ndarray, which: np.ndarray, n_fixed: int) -> np.ndarray:
        """Set the dual variables to means of the neighbours'; False where there is no neighbour."""
        known = np.zeros(which.size, np.bool_)
        if not which.size:
            return known
        start, boxes = boxes_of(slots, which)
        vertices = self.cache.vertices

        def work(part: slice) -> int:
            known[part] = blend_duals(
                vertices, self.loss_weights, slots, which[part], start[part.start :], boxes, n_fixed
            )
            return 0

        self.map_slices(which.size, work)
        return known

    def _solve(self, which: np.ndarray, warm: bool) -> None:
        """Compute the exact values at the vertices `which`."""
        clouds, vertices = self.space.clouds, self.cache.vertices
        self.map_slices(
            which.size, lambda part: bound_vertices(clouds, vertices, True, warm, which[part])
        )

    def _bound(self, boxes: SharedBoxes, rows: np.ndarray, effort: Effort) -> None:
        """Bound some of the boxes."""
        some = SharedBoxes(*(array[rows] for array in boxes))
        clouds, vertices = self.space.clouds, self.cache.vertices
        self.map_slices(
            rows.size,
            lambda part: shared_bounds(
                clouds, vertices, effort, SharedBoxes(*(array[part] for array in some))
            ),
        )
        boxes.points[rows], boxes.bounds[rows] = some.points, some.bounds
        boxes.binding[rows] = some.binding


class TightBound(SharedBound):
    """Shared vertex values, and the linearisation point that maximises the bound."""

    name = "tight"
    moves = 2
