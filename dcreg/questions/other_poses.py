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
from dcreg.problem.geometry import error_of_sum, last_bits
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
RAISE = 1.5  # factor by which a bound is raised
MIN_RAISE = 1.01  # smaller factors are not tried

# A pose and its objective, in normalised units.
Known = tuple[np.ndarray, float]


class Found(NamedTuple):
    """What a search found: a pose below the threshold or None, a lower bound, and how it ended."""

    pose: Known | None
    lower_bound: float
    status: Status


class Search:
    """The search for other poses after a solve.

    Attributes
    ----------
    distance : float
        Displacement beyond which poses are distinct, in units of the target.
    usual_distance : float
        Its default.
    threshold : float
        The objective up to which poses are listed, in normalised units.
    """

    def __init__(
        self,
        setup: Setup,
        result: Result,
        normalised: NormalisedProblem,
        min_displacement: float | None,
        ratio: float,
        noise: float | None,
    ) -> None:
        self.setup, self.result, self.normalised = setup, result, normalised
        problem = setup.problems[0]
        size = rms_radius(problem.target) or rms_radius(problem.source) or 1.0
        area, count, abs_gap = setup.frame.area, result.n_inliers, normalised.tolerance.abs
        residual = math.sqrt(result.upper_bound / count + abs_gap * area / count)
        residual = max(residual, noise or 0.0)
        self.usual_distance = max(RESIDUALS * residual, SHARE_OF_SIZE * size)
        self.distance = min_displacement or self.usual_distance
        least = noise or min(self.distance, SHARE_OF_SIZE * size) / RESIDUALS
        self.threshold = max(ratio * result.upper_bound, count * least**2) / area + abs_gap

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
            found = self._next(known, minima, budget, self.threshold)
            if found.pose is None:
                lower_bound = found.lower_bound
                is_complete = lower_bound > self.threshold
                status = Status.OPTIMAL if is_complete else found.status
                break
            known.append(found.pose)
            if len(known) > max_others:
                status = Status.CONVERGED
                break
        return status, lower_bound, known

    def raised(
        self, lower_bound: float, known: list[Known], minima: list[Known], budget: Budget
    ) -> float:
        """Raise the lower bound on all other poses until one of them is near it, or until a limit."""
        most = math.inf
        while True:
            aim = min(RAISE * lower_bound, most)
            if self._is_stationary_sooner:
                grown = self._grown(1.0 - INNER[0], aim)
                aim = min(aim, grown / (1.0 + _ROUNDING) ** 2 or math.inf)
            if aim < MIN_RAISE * lower_bound or budget.is_over:
                return lower_bound
            found = self._next(known, minima, budget, aim)
            if found.pose is not None:
                most = found.pose[1] / MIN_RAISE
                continue
            lower_bound = max(lower_bound, found.lower_bound)
            if lower_bound <= aim:
                return lower_bound

    @property
    def _is_stationary_sooner(self) -> bool:
        """Whether a search for stationary poses is faster than one for all poses.

        In 2D all bounds hold for every pose. Stationary poses are few only if the translation is known.
        """
        n, m = len(self.normalised.source), len(self.normalised.target)
        return self.normalised.dim == 3 or n == m

    def _next(
        self, known: list[Known], minima: list[Known], budget: Budget, threshold: float
    ) -> Found:
        """Search for another pose below a threshold."""
        poses, source = [T for T, _ in known], self.normalised.source
        distance = self.distance / self.setup.frame.unit
        far = Far.of(poses, distance, source)
        if any(value <= threshold and far.contains(T) for T, value in minima):
            return self._search(far, minima, budget, threshold)
        for share in INNER if self._is_stationary_sooner else ():
            grown = self._grown(1.0 - share, threshold)
            if grown <= threshold * (1.0 + _ROUNDING):
                continue
            stationary = FarStationary.of(poses, share * distance, source)
            found = self._search(stationary, minima, budget, threshold)
            if found.pose is None:
                return found._replace(lower_bound=min(found.lower_bound, grown))
            break
        return self._search(far, minima, budget, threshold)

    def _grown(self, share: float, threshold: float) -> float:
        """Return a lower bound on the cost of a matching at a pose far from its best pose.

        Far means: by more than this share of the distance. The bound holds for costs up to the threshold;
        it is 0 if none is known.

        The derivation is in docs/bounds.md, section "Poses far from known ones".
        """
        source, low = self.normalised.source, self.normalised.scale_range[0]
        n, d = source.shape
        if self.normalised.n_inliers != n:
            return 0.0
        centred = source - source.mean(axis=0)
        least = float((centred**2).sum())
        if d == 3:
            least -= float(np.linalg.eigvalsh(centred.T @ centred)[-1])
        lost = math.sqrt(threshold / least) / low if least > 0.0 else 1.0
        growth = n * (share * self.distance / self.setup.frame.unit) ** 2
        return self.result.lower_bound / self.setup.frame.area + max(0.0, 1.0 - lost) * growth

    def _search(self, region: Far, minima: list[Known], budget: Budget, threshold: float) -> Found:
        """Search for a pose of the region below the threshold."""
        given = self.setup.problems[-1]
        bits = last_bits(given.source, given.target) / self.setup.frame.unit
        margin = error_of_sum(threshold, self.normalised.n_inliers, bits)
        tolerance = Tolerance(rel=1e-6, target=threshold, margin=margin)
        problem = replace(self.normalised, region=region, tolerance=tolerance, init=None)
        attempt = Attempt(replace(self.setup.mode, stage=STAGE), problem)
        ends = [(T, value) for T, value in minima if region.contains(T)]
        if ends:
            T, value = min(ends, key=lambda each: each[1])
            start = Start(attempt.space.parameter(T), value)
        elif len(region.poses) > 1:  # the shape may be symmetric and have more such poses
            start = attempt.start(budget)
        else:
            start = Start(attempt.bound.roots[0].centre)
        found = attempt.run(budget, start)
        if found.upper_bound <= threshold:
            return Found((attempt.space.pose(found.theta), found.upper_bound), 0.0, found.status)
        return Found(None, found.lower_bound, found.status)
