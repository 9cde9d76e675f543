"""Bounds whose kernel treats a batch of boxes of rotations at once."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np

from dcreg.bounds.base import SpaceBound
from dcreg.search import Evaluation
from dcreg.spaces.clouds import CloudSpace

S = TypeVar("S", bound=CloudSpace)


class CloudBound(SpaceBound[S]):
    """Each box on its own, the candidate at its centre.

    Attributes
    ----------
    bound_boxes : callable
        The kernel: (lower, upper, cutoff, clouds, bounds, values) -> assignments.
    """

    bound_boxes: Callable[..., int]

    def _evaluate(
        self, lower: np.ndarray, upper: np.ndarray, cutoff: float, thorough: bool
    ) -> Evaluation:
        bounds, values = np.empty(len(lower)), np.empty(len(lower))

        def work(part: slice) -> int:
            return self.bound_boxes(
                lower[part], upper[part], cutoff, self.space.clouds, bounds[part], values[part]
            )

        self._run(work, len(lower))
        return Evaluation(bounds, 0.5 * (lower + upper), values)
