"""Term-wise bilinear bounds: reconstructions of RPM-HTB, the paper's rival.

The body of RPM-HTB (arXiv 2101.07458) was not available; R1 and R2 are valid members of the family it
describes and not the authors' exact choice of facets. Call them "reconstructed" wherever shown. In 3D
they bound the norm objective of DC-Reg, so that the two methods differ in nothing but the bound.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dcreg.families.dc.kernels import termwise_norm as norm
from dcreg.families.dc.kernels import termwise_plane as plane
from dcreg.families.dc.space import FeatureSpace
from dcreg.families.protocol import SpaceBound
from dcreg.families.similarity2d.space import Similarity2D
from dcreg.families.translation3d.space import Translation3D
from dcreg.problem import InputError
from dcreg.search import Box, Evaluation


class TermwiseBound(SpaceBound[FeatureSpace]):
    """Common part: the pair features of a 2D problem; the candidate is evaluated exactly."""

    spaces: tuple[type[FeatureSpace], ...] = (Similarity2D,)

    def __init__(
        self, space: FeatureSpace, roots: Sequence[Box] | None = None, threads: int = 1
    ) -> None:
        super().__init__(space, roots, threads)
        if not isinstance(space, self.spaces):
            raise InputError(
                "bound: termwise-r3 treats 2D similarity only; in 3D use termwise, termwise-r1 or "
                "termwise-r2"
            )
        if isinstance(space, Similarity2D):
            self.features = np.empty((8, space.n_source, space.n_target))
            plane.pair_features(space.points, self.features)


class SeparableBound(TermwiseBound):
    """R1 and R2: matching and pose separate, which costs one assignment a box in either space."""

    spaces = (Similarity2D, Translation3D)
    averaged: bool  # R1

    def __init__(
        self, space: FeatureSpace, roots: Sequence[Box] | None = None, threads: int = 1
    ) -> None:
        super().__init__(space, roots, threads)
        self.low = self.high = np.empty(0)
        if self.averaged:
            self.low, self.high = self._aggregates()

    def _aggregates(self) -> tuple[np.ndarray, np.ndarray]:
        """Ranges of the aggregated features over all matchings, feasible or not."""
        space = self.space
        if isinstance(space, Translation3D):
            ordered = np.sort(space.source, axis=0)
            return ordered[: space.n_inliers].sum(axis=0), ordered[-space.n_inliers :].sum(axis=0)
        low, high = np.empty(plane.N_FEATURES), np.empty(plane.N_FEATURES)
        plane.feature_ranges(self.features, space.n_inliers, space.stop_flag, low, high)
        self.n_assignments += 2 * plane.N_FEATURES
        return low, high

    def _evaluate(
        self, lower: np.ndarray, upper: np.ndarray, cutoff: float, thorough: bool
    ) -> Evaluation:
        found = Evaluation(np.empty(len(lower)), 0.5 * (lower + upper), np.empty(len(lower)))

        def work(part: slice) -> int:
            bounds, thetas = found.lower_bounds[part], found.thetas[part]
            spent = self._bound(lower[part], upper[part], bounds, thetas)
            return spent + self.space.objectives(thetas, found.values[part])

        self._run(work, len(lower))
        return found

    def _bound(
        self, lower: np.ndarray, upper: np.ndarray, bounds: np.ndarray, thetas: np.ndarray
    ) -> int:
        space, k = self.space, self.space.n_inliers
        if isinstance(space, Translation3D):
            return norm.norm_bounds(
                space.points, self.low, self.high, self.averaged, lower, upper, bounds, thetas
            )
        if self.averaged:
            return plane.aggregated_bound(
                self.features,
                (self.low, self.high),
                k,
                space.stop_flag,
                lower,
                upper,
                bounds,
                thetas,
            )
        return plane.entry_bound(self.features, k, space.stop_flag, lower, upper, bounds)


class TermwiseR1(SeparableBound):
    """Aggregated products, mean McCormick facets; the candidate minimises the separable QP."""

    averaged = True


class TermwiseR2(SeparableBound):
    """Each monomial of each pair at its own least value; the candidate is the box centre."""

    averaged = False
