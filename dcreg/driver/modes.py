"""Choose and run a mode (`dcreg.families.mode`)."""

from __future__ import annotations

import functools
import logging
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import starmap
from operator import attrgetter
from typing import Any

import numpy as np

from dcreg.assignment.objective import is_large
from dcreg.driver.feasible import FEASIBLE, refuted_at_once
from dcreg.driver.normalised import NormalisedProblem, Solution
from dcreg.families.mode import Mode, load_mode
from dcreg.families.registry import bound_parts, make_bound
from dcreg.families.rotation3d.space import Rotation3D
from dcreg.jit import when_compiling
from dcreg.names import AUTO, COMPILING, MODEL_DIM, mode_files, mode_names
from dcreg.problem import InputError, Problem, suggestion
from dcreg.result import Stage
from dcreg.search import Bound, Box, Boxes, Budget, Interrupted, Outcome, Start, minimise
from dcreg.search.space_search import Cover
from dcreg.status import Status

_LOGGER = logging.getLogger("dcreg")
# Cutoff of the tiny problem of `compile_cover`. No cover gives up, so that all its kernels are compiled.
_CUTOFF = 0.3
# A dense cost matrix of more pairs than this does not fit into the memory of a common machine.
MAX_PAIRS = 100_000_000
# In norm space these match sorted norms and need no cost matrix.
MATRIX_FREE_BOUNDS = frozenset({"tight", "shared"})
# By dimension: point pairs above which a sample is searched (in 3D and up to `NORM_PAIRS`, those of two
# clouds as small as the smaller one), and the points of each cloud in it. In 2D,
# searches of some hundred points finish, but not even one local search of thousands of points does. In 3D
# some hundred points give as good an initial pose for all points as thousands, in a tenth of the time.
LARGE_PAIRS = {2: 1_000_000, 3: 1_000_000}
LARGE_SAMPLE = {2: 300, 3: 400}
# In 3D, point pairs above which norms are searched, unless a sample is.
NORM_PAIRS = 4_000_000
# In 3D, point pairs up to which a certificate is one of rigid poses: it is searched without a cover.
CERTIFIED_PAIRS = 160_000
# Share of the time for the translation search; the rotation search follows.
TRANSLATION_SHARE = 0.8
# Seconds per point that matching and warnings take after both searches of large clouds, and the largest
# share of the time that is reserved for them.
ENDING_S, LARGEST_ENDING = 1e-5, 0.75
ALL_POSES = "all poses"  # the stage of a search that a range of poses does not limit


def find_mode(model: str, name: str, bound: str | None = None) -> Mode:
    """Return the mode called `name`; a `bound` that is asked for works alone, without a cover.

    Raises
    ------
    InputError
        For an unknown name, listing the known ones.
    """
    if (model, name) in mode_files():
        mode = load_mode(model, name)
        return mode if bound is None else replace(mode, make_cover=None)
    raise InputError(
        f"mode: {name!r} is unknown for {model}{suggestion(name, [AUTO, *mode_names(model)])}"
    )


def choose_mode(problem: Problem, bound: str | None = None, certificate: bool = False) -> str:
    """Return the mode that gives the best pose for the time.

    In 3D this is ``full``, which had the highest success rate over all shapes, disturbances, sizes and
    limits measured (``make modes``). For ``rigid3d`` it is ``paper`` if a bound is requested, if more
    than `NORM_PAIRS` point pairs are searched, or if a certificate of more than `CERTIFIED_PAIRS` is
    requested.
    """
    if problem.model == "similarity3d":
        return "full"
    pairs = len(problem.source) * len(problem.target)
    only_paper = bound is not None or pairs > (CERTIFIED_PAIRS if certificate else NORM_PAIRS)
    if problem.model == "similarity2d" or (only_paper and problem.pose_range is None):
        return "paper"
    return "full"


def is_matrix_free(mode: Mode, problem: Problem, bound: str | None) -> bool:
    """Tell whether the search needs no matrix of costs."""
    return (
        mode.in_norm_space
        and mode.make_bound is None
        and problem.candidates is None
        and MATRIX_FREE_BOUNDS.issuperset(bound_parts(bound or mode.own_bound))
    )


def before_matching(mode: Mode, problem: NormalisedProblem) -> Budget:
    """Return the budget of the searches, after which the points of large clouds are matched."""
    budget, left = problem.budget, problem.budget.left()
    n, m = len(problem.source), len(problem.target)
    if mode.rotation is None or not left or not is_large(n, m):
        return budget
    return budget.isolated_sub_budget(1.0 - min(ENDING_S * (n + m) / left, LARGEST_ENDING))


