"""Is the answer the only one? All distinct poses that are nearly as good, or the proof of none.

After a solve, the objective is minimised over all poses that are farther than a distance from those found
so far (`dcreg.families.region.Far`). The search ends with another pose below the threshold, which joins
the list, or with the proof that there is none.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from dcreg import text
from dcreg._version import __version__
from dcreg.driver.modes import Attempt, run_mode
from dcreg.driver.normalised import NormalisedProblem
from dcreg.driver.options import Limits, SolveOptions, check_positive
from dcreg.driver.solve import Finish, Setup
from dcreg.driver.warm_up import warm_up_region
from dcreg.families.region import Far, FarStationary
from dcreg.files import as_json, plain, write_text
from dcreg.names import DEFAULT_RATIO, DEFAULT_REL_GAP, DEFAULT_TIME_LIMIT_S
from dcreg.problem import (
    Candidates,
    InputError,
    Problem,
    nearest_rotation,
    rms_radius,
    rotation_angle_deg,
)
from dcreg.result import Result
from dcreg.search import Budget, Start, Tolerance
from dcreg.status import Status

# Default distance at which poses count as distinct: RMS residuals, and at least a share of the size.
RESIDUALS, SHARE_OF_SIZE = 3.0, 0.01
STAGE = "other poses"  # in events
_ROUNDING = 1e-9  # relative
INNER = 1.0 / 3.0  # share of the distance beyond which stationary poses are searched
SOLVE_SHARE = 0.5  # of the time, for the best pose


@dataclass(frozen=True)
class Alternative:
    """Another pose with an objective below the threshold.

    Attributes
    ----------
    T_target_source : (d+1, d+1) array
    objective : float
    angle_deg : float
        Angle of its rotation relative to that of the best pose.
    displacement : float
        RMS displacement of the source points relative to the best pose, in units of the target.
    """

    T_target_source: np.ndarray
    objective: float
    angle_deg: float
    displacement: float


@dataclass(frozen=True, repr=False)
class Alternatives:
    """The poses that are nearly as good as the best one; see `dcreg.alternatives`.

    Attributes
    ----------
    status : Status
        ``optimal`` if the list is proven to be complete.
    result : Result
        The best pose.
    distance : float
        Poses count as distinct if they displace the source points by more than this (RMS), in units of
        the target.
    threshold : float
        The objective up to which poses are listed, in squared units of the target.
    lower_bound : float
        No pose farther than `distance` from all listed ones has a lower objective.
    others : list of Alternative
        Each farther than `distance` from the best pose and from those before it.
    time_s : float
    """

    status: Status
    result: Result
    distance: float
    threshold: float
    lower_bound: float
    others: list[Alternative]
    time_s: float

    question = "other poses"

    @property
    def warnings(self) -> list[str]:
        """Those of the search."""
        return self.result.warnings

    @property
    def poses(self) -> dict[str, np.ndarray]:
        """The best pose and the others."""
        others = {
            f"other pose {at}": each.T_target_source for at, each in enumerate(self.others, 1)
        }
        return {"best pose": self.result.T_certified, **others}

    @property
    def is_complete(self) -> bool:
        """Whether it is proven that no other pose has an objective up to the threshold."""
        return self.status is Status.OPTIMAL

    @property
    def is_unique(self) -> bool:
        """Whether it is proven that only the best pose has an objective up to the threshold."""
        return self.is_complete and not self.others

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        names = ("status", "is_complete", "is_unique", "distance", "threshold", "lower_bound")
        values = {name: getattr(self, name) for name in names}
        others = [vars(each) for each in self.others]
        return plain({**values, "others": others, "result": self.result.to_dict()})

    def to_json(self, **more: Any) -> str:
        """Return `to_dict`, the version and `more` keys as JSON."""
        return as_json({**self.to_dict(), **more, "dcreg_version": __version__})

    def write_json(self, path: str | Path, **more: Any) -> None:
        """Write `to_json` to a file."""
        write_text(path, self.to_json(**more) + "\n")

    def entries(self) -> Iterator[tuple[str, str]]:
        """Yield names and values of the summary; every warning is an entry of that name."""
        yield "answer", self.answer
        yield "distinct from", f"an RMS displacement of {self.distance:.4g}"
        yield "threshold", f"objective {self.threshold:.6g}"
        if not self.is_complete:
            yield "lower bound", f"{self.lower_bound:.6g} of any pose that is not listed"
        for each in self.others:
            yield (
                "other pose",
                f"objective {each.objective:.6g}, rotated by {each.angle_deg:.4g} deg and displaced by "
                f"{each.displacement:.4g} (RMS) relative to the best pose",
            )
        yield "time", f"{self.time_s:.2f} s"
        yield "best pose", self.result.summary()

    @property
    def answer(self) -> str:
        """The answer in a sentence."""
        others = text.count(len(self.others), "other pose")
        if self.is_unique:
            return "unique: no distinct pose is nearly as good; proven"
        if self.is_complete:
            return f"{others} nearly as good; proven to be all"
        if self.others:
            return f"at least {others} nearly as good; {self.status.value}"
        return f"no other pose is known, but one may exist ({self.status.value})"

    def __str__(self) -> str:
        return text.listing(list(self.entries()))

    def __repr__(self) -> str:
        return f"<Alternatives {self.answer}>"


def alternatives(
    source: np.ndarray,
    target: np.ndarray,
    *,
    n_inliers: int | float,
    model: str,
    ratio: float = DEFAULT_RATIO,
    distance: float | None = None,
    most: int = 20,
    scale_range: tuple[float, float] | None = None,
    candidates: Candidates | None = None,
    rel_gap: float = DEFAULT_REL_GAP,
    abs_gap: float | None = None,
    tol: float | None = None,
    time_limit: float | None = DEFAULT_TIME_LIMIT_S,
    node_limit: int | None = None,
    memory_limit_mb: float | None = None,
    options: SolveOptions | None = None,
) -> Alternatives:
    """Find all distinct poses that are nearly as good as the best one, or prove that there is none.

    Solves the problem of `dcreg.register`, then minimises over all poses that are farther than `distance`
    from those found so far, until the minimum is proven to exceed the threshold: `ratio` times the upper
    bound, at least ``n_inliers * (distance / 3)^2``.

    Parameters
    ----------
    source, target, n_inliers, model, scale_range, candidates
        As in `dcreg.register`. Clouds that `register` would sample are replaced by their samples.
    ratio : float
        A pose is nearly as good if its objective is at most this multiple of the best one; at least 1.
    distance : float, optional
        Poses are distinct if the RMS displacement of the source points between them exceeds this length,
        in units of the target. Default: three RMS residuals of the best pose, at least 1 % of the RMS
        radius of the target.
    most : int
        The search ends with this many other poses. A sphere has infinitely many.
    rel_gap, abs_gap, tol, node_limit, memory_limit_mb
        As in `dcreg.register`; tolerances are those of the best pose, and limits those of each search.
    time_limit : float, optional
        Seconds for all searches together; None or inf: no limit.
    options : SolveOptions, optional
        As in `dcreg.register`, without a certificate.

    Returns
    -------
    Alternatives

    Raises
    ------
    InputError
        For bad input, before any search.

    Examples
    --------
    >>> import numpy as np, dcreg
    >>> rectangle = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 1.0], [0.0, 1.0]])
    >>> found = dcreg.alternatives(
    ...     rectangle, rectangle + 5.0, n_inliers=4, model="similarity2d", scale_range=(1, 1)
    ... )
    >>> found.is_complete, [round(other.angle_deg) for other in found.others]
    (True, [180])
    """
    problem = Problem(source, target, n_inliers, model, scale_range, candidates)
    limits = Limits(rel_gap, abs_gap, tol, time_limit, node_limit, memory_limit_mb)
    return find_alternatives(
        problem, limits, SolveOptions.of(options), ratio=ratio, distance=distance, most=most
    )


def find_alternatives(
    problem: Problem,
    limits: Limits,
    options: SolveOptions,
    *,
    ratio: float,
    distance: float | None,
    most: int,
) -> Alternatives:
    """Solve a problem, then search for other poses; see `dcreg.alternatives`."""
    _check(problem, options, ratio, distance, most)
    setup = Setup.of([problem], limits, options)
    if setup.is_sampled:  # everything then refers to the sample
        problem = setup.searched[0]
        setup = Setup.of([problem], limits, replace(options, downsample=None, mode=setup.mode.name))
    if setup.mode.in_region is None:
        raise InputError(
            f"mode: {setup.mode.name!r} cannot search for other poses; use mode 'full' with clouds of at "
            "most 4,000,000 point pairs, and omit bound"
        )
    warm_up_region(setup.mode)
    with setup.budget() as budget:
        solving = budget.isolated_sub_budget(SOLVE_SHARE)
        normalised = setup.normalised(0, solving)
        solution = run_mode(setup.mode, normalised)
        solution.events = solving.history
        best, minima = (solution.T, solution.upper_bound), solution.minima
        result = Finish(setup, 0, normalised, solving, solving).result(solution)
        search = _Search(setup, result, replace(normalised, budget=budget), distance, ratio)
        return search.run(best, minima, budget, most)


def _check(
    problem: Problem, options: SolveOptions, ratio: float, distance: float | None, most: int
) -> None:
    check_positive("ratio", ratio, minimum=1.0, optional=False)
    check_positive("distance", distance)
    check_positive("most", most, such_as=20, optional=False)
    if problem.pose_range is not None:
        raise InputError("pose_range: alternatives are searched among all poses; omit it")
    if problem.model == "similarity3d":
        raise InputError(
            "model: similarity3d has no search for alternatives; use register, or rescale one cloud and "
            "use model rigid3d"
        )
    if options.certificate:
        raise InputError("certificate: a search for alternatives keeps none; omit it")


class _Search:
    """The search for other poses after a solve, in normalised units."""

    def __init__(
        self,
        setup: Setup,
        result: Result,
        normalised: NormalisedProblem,
        distance: float | None,
        ratio: float,
    ) -> None:
        self.setup, self.result, self.normalised = setup, result, normalised
        problem = setup.problems[0]
        size = rms_radius(problem.target) or rms_radius(problem.source) or 1.0
        residual = math.sqrt(result.upper_bound / result.n_inliers)
        self.distance = distance or max(RESIDUALS * residual, SHARE_OF_SIZE * size)
        own = result.n_inliers * (self.distance / RESIDUALS) ** 2
        self.threshold = max(ratio * result.upper_bound, own)

    def run(
        self,
        best: tuple[np.ndarray, float],
        minima: list[tuple[np.ndarray, float]],
        budget: Budget,
        most: int,
    ) -> Alternatives:
        """Search until no further pose is below the threshold, or until a limit."""
        known, status, lower_bound = [best], Status.CONVERGED, 0.0
        while True:
            found, lower = self._next(known, minima, budget)
            if found is None:
                lower_bound, is_complete = lower, lower > self.threshold / self.setup.frame.area
                status = Status.OPTIMAL if is_complete else budget.ended_by
                break
            known.append(found)
            if len(known) > most:
                status = Status.CONVERGED
                break
        return Alternatives(
            status, self.result, self.distance, self.threshold,
            lower_bound * self.setup.frame.area, [self._described(*each) for each in known[1:]],
            budget.elapsed(),
        )  # fmt: skip

    def _next(
        self,
        known: list[tuple[np.ndarray, float]],
        minima: list[tuple[np.ndarray, float]],
        budget: Budget,
    ) -> tuple[tuple[np.ndarray, float] | None, float]:
        """Return another pose below the threshold, if one is found, and a lower bound on the others."""
        poses, source = [T for T, _ in known], self.normalised.source
        distance = self.distance / self.setup.frame.unit
        far = Far.of(poses, distance, source)
        if self._is_known_far(far, minima):
            return self._search(far, minima, budget)
        if self._grows((1.0 - INNER) * distance):
            stationary = FarStationary.of(poses, INNER * distance, source)
            found, lower_bound = self._search(stationary, minima, budget)
            if found is None:
                return None, lower_bound
        return self._search(far, minima, budget)

    def _is_known_far(self, far: Far, minima: list[tuple[np.ndarray, float]]) -> bool:
        """Tell whether a pose below the threshold is known already."""
        threshold = self.threshold / self.setup.frame.area
        return any(value <= threshold and far.contains(T) for T, value in minima)

    def _grows(self, distance: float) -> bool:
        """Tell whether every matching costs too much at a distance from its best pose.

        Let all source points be matched, and let a pose T farther than D from the known ones have an
        objective below the threshold C, with the matching P. If the best pose of P is farther than D / 3
        from the known ones, a search for stationary poses finds it. Otherwise it is farther than d = 2 D
        / 3 from T. With S and w as in `dcreg.families.rigid3d.cover`, for all points instead of three,
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
            return False
        centred = source - source.mean(axis=0)
        spread = float((centred**2).sum())
        least = spread - float(np.linalg.eigvalsh(centred.T @ centred)[-1])
        threshold = self.threshold / area
        share = max(0.0, 1.0 - math.sqrt(threshold / least)) if least > 0.0 else 0.0
        lower_bound = self.result.lower_bound / area
        return lower_bound + share * n * distance**2 > threshold * (1.0 + _ROUNDING)

    def _search(
        self, region: Far, minima: list[tuple[np.ndarray, float]], budget: Budget
    ) -> tuple[tuple[np.ndarray, float] | None, float]:
        """Return a pose of the region below the threshold, if one is found, and a lower bound."""
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
            return (attempt.space.pose(found.theta), found.upper_bound), 0.0
        return None, found.lower_bound

    def _described(self, T: np.ndarray, value: float) -> Alternative:
        frame, best = self.setup.frame, self.result.T_certified
        pose, d = frame.pose(T), len(best) - 1
        turn = nearest_rotation(pose[:d, :d] @ np.linalg.inv(best[:d, :d]))
        source = self.setup.problems[0].source
        gaps = source @ (pose[:d, :d] - best[:d, :d]).T + pose[:d, d] - best[:d, d]
        return Alternative(
            pose, value * frame.area, abs(rotation_angle_deg(turn)),
            float(np.sqrt((gaps**2).sum(axis=1).mean())),
        )  # fmt: skip
