"""Similarities in 2D of a region: spaces. The DC bounds hold for every pose, so they need no change."""

from __future__ import annotations

import math
from functools import cached_property
from typing import Any

import numpy as np

from dcreg.families.region import BoxPoses, InRegion, Near, NearSpace, Region, shift_box
from dcreg.families.similarity2d.space import Similarity2D
from dcreg.search import Box


class SimilarityInRegion(InRegion, Similarity2D):
    """Similarities in a region."""

    @cached_property
    def stationary(self) -> Box:
        (box,) = Similarity2D.roots(self)
        return Box(box.lower[2:], box.upper[2:])

    def roots(self) -> list[Box]:
        (box,) = super().roots()
        shifts = shift_box(self.stationary, self.region, self.scale_range[1])
        lower, upper = (
            np.append(box.lower[:2], shifts.lower),
            np.append(box.upper[:2], shifts.upper),
        )
        return [Box(lower, upper)]

    def box_poses(self, lower: np.ndarray, upper: np.ndarray) -> BoxPoses:
        """Return the poses of boxes of (s cos a, s sin a, t_x, t_y)."""
        (a, b, *_), centres = 0.5 * (lower + upper).T, 0.5 * (lower + upper)
        half = 0.5 * (upper - lower)
        radius, length = np.linalg.norm(half[:, :2], axis=1), np.hypot(a, b)
        ratio = radius / np.maximum(length, 1e-300)
        angle = np.where(ratio < 1.0, np.arcsin(np.minimum(ratio, 1.0)), math.pi)
        shift_radius = np.linalg.norm(half[:, 2:], axis=1)
        return BoxPoses(*self.poses(centres), radius, shift_radius, angle)

    def of_points(self, source: np.ndarray, target: np.ndarray, n_inliers: int) -> Similarity2D:
        settings = self.scale_range, None, self.stop_flag, self.stationary_box
        return type(self)(source, target, n_inliers, *settings).within(self.region)

    def poses(self, thetas: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        a, b = thetas[:, :2].T
        return np.moveaxis(np.array([[a, -b], [b, a]]), 2, 0), thetas[:, 2:]


class SimilarityNear(NearSpace, SimilarityInRegion):
    """Similarities near a reference pose, which does not rotate."""

    def roots(self) -> list[Box]:
        """Return a box around the sector of the angles and scales that the range allows."""
        (box,) = super().roots()
        low, high = self.scale_range
        limit = math.radians(self.region.pose_range.max_angle)
        reach = high * math.sin(min(limit, 0.5 * math.pi)) * (1.0 + 1e-9)
        least = (low if limit < 0.5 * math.pi else high) * math.cos(limit)
        lower, upper = box.lower.copy(), box.upper.copy()
        lower[:2] = max(lower[0], least * (1.0 - 1e-9 * np.sign(least))), -reach
        upper[1] = reach
        return [Box(lower, upper)]

    def fit_matching(self, theta: np.ndarray, col_of: np.ndarray) -> np.ndarray:
        rows = np.flatnonzero(col_of >= 0)
        x, y = self.clouds.source[:, rows].T, self.clouds.target[:, col_of[rows]].T
        return self.parameter(self.region.pose_range.fit(x, y, self.scale_range))


def similarity_in_region(
    source: np.ndarray,
    target: np.ndarray,
    n_inliers: int,
    scale_range: tuple[float, float],
    candidates: np.ndarray | None,
    *settings: Any,
    region: Region,
) -> SimilarityInRegion:
    """Return the space of the similarities in a region."""
    kind = SimilarityNear if isinstance(region, Near) else SimilarityInRegion
    return kind(source, target, n_inliers, scale_range, candidates, *settings).within(region)
