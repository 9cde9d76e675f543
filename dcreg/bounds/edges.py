"""The independent-edge bound: every pair at its own best parameter in the box."""

from __future__ import annotations

import numpy as np

from dcreg.bounds.base import SpaceBound
from dcreg.kernels.features.bounds import edge_bound
from dcreg.search import Evaluation
from dcreg.spaces import FeatureSpace


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
