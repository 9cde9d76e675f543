"""2D similarity: theta = (s cos a, s sin a, t_x, t_y), the scale in a given range."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator

import numpy as np

from dcreg.assignment.alternation import alternate_assignments
from dcreg.assignment.kernels.dense import cheapest_pairs
from dcreg.families.dc.kernels import objectives
from dcreg.families.dc.space import FeatureSpace
from dcreg.families.means import mean_of_largest, means_of_subsets
from dcreg.families.protocol import radius
from dcreg.families.similarity2d.starts import similar_poses
from dcreg.jit import NEVER
from dcreg.names import SIMILARITY_POSE
from dcreg.problem.geometry import fit_pose, representative_points, sampled_pairs
from dcreg.search import Box, Budget

# Shares of the pairs beyond k with which local searches begin; they end with k pairs.
_SURPLUS = (0.75, 0.5, 0.25)
COARSE_PAIRS = 160_000  # pairs of points above which local searches begin with a sample
MAX_SCORED = 150  # points of each cloud by which seeds are scored


def largest_subset_mean(
    points: np.ndarray, count: int, lightest: float = 1.0, n_directions: int = 64
) -> float:
    """Return an upper bound on ``|mean of any `count` points|`` of (2, n) points.

    Means have weights from `lightest` to 1.

    The support function of all subset means is the mean of the largest projections. The worst direction
    differs from a sampled one by at most half their spacing.
    """
    angles = np.arange(n_directions) * (2 * np.pi / n_directions)
    directions = np.stack([np.cos(angles), np.sin(angles)])
    projections = mean_of_largest(points @ directions, count, lightest)
    return float(max(projections.max(), 0.0) / np.cos(np.pi / n_directions))


class Similarity2D(FeatureSpace):
    """T(x) = [[t1, -t2], [t2, t1]] x + (t3, t4), DC-Reg section "2D similarity".

    Centre both clouds for good conditioning. In the stationary box, t is a mean of matched y -
    s R mean of matched x, because the residuals of a stationary point have zero mean.

    Parameters
    ----------
    source, target, n_inliers, candidates, stop_flag, stationary_box
        As in `Space`.
    scale_range : (low, high)
        Parameters outside this annulus are not poses. Without a lower limit the scale would collapse:
        the source would shrink into a small part of the target.
    """

    scope = SIMILARITY_POSE
    identity = np.array([1.0, 0.0, 0.0, 0.0])

    def __init__(
        self,
        source: np.ndarray,
        target: np.ndarray,
        n_inliers: int,
        scale_range: tuple[float, float],
        candidates: np.ndarray | None = None,
        stop_flag: np.ndarray = NEVER,
        stationary_box: bool = True,
    ) -> None:
        super().__init__(
            source, target, n_inliers, candidates, stop_flag, stationary_box, scale_range[1]
        )
        self.scale_range = scale_range
        # a scale fitted and clipped to an end of the range may be a rounding error outside
        self._admissible_scales = scale_range[0] * (1 - 1e-12), scale_range[1] * (1 + 1e-12)
        spread = max(float(np.sqrt((source**2).sum(axis=1).mean())), 1e-12)
        self.axis_weights = np.array([spread, spread, 1.0, 1.0])

    def roots(self) -> list[Box]:
        high = self.scale_range[1]
        if self.stationary_box:
            reach = high * largest_subset_mean(self.source, self.n_inliers, self.lightest)
            low_y, high_y = means_of_subsets(self.clouds.target, self.n_inliers, self.lightest)
            # rounding must not cut off the optimum, but the box of a centred cloud keeps zero width
            reach = 0.0 if reach < 1e-12 else reach
            low_y, high_y = (np.where(np.abs(y) < 1e-12, 0.0, y) for y in (low_y, high_y))
            lower, upper = low_y - reach, high_y + reach
        else:
            reach = high * radius(self.source) + radius(self.clouds.target.T)
            lower, upper = np.full(2, -reach), np.full(2, reach)
        return [Box(np.array([-high, -high, *lower]), np.array([high, high, *upper]))]

    def admissible(self, thetas: np.ndarray) -> np.ndarray:
        scale = np.hypot(thetas[:, 0], thetas[:, 1])
        low, high = self._admissible_scales
        return (scale >= low) & (scale <= high)

    def touches(self, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
        low, high = self._admissible_scales
        near = np.maximum(np.maximum(lower[:, :2], -upper[:, :2]), 0.0)
        far = np.maximum(-lower[:, :2], upper[:, :2])
        return (np.hypot(*near.T) <= high) & (np.hypot(*far.T) >= low)

    def objectives(self, thetas: np.ndarray, values: np.ndarray) -> int:
        return objectives(self.clouds, thetas, values)

    def score(self, seeds: np.ndarray) -> tuple[np.ndarray, int]:
        """Score by the objective, of a sample of large clouds."""
        return self._score(seeds, self.n_inliers)

    def _score(self, seeds: np.ndarray, count: int) -> tuple[np.ndarray, int]:
        clouds = self.source, self.clouds.target.T
        rows, columns = (representative_points(points, MAX_SCORED) for points in clouds)
        count = sampled_pairs(count, clouds, (rows, columns))
        values = np.empty(len(seeds))
        for at, seed in enumerate(seeds):
            costs = np.ascontiguousarray(self._costs(seed)[np.ix_(rows, columns)])
            values[at], _, _ = cheapest_pairs(costs, count, self.stop_flag)
            self.check()
        return values, len(seeds)

    def starts(self, budget: Budget) -> Iterator[tuple[np.ndarray, int]]:
        """Yield the best seeds, then poses of pairs of points, then results of searches with more pairs.

        A small part of a cloud fits in many places, each with a narrow basin of attraction. A larger part
        fits in few places with wide basins.
        """
        yield from super().starts(budget)
        for theta in self._similar(budget):
            yield theta, 0
        surplus = min(self.n_source, self.n_target) - self.n_inliers
        counts = [self.n_inliers + round(share * surplus) for share in _SURPLUS]
        if surplus == 0 or budget.is_over:
            return
        seeds = self.seeds()
        scores, spent = self._score(seeds, counts[0])
        for theta in seeds[np.argsort(scores, kind="stable")[: self.n_descents]]:
            for count in counts:
                theta, _, descending = self._descend(theta, count)
                spent += descending
            yield theta, spent
            spent = 0

    def _similar(self, budget: Budget) -> np.ndarray:
        """Return poses of pairs of points; none if all points match, as the centroids then match too."""
        if self.n_inliers == max(self.n_source, self.n_target) or budget.is_over:
            return np.empty((0, 4))
        return similar_poses(
            self.source, self.clouds.target.T, self.n_inliers, self.scale_range,
            self.candidates, stop=self.stop_flag,
        )  # fmt: skip

    def refine(self, theta: np.ndarray) -> tuple[np.ndarray, float, int]:
        """Alternate matching and fit, of large clouds with a sample first.

        Each assignment starts from the previous dual variables.
        """
        coarse, before = self._coarse, 0
        if coarse is not None:
            theta, _, before = coarse._descend(theta, coarse.n_inliers)
        theta, value, spent = self._descend(theta, self.n_inliers)
        return theta, value, before + spent

    @functools.cached_property
    def _coarse(self) -> Similarity2D | None:
        """The space of a sample, in which local searches of large clouds begin."""
        free = self.candidates is None and not self.clouds.weights.size
        if self.n_pairs <= COARSE_PAIRS or not free:
            return None
        clouds = self.source, self.clouds.target.T
        some = [points[representative_points(points, MAX_SCORED)] for points in clouds]
        count = sampled_pairs(self.n_inliers, clouds, some)
        return self.of_points(some[0], some[1], count)

    def of_points(self, source: np.ndarray, target: np.ndarray, n_inliers: int) -> Similarity2D:
        """Return the same space over other points, without candidates."""
        return Similarity2D(
            source, target, n_inliers, self.scale_range, None, self.stop_flag, self.stationary_box
        )

    def _descend(self, theta: np.ndarray, count: int) -> tuple[np.ndarray, float, int]:
        """Refine with `count` pairs; `theta` need not be admissible."""
        return alternate_assignments(
            theta, self._costs, count, self.fit_matching, self.min_gain, self.stop_flag,
            is_admissible=False,
        )  # fmt: skip

    def fit_matching(self, theta: np.ndarray, col_of: np.ndarray) -> np.ndarray:
        """Return the least-squares similarity of the matched pairs, its scale clipped to the range.

        Clipping is exact: the best rotation does not depend on the scale, and the objective is a parabola
        in the scale.
        """
        rows = np.flatnonzero(col_of >= 0)
        both = np.concatenate([self.clouds.source[:, rows], self.clouds.target[:, col_of[rows]]])
        weights = self.weights_of(rows, col_of[rows])
        if weights is not None:
            return self.parameter(fit_pose(both[:2].T, both[2:].T, self.scale_range, weights))
        mx, my, mu, mv = centre = both.sum(axis=1) / rows.size
        both -= centre[:, None]
        products = both @ both.T  # of x, y of the source and u, v of the target
        dot = products[0, 2] + products[1, 3]
        cross = products[0, 3] - products[1, 2]
        spread = products[0, 0] + products[1, 1]
        low, high = self.scale_range
        length = math.hypot(dot, cross)
        scale = min(max(length / spread if spread > 0.0 else low, low), high)
        a, b = (scale * dot / length, scale * cross / length) if length > 0.0 else (scale, 0.0)
        return np.array([a, b, mu - (a * mx - b * my), mv - (b * mx + a * my)])

    def seeds(self) -> np.ndarray:
        """Return rotations at steps of 15 degrees, at the scale that gives the clouds equal spread."""
        spread = self.axis_weights[0]
        scale = np.clip(
            np.sqrt((self.clouds.target**2).sum(axis=0).mean()) / spread, *self.scale_range
        )
        angles = np.arange(24) * (np.pi / 12)
        centre = np.zeros((24, 2))
        return np.hstack([scale * np.stack([np.cos(angles), np.sin(angles)], axis=1), centre])

    def pose(self, theta: np.ndarray) -> np.ndarray:
        a, b, tx, ty = theta
        return np.array([[a, -b, tx], [b, a, ty], [0.0, 0.0, 1.0]])

    @staticmethod
    def parameter(T: np.ndarray) -> np.ndarray:
        """Return the parameter of a (3, 3) pose: the inverse of `pose`."""
        return np.array([T[0, 0], T[1, 0], T[0, 2], T[1, 2]])
