"""Bounds over 2D similarities from linearised products, for RPM-BP and HBSP.

With phi1 = t1^2 + t2^2, phi2 = t1 t3 + t2 t4 and phi3 = t1 t4 - t2 t3 the products in the objective have
two factors: an aggregate g_f = sum p_ij f_ij of the matching, and a component of theta or phi,

    E = g_xx phi1 + 2 g_x1 phi2 + 2 g_x2 phi3 - 2 (g_d t1 + g_w t2 + g_y1 t3 + g_y2 t4)
        + k (t3^2 + t4^2) + g_yy.

Each product is replaced by the mean of its two active McCormick facets over the range of g_f (over all
matchings) and of the other factor (over the box; exact, since the summands of each phi share no
parameter). Then E is the sum of a constant, a linear function of the matching, minimised by a
k-assignment, and

    beta.theta + gamma.phi + k (t3^2 + t4^2),

which each method relaxes further, with phi tied to theta.
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Sequence

import numpy as np

from baselines._shared.kernels.products import (
    N_FEATURES,
    feature_ranges,
    linearise,
    pair_features,
)
from dcreg.families.dc.space import FeatureSpace
from dcreg.families.protocol import SpaceBound
from dcreg.search import Box, Boxes, Evaluation

# (beta, gamma, lower, upper) -> relaxed minimum of beta.theta + gamma.phi + k (t3^2 + t4^2) over the box,
# and the theta that attains it
MinimumOverBox = Callable[
    [np.ndarray, np.ndarray, np.ndarray, np.ndarray], tuple[float, np.ndarray]
]


class SubstitutedBound(SpaceBound[FeatureSpace]):
    """Common part of the bounds: the linear part over matchings, and the exact value of the candidate.

    Every box needs a convex programme. Rounds are small so that the search stays interruptible.
    """

    round_pairs, max_round = 20_000, 4

    def __init__(
        self, space: FeatureSpace, roots: Sequence[Box] | None = None, threads: int = 1
    ) -> None:
        super().__init__(space, roots, threads)
        self.features = np.empty((N_FEATURES + 1, space.n_source, space.n_target))
        pair_features(space.source, space.clouds.target, self.features)
        self.low, self.high = np.empty(N_FEATURES), np.empty(N_FEATURES)
        feature_ranges(self.features, space.n_inliers, space.stop_flag, self.low, self.high)
        self.n_assignments += 2 * N_FEATURES

    @abc.abstractmethod
    def minimum_over_box(self) -> MinimumOverBox:
        """Return a solver of the programme in theta and phi for one thread."""

    def _evaluate(self, boxes: Boxes, cutoff: float | None) -> Evaluation:
        space, found = self.space, Evaluation.empty(boxes)

        def work(part: slice) -> int:
            lo, up, bounds = boxes.lower[part], boxes.upper[part], found.lower_bounds[part]
            beta, gamma = np.empty_like(lo), np.empty((len(lo), 3))
            spent = linearise(
                self.features, self.low, self.high, space.n_inliers, lo, up, bounds, beta, gamma
            )
            minimum = self.minimum_over_box()
            for box in range(len(lo)):
                value, theta = minimum(beta[box], gamma[box], lo[box], up[box])
                bounds[box] += value
                found.thetas[part][box] = np.clip(theta, lo[box], up[box])
            return spent + space.objectives(found.thetas[part], found.values[part])

        self.map_slices(len(boxes), work)
        return found
