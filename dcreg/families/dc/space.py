"""Spaces whose residuals are distances of features: plane points, or norms in space."""

from __future__ import annotations

import abc
from typing import TypeVar

import numpy as np

from dcreg.assignment.kernels.dense import cheapest_pairs
from dcreg.families.dc.kernels.motion import pair_costs
from dcreg.families.kernels import Clouds
from dcreg.families.protocol import Space


class FeatureSpace(Space):
    """A space over which every bound is written once, in terms of features of the moved source.

    Attributes
    ----------
    clouds : Clouds
        The normalised problem as the kernels take it.
    identity : (dim,) array
        The parameter that moves nothing.
    """

    clouds: Clouds
    identity: np.ndarray
    n_descents = 6
    min_gain = 1e-9

    @property
    def source(self) -> np.ndarray:
        """(n, d) normalised source points."""
        return np.ascontiguousarray(self.clouds.source.T)

    @property
    def n_source(self) -> int:
        return int(self.clouds.source.shape[1])

    @property
    def n_target(self) -> int:
        return int(self.clouds.target.shape[-1])

    def objective(
        self, theta: np.ndarray, stop_flag: np.ndarray | None = None
    ) -> tuple[float, np.ndarray]:
        stop_flag = self.stop_flag if stop_flag is None else stop_flag
        value, col_of, _ = cheapest_pairs(self._costs(theta), self.n_inliers, stop_flag)
        self.check(stop_flag)
        return float(value), col_of

    def _costs(self, theta: np.ndarray) -> np.ndarray:
        """(n, m) squared residuals, and the prices of the pairs."""
        cost = np.empty((self.n_source, self.n_target))
        pair_costs(self.clouds, theta, cost)
        return cost

    @abc.abstractmethod
    def objectives(self, thetas: np.ndarray, values: np.ndarray) -> int:
        """The objective at every row of `thetas` into `values`; the assignments that took."""


F = TypeVar("F", bound=FeatureSpace)
