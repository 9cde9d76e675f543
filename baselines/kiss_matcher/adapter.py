"""KISS-Matcher: with its own front end, or its pruning and solver on given correspondences."""

from __future__ import annotations

from typing import Any

import numpy as np

from baselines._shared.front_ends import CorrespondenceMethod
from baselines._shared.poses import homogeneous
from baselines.contract import Instance
from dcreg.problem import nearest_rotation
from dcreg.search import Budget

# The library derives its radii and noise bounds from the voxel size and refuses small ones; clouds are
# rescaled so that the voxel size in the unit of the instance becomes this one (the library's default).
VOXEL = 0.3


class Adapter(CorrespondenceMethod):
    """ROBIN's graph pruning (k-core) and GNC over the remaining pairs."""

    has_own_front_end = True

    def solve_clouds(self, instance: Instance) -> tuple[np.ndarray | None, int]:
        frame = _Frame(instance, self.inlier_distance(instance))
        matcher = _matcher()
        found = matcher.estimate(frame.source(instance.source), frame.target(instance.target))
        return frame.pose(found), len(matcher.get_final_correspondences())

    def solve_pairs(
        self, instance: Instance, pairs: np.ndarray, budget: Budget
    ) -> np.ndarray | None:
        frame = _Frame(instance, self.inlier_distance(instance))
        found = _matcher().prune_and_solve(
            frame.source(instance.source[pairs[:, 0]]), frame.target(instance.target[pairs[:, 1]])
        )
        return frame.pose(found)


def _matcher() -> Any:
    import kiss_matcher

    return kiss_matcher.KISSMatcher(kiss_matcher.KISSMatcherConfig(voxel_size=VOXEL))


class _Frame:
    """The library's coordinates: it uses single precision, so the clouds are centred."""

    def __init__(self, instance: Instance, voxel: float) -> None:
        self.unit = voxel / VOXEL
        self.origin_source = instance.source.mean(axis=0)
        self.origin_target = instance.target.mean(axis=0)

    def source(self, points: np.ndarray) -> list[np.ndarray]:
        return list(((points - self.origin_source) / self.unit).astype(np.float32))

    def target(self, points: np.ndarray) -> list[np.ndarray]:
        return list(((points - self.origin_target) / self.unit).astype(np.float32))

    def pose(self, found: Any) -> np.ndarray | None:
        """Return the pose of a solution in the coordinates of the instance, or None if it is invalid."""
        rotation, translation = np.asarray(found.rotation), np.ravel(found.translation)
        if not (found.valid and np.isfinite(rotation).all() and np.isfinite(translation).all()):
            return None
        rotation = nearest_rotation(rotation)
        shift = self.unit * translation + self.origin_target - rotation @ self.origin_source
        return homogeneous(1.0, rotation, shift)
