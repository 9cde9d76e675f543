"""The leaves of a search: the boxes it did not divide, and why."""

from __future__ import annotations

import numpy as np

PRUNED, EMPTY, OPEN = 0, 1, 2  # why a leaf was not divided further


class Leaves:
    """The undivided boxes at the end of a search: together they cover the roots exactly.

    ``reason`` is PRUNED (bound at least upper_bound - gap_tol), EMPTY (no admissible parameter) or
    OPEN (a limit came first).
    """

    def __init__(self) -> None:
        self._parts: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]] = []

    def add(
        self, lower: np.ndarray, upper: np.ndarray, bounds: np.ndarray, is_open: bool = False
    ) -> None:
        reason = np.where(np.isinf(bounds), EMPTY, OPEN if is_open else PRUNED)
        self._parts.append((lower.copy(), upper.copy(), bounds.copy(), reason.astype(np.int8)))

    def arrays(self) -> dict[str, np.ndarray]:
        """``lower`` (L, d), ``upper`` (L, d), ``bounds`` (L,) and ``reason`` (L,)."""
        names = ("lower", "upper", "bounds", "reason")
        return dict(zip(names, map(np.concatenate, zip(*self._parts, strict=True)), strict=True))
