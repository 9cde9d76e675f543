"""KISS-Matcher's pruning and solver on given correspondences."""

from __future__ import annotations

import numpy as np

from baselines._shared.front_ends import CorrespondenceMethod
from baselines._shared.poses import homogeneous
from baselines.contract import Instance
from dcreg.problem import nearest_rotation
from dcreg.search import Budget

# The library derives its noise bounds from the voxel size and refuses small ones; clouds are
# rescaled so that the noise bound becomes this voxel size (the library's default).
VOXEL = 0.3


class Adapter(CorrespondenceMethod):
    """ROBIN's graph pruning (k-core) and GNC over the remaining pairs."""

    def solve_pairs(
        self, instance: Instance, pairs: np.ndarray, budget: Budget
    ) -> np.ndarray | None:
        import kiss_matcher

        unit = self.inlier_distance(instance) / VOXEL
        origin_source = instance.source.mean(
            axis=0
        )  # the library uses single precision: centre the clouds
        origin_target = instance.target.mean(axis=0)
        source = (instance.source[pairs[:, 0]] - origin_source) / unit
        target = (instance.target[pairs[:, 1]] - origin_target) / unit
        matcher = kiss_matcher.KISSMatcher(kiss_matcher.KISSMatcherConfig(voxel_size=VOXEL))
        found = matcher.prune_and_solve(
            list(source.astype(np.float32)), list(target.astype(np.float32))
        )
        rotation, translation = np.asarray(found.rotation), np.ravel(found.translation)
        if not (found.valid and np.isfinite(rotation).all() and np.isfinite(translation).all()):
            return None
        rotation = nearest_rotation(rotation)
        return homogeneous(
            1.0, rotation, unit * translation + origin_target - rotation @ origin_source
        )
