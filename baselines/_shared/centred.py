"""What papers leave open about their problem: units, start boxes and the tolerance; ours."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from baselines._shared.tolerance import absolute_tolerance
from baselines.contract import Instance
from dcreg.families.dc.space import FeatureSpace
from dcreg.families.similarity2d.space import Similarity2D
from dcreg.families.translation3d.space import Translation3D
from dcreg.problem import Frame, rms_radius
from dcreg.search import Box

UNITS = ("source", "target", "none")
START_BOXES = ("radius", "extent", "stationary")
_INFLATION = 1.5  # of the bounding box of the source, in norm space


@dataclass(frozen=True)
class Centred:
    """An instance whose clouds are centred at their means and divided by one unit.

    Attributes
    ----------
    frame : Frame
    source, target : (n, d), (m, d) arrays
    n_inliers : int
    scale_range : (low, high)
    """

    frame: Frame
    source: np.ndarray
    target: np.ndarray
    n_inliers: int
    scale_range: tuple[float, float]

    @classmethod
    def of(cls, instance: Instance, unit: str) -> Centred:
        """Centre both clouds and divide them by the RMS radius of one of them.

        The unit decides how the edges of boxes compare: with that of the source, a unit step along each
        axis of a similarity moves its points by the same RMS distance.
        """
        source, target = (
            np.asarray(points, float) for points in (instance.source, instance.target)
        )
        centres = source.mean(axis=0), target.mean(axis=0)
        lengths = {"source": rms_radius(source), "target": rms_radius(target), "none": 1.0}
        frame = Frame(*centres, lengths[unit] or 1.0)
        return cls(
            frame, frame.source(source), frame.target(target), instance.n_inliers,
            instance.scale_range,
        )  # fmt: skip

    def epsilon(self, factor: float) -> float:
        """Return ``k (factor r)^2``, r the RMS radius of the target."""
        return absolute_tolerance(self.target, self.n_inliers, factor)

    def space(self, stop_flag: np.ndarray, stationary: bool = False) -> FeatureSpace:
        """Return the similarities, or the translations in norm space."""
        if self.source.shape[1] == 3:
            return Translation3D(
                self.source, self.target, self.n_inliers, None, stop_flag, stationary
            )
        return Similarity2D(
            self.source, self.target, self.n_inliers, self.scale_range, None, stop_flag, stationary
        )

    def start_box(self, name: str) -> Box:
        """Return the start box.

        - ``radius``: in 2D similarities of at most the maximum admissible scale along each axis;
          translations up to the sum of the radii of both clouds, the source at that scale.
        - ``extent``: 2D: the same, with translations up to the largest coordinate of the target. 3D:
          the bounding box of the source, half as large again. It need not contain the optimum: of
          instances with many outliers or occlusion it excludes the true pose of some.
        - ``stationary``: the start box of this library.

        The first and the last one contain every optimum.
        """
        if name != "extent":
            (root,) = self.space(np.zeros(1, np.uint8), name == "stationary").roots()
            return root
        if self.source.shape[1] == 3:
            half = 0.5 * _INFLATION * np.ptp(self.source, axis=0)
        else:
            reach = np.abs(self.target).max()
            half = np.array([*2 * [self.scale_range[1]], reach, reach])
        return Box(-half, half)
