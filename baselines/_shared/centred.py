"""Our choices of what the papers leave open: unit, start box and tolerance."""

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

        The unit decides which edge of a box is the longest. With the unit of the source, a unit step
        along any axis of a similarity moves the source points by the same RMS distance.
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
        """Return ``k (factor r)^2``, where r is the RMS radius of the target."""
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

        - ``radius``: the start box ``radius`` of this library. Each linear parameter is at most the
          maximum scale; translations are at most the sum of the radii of both clouds, in 2D with the
          source at the maximum scale.
        - ``extent``: in 2D the same, with translations up to the largest coordinate of the target; in
          3D the bounding box of the source, enlarged by half. It may not contain the optimum: it
          excludes the true pose of some instances with many outliers or occlusion.
        - ``stationary``: the default start box of this library.

        ``radius`` and ``stationary`` contain every optimum.
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
