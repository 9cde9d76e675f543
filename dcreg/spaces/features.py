"""Spaces whose residuals are distances of features: plane points, or norms in space."""

from __future__ import annotations

import numpy as np

from dcreg.kernels import vertices
from dcreg.spaces.base import Space


class FeatureSpace(Space):
    """A space over which every bound is written once, in terms of features of the moved source.

    Attributes
    ----------
    kind : int
        Selects the compiled kernels (``dcreg.kernels.features``).
    source : (n, d) array
        Normalised source points.
    target_features : (q, m) or (q + n, m) array
        What the moved source is compared with: target points in 2D, their norms in norm space. Where
        not every pair is feasible, the prices of the pairs follow (`with_prices`).
    identity : (dim,) array
        The parameter that moves nothing.
    """

    kind: int
    source: np.ndarray
    target_features: np.ndarray
    identity: np.ndarray
    n_descents = 6

    @property
    def n_source(self) -> int:
        return len(self.source)

    @property
    def n_target(self) -> int:
        return int(self.target_features.shape[1])

    def score(self, seeds: np.ndarray) -> tuple[np.ndarray, int]:
        """The objective itself."""
        values = np.empty(len(seeds))
        spent = vertices.objectives(
            self.kind, self.source, self.target_features, self.n_inliers, seeds, values
        )
        return values, spent

    def objective(self, theta: np.ndarray) -> tuple[float, np.ndarray]:
        value, col_of = vertices.objective(
            self.kind, self.source, self.target_features, self.n_inliers, theta
        )
        return float(value), col_of
