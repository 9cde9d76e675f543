"""Term-wise bilinear bounds for 2D similarity: reconstructions of RPM-HTB, the paper's rival.

The body of RPM-HTB (arXiv 2101.07458) was not available; R1 and R2 are valid members of the family it
describes and not the authors' exact choice of facets. Call them "reconstructed" wherever shown.
"""

from __future__ import annotations

import numpy as np

from dcreg.bounds.base import ModelBound
from dcreg.kernels import termwise, vertices
from dcreg.models import Model
from dcreg.problem import InputError
from dcreg.search import Evaluation


class TermwiseBound(ModelBound):
    """Common part: the pair features of a 2D problem; the candidate is evaluated exactly."""

    def __init__(self, model: Model, threads: int = 1) -> None:
        super().__init__(model, threads)
        if model.target_features.shape[0] != 2:
            raise InputError(
                "bound: the term-wise bounds treat 2D similarity only; use bound 'paper' or 'edges' in 3D"
            )
        n, m = len(model.source), model.target_features.shape[1]
        self.features = np.empty((8, n, m))
        termwise.pair_features(model.source, model.target_features, self.features)

    def _values(self, thetas: np.ndarray, values: np.ndarray) -> int:
        model = self.model
        return vertices.objectives(
            model.kind, model.source, model.target_features, model.n_inliers, thetas, values
        )


class TermwiseR1(TermwiseBound):
    """Aggregated products, mean McCormick facets; separates into one assignment and one box QP."""

    def __init__(self, model: Model, threads: int = 1) -> None:
        super().__init__(model, threads)
        self.low, self.high = np.empty(termwise.N_FEATURES), np.empty(termwise.N_FEATURES)
        termwise.feature_ranges(self.features, model.n_inliers, self.low, self.high)
        self.n_assignments += 2 * termwise.N_FEATURES

    def _evaluate(self, lower: np.ndarray, upper: np.ndarray, cutoff: float) -> Evaluation:
        found = Evaluation(np.empty(len(lower)), np.empty_like(lower), np.empty(len(lower)))

        def work(part: slice) -> int:
            spent = termwise.aggregated_bound(
                self.features,
                self.low,
                self.high,
                self.model.n_inliers,
                lower[part],
                upper[part],
                found.lower_bounds[part],
                found.thetas[part],
            )
            return spent + self._values(found.thetas[part], found.values[part])

        self._run(work, len(lower))
        return found


class TermwiseR2(TermwiseBound):
    """Each monomial of each pair at its own least value; the candidate is the box centre."""

    def _evaluate(self, lower: np.ndarray, upper: np.ndarray, cutoff: float) -> Evaluation:
        bounds, values = np.empty(len(lower)), np.empty(len(lower))
        centres = 0.5 * (lower + upper)

        def work(part: slice) -> int:
            spent = termwise.entry_bound(
                self.features, self.model.n_inliers, lower[part], upper[part], bounds[part]
            )
            return spent + self._values(centres[part], values[part])

        self._run(work, len(lower))
        return Evaluation(bounds, centres, values)
