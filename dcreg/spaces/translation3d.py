"""3D translation in norm space: theta = t, matched are |x + t| and |y| (DC-Reg, Case II)."""

from __future__ import annotations

import numpy as np

from dcreg.kernels import features
from dcreg.kernels.refine import refine_norm3d
from dcreg.search import Box
from dcreg.spaces.base import mean_of_largest, radius, with_prices
from dcreg.spaces.features import FeatureSpace


class Translation3D(FeatureSpace):
    """Match the norms of the moved source and of the target, which no rotation changes.

    The objective is ``sum p_ij (|x_i + t| - |y_j|)^2``. It is a lower bound on the full rigid objective
    for every rotation, and a surrogate of it: its optimum need not be the optimal rigid pose.

    Parameters
    ----------
    source, target : (n, 3), (m, 3) arrays
        Normalised points. The origin of the target is the centre of rotation.
    n_inliers : int
    reduced_box : bool
        Start from the translations a stationary point can have, or from the plain safe box.
    candidates : (n, m) bool array, optional
        The feasible pairs. With them the assignment is no longer one-dimensional, hence dearer.
    """

    kind = features.NORM3D
    scope = "translation in norm space"
    identity = np.zeros(3)

    def __init__(
        self,
        source: np.ndarray,
        target: np.ndarray,
        n_inliers: int,
        reduced_box: bool = True,
        candidates: np.ndarray | None = None,
    ) -> None:
        self.source = np.ascontiguousarray(source)
        self.target = np.ascontiguousarray(target)
        self.norms = np.sqrt((self.target**2).sum(axis=1))
        reach = radius(self.source) + radius(self.target)
        self.target_features = with_prices(self.norms[None, :], candidates, n_inliers, reach)
        self.n_inliers = n_inliers
        self.reduced_box = reduced_box
        self.axis_weights = np.ones(3)

    def roots(self) -> list[Box]:
        """Every minimiser is stationary: t = mean of (|y| u - x) over the matched, u unit vectors."""
        if not self.reduced_box:
            reach = self.norms.max() + np.sqrt((self.source**2).sum(axis=1)).max()
            return [Box(np.full(3, -reach), np.full(3, reach))]
        reach = mean_of_largest(self.norms, self.n_inliers)
        low_x = np.array([mean_of_largest(-x, self.n_inliers) for x in self.source.T])
        high_x = np.array([mean_of_largest(x, self.n_inliers) for x in self.source.T])
        return [Box(-(reach + high_x), reach + low_x)]

    def seeds(self) -> np.ndarray:
        """The identity and the 26 neighbours of a coarse grid around it."""
        steps = 0.5 * np.array([0.0, -1.0, 1.0])
        return np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)

    def refine(self, theta: np.ndarray) -> tuple[np.ndarray, float, int]:
        return refine_norm3d(self.source, self.target_features, self.n_inliers, theta)
