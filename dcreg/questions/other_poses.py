"""The search for poses that are far from known ones, and nearly as good."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from dcreg.driver.modes import Attempt
from dcreg.driver.normalised import NormalisedProblem
from dcreg.driver.solve import Setup
from dcreg.families.region import Far, FarStationary
from dcreg.problem import rms_radius
from dcreg.result import Result
from dcreg.search import Budget, Start, Tolerance
from dcreg.status import Status

# Default displacement at which poses are distinct: RMS residuals, and at least a share of the size.
RESIDUALS, SHARE_OF_SIZE = 3.0, 0.01
STAGE = "other poses"  # in events
# Shares of the distance beyond which stationary poses are searched; the first that suffices is the
# fastest, because the objective is larger farther away.
INNER = 0.5, 1.0 / 3.0
_ROUNDING = 1e-9  # relative

# A pose and its objective, in normalised units.
Known = tuple[np.ndarray, float]


class Found(NamedTuple):
    """What a search found: a pose below the threshold or None, a lower bound, and how it ended."""

    pose: Known | None
    lower_bound: float
    status: Status


class Search:
    """The search for other poses after a solve, in normalised units."""

    def __init__(
        self,
        setup: Setup,
        result: Result,
        normalised: NormalisedProblem,
        min_displacement: float | None,
        ratio: float,
    ) -> None:
        self.setup, self.result, self.normalised = setup, result, normalised
        problem = setup.problems[0]
        size = rms_radius(problem.target) or rms_radius(problem.source) or 1.0
        residual = math.sqrt(result.upper_bound / result.n_inliers)
        self.distance = min_displacement or max(RESIDUALS * residual, SHARE_OF_SIZE * size)
        own = result.n_inliers * (self.distance / RESIDUALS) ** 2
        self.threshold = max(ratio * result.upper_bound, own)

    def run(
        self,
        best: Known,
        minima: list[Known],
        budget: Budget,
        max_others: int,
    ) -> tuple[Status, float, list[Known]]:
        """Search until no further pose is below the threshold, or until a limit.

        Returns
        -------
        status : Status
            ``optimal`` if no pose is missing.
        lower_bound : float
            Of the objective of all other poses.
        known : list of (pose, objective)
            The best pose and the others.
        """
        known, status, lower_bound = [best], Status.CONVERGED, 0.0
        while True:
            found = self._next(known, minima, budget)
            if found.pose is None:
                lower_bound = found.lower_bound
                is_complete = lower_bound > self.threshold / self.setup.frame.area
                status = Status.OPTIMAL if is_complete else found.status
                break
            known.append(found.pose)
            if len(known) > max_others:
                status = Status.CONVERGED
                break
        return status, lower_bound, known

    def _next(self, known: list[Known], minima: list[Known], budget: Budget) -> Found:
        """Search for another pose below the threshold."""
        poses, source = [T for T, _ in known], self.normalised.source
        distance = self.distance / self.setup.frame.unit
        far = Far.of(poses, distance, source)
        if self._is_known_far(far, minima):
            return self._search(far, minima, budget)
        for share in INNER:
            grown = self._grown((1.0 - share) * distance)
            if grown <= self.threshold / self.setup.frame.area * (1.0 + _ROUNDING):
                continue
            stationary = FarStationary.of(poses, share * distance, source)
            found = self._search(stationary, minima, budget)
            if found.pose is None:
                return found._replace(lower_bound=min(found.lower_bound, grown))
            break
        return self._search(far, minima, budget)

    def _is_known_far(self, far: Far, minima: list[Known]) -> bool:
        """Tell whether a pose below the threshold is known already."""
        threshold = self.threshold / self.setup.frame.area
        return any(value <= threshold and far.contains(T) for T, value in minima)

    def _grown(self, distance: float) -> float:
        """Return a lower bound on the cost of every matching at a distance from its best pose.

        It holds for costs below the threshold; 0 if it is not known.

        Let all source points be matched, and let a pose T farther than D from the known ones have an
        objective below the threshold C, with the matching P. If the best pose of P is farther than D - d
        from the known ones, a search for stationary poses finds it. Otherwise it is farther than d from
        T. With S and w as in `dcreg.families.rigid3d.cover`, for all points instead of three,
        the cost of P grows by n |t'|^2 + w^T (tr(S) I - S) w from its best pose to T, and the squared
        displacements add up to n |t'|^2 + w^T (tr(M) I - M) w with the second moments M of the points.
        S - M is the sum of the products e x^T of residuals and centred points at the best pose. For a
        unit vector a, a^T (tr(S - M) I - (S - M)) a is therefore the sum of the inner products of the
        parts of e and x orthogonal to a. It is at least -sqrt(C m), where m = a^T (tr(M) I - M) a is the
        sum of the squares of these parts of x. So the cost grows by at least the share 1 - sqrt(C / q) of
        n d^2, where q is the minimum eigenvalue of tr(M) I - M.
        """
        source, area = self.normalised.source, self.setup.frame.area
        n, d = source.shape
        if d != 3 or self.normalised.n_inliers != n or self.normalised.candidates is not None:
            return 0.0
        centred = source - source.mean(axis=0)
        spread = float((centred**2).sum())
        least = spread - float(np.linalg.eigvalsh(centred.T @ centred)[-1])
        threshold = self.threshold / area
        share = max(0.0, 1.0 - math.sqrt(threshold / least)) if least > 0.0 else 0.0
        return self.result.lower_bound / area + share * n * distance**2

    def _search(self, region: Far, minima: list[Known], budget: Budget) -> Found:
        """Search for a pose of the region below the threshold."""
        threshold = self.threshold / self.setup.frame.area
        tolerance = Tolerance(rel=1e-6, target=threshold)
        problem = replace(self.normalised, region=region, tolerance=tolerance, init=None)
        attempt = Attempt(replace(self.setup.mode, stage=STAGE), problem)
        far = [
            Start(attempt.space.parameter(T), value) for T, value in minima if region.contains(T)
        ]
        start = min(far, key=lambda each: each.value, default=Start(attempt.bound.roots[0].centre))
        found = attempt.run(budget, start)
        if found.upper_bound <= threshold:
            return Found((attempt.space.pose(found.theta), found.upper_bound), 0.0, found.status)
        return Found(None, found.lower_bound, found.status)
