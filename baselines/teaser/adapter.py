"""TEASER, a port of the published algorithm."""

from __future__ import annotations

import numpy as np

from baselines._shared import cliques
from baselines._shared.front_ends import CorrespondenceMethod, Estimate
from baselines.contract import Instance
from baselines.teaser.pipeline import register
from dcreg.search import Budget


class Adapter(CorrespondenceMethod):
    """Maximum clique of consistent pairs, GNC-TLS rotation, voted scale and translation."""

    def warm_up(self, instance: Instance) -> None:
        super().warm_up(instance)
        cliques.warm_up()

    def estimate(self, instance: Instance, pairs: np.ndarray, budget: Budget) -> Estimate:
        found = register(
            instance.source[pairs[:, 0]],
            instance.target[pairs[:, 1]],
            pairs,
            self.inlier_distance(instance),
            instance.scale_range,
            budget,
        )
        size, bound = len(found.clique.vertices), found.clique.upper_bound
        proof = "proven maximum" if found.clique.is_maximum else f"not proven, at most {bound}"
        return Estimate(
            found.pose,
            found.finished,
            f"clique of {size} pairs ({proof}); {found.n_rotation_inliers} kept by the rotation",
            {
                "clique_size": size,
                "clique_upper_bound": bound,
                "rotation_inliers": found.n_rotation_inliers,
                "inliers": found.n_inliers,
            },
        )
