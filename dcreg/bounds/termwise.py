"""Term-wise bilinear bounds: reconstructions of RPM-HTB, the paper's rival.

The body of RPM-HTB (arXiv 2101.07458) was not available; R1 and R2 are valid members of the family it
describes and not the authors' exact choice of facets. Call them "reconstructed" wherever shown. In 3D
they bound the norm objective of DC-Reg, so that the two methods differ in nothing but the bound.
"""

from __future__ import annotations

import numpy as np

from dcreg.bounds.base import ModelBound
from dcreg.kernels import features, termwise, vertices
from dcreg.models import Model
from dcreg.problem import InputError
from dcreg.search import Evaluation


class TermwiseBound(ModelBound):
    """Common part: the pair features of a 2D problem; the candidate is evaluated exactly."""

    kinds: tuple[int, ...] = (features.SIMILARITY2D,)

    def __init__(self, model: Model, threads: int = 1) -> None:
        super().__init__(model, threads)
        if model.kind not in self.kinds:
            raise InputError(
                "bound: termwise-r3 treats 2D similarity only; in 3D use termwise, termwise-r1 or "
                "termwise-r2"
            )
        if model.kind == features.SIMILARITY2D:
            n, m = len(model.source), model.target_features.shape[1]
            self.features = np.empty((8, n, m))
            termwise.pair_features(model.source, model.target_features, self.features)

    def _values(self, thetas: np.ndarray, values: np.ndarray) -> int:
        model = self.model
        return vertices.objectives(
            model.kind, model.source, model.target_features, model.n_inliers, thetas, values
        )


class SeparableBound(TermwiseBound):
    """R1 and R2: matching and pose separate, which costs one assignment a box in either model."""

    kinds = (features.SIMILARITY2D, features.NORM3D)
    averaged: bool  # R1

    def __init__(self, model: Model, threads: int = 1) -> None:
        super().__init__(model, threads)
        self.low = self.high = np.empty(0)
        if self.averaged:
            self.low, self.high = self._aggregates()

    def _aggregates(self) -> tuple[np.ndarray, np.ndarray]:
        """Ranges of the aggregated features over all matchings, feasible or not."""
        model = self.model
        if model.kind == features.NORM3D:
            ordered = np.sort(model.source, axis=0)
            return ordered[: model.n_inliers].sum(axis=0), ordered[-model.n_inliers :].sum(axis=0)
        low, high = np.empty(termwise.N_FEATURES), np.empty(termwise.N_FEATURES)
        termwise.feature_ranges(self.features, model.n_inliers, low, high)
        self.n_assignments += 2 * termwise.N_FEATURES
        return low, high

    def _evaluate(self, lower: np.ndarray, upper: np.ndarray, cutoff: float) -> Evaluation:
        found = Evaluation(np.empty(len(lower)), 0.5 * (lower + upper), np.empty(len(lower)))

        def work(part: slice) -> int:
            bounds, thetas = found.lower_bounds[part], found.thetas[part]
            spent = self._bound(lower[part], upper[part], bounds, thetas)
            return spent + self._values(thetas, found.values[part])

        self._run(work, len(lower))
        return found

    def _bound(
        self, lower: np.ndarray, upper: np.ndarray, bounds: np.ndarray, thetas: np.ndarray
    ) -> int:
        model, k = self.model, self.model.n_inliers
        if model.kind == features.NORM3D:
            return termwise.norm_bounds(
                model.source, model.target_features, k, self.low, self.high, self.averaged,
                lower, upper, bounds, thetas,
            )  # fmt: skip
        if self.averaged:
            return termwise.aggregated_bound(
                self.features, self.low, self.high, k, lower, upper, bounds, thetas
            )
        return termwise.entry_bound(self.features, k, lower, upper, bounds)


class TermwiseR1(SeparableBound):
    """Aggregated products, mean McCormick facets; the candidate minimises the separable QP."""

    averaged = True


class TermwiseR2(SeparableBound):
    """Each monomial of each pair at its own least value; the candidate is the box centre."""

    averaged = False
