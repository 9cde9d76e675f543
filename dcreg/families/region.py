"""Searches for the best pose of a region: near a reference pose, or far from known poses.

The bounds of some families hold for stationary poses only. Inside a region a local optimum is stationary,
but on its boundary it need not be. A region therefore classifies boxes by two tests. It `touches` a box
that may contain a pose of the region, and a box is `inside` if all its poses lie in the interior. A box
that is not inside needs a bound that holds for every pose.

All tests compare the pose at the centre of a box with the radius of the box in the same metric: the angle
of the rotation, the displacement of the pivot, or the root mean square displacement of the source.
"""

from __future__ import annotations

import abc
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol, Self

import numpy as np

from dcreg.families.protocol import Space
from dcreg.problem import Moments, PoseRange
from dcreg.problem.pose_range import SLACK
from dcreg.search import Box, Budget


class BoxPoses(NamedTuple):
    """B boxes of poses x -> L x + t: the pose at the centre of each, and its radii.

    Attributes
    ----------
    linear : (B, d, d) array
    shift : (B, d) array
    linear_radius : (B,) array
        Maximum spectral norm of the difference between L of a pose in the box and L at its centre.
    shift_radius : (B,) array
        Maximum distance of t from t at the centre.
    angle_radius : (B,) array
        Maximum angle of a rotation of the box from that at the centre.
    """

    linear: np.ndarray
    shift: np.ndarray
    linear_radius: np.ndarray
    shift_radius: np.ndarray
    angle_radius: np.ndarray


class Region(Protocol):
    """A set of poses."""

    @property
    def has_limits(self) -> bool:
        """Whether a search without the limits of the region comes first; see `Near.without_limits`."""
        ...

    def touches(self, boxes: BoxPoses) -> np.ndarray:
        """Tell which boxes may contain a pose of the region; False is certain."""
        ...

    def inside(self, boxes: BoxPoses) -> np.ndarray:
        """Tell which boxes contain only poses in the interior of the region; True is certain."""
        ...


@dataclass(frozen=True)
class Near:
    """The poses of a range whose reference pose is a translation; see `PoseRange.in_frame`."""

    pose_range: PoseRange

    @property
    def has_limits(self) -> bool:
        """Whether an optimum can lie at a limit."""
        return self.pose_range.has_limits

    def without_limits(self) -> Near | None:
        """Return the region whose optima are all stationary; None if it consists of all poses."""
        given = self.pose_range
        if given.axis is None and given.max_angle > 0.0:
            return None
        angle = 180.0 if given.max_angle > 0.0 else 0.0
        return Near(replace(given, max_angle=angle, max_translation=math.inf))

    def _excess(self, boxes: BoxPoses) -> tuple[np.ndarray, np.ndarray]:
        """Return by how much angle and displacement at the centre exceed the limits."""
        given = self.pose_range
        angle = angles(boxes.linear) - math.radians(given.max_angle)
        gap = boxes.linear @ given.pivot + boxes.shift - given.place
        return angle, np.linalg.norm(gap, axis=1) - given.max_translation

    def _radii(self, boxes: BoxPoses) -> tuple[np.ndarray, np.ndarray]:
        reach = np.linalg.norm(self.pose_range.pivot) * boxes.linear_radius + boxes.shift_radius
        return boxes.angle_radius + SLACK, reach + SLACK

    def touches(self, boxes: BoxPoses) -> np.ndarray:
        angle, gap = self._excess(boxes)
        angle_radius, gap_radius = self._radii(boxes)
        return (angle <= angle_radius) & (gap <= gap_radius)

    def inside(self, boxes: BoxPoses) -> np.ndarray:
        angle, gap = self._excess(boxes)
        angle_radius, gap_radius = self._radii(boxes)
        # without rotations, all poses of the roots have the reference rotation
        no_limit = self.pose_range.max_angle in (0.0, 180.0)
        return ((angle < -angle_radius) | no_limit) & (gap < -gap_radius)


@dataclass(frozen=True)
class Far:
    """The poses that differ from each of some poses by more than a distance.

    The difference is the root mean square displacement of the source points.

    Attributes
    ----------
    poses : sequence of (d+1, d+1) arrays
    distance : float
    moments : Moments
        Of the source points.
    """

    poses: tuple[np.ndarray, ...]
    distance: float
    moments: Moments

    @property
    def has_limits(self) -> bool:
        return False

    @classmethod
    def of(cls, poses: Any, distance: float, source: np.ndarray) -> Far:
        """Return the region for a source cloud."""
        return cls(tuple(poses), distance, Moments.of(source))

    def _nearest(self, linear: np.ndarray, shift: np.ndarray) -> np.ndarray:
        """Return the displacement of each of B poses from the nearest known pose."""
        gaps = [
            self.moments.displacements(linear - T[:-1, :-1], shift - T[:-1, -1]) for T in self.poses
        ]
        nearest: np.ndarray = np.min(gaps, axis=0)
        return nearest

    def contains(self, T: np.ndarray) -> bool:
        """Tell whether a pose belongs to the region."""
        return bool(self._nearest(T[None, :-1, :-1], T[None, :-1, -1])[0] > self.distance)

    def _radius(self, boxes: BoxPoses) -> np.ndarray:
        mean, covariance = self.moments
        rms = math.sqrt(float(mean @ mean + np.trace(covariance)))
        radius: np.ndarray = rms * boxes.linear_radius + boxes.shift_radius + SLACK
        return radius

    def touches(self, boxes: BoxPoses) -> np.ndarray:
        """A box in the union of several balls counts only if one ball contains it."""
        gap: np.ndarray = self._nearest(boxes.linear, boxes.shift) + self._radius(boxes)
        return gap > self.distance

    def inside(self, boxes: BoxPoses) -> np.ndarray:
        gap: np.ndarray = self._nearest(boxes.linear, boxes.shift) - self._radius(boxes)
        return gap > self.distance


