"""`sweep`: the optimum for several cardinalities, to choose from when `n_inliers` is not known.

Let E_k(theta) be the least sum of squared residuals of k one-to-one pairs at a pose. Of an optimal
matching of k' > k pairs the k cheapest cost at most the share k / k', and they are a k-matching, so

    E_k(theta) / k <= E_k'(theta) / k'   for every theta, and so for the minima over theta.

A lower bound for k, times k' / k, is thus one for k' (*transfer*). A search for k that ends a little
below its own tolerance often proves a whole run of larger cardinalities: with U and eps their upper
bounds and tolerances, it is enough that

    lower_bound_k >= (k / k') (U_k' - eps_k')   for every k' of the run,

which asks of the search only a gap of U_k less the greatest right side. While the points added fit
as well as those before, the bounds per pair hardly move and one search serves many cardinalities;
where outliers come in, every cardinality has its own search, over its own (smaller) start box.

Poses travel both ways: the best one for k, refined, is tried for the neighbours of k.
"""

from __future__ import annotations

import dataclasses
import itertools
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dcreg.bounds import bound_parts, make_bound
from dcreg.box import LongestEdge
from dcreg.frame import Frame
from dcreg.models import Model, Similarity2D, Translation3D
from dcreg.polish import objective, polish
from dcreg.problem import Candidates, InputError, Problem, default_gap_tol
from dcreg.registration import (
    DEFAULT_BOUND,
    TRANSLATION_SHARE,
    _check_settings,
    _in_file_units,
    _round_size,
    _scaled,
    _warm_up,
    check_size,
)
from dcreg.result import Result, Status
from dcreg.rotation import search_rotation
from dcreg.search import Limits, branch_and_bound
from dcreg.trace import Event, Listener, Trace

MODE = "paper"
# A search may be asked for this share of its own tolerance to prove larger cardinalities as well;
# with less, the one search costs more than those it saves.
TIGHTEST_SHARE = 0.5
# An elbow must lie below the chord of the curve by at least this share of the curve's height.
_CLEAR_BEND = 0.1
_ROUNDING = 1e-3  # curves this flat, beside the tolerated residual, rise by rounding


