"""The boxes that a search has still to divide."""

from __future__ import annotations

import numpy as np

from dcreg.kernels import heap


class OpenNodes:
    """Open boxes, best lower bound first; among equals the larger box, then the older."""

    def __init__(self, dim: int, capacity: int = 64) -> None:
        self._lower, self._upper = np.empty((capacity, dim)), np.empty((capacity, dim))
        self._hints = np.empty((capacity, 0), np.uint16)
        self._bounds, self._sizes = np.empty(capacity), np.empty(capacity)
        self._serials = np.empty(capacity, np.int64)
        self._heap = np.empty(capacity, np.int64)
        self._free = np.arange(capacity)  # slots; the first _length of them are taken
        self._length = 0
        self._serial = 0

    def __len__(self) -> int:
        return self._length

    @property
    def nbytes(self) -> int:
        """Memory of the boxes held."""
        hints = self._hints.itemsize * self._hints.shape[1]
        return self._length * (16 * self._lower.shape[1] + 40 + hints)

    @property
    def lower_bound(self) -> float:
        return float(self._bounds[self._heap[0]]) if self._length else np.inf

    def push(
        self,
        lower: np.ndarray,
        upper: np.ndarray,
        bounds: np.ndarray,
        hints: np.ndarray | None = None,
    ) -> None:
        """Add boxes; with hints, all boxes of a search or none of them."""
        count = len(bounds)
        if hints is not None and not self._length and hints.shape[1] != self._hints.shape[1]:
            self._hints = np.empty((len(self._heap), hints.shape[1]), hints.dtype)
        while self._length + count > len(self._heap):
            self._double()
        slots = self._free[self._length : self._length + count]
        self._lower[slots], self._upper[slots], self._bounds[slots] = lower, upper, bounds
        if hints is not None:
            self._hints[slots] = hints
        self._sizes[slots] = (upper - lower).sum(axis=1)
        self._serials[slots] = np.arange(self._serial, self._serial + count)
        self._serial += count
        self._length = heap.push(
            self._heap, self._length, slots, self._bounds, self._sizes, self._serials
        )

    def pop(
        self, count: int, cutoff: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray | None]:
        """Up to `count` best boxes whose bound lies below `cutoff`: corners, bounds, hints."""
        slots = np.empty(count, np.int64)
        taken = heap.pop(
            self._heap, self._length, cutoff, self._bounds, self._sizes, self._serials, slots
        )
        slots = slots[:taken]
        self._length -= taken
        self._free[self._length : self._length + taken] = slots
        hints = self._hints[slots] if self._hints.shape[1] else None
        return self._lower[slots], self._upper[slots], self._bounds[slots], hints

    def _double(self) -> None:
        capacity = len(self._heap)
        boxes = ("_lower", "_upper", "_hints", "_bounds", "_sizes", "_serials")
        for name in (*boxes, "_heap", "_free"):
            old = getattr(self, name)
            setattr(self, name, np.concatenate([old, np.empty_like(old)]))
        self._free[capacity:] = np.arange(capacity, 2 * capacity)
