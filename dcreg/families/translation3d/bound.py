"""DC bounds over translations in norm space, from shared vertex values.

Here the linearisation gap R_i is the same for all rows, so the values at the vertices alone give every
bound of `dcreg.families.dc.bounds` exactly. A value is cheap, and all of them are computed.
"""

from __future__ import annotations

import numpy as np

from dcreg.families.dc.bounds import SharedVertexBound
from dcreg.families.translation3d.kernels.bounds import centre_bounds, tight_bounds
from dcreg.families.translation3d.space import Translation3D
from dcreg.search import Boxes


class SharedBound(SharedVertexBound[Translation3D]):
    """The paper's linearisation at the box centre, over shared vertex values."""

    name = "shared"
    space_type = Translation3D

    def _bound_boxes(
        self, boxes: Boxes, slots: np.ndarray, first_new: int, cutoff: float | None
    ) -> np.ndarray:
        cache, space, bounds = self.cache, self.space, np.empty(len(boxes))

        def solve(part: slice) -> int:
            new = slice(first_new + part.start, first_new + part.stop)
            return space.objectives(cache.thetas[new], cache.values[new])

        def bound(part: slice) -> int:
            return self._bound(boxes[part], slots[part], cutoff, bounds[part])

        self.map_slices(cache.used - first_new, solve)
        self.map_slices(len(boxes), bound)
        return bounds

    def _bound(
        self, boxes: Boxes, slots: np.ndarray, cutoff: float | None, bounds: np.ndarray
    ) -> int:
        values, k = self.cache.values, self.space.n_inliers
        return centre_bounds(values, k, boxes.lower, boxes.upper, slots, bounds)


class TightBound(SharedBound):
    """The best linearisation point, and the curvature of E in the box.

    The curvature is that of `dcreg.families.translation3d.kernels.curvature`.
    """

    name = "tight"

    def _bound(
        self, boxes: Boxes, slots: np.ndarray, cutoff: float | None, bounds: np.ndarray
    ) -> int:
        known, thorough = (self.cache.thetas, self.cache.values), cutoff is None
        return tight_bounds(
            self.space.clouds, known, boxes.lower, boxes.upper, slots,
            np.inf if thorough else cutoff, thorough, bounds,
        )  # fmt: skip
