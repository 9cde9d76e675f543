"""Ranges of poses around a reference pose, limited by axis, angle or translation."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dcreg.problem.errors import InputError
from dcreg.problem.geometry import apply_pose, fit_pose, nearest_rotation, scale_of

SLACK = 1e-9  # relative; a pose at a limit of the range may be a rounding error outside
_AT = 1.0 - 1e-6  # share of a limit from which a pose lies at it
_RIGID = 1e-4  # deviation of a given matrix from a rotation that counts as its rounding
# Deviation from 1 of the scale of a rigid pose. That of 3DMatch's official poses reaches 0.00063.
_UNIT_SCALE = 1e-3


@dataclass(frozen=True)
class PoseRange:
    """The poses that a search may return, relative to a reference pose.

    Attributes
    ----------
    axis : (3,) array, optional
        In 3D: the axis of all admissible rotations, in the coordinates of the target; it need not be a
        unit vector. For level scans this is the direction of gravity.
    max_angle : float
        Maximum angle of the rotation from the reference pose, in degrees; 0 excludes rotations.
    max_translation : float
        Maximum distance of the moved pivot from its place at the reference pose, in units of the target.
    around : (d+1, d+1) array, optional
        The reference pose; default: the identity. Its scale does not limit that of the result; in 3D it
        must be 1.
    pivot : (d,) array, optional
        The source point whose displacement is limited; default: the centroid of the source.

    Examples
    --------
    >>> import numpy as np, dcreg
    >>> rng = np.random.default_rng(0)
    >>> points = rng.random((30, 3))
    >>> found = dcreg.register(
    ...     points, points + [0.2, 0.0, 0.1], n_inliers=20, model="rigid3d",
    ...     pose_range=dcreg.PoseRange(axis=(0, 0, 1), max_angle=30, max_translation=1.0),
    ... )
    >>> found.status.value, np.round(found.translation, 6).tolist()
    ('optimal', [0.2, 0.0, 0.1])
    """

    axis: Any = None
    max_angle: float = 180.0
    max_translation: float = math.inf
    around: Any = None
    pivot: Any = None

    def checked(self, source: np.ndarray, scale_range: tuple[float, float]) -> PoseRange:
        """Return the range with checked values and all defaults filled in; `axis` may remain None.

        Raises
        ------
        InputError
        """
        d = source.shape[1]
        axis = _checked_axis(self.axis, d)
        angle = _checked_number("max_angle", self.max_angle, "an angle in degrees such as 30")
        if angle > 180.0:
            raise InputError(f"max_angle: {angle} exceeds 180 degrees; give at most 180")
        shift = _checked_number("max_translation", self.max_translation, "a length such as 0.5")
        around = (
            np.eye(d + 1)
            if self.around is None
            else checked_pose("around", self.around, d, has_scale=d == 2)
        )
        pivot = source.mean(axis=0) if self.pivot is None else _vector("pivot", self.pivot, d)
        low, high = scale_range
        if low == high and shift == angle == 0.0:
            raise InputError(
                "max_angle, max_translation: both are 0 and the scale is fixed, which leaves only one "
                "pose; use dcreg.objective for its objective"
            )
        return PoseRange(axis, angle, shift, around, pivot)

    @property
    def has_limits(self) -> bool:
        """Whether an optimum can lie at a limit of the range, where it need not be stationary."""
        return math.isfinite(self.max_translation) or 0.0 < self.max_angle < 180.0

    @property
    def place(self) -> np.ndarray:
        """The pivot, moved by the reference pose."""
        place: np.ndarray = apply_pose(self.around, self.pivot[None])[0]
        return place

    def is_at_limit(self, T: np.ndarray) -> bool:
        """Tell whether a pose of the range lies at a limit that is neither 0 nor everything."""
        angle, gap = np.linalg.norm(self._turn(T)), self._gap(T)
        is_turned = 0.0 < self.max_angle < 180.0 and angle >= _AT * math.radians(self.max_angle)
        return bool(is_turned or 0.0 < _AT * self.max_translation <= gap)

    def _turn(self, T: np.ndarray) -> np.ndarray:
        """Return the rotation of a pose from the reference pose, as a `rotation_vector`."""
        d = len(self.pivot)
        return rotation_vector(
            nearest_rotation(T[:d, :d]) @ nearest_rotation(self.around[:d, :d]).T
        )

    def _gap(self, T: np.ndarray) -> float:
        """Return the distance of the moved pivot from its place."""
        return float(np.linalg.norm(apply_pose(T, self.pivot[None])[0] - self.place))

    def contains(self, T: np.ndarray) -> bool:
        """Tell whether a pose of the model lies in the range, up to rounding."""
        vector = self._turn(T)
        if np.linalg.norm(vector) > math.radians(self.max_angle) + SLACK:
            return False
        if self.axis is not None and np.linalg.norm(np.cross(vector, self.axis)) > SLACK:
            return False
        slack = SLACK * (1.0 + np.abs(T).max())
        return bool(self._gap(T) <= self.max_translation * (1.0 + SLACK) + slack)

    def fit(
        self, source: np.ndarray, target: np.ndarray, scale_range: tuple[float, float]
    ) -> np.ndarray:
        """Return a pose of the range that fits paired points.

        It is the least-squares pose of the range, except at the limit of the angle in 3D without an axis,
        or of the translation if the pivot is not the mean of the source points.

        Parameters
        ----------
        source, target : (k, d) arrays
        scale_range : (low, high)

        Returns
        -------
        (d+1, d+1) array
        """
        T = fit_pose(source, target, scale_range)
        d, scale = source.shape[1], scale_of(T)
        x, y = source - source.mean(axis=0), target - target.mean(axis=0)
        rotation = self._turned(T[:d, :d] / scale, x, y)
        if scale_range[0] < scale_range[1]:
            spread = (x * x).sum()
            gain = (y * (x @ rotation.T)).sum() / spread if spread > 0.0 else scale
            scale = float(np.clip(gain, *scale_range))
        return self._placed(scale * rotation, target.mean(axis=0), source.mean(axis=0))

    def nearest(self, T: np.ndarray) -> np.ndarray:
        """Return a pose of the range near a pose of the model; exact if that lies in the range."""
        d, scale = len(self.pivot), scale_of(T)
        identity = np.eye(d)
        rotation = T[:d, :d] / scale
        rotation = self._turned(rotation, identity, identity @ rotation.T)
        return self._placed(scale * rotation, apply_pose(T, self.pivot[None])[0], self.pivot)

    def _turned(self, rotation: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the rotation of the range that is best for centred pairs, given the best one of all."""
        reference = nearest_rotation(self.around[: len(rotation), : len(rotation)])
        limit = math.radians(self.max_angle)
        if self.axis is None:
            vector = rotation_vector(rotation @ reference.T)
            angle = float(np.linalg.norm(vector))
            if angle <= limit:
                return rotation
            return rotation_of(vector * (limit / angle)) @ reference
        moved = x @ reference.T
        sine = float(np.cross(moved, y).sum(axis=0) @ self.axis)
        cosine = float((moved * y).sum() - (moved @ self.axis) @ (y @ self.axis))
        angle = min(max(math.atan2(sine, cosine), -limit), limit)
        return rotation_of(angle * self.axis) @ reference

    def _placed(self, linear: np.ndarray, y: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Return the pose with this linear part that moves x as near to y as the range allows."""
        shift = y - linear @ x
        gap = linear @ self.pivot + shift - self.place
        length = float(np.linalg.norm(gap))
        if length > self.max_translation:
            shift = shift - gap * (1.0 - self.max_translation / length)
        T = np.eye(len(linear) + 1)
        T[:-1, :-1], T[:-1, -1] = linear, shift
        return T

    def rotations(self) -> tuple[np.ndarray, np.ndarray]:
        """Return rotations of source and target after which the reference pose does not rotate.

        The axis becomes the z-axis.
        """
        d = len(self.pivot)
        turned: np.ndarray = np.eye(d)
        if self.axis is not None:
            # the rows are an orthonormal basis, the axis last
            turned = np.vstack([np.linalg.svd(self.axis[None])[2][1:], self.axis])
            turned[0] *= np.sign(np.linalg.det(turned))
        return turned @ nearest_rotation(self.around[:d, :d]), turned

    def in_frame(
        self, target: np.ndarray, pivot: np.ndarray, place: np.ndarray, unit: float
    ) -> PoseRange:
        """Return the same range in coordinates in which the reference pose is a translation.

        Parameters
        ----------
        target : (d, d) array
            Rotation of the target to the new coordinates.
        pivot, place : (d,) arrays
            In the new coordinates.
        unit : float
            New unit of length.
        """
        around = np.eye(len(pivot) + 1)
        around[:-1, -1] = place - pivot
        axis = None if self.axis is None else target @ self.axis
        return replace(
            self, axis=axis, max_translation=self.max_translation / unit, around=around, pivot=pivot
        )


def rotation_vector(rotation: np.ndarray) -> np.ndarray:
    """Return axis times angle of a rotation; in 2D the angle, as a vector of one number."""
    if len(rotation) == 2:
        return np.array([math.atan2(rotation[1, 0], rotation[0, 0])])
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(rotation).as_rotvec())


def rotation_of(vector: np.ndarray) -> np.ndarray:
    """Return the rotation of a `rotation_vector`."""
    if len(vector) == 1:
        cosine, sine = math.cos(vector[0]), math.sin(vector[0])
        return np.array([[cosine, -sine], [sine, cosine]])
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_rotvec(vector).as_matrix())


def checked_pose(name: str, pose: Any, d: int, *, has_scale: bool) -> np.ndarray:
    """Return a (d+1, d+1) pose: a rotation, times a scale if it has one, and a translation.

    Raises
    ------
    InputError
    """
    try:
        T = np.array(pose, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(
            f"{name}: not a matrix of numbers; give a pose such as np.eye({d + 1})"
        ) from None
    if T.shape != (d + 1, d + 1):
        raise InputError(f"{name}: shape {T.shape}; give a ({d + 1}, {d + 1}) matrix of numbers")
    if not np.isfinite(T).all():
        raise InputError(f"{name}: contains NaN or infinity, not finite numbers; correct it")
    scale = scale_of(T)
    if np.abs(T[d] - np.eye(d + 1)[d]).max() > 0.0:
        raise InputError(f"{name}: the last row is {T[d].tolist()}; it must be 0 … 0 1")
    rotation = nearest_rotation(T[:d, :d])
    if not scale > 0.0 or np.abs(T[:d, :d] - scale * rotation).max() > _RIGID * scale:
        raise InputError(
            f"{name}: the upper left {d} x {d} part is not a rotation"
            f"{' times a scale' if has_scale else ''}; give a proper pose (determinant above 0)"
        )
    if not has_scale and abs(scale - 1.0) > _UNIT_SCALE:
        raise InputError(
            f"{name}: its scale is {scale:.6g}, but rigid3d has no scale; divide its upper left 3 x 3 "
            "part by it, or use model similarity3d"
        )
    T[:d, :d] = rotation * (scale if has_scale else 1.0)
    return T


def _checked_axis(axis: Any, d: int) -> np.ndarray | None:
    if axis is None:
        return None
    if d != 3:
        raise InputError(
            "axis: only rigid3d has an axis; omit axis, because rotations in 2D have none"
        )
    vector = _vector("axis", axis, d)
    length = float(np.linalg.norm(vector))
    if not length > 0.0:
        raise InputError("axis: all zero; give a direction such as (0, 0, 1)")
    return vector / length


def _vector(name: str, values: Any, d: int) -> np.ndarray:
    try:
        vector = np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        vector = np.empty(0)
    if vector.shape != (d,) or not np.isfinite(vector).all():
        raise InputError(f"{name}: {values!r} is not a vector; give {d} numbers")
    return vector


def _checked_number(name: str, value: Any, such_as: str) -> float:
    is_number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    if not is_number or not value >= 0.0:
        raise InputError(
            f"{name}: {value!r} is negative or not a number; give {such_as}, at least 0"
        )
    return float(value)
