"""The lower bound over boxes of rotations for the problem over given matches."""

from __future__ import annotations

import numpy as np

from dcreg.families.matches.kernels.bounds import rotation_bounds
from dcreg.families.matches.kernels.compatible import caps
from dcreg.families.matches.problem import MatchProblem
from dcreg.families.matches.start import descend
from dcreg.families.rotation3d.space import Rotation3D
from dcreg.search import (
    Box,
    Boxes,
    Budget,
    Evaluation,
    LongestEdge,
    Outcome,
    Tolerance,
    branch_and_bound,
)

ROUND_WORK = 200_000  # matches evaluated in a round
# Bounds aim above the cutoff by this share of the allowed gap, so that rounding leaves no box open.
MARGIN = 1e-5
MAX_CAPPED = 6000  # matches up to which all pairs of them are compared again


class MatchBound:
    """Bound over quaternion boxes with nested translations; poses are flattened (3, 4) arrays.

    The cap of a match is an upper bound on the score of any pose that agrees with it. A match whose cap
    does not exceed the incumbent's score is removed: no better pose agrees with it.

    Attributes
    ----------
    roots : list of Box
    n_left : int
        Number of matches that remain.
    """

    n_assignments = 0

    def __init__(self, problem: MatchProblem, incumbent: float, tolerance: Tolerance) -> None:
        self._problem, self._tolerance = problem, tolerance
        self._margin = MARGIN * tolerance.allowed(incumbent)
        self.roots: list[Box] = Rotation3D.roots()
        self.axis_weights = np.ones(4)
        self._best = problem.score(incumbent)
        chosen, before = np.arange(len(problem.pairs)), np.inf
        while 0 < len(chosen) <= min(MAX_CAPPED, 0.95 * before):
            before, highest = len(chosen), np.empty(len(chosen))
            caps(problem.part(chosen), highest)
            chosen = chosen[highest > self._best]
        self._matches = problem.part(chosen)
        self.n_left = len(chosen)

    @property
    def round_size(self) -> int:
        """Maximum number of boxes bounded between two readings of the clock."""
        return int(np.clip(ROUND_WORK // max(1, self.n_left), 16, 512))

    def fresh(self) -> MatchBound:
        """Return the bound itself, which stores nothing about boxes."""
        return self

    def evaluate(self, boxes: Boxes, cutoff: float | None) -> Evaluation:
        """Bound B boxes; only the value of the most promising pose is computed."""
        cutoff = np.inf if cutoff is None else cutoff
        count = len(boxes)
        highest, poses = np.full(count, self._best), np.zeros((count, 3, 4))
        if self.n_left:
            enough = max(self._best, self._problem.score(cutoff + self._margin))
            rotation_bounds(self._matches, boxes.lower, boxes.upper, enough, highest, poses)
        values = np.full(count, np.inf)
        best = int(np.argmax(highest))
        if self.n_left:
            values[best], _ = self._problem.cost(poses[best])
        bounds = (self._problem.max_cardinality - highest) * self._problem.inlier_threshold**2
        return Evaluation(bounds, poses.reshape(count, 12), values)

    def refine(self, theta: np.ndarray) -> tuple[np.ndarray, float, int]:
        """Search locally from a pose."""
        pose, value = descend(self._problem, theta.reshape(3, 4))
        return pose.ravel(), value, 0

    def search(self, budget: Budget, start: tuple[np.ndarray, float]) -> Outcome:
        """Certify the pose `start`, or find a better one."""
        return branch_and_bound(
            self, budget, branching=LongestEdge(self.axis_weights), tolerance=self._tolerance,
            refine=self.refine, start=start, stage="rotation",
        )  # fmt: skip
