"""Term-wise bounds R1 and R2: reconstructions of RPM-HTB.

The body of RPM-HTB (arXiv 2101.07458) was not available. R1 and R2 are valid members of the family it
describes, not the authors' exact choice of facets. Call them "reconstructed" wherever they are shown. In
3D they bound the norm objective of DC-Reg, so that the two methods differ only in the bound.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from baselines._shared.kernels import products
from baselines._shared.relaxations import Relaxation
from baselines.rpm_htb import kernels
from dcreg.families.dc.space import FeatureSpace
from dcreg.families.similarity2d.space import Similarity2D
from dcreg.families.translation3d.space import Translation3D
from dcreg.search import Box, Boxes, Evaluation


class TermwiseBound(Relaxation[FeatureSpace]):
    """Common part: the pair features of a 2D problem."""

    def __init__(
        self, space: FeatureSpace, roots: Sequence[Box] | None = None, threads: int = 1
    ) -> None:
        super().__init__(space, roots, threads)
        if isinstance(space, Similarity2D):
            self.features = np.empty((products.N_FEATURES + 1, space.n_source, space.n_target))
            products.pair_features(space.source, space.clouds.target, self.features)


class SeparableBound(TermwiseBound):
    """R1 and R2: matching and pose separate, so a box costs one assignment."""

    averaged: bool  # R1

    def __init__(
        self, space: FeatureSpace, roots: Sequence[Box] | None = None, threads: int = 1
    ) -> None:
        super().__init__(space, roots, threads)
        self.low = self.high = np.empty(0)
        if self.averaged:
            self.low, self.high = self._aggregates()

    def _aggregates(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the ranges of the aggregated features over all matchings, feasible or not."""
        space = self.space
        if isinstance(space, Translation3D):
            ordered = np.sort(space.source, axis=0)
            return ordered[: space.n_inliers].sum(axis=0), ordered[-space.n_inliers :].sum(axis=0)
        low, high = np.empty(products.N_FEATURES), np.empty(products.N_FEATURES)
        products.feature_ranges(self.features, space.n_inliers, space.stop_flag, low, high)
        self.n_assignments += 2 * products.N_FEATURES
        return low, high

    def _evaluate(self, boxes: Boxes, cutoff: float | None) -> Evaluation:
        found, matchings = Evaluation.empty(boxes), self.no_matchings(len(boxes))

        def work(part: slice) -> int:
            bounds, thetas = found.lower_bounds[part], found.thetas[part]
            spent = self._bound(
                boxes.lower[part], boxes.upper[part], bounds, thetas, matchings[part]
            )
            return spent + self.space.objectives(thetas, found.values[part])

        self.map_slices(len(boxes), work)
        return found

    def _bound(
        self,
        lower: np.ndarray,
        upper: np.ndarray,
        bounds: np.ndarray,
        thetas: np.ndarray,
        matchings: np.ndarray,
    ) -> int:
        space, k = self.space, self.space.n_inliers
        if isinstance(space, Translation3D):
            return kernels.norm_bounds(
                space.clouds, self.low, self.high, self.averaged, lower, upper, bounds, thetas,
                matchings,
            )  # fmt: skip
        if self.averaged:
            ranges = self.low, self.high
            return kernels.aggregated_bound(
                self.features, ranges, k, space.stop_flag, lower, upper, bounds, thetas, matchings
            )
        return kernels.entry_bound(
            self.features, k, space.stop_flag, lower, upper, bounds, matchings
        )


class TermwiseR1(SeparableBound):
    """Aggregated products, mean McCormick facets; the candidate minimises the separable QP."""

    averaged = True


class TermwiseR2(SeparableBound):
    """Each monomial of each pair at its own minimum; the candidate is the box centre."""

    averaged = False
