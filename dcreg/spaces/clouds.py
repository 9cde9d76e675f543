"""Spaces of rotations: clouds by component, descents by the least-squares fit of the matched points."""

from __future__ import annotations

import abc

import numpy as np

from dcreg.kernels.points import NEVER, Clouds
from dcreg.problem.pairs import FeasiblePairs
from dcreg.spaces.base import Space, radius
from dcreg.spaces.descent import alternate

_LEAST_GAIN = 1e-12


class CloudSpace(Space):
    """A space whose kernels take both clouds by component.

    Parameters
    ----------
    source, target : (n, 3), (m, 3) arrays
    n_inliers : int
    candidates : (n, m) bool array, optional
        The feasible pairs.

    Attributes
    ----------
    clouds : Clouds
        The problem as the kernels take it.
    """

    def __init__(
        self,
        source: np.ndarray,
        target: np.ndarray,
        n_inliers: int,
        candidates: np.ndarray | None = None,
    ) -> None:
        source, target = (np.asarray(points, dtype=np.float64) for points in (source, target))
        reach = radius(source) + radius(target)
        self.clouds = Clouds(
            np.ascontiguousarray(source.T),
            np.ascontiguousarray(target.T),
            FeasiblePairs(candidates).prices(n_inliers, reach),
            n_inliers,
            NEVER,
        )
        self.n_inliers = n_inliers

    def heed(self, stop: np.ndarray) -> None:
        super().heed(stop)
        self.clouds = self.clouds._replace(stop=stop)

    @property
    def n_source(self) -> int:
        return int(self.clouds.source.shape[1])

    @property
    def n_target(self) -> int:
        return int(self.clouds.target.shape[1])

    @staticmethod
    @abc.abstractmethod
    def fit(source: np.ndarray, target: np.ndarray) -> np.ndarray:
        """The best parameter for paired points, (3, k) each."""

    @abc.abstractmethod
    def normalised(self, theta: np.ndarray) -> np.ndarray:
        """The same pose with the parameter that lies in a root."""

    def matched(self, col_of: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The matched points of both clouds, (3, k) each."""
        rows = np.flatnonzero(col_of >= 0)
        return self.clouds.source[:, rows], self.clouds.target[:, col_of[rows]]

    def refine(self, theta: np.ndarray) -> tuple[np.ndarray, float, int]:
        """Alternate matching and best pose from `theta`: theta, objective, assignments."""
        value, col_of = self.objective(theta)
        theta, value, spent = alternate(
            theta,
            value,
            col_of,
            lambda _, matching: self.fit(*self.matched(matching)),
            self.objective,
            _LEAST_GAIN,
        )
        return self.normalised(theta), value, spent + 1
