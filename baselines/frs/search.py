"""FRS: branch and bound over translations with an exact rotation search in every cube.

The search maximises the number of source points that R x + t moves within ``radius`` of a target
point. In a cube of translations with half-diagonal rho and centre t0, R x + t lies within the radius
of y for some t only if R x lies within radius + rho of y - t0. The rotation search then bounds the
count over all rotations. With the radius itself it finds the best rotation at t0: the incumbents are
these poses, and there are no others. Objective values are minus the counts, since the search minimises.
"""

from __future__ import annotations

import numpy as np

from baselines._shared.consensus import Consensus
from baselines._shared.cubes import Incumbent
from baselines._shared.poses import homogeneous
from baselines._shared.rotation_search import most_matches
from dcreg.search import Budget


class TranslationCubes:
    """The bound of a cube of translations; it also improves the incumbent."""

    def __init__(self, consensus: Consensus, incumbent: Incumbent, slack: int, budget: Budget):
        self.consensus, self.incumbent = consensus, incumbent
        self.slack, self.budget = slack, budget
        self.n_rotation_cubes = 0

    def bound(self, centre: np.ndarray, half: float, passed_on: None = None) -> tuple[float, None]:
        """Return minus a bound on the number of matches of any rotation and translation of the cube."""
        problem = self.consensus
        rho = np.sqrt(3.0) * half
        known = int(-self.incumbent.value)
        # Cubes that are small relative to the radius need an exact count; for others a rough one
        # suffices.
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
        if found.upper_bound > known:
            at_centre = most_matches(
                problem.source, problem.target - centre, problem.radius, known, 0, self.budget
            )
            self.n_rotation_cubes += at_centre.n_cubes
            if at_centre.count > known:
                pose = homogeneous(1.0, at_centre.rotation, centre)
                self.incumbent.offer(-problem.count(pose), pose)
        return -float(found.upper_bound), None


def matching_translations(
    source: np.ndarray, target: np.ndarray, radius: float
) -> tuple[np.ndarray, float]:
    """Return centre and half-width of a cube with every t such that some R x + t is near some y.

    t = y - R x up to `radius`: the bounding box of the target, extended by the longest x.
    """
    low, high = target.min(axis=0), target.max(axis=0)
    half = (high - low).max() / 2 + np.linalg.norm(source, axis=1).max() + radius
    return (low + high) / 2, float(half) * (1 + 1e-9)
