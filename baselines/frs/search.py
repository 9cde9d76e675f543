"""FRS: branch and bound over translations with an exact rotation search in every cube.

Maximised is the number of source points that R x + t brings within ``radius`` of a target point. In
a cube of translations with half-diagonal rho, R x + t comes within the radius for some t of the cube
only if R x comes within radius + rho of y - t0; the rotation search then bounds the count for all
rotations. Objective values here are minus the counts, as the search minimises.
"""

from __future__ import annotations

import numpy as np

from baselines._shared.consensus import Consensus
from baselines._shared.cubes import Incumbent
from baselines._shared.poses import homogeneous
from baselines._shared.rotation_search import most_matches
from dcreg.search import Budget


class TranslationCubes:
    """The bound of a cube of translations; improves the incumbent on the way."""

    def __init__(self, consensus: Consensus, incumbent: Incumbent, slack: int, budget: Budget):
        self.consensus, self.incumbent = consensus, incumbent
        self.slack, self.budget = slack, budget
        self.n_rotation_cubes = 0

    def bound(self, centre: np.ndarray, half: float, passed_on: None = None) -> tuple[float, None]:
        """Minus the most source points matched by any rotation and a translation of the cube."""
        problem = self.consensus
        rho = np.sqrt(3.0) * half
        known = int(-self.incumbent.value)
        # Once cubes are small against the radius an exact count decides; before, a rough one does.
        slack = self.slack if rho > problem.radius else 0
        found = most_matches(
            problem.source,
            problem.target - centre,
            problem.radius + rho,
            known,
            slack,
            self.budget,
        )
        self.n_rotation_cubes += found.n_cubes
        if found.count > known:
            pose = homogeneous(1.0, found.rotation, centre)
            pose, count = problem.ascend(pose, problem.radius + rho)
            self.incumbent.offer(-count, pose)
        return -float(found.upper_bound), None


def matching_translations(
    source: np.ndarray, target: np.ndarray, radius: float
) -> tuple[np.ndarray, float]:
    """Centre and half-width of a cube with every t for which some R x + t is near some y.

    t = y - R x up to `radius`: the target's bounding box, grown by the longest x.
    """
    low, high = target.min(axis=0), target.max(axis=0)
    half = (high - low).max() / 2 + np.linalg.norm(source, axis=1).max() + radius
    return (low + high) / 2, float(half) * (1 + 1e-9)