def search_share(mode: Mode) -> float:
    """Return the share of the time for the certified search."""
    return 1.0 if mode.rotation is None else TRANSLATION_SHARE


def space_of(mode: Mode, problem: NormalisedProblem) -> Any:
    """Return the space of the certified search."""
    given = "source", "target", "n_inliers", *mode.needs, "candidates", "budget.stop"
    fields = attrgetter(*given, "stationary_box")(problem)
    if problem.weights is not None:
        return mode.space(*fields).weighted(problem.weights)
    if problem.region is None:
        return mode.space(*fields)
    assert mode.in_region is not None
    return mode.in_region()[0](*fields, region=problem.region)


def bound_of(mode: Mode, problem: NormalisedProblem, space: Any) -> Bound:
    """Return the bound of the certified search."""
    make_own = mode.make_bound
    if problem.region is not None and mode.in_region is not None:
        make_own = mode.in_region()[1]
    if make_own is not None:
        return make_own(space, threads=problem.threads)
    return make_bound(problem.bound, space, threads=problem.threads)


def cover_of(mode: Mode, space: Any, threads: int, budget: Budget) -> Cover:
    """Return the cover of a mode; if it applies and must be compiled, pause the clock for that."""
    assert mode.make_cover is not None
    cover = mode.make_cover(space, threads)
    if cover.applies and not cover.is_compiled:
        with budget.clock.paused():
            compile_cover(mode)
    return cover


def compile_cover(mode: Mode) -> None:
    """Compile the kernels of a mode's cover, or load them, by confining a tiny problem."""
    if mode.make_cover is None:
        return
    points = np.random.default_rng(0).standard_normal((8, MODEL_DIM[mode.model]))
    ranges = {"scale_range": (0.5, 1.5)} if "scale_range" in mode.needs else {}
    space = mode.space(points, points[:, ::-1].copy(), 6, **ranges)
    with when_compiling(lambda: _LOGGER.info(COMPILING)):
        confined = mode.make_cover(space).confine(_CUTOFF, Budget(), np.inf)
        if confined is not None:
            confined.meeting(Boxes.of(space.roots()))


def run_mode(mode: Mode, problem: NormalisedProblem) -> Solution:
    """Search the space of the mode, then recover the pose."""
    budget = before_matching(mode, problem)
    # of two stages, each has its own stop flags
    part = budget.sub_budget if mode.rotation is None else budget.isolated_sub_budget
    searching = part(search_share(mode))
    tried = Attempt(mode, replace(problem, budget=searching))
    tries = list(attempts(tried, searching.with_patience(problem.patience_s)))
    attempt, found = tries[-1]
    space = attempt.space
    solution = Solution(
        np.empty(0), found.status, found.lower_bound, found.upper_bound, space.scope,
        certified=(box_around(attempt.bound.roots), found),
    )  # fmt: skip
    for tried, each in tries:
        solution.add(tried.mode.stage, each)
        solution.stages += map(Stage.confining, each.confined)
        solution.stages += starmap(Stage, each.abandoned_s.items())
    recover_pose(mode, problem, space, found.theta, budget, solution)
    return solution


def box_around(boxes: list[Box]) -> Box:
    """Return the smallest box that contains all of `boxes`."""
    each = Boxes.of(boxes)
    return Box(each.lower.min(axis=0), each.upper.max(axis=0))


@dataclass
class Attempt:
    """One search: of all poses of a model, or of a region."""

    mode: Mode
    problem: NormalisedProblem
    space: Any = None  # by default a new one

    def __post_init__(self) -> None:
        if self.space is None:
            self.space = space_of(self.mode, self.problem)

    @functools.cached_property
    def bound(self) -> Bound:
        """The bound of the certified search."""
        return bound_of(self.mode, self.problem, self.space)

    def run(self, budget: Budget, start: Start | None = None) -> Outcome:
        """Minimise the objective over the space."""
        mode, problem, make_cover = self.mode, self.problem, None
        # A cover contains the poses that are stationary without weights, which need not be those of a
        # region. Attributes change no stationary pose, and costs only increase.
        is_free = problem.region is None
        is_free = is_free and not (problem.weights is not None and problem.weights.are_weighted)
        if start is None and problem.init is not None and budget.resumed is None:
            start = self.start(budget)
        if mode.make_cover is not None and is_free:
            make_cover = functools.partial(
                cover_of, mode, self.space, problem.threads, problem.budget
            )
        return minimise(
            self.space, self.bound, budget, tolerance=problem.tolerance, start=start,
            stage=mode.stage, keep_leaves=problem.keep_leaves, make_cover=make_cover,
        )  # fmt: skip

    def start(self, budget: Budget) -> Start:
        """Find a first incumbent, from the initial guess and from the initial poses of the space."""
        began, space = budget.elapsed(), self.space
        own = None
        if self.problem.init is not None:
            with suppress(Interrupted):
                own = space.refine(space.parameter(self.problem.init))
                budget.report_incumbent(own[1])
        known = np.inf if own is None else own[1]
        theta, value, spent = space.start(budget, self.problem.tolerance.enough, known)
        if own is not None:
            space.ends = [*space.ends, own[:2]]
            spent += own[2]
            if own[1] < value:
                theta, value = own[:2]
        return Start(theta, value, spent, budget.elapsed() - began)


