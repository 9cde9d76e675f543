"""The normalised frame in which a problem is searched."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dcreg.problem.geometry import unit_length
from dcreg.problem.pose_range import PoseRange
from dcreg.problem.problem import Problem


@dataclass(frozen=True)
class Frame:
    """Normalised coordinates: both clouds centred, with a common unit of length.

    Attributes
    ----------
    source_centre, target_centre : (d,) arrays
    unit : float
    source_rotation, target_rotation : (d, d) arrays, optional
        Applied to the clouds after that; default: none.
    """

    source_centre: np.ndarray
    target_centre: np.ndarray
    unit: float
    source_rotation: np.ndarray | None = None
    target_rotation: np.ndarray | None = None

    @classmethod
    def of(cls, problem: Problem) -> Frame:
        unit = unit_length(problem.source, problem.target) or 1.0
        centres = problem.source.mean(axis=0), problem.target.mean(axis=0)
        if problem.pose_range is None:
            return cls(*centres, unit)
        return cls(*centres, unit, *problem.pose_range.rotations())

    @property
    def area(self) -> float:
        """Factor from normalised objectives to squared units of the input."""
        return self.unit**2

    def source(self, points: np.ndarray) -> np.ndarray:
        return _turned((points - self.source_centre) / self.unit, self.source_rotation)

    def target(self, points: np.ndarray) -> np.ndarray:
        return _turned((points - self.target_centre) / self.unit, self.target_rotation)

    def pose_range(self, given: PoseRange) -> PoseRange:
        """Return a range in normalised coordinates, where its reference pose is a translation."""
        assert self.target_rotation is not None
        pivot, place = self.source(given.pivot[None])[0], self.target(given.place[None])[0]
        return given.in_frame(self.target_rotation, pivot, place, self.unit)

    def pose(self, T: np.ndarray) -> np.ndarray:
        """Convert a pose between normalised clouds to the coordinates of the input."""
        d = len(self.source_centre)
        linear, shift, out = T[:d, :d], T[:d, d], np.eye(d + 1)
        if self.source_rotation is not None and self.target_rotation is not None:
            linear = self.target_rotation.T @ linear @ self.source_rotation
            shift = self.target_rotation.T @ shift
        out[:d, :d] = linear
        out[:d, d] = self.unit * shift + self.target_centre - linear @ self.source_centre
        return out

    def normalised_pose(self, T: np.ndarray) -> np.ndarray:
        """Convert a pose of the input to normalised coordinates: the inverse of `pose`."""
        d = len(self.source_centre)
        linear, out = T[:d, :d], np.eye(d + 1)
        shift = (linear @ self.source_centre + T[:d, d] - self.target_centre) / self.unit
        if self.source_rotation is not None and self.target_rotation is not None:
            linear = self.target_rotation @ linear @ self.source_rotation.T
            shift = self.target_rotation @ shift
        out[:d, :d], out[:d, d] = linear, shift
        return out


def _turned(points: np.ndarray, rotation: np.ndarray | None) -> np.ndarray:
    return np.ascontiguousarray(points if rotation is None else points @ rotation.T)
