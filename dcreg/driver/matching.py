"""`register_matches`: from two clouds and a list of matches to a pose."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from dcreg.driver.options import SolveOptions
from dcreg.driver.solve import check_settings
from dcreg.driver.warm_up import warm_up_matches
from dcreg.families.matches.bound import MatchBound
from dcreg.families.matches.doubts import doubts
from dcreg.families.matches.problem import MatchProblem
from dcreg.families.matches.start import coinciding_poses, is_near, promising_poses
from dcreg.names import DEFAULT_TIME_LIMIT_S, JUDGES
from dcreg.problem import InputError, suggestion
from dcreg.result import Result, Score, Stage
from dcreg.search import Budget, LongestEdge, Trace, branch_and_bound
from dcreg.status import Status

MODE, BOUND = "matches", "nested"
TOLERATED = 0.1  # gap per chosen match, in squared inlier distances
SCOPE = "rigid pose over the given matches, those not chosen priced at inlier_distance^2"


def register_matches(
    source: np.ndarray,
    target: np.ndarray,
    matches: np.ndarray,
    *,
    inlier_distance: float,
    judge: str = JUDGES[0],
    certify: bool | None = None,
    gap_tol: float | None = None,
    time_limit: float | None = DEFAULT_TIME_LIMIT_S,
    node_limit: int | None = None,
    options: SolveOptions | None = None,
) -> Result:
    """Register two clouds in space over a list of matches of which many may be wrong.

    Chooses matches one to one and the rigid pose, so that the sum of squared residuals of the chosen ones
    and of `inlier_distance` squared for every match that could have been chosen and was not is least: the
    objective of `register` over these feasible pairs, with a price in place of ``n_inliers``. The answer
    tells how many were chosen; for that number it is a solution of `register`'s problem too.

    Poses that many compatible matches agree on are refined first. Branch and bound over the rotation, the
    translation inside, then certifies the best one, as far as the limits allow. Time and memory grow with
    the number of matches, not with the product of the sizes of the clouds.

    Parameters
    ----------
    source, target : (n, 3), (m, 3) arrays
    matches : (N, 2) int array
        Source row and target row of every match, the likely ones first; a point may be in several.
        Starts are made of the first 5,000.
    inlier_distance : float
        Residual from which on a match counts as wrong, in the unit of the clouds.
    judge : {"matches", "surfaces"}
        What tells the right one of the poses that matches agree on: the cost above; or the score of
        the matches times that of the surfaces of both clouds, near points with like normals, once these
        are brought together. It is right more often for dense scans that overlap in part, and says
        nothing where points are sparse. The pose need not be that of least cost, and is not certified.
    certify : bool, optional
        False: the pose alone, with no lower bound but 0 and status ``converged``. Default: whether the
        matches judge.
    gap_tol : float, optional
        Absolute tolerance on the gap, in squared units; default a tenth of `inlier_distance` squared for
        every match chosen by the start.
    time_limit : float, optional
        Seconds for the solve, 60 unless told otherwise; None or inf: no limit.
    node_limit : int, optional
        Boxes bounded. As `gap_tol`, it is of the certificate, and does nothing without.
    options : SolveOptions, optional
        Its listener; the other options do not apply and are refused.

    Returns
    -------
    Result
        `n_inliers` is the number of matches chosen, `assignment` which, `objective` their sum of squared
        residuals. Bounds speak of the whole cost, with the price of matches that are not chosen; `score`
        says the same in numbers of matches. `warnings` name, beside what is not proven or not
        determined, another pose that agrees with the matches nearly as well.

    Raises
    ------
    InputError
        For bad input, naming field, value and remedy.

    Examples
    --------
    >>> import numpy as np, dcreg
    >>> points = np.random.default_rng(0).random((40, 3))
    >>> target = np.vstack([points[:20] + 3.0, points[:20]])  # the last 20 matches are wrong
    >>> matches = np.column_stack([np.arange(40), np.arange(40)])
    >>> result = dcreg.register_matches(points, target, matches, inlier_distance=0.02)
    >>> result.n_inliers, np.round(result.translation, 6).tolist()
    (20, [3.0, 3.0, 3.0])
    """
    began = time.perf_counter()
    options = options or SolveOptions()
    if replace(options, listener=None) != SolveOptions():
        raise InputError("options: registration over matches has one mode; set the listener alone")
    problem = MatchProblem.checked(source, target, matches, inlier_distance)
    check_settings(gap_tol=gap_tol, time_limit=time_limit, node_limit=node_limit)
    certify = _certified(judge, certify)
    warm_up_matches()
    setup = time.perf_counter() - began
    with Budget(time_limit, node_limit, listener=options.listener) as budget:
        return _solved(problem, judge, certify, gap_tol, budget, setup)


def _certified(judge: str, certify: bool | None) -> bool:
    """Whether bounds are wanted; refuses a judge that is unknown, or has none."""
    if judge not in JUDGES:
        raise InputError(f"judge: {judge!r} is unknown{suggestion(judge, JUDGES)}")
    if certify and judge == "surfaces":
        raise InputError(
            "certify: bounds speak of the cost of matches, and judge='surfaces' chooses a pose by other "
            "evidence; leave one of both out"
        )
    return judge == "matches" if certify is None else certify


def _solved(
    problem: MatchProblem,
    judge: str,
    certify: bool,
    gap_tol: float | None,
    budget: Budget,
    setup: float,
) -> Result:
    if judge == "surfaces":
        starts = coinciding_poses(problem, budget)
    else:
        starts = [(problem.score(cost), pose) for cost, pose in promising_poses(problem, budget)]
    best, pose = starts[0]
    value, chosen = problem.cost(pose)
    stages = [Stage("start", budget.elapsed(), n_assignments=len(starts))]
    if gap_tol is None:
        gap_tol = TOLERATED * problem.reach**2 * max(1, len(chosen))
    status = budget.ended_by if budget.is_over else Status.CONVERGED
    lower, events = 0.0, []
    if certify:
        bound = MatchBound(problem, value, gap_tol)
        found = branch_and_bound(
            bound, budget, branching=LongestEdge(bound.axis_weights), gap_tol=gap_tol,
            refine=bound.refine, start=(pose.ravel(), value), stage="rotation",
        )  # fmt: skip
        pose, status = found.theta.reshape(3, 4), found.status
        lower, events = found.lower_bound, found.events
        stages.append(Stage.of("rotation", found))
        value, chosen = problem.cost(pose)
        best = problem.score(value)
    lower = max(0.0, lower)
    score = Score(problem.score(value), problem.score(lower))
    others = [evidence for evidence, other in starts if not is_near(other, pose, problem.reach)]
    objective = float(problem.residuals(pose)[chosen].sum())
    is_open = certify and status is not Status.OPTIMAL
    T = problem.pose(pose)
    return Result(
        status=status, model="rigid3d", mode=MODE, bound=BOUND, T_target_source=T, T_certified=T,
        assignment=problem.pairs[chosen], n_inliers=len(chosen),
        lower_bound=lower, upper_bound=value, gap_tol=gap_tol,
        certificate_scope=SCOPE, objective=objective, objective_certified=objective,
        n_nodes=sum(stage.n_nodes for stage in stages),
        n_assignments=sum(stage.n_assignments for stage in stages),
        time_setup_s=setup, time_solve_s=budget.elapsed(), stages=stages,
        trace=Trace(events), score=score,
        warnings=doubts(problem, chosen, judge, [best, *others], score if is_open else None),
    )  # fmt: skip