def attempts(
    attempt: Attempt, budget: Budget, start: Start | None = None
) -> Iterator[tuple[Attempt, Outcome]]:
    """Yield the searches that a problem needs, each with its outcome; the last one gives the pose.

    A range of poses with limits is searched with weak bounds near its limits. They are not needed if the
    range contains the best of all poses. So all poses are searched first, unless a pose outside the range
    is clearly better than the best one inside.

    Parameters
    ----------
    attempt : Attempt
        The search of the range.
    budget : Budget
    start : Start, optional
        A known pose of the range. By default, it is searched for.
    """
    problem, region = attempt.problem, attempt.problem.region
    is_new = budget.resumed is None
    if is_new and (refuted := refuted_at_once(attempt.space, problem, budget)):
        yield replace(attempt, mode=replace(attempt.mode, stage=FEASIBLE)), refuted
        return
    if region is None or not region.has_limits:
        yield attempt, attempt.run(budget, start)
        return
    start = attempt.start(budget) if start is None else start
    all_poses = replace(attempt.mode, stage=ALL_POSES)
    free = Attempt(all_poses, replace(problem, region=region.without_limits()))
    best = free.start(budget.silent())
    floor, tolerance = 0.0, problem.tolerance
    if best.value >= tolerance.cutoff(start.value) or budget.is_over:
        own = start._replace(theta=free.space.parameter(attempt.space.pose(start.theta)))
        searching = budget.with_incumbent(start.value)
        found = free.run(searching, min(own, best, key=lambda each: each.value))
        theta = attempt.space.parameter(free.space.pose(found.theta))
        if attempt.space.admissible(theta[None])[0]:
            yield attempt, replace(found, theta=theta)
            return
        floor = min(found.lower_bound, start.value)
        if status := tolerance.status(floor, start.value):  # decided by all poses
            found = replace(found, status=status, theta=start.theta, lower_bound=floor)
            yield attempt, replace(found, upper_bound=start.value)
            return
        yield free, found
    found = attempt.run(budget, start)
    lower_bound = min(max(floor, found.lower_bound), found.upper_bound)
    status = tolerance.status(lower_bound, found.upper_bound) or found.status
    yield attempt, replace(found, status=status, lower_bound=lower_bound)


def recover_pose(
    mode: Mode,
    problem: NormalisedProblem,
    space: Any,
    theta: np.ndarray,
    budget: Budget,
    solution: Solution,
) -> None:
    """Complete the solution of a search that ended at `theta`, by a rotation search if needed."""
    if mode.rotation is None:
        solution.T = space.pose(theta)
        solution.minima = [(space.pose(end), value) for end, value in space.ends]
        return
    found = mode.rotation(
        problem.source + theta, problem.target, problem.n_inliers, problem.candidates,
        tolerance=problem.tolerance, threads=problem.threads, budget=budget,
    )  # fmt: skip
    solution.add("rotation", found)
    solution.T = shifted_rotation(Rotation3D.matrix(found.theta), theta)
    if mode.rotation_scope:
        solution.lower_bound, solution.upper_bound = found.lower_bound, found.upper_bound
        solution.scope, solution.certified = mode.rotation_scope, None
    finished = (Status.OPTIMAL, Status.CONVERGED)
    if solution.status in finished and found.status is not Status.OPTIMAL:
        solution.status = found.status  # no stage proves more than the weakest one


def shifted_rotation(rotation: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Return ``x -> rotation (x + shift)`` as a (4, 4) matrix."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, rotation @ shift
    return T
