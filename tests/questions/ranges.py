"""The best pose of a range for given pairs, where `PoseRange.fit` is not exact: by local searches."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from dcreg.problem import PoseRange, Problem, apply_pose, nearest_rotation, scale_of

STARTS = 4  # in addition to the pose of `PoseRange.fit`


def improved(problem: Problem, T: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the best pose of the range for the pairs x, y; `T` if that is known to be the best one.

    Local searches start from `T` and from other poses of the range. All poses are admissible, so the
    objective of the best one can only be too high: a lower bound above it is wrong in any case.
    """
    poses = _Poses.of(problem, x, y)
    if poses is None:
        return T
    rng, best, least = np.random.default_rng(0), T, poses.value(T)
    for start in [poses.parameters(T), *(poses.random(rng) for _ in range(STARTS))]:
        found = minimize(
            lambda parameters: poses.value(poses.pose(parameters)), start, method="SLSQP",
            bounds=poses.bounds, constraints=poses.constraints, options={"ftol": 1e-13},
        )  # fmt: skip
        pose = poses.pose(found.x)
        value = poses.value(pose)
        if value < least and poses.limits.contains(pose):
            best, least = pose, value
    return best


@dataclass(frozen=True)
class _Poses:
    """The poses of a range by rotation vector and scale, each with the best translation for the pairs."""

    limits: PoseRange
    scale_range: tuple[float, float]
    x: np.ndarray
    y: np.ndarray

    @classmethod
    def of(cls, problem: Problem, x: np.ndarray, y: np.ndarray) -> _Poses | None:
        """Return the poses; None if `PoseRange.fit` is exact."""
        limits, scales = problem.pose_range, problem.scale_range
        assert limits is not None
        is_exact = math.isinf(limits.max_translation) or len(x) == len(problem.source)
        if not limits.max_angle and scales[0] == scales[1]:
            return None  # only a translation is free
        if is_exact and (x.shape[1] == 2 or limits.axis is not None or not limits.has_limits):
            return None
        return cls(limits, scales, x, y)

    @property
    def n_turns(self) -> int:
        """The number of parameters of the rotation."""
        if not self.limits.max_angle:
            return 0
        return 3 if self.x.shape[1] == 3 and self.limits.axis is None else 1

    @property
    def bounds(self) -> list[tuple[float, float]]:
        """Bounds of the parameters."""
        most = math.radians(self.limits.max_angle)
        has_scale = self.scale_range[0] < self.scale_range[1]
        return [(-most, most)] * self.n_turns + [self.scale_range] * has_scale

    @property
    def constraints(self) -> list[dict[str, object]]:
        """The limit of the angle of a free rotation in 3D."""
        most = math.radians(self.limits.max_angle)
        if self.n_turns < 3 or self.limits.max_angle == 180.0:
            return []
        return [{"type": "ineq", "fun": lambda p: most**2 - p[:3] @ p[:3]}]

    def random(self, rng: np.random.Generator) -> np.ndarray:
        """Return random parameters of the range."""
        found = rng.uniform(*np.transpose(self.bounds))
        if self.n_turns == 3:
            found[:3] /= math.sqrt(3.0)  # the largest angle is that of the range
        return found

    def parameters(self, T: np.ndarray) -> np.ndarray:
        """Return the parameters of a pose."""
        reference = nearest_rotation(self.limits.around[:-1, :-1])
        turn = nearest_rotation(T[:-1, :-1]) @ reference.T
        if len(turn) == 2:
            vector = np.array([math.atan2(turn[1, 0], turn[0, 0])])
        else:
            vector = Rotation.from_matrix(turn).as_rotvec()
            vector = vector if self.limits.axis is None else np.array([vector @ self.limits.axis])
        found = np.concatenate([vector[: self.n_turns], [scale_of(T)]])
        return np.clip(found[: len(self.bounds)], *np.transpose(self.bounds))

    def pose(self, parameters: np.ndarray) -> np.ndarray:
        """Return the pose of parameters."""
        limits, turns = self.limits, parameters[: self.n_turns]
        scale = parameters[self.n_turns] if len(parameters) > self.n_turns else self.scale_range[0]
        d = self.x.shape[1]
        turn = np.eye(d)
        if d == 2 and len(turns):
            cosine, sine = math.cos(turns[0]), math.sin(turns[0])
            turn = np.array([[cosine, -sine], [sine, cosine]])
        elif len(turns):
            vector = turns if limits.axis is None else turns[0] * limits.axis
            turn = Rotation.from_rotvec(vector).as_matrix()
        T = np.eye(d + 1)
        T[:d, :d] = scale * turn @ nearest_rotation(limits.around[:d, :d])
        T[:d, d] = self.y.mean(axis=0) - T[:d, :d] @ self.x.mean(axis=0)
        # the objective grows with the distance from the best translation
        gap = apply_pose(T, limits.pivot[None])[0] - limits.place
        length = float(np.linalg.norm(gap))
        T[:d, d] -= gap * max(0.0, 1.0 - limits.max_translation / max(length, 1e-300))
        return T

    def value(self, T: np.ndarray) -> float:
        """Return the sum of the squared residuals of the pairs."""
        return float(((apply_pose(T, self.x) - self.y) ** 2).sum())
