"""The holistic difference-of-convex bound of DC-Reg (arXiv 2603.25442), exactly as published."""

from __future__ import annotations

import numpy as np

from dcreg.bounds.base import SpaceBound
from dcreg.kernels.features.bounds import paper_bound
from dcreg.search import Evaluation
from dcreg.spaces import FeatureSpace


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
