"""Rigid poses of a region: spaces and bound."""

from __future__ import annotations

import math
from functools import cached_property
from typing import Any

import numpy as np

from dcreg.families.region import (
    BoxPoses,
    InRegion,
    Near,
    NearSpace,
    Region,
    angles,
    shift_box,
)
from dcreg.families.rigid3d.bound import RigidBound
from dcreg.families.rigid3d.kernels.anywhere import bound_boxes_anywhere
from dcreg.families.rigid3d.space import Rigid3D
from dcreg.families.rotation3d.space import Rotation3D
from dcreg.problem import PoseRange
from dcreg.search import Box, Boxes, Evaluation

# Initial poses are dropped if their rotation differs by more than this angle from any in the range.
_MAX_CHANGE = 0.35


class RigidInRegion(InRegion, Rigid3D):
    """Rigid poses in a region."""

    @cached_property
    def stationary(self) -> Box:
        return super().translations()

    def translations(self) -> Box:
        return shift_box(self.stationary, self.region, 1.0)

    def box_poses(self, lower: np.ndarray, upper: np.ndarray) -> BoxPoses:
        """Return the poses of boxes of quaternions and translations."""
        centres, half = 0.5 * (lower + upper), 0.5 * (upper - lower)
        angle = _angle_radii(lower[:, :4], upper[:, :4])
        return BoxPoses(
            _matrices(centres[:, :4]), centres[:, 4:], 2.0 * np.sin(0.5 * angle),
            np.linalg.norm(half[:, 4:], axis=1), angle,
        )  # fmt: skip

    def poses(self, thetas: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return _matrices(thetas[:, :4]), thetas[:, 4:]

    def of_points(self, source: np.ndarray, target: np.ndarray, n_inliers: int) -> Rigid3D:
        space = type(self)(source, target, n_inliers, None, self.stop_flag, self.stationary_box)
        return space.within(self.region)


class RigidNear(NearSpace, RigidInRegion):
    """Rigid poses near a reference pose, which does not rotate; an axis is the z-axis."""

    @property
    def pose_range(self) -> PoseRange:
        return self.region.pose_range

    def roots(self) -> list[Box]:
        """Return boxes of the quaternions that the range allows."""
        shifts, limit = self.translations(), math.radians(self.pose_range.max_angle)
        free = np.array([0.0, 0.0, 0.0, 1.0]) if self.pose_range.axis is not None else np.ones(4)
        free[0] = 1.0
        boxes = []
        for axis, facet in enumerate(Rotation3D.roots()):
            if not free[axis] or (axis and limit <= 0.5 * math.pi):
                continue
            lower, upper = facet.lower * free, facet.upper * free
            if axis == 0:
                reach = min(1.0, math.tan(min(0.5 * limit, 0.25 * math.pi)) * (1.0 + 1e-9))
                lower[1:], upper[1:] = lower[1:] * reach, upper[1:] * reach
            boxes.append(Box(np.append(lower, shifts.lower), np.append(upper, shifts.upper)))
        return boxes

    def fit_matching(self, theta: np.ndarray, col_of: np.ndarray) -> np.ndarray:
        x, y = self.matched(col_of)
        return self.parameter(self.pose_range.fit(x.T, y.T, (1.0, 1.0)))

    def fit_pairs(self, source: np.ndarray, target: np.ndarray) -> np.ndarray:
        pairs = zip(source, target, strict=True)
        return np.array([self.pose_range.fit(x, y, (1.0, 1.0)) for x, y in pairs])

    def seeds(self) -> np.ndarray:
        """Return regular poses of the model, moved into the range, each once."""
        moved, given = super().seeds(), self.pose_range
        w, v = moved[:, :1], moved[:, 1:4]
        if given.axis is not None:
            v[:, :2] = 0.0  # the nearest rotation about the z-axis
        length = np.linalg.norm(v, axis=1)[:, None]
        half = np.minimum(np.arctan2(length, np.abs(w)), 0.5 * math.radians(given.max_angle))
        v *= np.sin(half) * np.where(w < 0.0, -1.0, 1.0) / np.where(length > 0.0, length, np.inf)
        w[:] = np.cos(half)
        gap = _matrices(moved[:, :4]) @ given.pivot + moved[:, 4:] - given.place
        excess = np.linalg.norm(gap, axis=1)[:, None] / max(given.max_translation, 1e-300)
        moved[:, 4:] -= gap * (1.0 - 1.0 / np.maximum(1.0, excess))
        _, first = np.unique(np.round(moved, 6), axis=0, return_index=True)
        return moved[np.sort(first)]

    def _congruent(self, seed: int, budget: Any) -> list[np.ndarray]:
        """Return poses of congruent triples that nearly lie in the range."""
        return [theta for theta in super()._congruent(seed, budget) if self._is_near(theta)]

    def _is_near(self, theta: np.ndarray) -> bool:
        own, near = (_matrices(each[None, :4])[0] for each in (theta, self.nearest(theta)))
        return bool(angles((near @ own.T)[None])[0] <= _MAX_CHANGE)


def rigid_in_region(
    source: np.ndarray,
    target: np.ndarray,
    n_inliers: int,
    candidates: np.ndarray | None,
    *settings: Any,
    region: Region,
) -> RigidInRegion:
    """Return the space of the rigid poses in a region; the source is the moving cloud."""
    kind = RigidNear if isinstance(region, Near) else RigidInRegion
    return kind(source, target, n_inliers, candidates, *settings).within(region)


class RegionBound(RigidBound):
    """The bounds of stationary poses inside the region, elsewhere bounds that hold for every pose."""

    space: RigidInRegion

    def _evaluate(self, boxes: Boxes, cutoff: float | None) -> Evaluation:
        inside = self.space.inside(boxes.lower, boxes.upper)
        if inside.all():
            return super()._evaluate(boxes, cutoff)
        found, outside = Evaluation.empty(boxes), np.flatnonzero(~inside)
        m = self.space.n_target
        kept = (
            np.zeros((len(boxes), m), np.uint16) if boxes.warm_start is None else boxes.warm_start
        )
        found.warm_start = kept
        if inside.any():
            some = super()._evaluate(boxes[inside], cutoff)
            assert some.warm_start is not None
            found.lower_bounds[inside], found.values[inside] = some.lower_bounds, some.values
            found.thetas[inside], kept[inside] = some.thetas, some.warm_start
        self._evaluate_anywhere(boxes, outside, np.inf if cutoff is None else cutoff, found)
        return found

    def _evaluate_anywhere(
        self, boxes: Boxes, rows: np.ndarray, cutoff: float, found: Evaluation
    ) -> None:
        lower, upper = boxes.lower[rows], boxes.upper[rows]
        bounds, values = np.empty(len(rows)), np.empty(len(rows))

        def work(part: slice) -> int:
            spent: int = bound_boxes_anywhere(
                lower[part], upper[part], cutoff, self.space.clouds, bounds[part], values[part]
            )
            return spent

        self.map_slices(len(rows), work)
        found.lower_bounds[rows], found.values[rows] = bounds, values


def _angle_radii(lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return the maximum angle of a rotation in boxes of quaternions from that at the centre.

    The quaternions within an angle of the centre form a convex cone, so the vertices are farthest. One of
    the four coordinates of each box is fixed.
    """
    q = 0.5 * (lower + upper)
    widest = np.argsort(lower - upper, axis=1)[:, None, :3]
    ends = [np.take_along_axis(each[:, None], widest, axis=2) for each in (lower, upper)]
    bits = (np.arange(8)[:, None] >> np.arange(3)) & 1
    vertices = np.repeat(q[:, None], 8, axis=1)
    places = np.repeat(widest, 8, axis=1)
    np.put_along_axis(vertices, places, np.where(bits, ends[1], ends[0]), axis=2)
    # real and vector part of the rotations from the centre to the vertices
    inner, v, c = np.einsum("bvc,bc->bv", vertices, q), vertices[..., 1:], q[:, None, 1:]
    outer = q[:, None, :1] * v - vertices[..., :1] * c + np.cross(c, v)
    angle = 2.0 * np.arctan2(np.linalg.norm(outer, axis=2), inner).max(axis=1)
    return np.minimum(angle * (1.0 + 1e-12), math.pi)


def _matrices(quaternions: np.ndarray) -> np.ndarray:
    """Return the (B, 3, 3) rotation matrices of quaternions of any length."""
    w, x, y, z = quaternions.T / np.linalg.norm(quaternions, axis=1)
    rows = (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
    return np.moveaxis(np.array(rows), 2, 0)
