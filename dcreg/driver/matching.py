"""`register_matches`: from two clouds and a list of matches to a pose."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np

from dcreg.diagnostics import slide_warning
from dcreg.driver.options import Limits, SolveOptions
from dcreg.driver.solve import PATIENCE_S
from dcreg.driver.uncertainty import with_uncertainty
from dcreg.driver.warm_up import warm_up_matches
from dcreg.families.matches.bound import MatchBound
from dcreg.families.matches.problem import MatchProblem
from dcreg.families.matches.start import is_near, promising_poses, surface_consistent_poses
from dcreg.families.matches.warnings import (
    LIMIT,
    NO_PROSPECT,
    TOLERANCE,
    is_clear,
    warnings_of,
)
from dcreg.names import SCORES
from dcreg.problem import InputError, apply_pose, suggestion
from dcreg.problem.geometry import EXACT
from dcreg.problem.trees import tree_of
from dcreg.result import Result, Score, Stage, Trace
from dcreg.search import Budget
from dcreg.search.space_search import UNSURE
from dcreg.status import Status

MODE, BOUND = "matches", "nested"
SCOPE = "rigid pose over the given matches, at a cost of inlier_distance^2 per unselected match"


def register_match_problem(
    problem: MatchProblem, score: str, certify: bool | None, limits: Limits, options: SolveOptions
) -> Result:
    """Solve a problem over matches; see `dcreg.register_matches`."""
    began = time.perf_counter()
    defaults = vars(SolveOptions()) | {"listener": options.listener}
    given = [name for name, value in vars(options).items() if _differs(value, defaults[name])]
    if given:
        raise InputError(
            f"options: registration over matches ignores {', '.join(given)}; set only the listener"
        )
    limits.check(problem.max_cardinality)
    patience_s = None if certify else PATIENCE_S
    certify = _certified(score, certify)
    warm_up_matches()
    setup = time.perf_counter() - began
    with limits.budget(options, options.listener) as budget:
        patient = budget.with_patience(patience_s)
        return _solved(problem, score, certify, limits, patient, setup)


def _differs(value: Any, default: Any) -> bool:
    """Whether an option is not the default, which is never an array."""
    return value is not default and (isinstance(value, np.ndarray) or value != default)


def _certified(score: str, certify: bool | None) -> bool:
    """Tell whether bounds are requested; refuse an unknown score, or one without bounds."""
    if score not in SCORES:
        raise InputError(f"score: {score!r} is unknown{suggestion(score, SCORES)}")
    if certify and score == "surfaces":
        raise InputError(
            "certify: bounds refer to the cost of matches, but score='surfaces' selects a pose by "
            "another criterion; omit one of the two"
        )
    if not isinstance(certify, bool | np.bool_ | None):
        raise InputError(f"certify: {certify!r} is not a bool; give True, False or None")
    return score == "correspondences" if certify is None else bool(certify)


def _patient(
    budget: Budget, score: str, starts: list[tuple[float, np.ndarray]], threshold: float
) -> Budget:
    """Return the budget with more patience if another pose may turn out to be the best one."""
    (best, pose), *others = starts
    other = max((end for end, T in others if not is_near(T, pose, threshold)), default=0.0)
    if budget.patience_s is None or is_clear(score, best, other):
        return budget
    return budget.with_patience(UNSURE * budget.patience_s)


def _solved(
    problem: MatchProblem,
    score: str,
    certify: bool,
    limits: Limits,
    budget: Budget,
    setup: float,
) -> Result:
    if score == "surfaces":
        starts = surface_consistent_poses(problem, budget)
    else:
        starts = [(problem.score(cost), pose) for cost, pose in promising_poses(problem, budget)]
    best, pose = starts[0]
    value, chosen = problem.cost(pose)
    stages = [Stage("start", budget.elapsed(), n_assignments=len(starts))]
    tolerance = limits.tolerance(
        problem.max_cardinality, problem.rounding, EXACT * problem.rounding
    )
    status = budget.ended_by if budget.is_over else Status.CONVERGED
    lower, events = 0.0, []
    threshold = problem.inlier_threshold
    if certify:
        lower = problem.floor
        if (proven := tolerance.status(lower, value)) is Status.OPTIMAL:
            status = proven
        else:
            bound = MatchBound(problem, value, tolerance)
            found = bound.search(_patient(budget, score, starts, threshold), (pose.ravel(), value))
            pose, status = found.theta.reshape(3, 4), found.status
            lower, events = max(lower, found.lower_bound), found.events
            stages.append(Stage.of("rotation", found))
            value, chosen = problem.cost(pose)
            best = problem.score(value)
    lower = max(0.0, lower)
    scores = Score(problem.score(value), problem.score(lower))
    others = [evidence for evidence, other in starts if not is_near(other, pose, threshold)]
    objective = float(problem.residuals(pose)[chosen].sum())
    unproven = scores if certify and status is not Status.OPTIMAL else None
    end = LIMIT if status is not Status.CONVERGED else NO_PROSPECT
    if tolerance.status(lower, value) is Status.CONVERGED:
        end = TOLERANCE
    warnings = warnings_of(problem, chosen, score, [best, *others], unproven, end)
    T = problem.pose(pose)
    result = Result(
        status=status, model="rigid3d", mode=MODE, bound=BOUND, T_target_source=T, T_certified=T,
        assignment=problem.pairs[chosen], n_inliers=len(chosen),
        lower_bound=lower, upper_bound=value, gap_tol=tolerance.allowed(value),
        is_exact=certify and tolerance.is_exact(value),
        certificate_scope=SCOPE, objective=objective, objective_certified=objective,
        n_nodes=sum(stage.n_nodes for stage in stages),
        n_assignments=sum(stage.n_assignments for stage in stages),
        time_setup_s=setup, time_solve_s=budget.elapsed(), stages=stages,
        trace=Trace(events), score=scores,
        warnings=warnings,
    )  # fmt: skip
    return _with_uncertainty(result, problem)


def _with_uncertainty(result: Result, problem: MatchProblem) -> Result:
    """Return the result with its covariance, and with the directions that the overlap leaves open.

    All source points near the target are moved. The selected matches are often few and in one part of
    the overlap, which other parts keep from sliding.
    """
    moved = apply_pose(result.T_target_source, problem.source)
    overlap = moved[tree_of(problem.target).nearest(moved)[0] <= problem.inlier_threshold]
    result = with_uncertainty(result, problem.source, problem.target, surface=overlap)
    line = slide_warning(result, "look at the clouds at this pose")
    if line is None or result.covariance is None:  # other matches are needed, of which a line warns
        return result
    return replace(result, warnings=[*result.warnings, line])
