"""Values at the corners of the boxes of poses met so far, shared by all boxes that have them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dcreg.families.kernels import Clouds
from dcreg.families.rigid3d.kernels.corners import (
    CORNERS,
    Asked,
    Known,
    ask_for_values,
    bounds_by_corners,
    price_corners,
)
from dcreg.families.rigid3d.kernels.rigid import Found, is_small

# Corners a box asks for, time after time, as long as no value tells against it; then it is judged.
_ASKED_FOR = 1, 4, CORNERS, CORNERS, 0
_REMEMBERED = 2**21  # corners, of 73 bytes each; then all are forgotten


class CornerValues:
    """Values by slot, found by the pose of the corner.

    Parameters
    ----------
    clouds : Clouds
    map_slices : callable
        That of a `SpaceBound`.

    Attributes
    ----------
    most_boxes : int
        As many may be looked at at a time.
    """

    def __init__(
        self, clouds: Clouds, map_slices: Callable[[int, Callable[[slice], int]], None]
    ) -> None:
        self._clouds, self._map_slices = clouds, map_slices
        room = 1 if is_small(clouds) else _REMEMBERED
        self.most_boxes = _REMEMBERED // CORNERS
        self._used = 0
        self.known = Known(
            np.full(2 * room, -1, np.int32),
            np.empty((room, 7)),
            np.empty(room),
            np.empty(room, np.bool_),
        )

    def make_room(self, boxes: int) -> None:
        """Forget all values if those of so many boxes might not find room."""
        if self._used + CORNERS * boxes > len(self.known.values):
            self.known.table[:] = -1
            self._used = 0

    def raise_bounds(
        self, lower: np.ndarray, upper: np.ndarray, cutoff: float, found: Found
    ) -> None:
        """Raise the bounds of the open boxes whose corners cost enough."""
        known, most = self.known, CORNERS * len(lower)
        asked = Asked(np.empty(most, np.int64), np.empty(most, np.int64), np.empty(most))

        def price(part: slice) -> int:
            price_corners(known, asked.part(part), found.prices, self._clouds)
            return 0

        for share in _ASKED_FOR:
            self._used, count = ask_for_values(
                known, self._used, (lower, upper), found.prospects, cutoff, share, asked
            )
            if not count:  # every box is judged
                break
            self._map_slices(count, price)
        bounds_by_corners(known, found.prospects, cutoff, found.bounds)
