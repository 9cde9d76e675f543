"""2D similarity: theta = (s cos a, s sin a, t_x, t_y), the scale in a given range."""

from __future__ import annotations

import numpy as np

from dcreg.kernels import features
from dcreg.kernels.refine import refine_similarity2d
from dcreg.search import Box
from dcreg.spaces.base import largest_subset_mean, mean_of_largest, radius, with_prices
from dcreg.spaces.features import FeatureSpace


class Similarity2D(FeatureSpace):
    """T(x) = [[t1, -t2], [t2, t1]] x + (t3, t4), DC-Reg section "2D similarity".

    Parameters
    ----------
    source, target : (n, 2), (m, 2) arrays
        Normalised points; both sets centred at their centroid for the best conditioning.
    n_inliers : int
    scale_range : (low, high)
        Parameters outside this annulus are not poses: without a lower limit the scale would
        collapse (all sources onto one target neighbourhood).
    reduced_box : bool
        Start from the translations that an optimum can have (its residuals have zero mean, so
        t = mean of matched y - s R mean of matched x), or from the plain safe box of the paper.
    candidates : (n, m) bool array, optional
        The feasible pairs.
    """

    kind = features.SIMILARITY2D
    scope = "similarity pose"
    identity = np.array([1.0, 0.0, 0.0, 0.0])

    def __init__(
        self,
        source: np.ndarray,
        target: np.ndarray,
        n_inliers: int,
        scale_range: tuple[float, float],
        reduced_box: bool = True,
        candidates: np.ndarray | None = None,
    ) -> None:
        self.source = np.ascontiguousarray(source)
        self.target = np.ascontiguousarray(target)
        reach = scale_range[1] * radius(source) + radius(target)
        self.target_features = with_prices(self.target.T, candidates, n_inliers, reach)
        self.n_inliers = n_inliers
        self.scale_range = scale_range
        self.reduced_box = reduced_box
        spread = max(float(np.sqrt((source**2).sum(axis=1).mean())), 1e-12)
        self.axis_weights = np.array([spread, spread, 1.0, 1.0])

    def roots(self) -> list[Box]:
        high = self.scale_range[1]
        if self.reduced_box:
            reach = high * largest_subset_mean(self.source, self.n_inliers)
            low_y = np.array([-mean_of_largest(-y, self.n_inliers) for y in self.target.T])
            high_y = np.array([mean_of_largest(y, self.n_inliers) for y in self.target.T])
            # rounding must not cut off the optimum, yet an exactly centred set keeps zero width
            reach = 0.0 if reach < 1e-12 else reach
            low_y, high_y = (np.where(np.abs(y) < 1e-12, 0.0, y) for y in (low_y, high_y))
            lower, upper = low_y - reach, high_y + reach
        else:
            reach = high * radius(self.source) + radius(self.target)
            lower, upper = np.full(2, -reach), np.full(2, reach)
        return [Box(np.array([-high, -high, *lower]), np.array([high, high, *upper]))]

    def admissible(self, thetas: np.ndarray) -> np.ndarray:
        scale = np.hypot(thetas[:, 0], thetas[:, 1])
        low, high = self.scale_range
        # a scale fitted and clipped to the end of the range may be a rounding error outside
        return (scale >= low * (1 - 1e-12)) & (scale <= high * (1 + 1e-12))

    def touches(self, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
        low, high = self.scale_range
        near = np.maximum(np.maximum(lower[:, :2], -upper[:, :2]), 0.0)
        far = np.maximum(-lower[:, :2], upper[:, :2])
        return (np.hypot(*near.T) <= high) & (np.hypot(*far.T) >= low)

    def refine(self, theta: np.ndarray) -> tuple[np.ndarray, float, int]:
        low, high = self.scale_range
        return refine_similarity2d(
            self.source, self.target_features, self.n_inliers, low, high, theta
        )

    def seeds(self) -> np.ndarray:
        """Every 15 degrees, at the scale that gives both clouds the same spread."""
        spread = self.axis_weights[0]
        scale = np.clip(np.sqrt((self.target**2).sum(axis=1).mean()) / spread, *self.scale_range)
        angles = np.arange(24) * (np.pi / 12)
        centre = np.zeros((24, 2))
        return np.hstack([scale * np.stack([np.cos(angles), np.sin(angles)], axis=1), centre])

    def pose(self, theta: np.ndarray) -> np.ndarray:
        a, b, tx, ty = theta
        return np.array([[a, -b, tx], [b, a, ty], [0.0, 0.0, 1.0]])
