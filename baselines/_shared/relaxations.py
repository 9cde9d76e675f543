"""Relaxations that separate matching and pose: one box at a time, and in 2D for RPM-BP and HBSP.

In 2D both methods linearise products. Let phi1 = t1^2 + t2^2, phi2 = t1 t3 + t2 t4 and phi3 =
t1 t4 - t2 t3. The products in the objective then have two factors, an aggregate g_f = sum p_ij f_ij of
the matching and a component of theta or phi:

    E = g_xx phi1 + 2 g_x1 phi2 + 2 g_x2 phi3 - 2 (g_d t1 + g_w t2 + g_y1 t3 + g_y2 t4)
        + k (t3^2 + t4^2) + g_yy.

Each product is replaced by the mean of its two active McCormick facets over the range of g_f (over all
matchings) and of the other factor (over the box). The latter range is exact, because the summands of
each phi share no parameter. E is then the sum of a constant, a linear function of the matching, which a
k-assignment minimises, and

    beta.theta + gamma.phi + k (t3^2 + t4^2),

which each method relaxes further, with phi tied to theta.
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Sequence
from operator import itemgetter
from typing import Any, TypeVar

import numpy as np

from baselines._shared.algorithm1 import Bounded
from baselines._shared.kernels.products import (
    N_FEATURES,
    feature_ranges,
    linearise,
    pair_features,
)
from dcreg.families.dc.space import FeatureSpace
from dcreg.families.protocol import Space, SpaceBound
from dcreg.search import Box, Boxes, Evaluation

# (beta, gamma, lower, upper) -> relaxed minimum of beta.theta + gamma.phi + k (t3^2 + t4^2) over the box,
# and the theta that attains it
MinimumOverBox = Callable[
    [np.ndarray, np.ndarray, np.ndarray, np.ndarray], tuple[float, np.ndarray]
]


S = TypeVar("S", bound=Space)


class Relaxation(SpaceBound[S]):
    """A bound that replaces the objective of a box by one in which matching and pose separate.

    A box takes long, whatever its number of pairs, so threads share few boxes as well.

    Attributes
    ----------
    matchings : (B, n) int array
        The relaxed matching of each box of the last evaluation: a column per source row, -1 for none.
    """

    slice_pairs = 1
    matchings: np.ndarray

    def relax(self, boxes: Boxes) -> Evaluation:
        """Bound boxes over all their parameters, admissible or not."""
        found = self._evaluate(boxes, None)
        self.space.check()
        return found

    def no_matchings(self, count: int) -> np.ndarray:
        """Return empty `matchings` of `count` boxes, which the caller fills."""
        self.matchings = np.full((count, self.space.n_source), -1)
        return self.matchings


class SingleBoxes:
    """The maximum of several relaxations, box by box, in the form that `algorithm_1` needs.

    Candidates are the poses of the relaxations and, with `fits`, the least-squares fits to their
    matchings. Each costs one assignment.
    """

    def __init__(self, parts: Sequence[Relaxation[Any]], fits: bool) -> None:
        self.parts, self.fits = parts, fits
        self._n_fitted = 0

    @property
    def n_assignments(self) -> int:
        return sum(part.n_assignments for part in self.parts) + self._n_fitted

    def evaluate(self, boxes: list[Box]) -> list[Bounded]:
        """Bound each box; see `baselines._shared.algorithm1.Bounding`."""
        batch = Boxes.of(boxes)
        found = [part.relax(batch) for part in self.parts]
        return [self._bounded(at, found) for at in range(len(boxes))]

    def _bounded(self, at: int, found: list[Evaluation]) -> Bounded:
        candidates = [(float(each.values[at]), each.thetas[at]) for each in found]
        for part, each in zip(self.parts, found, strict=True) if self.fits else ():
            theta = part.space.fit_matching(each.thetas[at], part.matchings[at])
            candidates.append((part.space.objective(theta)[0], theta))
            self._n_fitted += 1
        value, theta = min(candidates, key=itemgetter(0))
        return Bounded(max(float(each.lower_bounds[at]) for each in found), theta, value)


class SubstitutedBound(Relaxation[FeatureSpace]):
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
        matchings = self.no_matchings(len(boxes))

        def work(part: slice) -> int:
            lo, up, bounds = boxes.lower[part], boxes.upper[part], found.lower_bounds[part]
            beta, gamma = np.empty_like(lo), np.empty((len(lo), 3))
            spent = linearise(
                self.features, (self.low, self.high), space.n_inliers, lo, up, bounds, beta, gamma,
                matchings[part],
            )  # fmt: skip
            minimum = self.minimum_over_box()
            for box in range(len(lo)):
                value, theta = minimum(beta[box], gamma[box], lo[box], up[box])
                bounds[box] += value
                found.thetas[part][box] = np.clip(theta, lo[box], up[box])
            return spent + space.objectives(found.thetas[part], found.values[part])

        self.map_slices(len(boxes), work)
        return found
