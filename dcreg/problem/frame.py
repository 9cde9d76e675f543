"""The normalised coordinates in which problems are solved."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dcreg.problem.problem import Problem
from dcreg.problem.tolerance import unit_length


@dataclass(frozen=True)
class Frame:
    """The normalised coordinates of a solve: both sets centred, one common unit of length."""

    source_centre: np.ndarray
    target_centre: np.ndarray
    unit: float

    @classmethod
    def of(cls, problem: Problem) -> Frame:
        unit = unit_length(problem.source, problem.target) or 1.0
        return cls(problem.source.mean(axis=0), problem.target.mean(axis=0), unit)

    @property
    def area(self) -> float:
        """Squared units of the files in one squared unit of the frame: the factor of objectives."""
        return self.unit**2

    def source(self, points: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray((points - self.source_centre) / self.unit)

    def target(self, points: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray((points - self.target_centre) / self.unit)

    def pose(self, T: np.ndarray) -> np.ndarray:
        """The pose `T` between normalised clouds, in the coordinates of the files."""
        d = len(self.source_centre)
        out = np.eye(d + 1)
        out[:d, :d] = T[:d, :d]
        out[:d, d] = self.unit * T[:d, d] + self.target_centre - T[:d, :d] @ self.source_centre
        return out