@dataclass(frozen=True)
class FarStationary(Far):
    """The stationary poses that are far from known ones: bounds of stationary poses hold everywhere."""

    def inside(self, boxes: BoxPoses) -> np.ndarray:
        return np.ones(len(boxes.shift), dtype=bool)


def angles(linear: np.ndarray) -> np.ndarray:
    """Return the angles of B rotations, times any scale, in radians from 0 to pi."""
    if linear.shape[-1] == 2:
        return np.abs(np.arctan2(linear[:, 1, 0], linear[:, 0, 0]))
    skew = linear - np.swapaxes(linear, 1, 2)
    sine = 0.5 * np.sqrt((skew**2).sum(axis=(1, 2)) / 2.0)
    cosine = 0.5 * (np.trace(linear, axis1=1, axis2=2) - 1.0)
    return np.arctan2(sine, cosine)


class InRegion(Space):
    """Mix-in: the poses of a space that lie in a `region`.

    Attributes
    ----------
    region : Region
    """

    region: Region

    @property
    @abc.abstractmethod
    def stationary(self) -> Box:
        """A box that contains the translations of all stationary poses.

        Translations are the last axes of the parameters.
        """

    @abc.abstractmethod
    def box_poses(self, lower: np.ndarray, upper: np.ndarray) -> BoxPoses:
        """Return the poses of B boxes of parameters."""

    @abc.abstractmethod
    def poses(self, thetas: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (B, d, d) L and (B, d) t of B parameters."""

    def within(self, region: Region) -> Self:
        """Set the region, and return the space."""
        self.region = region
        return self

    def touches(self, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
        poses, own = self.box_poses(lower, upper), super().touches(lower, upper)
        d = self.stationary.dim
        apart = (lower[:, -d:] > self.stationary.upper) | (upper[:, -d:] < self.stationary.lower)
        # an optimum inside the region is stationary
        return own & self.region.touches(poses) & ~(apart.any(axis=1) & self.region.inside(poses))

    def inside(self, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
        """Tell which boxes lie in the interior of the region."""
        return self.region.inside(self.box_poses(lower, upper))

    def admissible(self, thetas: np.ndarray) -> np.ndarray:
        point = np.zeros(len(thetas))
        poses = BoxPoses(*self.poses(thetas), point, point, point)
        return super().admissible(thetas) & self.region.touches(poses)

    def refine(self, theta: np.ndarray) -> tuple[np.ndarray, float, int]:
        """Search locally; an end outside the region has an infinite value."""
        end, value, spent = super().refine(theta)
        return end, value if self.admissible(end[None])[0] else np.inf, spent


class NearSpace(InRegion):
    """Mix-in: local searches and initial poses that stay in a `PoseRange`."""

    region: Near
    parameter: Callable[[np.ndarray], np.ndarray]  # of a pose

    def nearest(self, theta: np.ndarray) -> np.ndarray:
        """Return the parameter of a pose of the range near that of `theta`."""
        return self.parameter(self.region.pose_range.nearest(self.pose(theta)))

    def starts(self, budget: Budget) -> Iterator[tuple[np.ndarray, int]]:
        """Yield the reference pose, then the initial poses of the model, moved into the range."""
        yield self.parameter(self.region.pose_range.around), 0
        for theta, spent in super().starts(budget):
            yield self.nearest(theta), spent


def shift_box(stationary: Box, region: Region, linear_reach: float) -> Box:
    """Return a box of all translations that an optimum of the region can have.

    Within the region the optimum is stationary. At a limit it is the pose of the region that is nearest
    to a stationary one, or near a known pose.

    Parameters
    ----------
    stationary : Box
        Contains the translations of all stationary poses.
    region : Region
    linear_reach : float
        Maximum norm of L for the poses x -> L x + t of the model.
    """
    if isinstance(region, FarStationary):
        return stationary
    if isinstance(region, Far):
        shifts = np.array([T[:-1, -1] for T in region.poses])
        reach = region.distance + linear_reach * 2.0 * np.linalg.norm(region.moments.mean)
        lower, upper = shifts.min(axis=0) - reach, shifts.max(axis=0) + reach
        return Box(np.minimum(stationary.lower, lower), np.maximum(stationary.upper, upper))
    assert isinstance(region, Near)
    given = region.pose_range
    if math.isinf(given.max_translation):
        return stationary
    around = linear_reach * np.linalg.norm(given.pivot)
    lower = np.minimum(stationary.lower, given.place - around)
    upper = np.maximum(stationary.upper, given.place + around)
    reach = (around + given.max_translation) * (1.0 + SLACK) + SLACK
    lower, upper = np.maximum(lower, given.place - reach), np.minimum(upper, given.place + reach)
    return Box(lower, np.maximum(lower, upper))
