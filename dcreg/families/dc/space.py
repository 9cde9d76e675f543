"""Spaces whose residuals are distances of features: points in 2D, or norms of points in 3D."""

from __future__ import annotations

import abc
from typing import TypeVar

import numpy as np

from dcreg.assignment.kernels.dense import cheapest_pairs
from dcreg.families.dc.kernels import pair_costs
from dcreg.families.protocol import Space


class FeatureSpace(Space):
    """A space whose bounds are written in terms of features of the moved source.

    Attributes
    ----------
    identity : (dim,) array
        The parameter of the identity.
    """

    identity: np.ndarray
    n_descents = 6
    min_gain = 1e-9

    @property
    def source(self) -> np.ndarray:
        """(n, d) normalised source points."""
        return np.ascontiguousarray(self.clouds.source.T)

    def objective(self, theta: np.ndarray) -> tuple[float, np.ndarray]:
        value, col_of, _ = cheapest_pairs(self._costs(theta), self.n_inliers, self.stop_flag)
        self.check()
        return float(value), col_of

    def _costs(self, theta: np.ndarray) -> np.ndarray:
        """Return the (n, m) costs: squared residuals and penalties of infeasible pairs."""
        cost = np.empty((self.clouds.source.shape[1], self.clouds.target.shape[-1]))
        pair_costs(self.clouds, theta, cost)
        return cost

    @abc.abstractmethod
    def objectives(self, thetas: np.ndarray, values: np.ndarray) -> int:
        """Write the objective at each row of `thetas` into `values`; return the assignments solved."""


F = TypeVar("F", bound=FeatureSpace)
