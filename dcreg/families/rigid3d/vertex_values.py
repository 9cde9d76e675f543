"""Values at the vertices of boxes of poses, shared by all boxes that have them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from dcreg.families.kernels import Clouds
from dcreg.families.protocol import rows_of
from dcreg.families.rigid3d.kernels.boxes import Found
from dcreg.families.rigid3d.kernels.dual_bounds import allocate_workspace
from dcreg.families.rigid3d.kernels.vertices import (
    VERTICES,
    VertexRequests,
    VertexTable,
    bound_vertices_by_duals,
    bounds_by_vertices,
    judge_boxes,
    request_values,
)
from dcreg.search import Boxes

# Numbers of vertices that a box requests, in turn, until a value decides.
_REQUESTED = 1, 4, VERTICES, VERTICES
_REMEMBERED = 2**21  # maximum number of stored vertices, 73 bytes each; then all are dropped


class VertexValues:
    """Values by slot, found by the pose of the vertex.

    Parameters
    ----------
    clouds : Clouds
    map_slices : callable
        That of a `SpaceBound`.

    Attributes
    ----------
    most_boxes : int
        Maximum number of boxes in one call of `raise_bounds`.
    """

    def __init__(
        self, clouds: Clouds, map_slices: Callable[[int, Callable[[slice], int]], None]
    ) -> None:
        self._clouds, self._map_slices = clouds, map_slices
        self.most_boxes = _REMEMBERED // VERTICES
        self._used = 0
        self.known = VertexTable(
            np.full(2 * _REMEMBERED, -1, np.int32),
            np.empty((_REMEMBERED, 7)),
            np.empty(_REMEMBERED),
            np.empty(_REMEMBERED, np.bool_),
        )
        # Compile now, because the first vertices may be evaluated late in a search, with no time left.
        requests = VertexRequests(np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0))
        self._compute(requests, np.empty((0, clouds.target.shape[1]), np.uint16))

    def state(self) -> dict[str, Any]:
        """Return the values; see `dcreg.search.Stored`."""
        table, *arrays = self.known
        places = np.flatnonzero(table >= 0)
        return {
            "used": self._used, "places": places, "slots": table[places],
            "arrays": [array[: self._used] for array in arrays],
        }  # fmt: skip

    def restore(self, state: dict[str, Any]) -> None:
        """Replace the values by saved ones."""
        table, *arrays = self.known
        self._used = state["used"]
        table[:] = -1
        table[state["places"]] = state["slots"]
        for array, saved in zip(arrays, state["arrays"], strict=True):
            array[: self._used] = saved

    def _compute(self, requests: VertexRequests, kept: np.ndarray) -> int:
        """Compute the requested values from the duals `kept` of the boxes; return 0 assignments."""
        work = allocate_workspace(self._clouds.source.shape[1], self._clouds.target.shape[1])
        bound_vertices_by_duals(self.known, requests, kept, self._clouds, work)
        return 0

    def raise_bounds(self, boxes: Boxes, cutoff: float, found: Found) -> None:
        """Raise the bounds of the boxes that vertex values prune."""
        most = VERTICES * len(boxes)
        if self._used + most > len(
            self.known.values
        ):  # the memory is full, so all values are dropped
            self.known.table[:] = -1
            self._used = 0
        requests = VertexRequests(
            np.empty(most, np.int64), np.empty(most, np.int64), np.empty(most)
        )

        def judge(part: slice) -> int:
            lower, upper, states = boxes.lower[part], boxes.upper[part], rows_of(found.boxes, part)
            judge_boxes(self.known, lower, upper, states, cutoff)
            return 0

        self._map_slices(len(boxes), judge)
        for most_each in _REQUESTED:
            self._used, count = request_values(
                self.known, self._used, boxes.lower, boxes.upper, found.boxes, cutoff, most_each,
                requests,
            )  # fmt: skip
            if not count:
                break  # no undecided box has a vertex without a value
            self._map_slices(count, lambda part: self._compute(rows_of(requests, part), found.kept))
            self._map_slices(len(boxes), judge)
        bounds_by_vertices(self.known, found.boxes, cutoff, found.bounds)