@dataclass(frozen=True)
class SweepResult:
    """Optima for several cardinalities, fewest pairs first.

    Attributes
    ----------
    results : list of Result
        One per cardinality, as of `dcreg.register` in mode ``paper``. Work and time are those spent
        on this cardinality; where another search proved the bounds there are no nodes.
    proven_by : list of int or None
        The cardinality whose search gave the `lower_bound` of each result, perhaps its own; None
        where no search was needed because the objective is a sum of squares.
    """

    results: list[Result]
    proven_by: list[int | None]

    @property
    def status(self) -> Status:
        """``optimal`` if all are; else that of the first one that is not."""
        return next((r.status for r in self.results if not r.success), Status.OPTIMAL)

    @property
    def suggested_n_inliers(self) -> int | None:
        """Elbow of the RMSE of the final poses: a suggestion, nothing is proven about it.

        The cardinality farthest below the chord between the ends of the curve; None where the
        curve has no clear bend.
        """
        k = np.array([r.n_inliers for r in self.results], dtype=float)
        rmse = np.array([r.rmse_matched for r in self.results])
        height = rmse[-1] - rmse[0]
        tolerated = np.sqrt(self.results[-1].gap_tol / k[-1])
        if len(k) < 3 or height <= _ROUNDING * tolerated:
            return None
        below = rmse[0] + height * (k - k[0]) / (k[-1] - k[0]) - rmse
        at = int(np.argmax(below))
        return int(k[at]) if below[at] >= _CLEAR_BEND * height else None

    def rows(self) -> list[dict[str, Any]]:
        """One row of plain numbers per cardinality, for tables and figures.

        ``rms_low`` and ``rms`` enclose the RMS residual at the optimum: the roots of the bounds
        per pair. ``next_pair`` is the mean increase of the objective per additional pair up to
        the next cardinality of the sweep, by the upper bounds; ``next_pair_low`` and
        ``next_pair_high`` enclose that of the optima. ``rmse_matched`` is of the final pose; in 3D
        the others speak of norms.
        """
        following: list[Result | None] = [*self.results[1:], None]
        return [
            _row(result, after, proven_by)
            for result, after, proven_by in zip(
                self.results, following, self.proven_by, strict=True
            )
        ]

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON: the table, the suggestion, and every result in full."""
        return {
            "status": self.status.value,
            "suggested_n_inliers": self.suggested_n_inliers,
            "table": self.rows(),
            "results": [result.to_dict() for result in self.results],
        }


def _row(result: Result, after: Result | None, proven_by: int | None) -> dict[str, Any]:
    k = result.n_inliers
    row: dict[str, Any] = {
        "n_inliers": k,
        "status": result.status.value,
        "lower_bound": result.lower_bound,
        "upper_bound": result.upper_bound,
        "gap": result.gap,
        "gap_tol": result.gap_tol,
        "rms": float(np.sqrt(result.upper_bound / k)),
        "rms_low": float(np.sqrt(max(0.0, result.lower_bound) / k)),
        "rmse_matched": result.rmse_matched,
        "next_pair": None,
        "next_pair_low": None,
        "next_pair_high": None,
        "proven_by": proven_by,
        "n_nodes": result.n_nodes,
        "n_assignments": result.n_assignments,
        "time_s": result.time_solve_s,
    }
    if after is not None:
        more = after.n_inliers - k
        row["next_pair"] = (after.upper_bound - result.upper_bound) / more
        # the next pair costs at least what the average one does, or the k best of k' would be better
        floor = result.lower_bound / k
        row["next_pair_low"] = max((after.lower_bound - result.upper_bound) / more, floor)
        row["next_pair_high"] = (after.upper_bound - result.lower_bound) / more
    return row


@dataclass
class _Level:
    """One cardinality: its problem, what is known of its optimum, the work spent (frame units)."""

    problem: Problem
    model: Model
    gap_tol: float
    theta: np.ndarray = field(default_factory=lambda: np.empty(0))
    lower_bound: float = 0.0
    upper_bound: float = np.inf
    proven_by: int | None = None
    stopped_by: Status | None = None
    n_nodes: int = 0
    n_assignments: int = 0
    time_s: float = 0.0
    events: list[Event] = field(default_factory=list)
    stages: list[dict[str, Any]] = field(default_factory=list)

    @property
    def k(self) -> int:
        return self.problem.n_inliers

    @property
    def closed(self) -> bool:
        return self.lower_bound >= self.upper_bound - self.gap_tol

    def take(self, theta: np.ndarray, value: float, spent: int = 0) -> None:
        """A pose and its objective; the better one stays."""
        self.n_assignments += spent
        if value < self.upper_bound:
            self.theta, self.upper_bound = theta, value

    def inherit(self, smaller: _Level) -> None:
        """The transferred lower bound of a smaller cardinality."""
        bound = self.k / smaller.k * smaller.lower_bound
        if bound > self.lower_bound:
            self.lower_bound, self.proven_by = bound, smaller.proven_by


def sweep(
    source: np.ndarray,
    target: np.ndarray,
    n_inliers: Sequence[int | float],
    *,
    model: str,
    bound: str = DEFAULT_BOUND,
    scale_range: tuple[float, float] = (0.5, 1.5),
    gap_tol: float | None = None,
    time_limit: float | None = None,
    node_limit: int | None = None,
    memory_limit_mb: float | None = None,
    threads: int = 1,
    candidates: Candidates | None = None,
    polish: bool = True,
    listener: Listener | None = None,
) -> SweepResult:
    """Register two clouds for several numbers of inliers, with bounds for each.

    For every cardinality the problem of `dcreg.register` in mode ``paper`` is solved; searches share
    their poses, and a bound for fewer pairs serves for more of them where it is good enough. The k
    cheapest pairs of a feasible matching are feasible, so `candidates` change nothing about that.

    Parameters
    ----------
    source, target : (n, d), (m, d) arrays
    n_inliers : sequence of int or float
        Cardinalities, in any order and with repetitions; floats in (0, 1] are fractions of
        ``min(n, m)``.
    model, bound, scale_range, threads, candidates, polish
        As in `dcreg.register`.
    gap_tol : float, optional
        Absolute tolerance for every cardinality; default `dcreg.default_gap_tol` of each.
    time_limit : float, optional
        Seconds for all cardinalities. What one leaves over goes to those after it; those whose gap
        is open at the end have status ``time_limit``, with valid bounds and a pose.
    node_limit, memory_limit_mb : optional
        For each search.
    listener : callable, optional
        Called with every `dcreg.trace.Event`, whose stage names the cardinality (``k=40``);
        returning True ends the sweep, with status ``stopped`` for what is not proven.

    Returns
    -------
    SweepResult

    Raises
    ------
    InputError
        For bad input, before any search, naming field, value and remedy.

    Examples
    --------
    >>> import numpy as np, dcreg
    >>> rng = np.random.default_rng(0)
    >>> points = rng.random((20, 2))
    >>> moved = points + 3.0 + 0.01 * rng.standard_normal((20, 2))
    >>> moved[16:] = rng.random((4, 2)) + 3.0  # outliers
    >>> found = dcreg.sweep(points, moved, [12, 14, 16, 18, 20], model="similarity2d")
    >>> found.status.value, [round(row["rms"], 2) for row in found.rows()]
    ('optimal', [0.01, 0.01, 0.01, 0.03, 0.11])
    """
    began = time.perf_counter()
    problems = _problems(source, target, n_inliers, model, scale_range, candidates)
    check_size(problems[0])
    bound_parts(bound)
    _check_settings(
        gap_tol=gap_tol, time_limit=time_limit, node_limit=node_limit,
        memory_limit_mb=memory_limit_mb, threads=threads,
    )  # fmt: skip
    _warm_up(model, MODE, bound)
    time_setup = time.perf_counter() - began
    solve = _Sweep(
        problems,
        bound=bound,
        gap_tol=gap_tol,
        limits=Limits(time_limit, node_limit, memory_limit_mb),
        threads=threads,
        listener=listener,
    )
    solve.incumbents()
    solve.bounds()
    return SweepResult(
        solve.results(polish, time_setup), [level.proven_by for level in solve.levels]
    )


def _problems(
    source: np.ndarray,
    target: np.ndarray,
    n_inliers: Sequence[int | float],
    model: str,
    scale_range: tuple[float, float],
    candidates: Candidates | None,
) -> list[Problem]:
    """One problem per distinct cardinality, ascending."""
    if isinstance(n_inliers, str) or not isinstance(n_inliers, Iterable):
        raise InputError(
            f"n_inliers: {n_inliers!r} is not a list; give several such as [0.5, 0.7, 0.9], or use "
            "register for one"
        )
    made = {
        problem.n_inliers: problem
        for problem in (
            Problem(source, target, k, model, scale_range, candidates) for k in n_inliers
        )
    }
    if not made:
        raise InputError("n_inliers: the list is empty; give at least one count or fraction")
    return [made[k] for k in sorted(made)]


class _Sweep:
    """The state of one sweep; its methods are the stages, in the order in which they are called."""

    def __init__(
        self,
        problems: list[Problem],
        *,
        bound: str,
        gap_tol: float | None,
        limits: Limits,
        threads: int,
        listener: Listener | None,
    ) -> None:
        self.frame = Frame.of(problems[0])
        self.area = self.frame.unit**2
        self.bound, self.limits, self.threads = bound, limits, threads
        self.listener = _in_file_units(listener, self.area)
        self.levels = [self._level(problem, gap_tol) for problem in problems]
        self.began = time.perf_counter()

    def _level(self, problem: Problem, gap_tol: float | None) -> _Level:
        source, target = self.frame.source(problem.source), self.frame.target(problem.target)
        k = problem.n_inliers
        if gap_tol is None:  # a target without extent is measured by the source
            gap_tol = default_gap_tol(problem.target, k) or default_gap_tol(problem.source, k)
        model: Model
        if problem.model == "similarity2d":
            model = Similarity2D(
                source, target, k, problem.scale_range, candidates=problem.candidates
            )
        else:
            model = Translation3D(source, target, k, candidates=problem.candidates)
        return _Level(problem, model, gap_tol / self.area)

    def _left(self, share: float = 1.0) -> float | None:
        """Seconds left of a share of the time limit."""
        if self.limits.time_s is None:
            return None
        return share * self.limits.time_s - (time.perf_counter() - self.began)

    def incumbents(self) -> None:
        for level in self.levels:
            level.take(*level.model.first_incumbent())
        self._exchange()

    def _exchange(self) -> None:
        """Every pose is tried by its neighbours, last by the smaller ones: U_k / k then ascends."""
        upward = list(itertools.pairwise(self.levels))
        downward = [(b, a) for a, b in reversed(upward)]
        for giver, taker in upward + downward:
            taker.take(*taker.model.refine(giver.theta))

    def bounds(self) -> None:
        """Prove the cardinalities in ascending order, each by transfer if that is enough."""
        share = 1.0 if self.levels[0].problem.dim == 2 else TRANSLATION_SHARE
        ended: Status | None = None  # nothing more is searched, for this reason
        for at, level in enumerate(self.levels):
            if at:
                level.inherit(self.levels[at - 1])
            if level.closed:
                continue
            left = self._left(share)
            if ended is None and left is not None and left <= 0.0:
                ended = Status.TIME_LIMIT
            if ended is not None:
                level.stopped_by = ended
                continue
            run, gap_tol = self._run(at)
            if left is not None:
                left *= run / sum(not other.closed for other in self.levels[at:])
            if self._search(level, gap_tol, left) is Status.STOPPED:
                ended = Status.STOPPED

    def _run(self, at: int) -> tuple[int, float]:
        """How many levels from `at` on one search can prove, and the gap it needs for that."""
        level = self.levels[at]
        count, gap_tol = 1, level.gap_tol
        for other in self.levels[at + 1 :]:
            needed = level.k / other.k * (other.upper_bound - other.gap_tol)
            # the last digits of the division must not keep the transfer from closing the gap
            wanted = min(gap_tol, (level.upper_bound - needed) * (1.0 - 1e-6))
            if wanted < TIGHTEST_SHARE * level.gap_tol:
                break
            count, gap_tol = count + 1, wanted
        return count, gap_tol

    def _search(self, level: _Level, gap_tol: float, time_s: float | None) -> Status:
        model = level.model
        found = branch_and_bound(
            make_bound(self.bound, model, self.threads),
            [model.start_box()],
            branching=LongestEdge(model.axis_weights),
            gap_tol=gap_tol,
            refine=model.refine,
            start=(level.theta, level.upper_bound),
            limits=dataclasses.replace(self.limits, time_s=time_s),
            round_size=_round_size(len(model.source) * model.target_features.shape[1]),
            listener=self.listener,
            stage=f"k={level.k}",
        )
        better = found.upper_bound < level.upper_bound
        level.take(found.theta, found.upper_bound, found.n_assignments)
        if found.lower_bound > level.lower_bound:
            level.lower_bound, level.proven_by = found.lower_bound, level.k
        level.stopped_by = found.status
        level.n_nodes += found.n_nodes
        level.time_s += found.time_s
        level.events = found.events
        level.stages.append(
            {
                "stage": "search",
                "status": found.status.value,
                "lower_bound": found.lower_bound * self.area,
                "upper_bound": found.upper_bound * self.area,
                "gap_tol": gap_tol * self.area,
                "n_nodes": found.n_nodes,
                "n_assignments": found.n_assignments,
                "time_s": found.time_s,
            }
        )
        if better:
            self._exchange()
        return found.status

    def results(self, polish_pose: bool, time_setup: float) -> list[Result]:
        return [
            self._result(level, polish_pose, time_setup, len(self.levels) - at)
            for at, level in enumerate(self.levels)
        ]

    def _result(self, level: _Level, polish_pose: bool, time_setup: float, n_left: int) -> Result:
        began = time.perf_counter()
        status = Status.OPTIMAL
        if not level.closed:
            status = level.stopped_by or Status.STOPPED
        if isinstance(level.model, Similarity2D):
            T = level.model.pose(level.theta)
        else:
            T, rotated = self._rotate(level, n_left)
            status = rotated if status is Status.OPTIMAL else status
        T_certified = self.frame.pose(T)
        problem = level.problem
        value, pairs = objective(
            problem.source, problem.target, T_certified, level.k, problem.candidates
        )
        final_T, final_value = T_certified, value
        if polish_pose:
            final_T, final_value, pairs, spent = polish(
                problem.source,
                problem.target,
                T_certified,
                level.k,
                problem.scale_range,
                candidates=problem.candidates,
            )
            level.stages.append(
                {
                    "stage": "polish",
                    "objective_before": value,
                    "objective_after": final_value,
                    "n_assignments": spent,
                }
            )
        return Result(
            status=status,
            model=problem.model,
            mode=MODE,
            bound=self.bound,
            T_target_source=final_T,
            T_certified=T_certified,
            assignment=pairs,
            n_inliers=level.k,
            lower_bound=level.lower_bound * self.area,
            upper_bound=level.upper_bound * self.area,
            gap_tol=level.gap_tol * self.area,
            certificate_scope=level.model.scope,
            objective=final_value,
            objective_certified=value,
            n_nodes=level.n_nodes,
            n_assignments=level.n_assignments,
            n_bound_evals=level.n_nodes,
            time_setup_s=time_setup,
            time_solve_s=level.time_s + time.perf_counter() - began,
            trace=Trace([_scaled(event, self.area) for event in level.events]),
            stages=level.stages,
        )

    def _rotate(self, level: _Level, n_left: int) -> tuple[np.ndarray, Status]:
        """The second stage of the paper in 3D: the best rotation for the level's translation."""
        left = self._left()
        found = search_rotation(
            level.model.source + level.theta,
            self.frame.target(level.problem.target),
            level.k,
            gap_tol=level.gap_tol,
            time_limit=None if left is None else max(0.0, left) / n_left,
            node_limit=self.limits.nodes,
            candidates=level.problem.candidates,
            listener=self.listener,
        )
        level.n_nodes += found.n_nodes
        level.n_assignments += found.n_assignments
        level.events += found.events
        level.stages.append(
            {
                "stage": "rotation",
                "status": found.status.value,
                "lower_bound": found.lower_bound * self.area,
                "upper_bound": found.upper_bound * self.area,
                "n_nodes": found.n_nodes,
                "n_assignments": found.n_assignments,
                "time_s": found.time_s,
            }
        )
        T = np.eye(4)
        T[:3, :3] = found.rotation
        T[:3, 3] = found.rotation @ level.theta
        return T, found.status
