"""Is the answer the only one? All distinct poses that are nearly as good, or the proof of none.

After a solve, the objective is minimised over all poses that are distinct from those found so far: they
displace the source points by more than a given length (`dcreg.families.region.Far`). The search ends with
another pose below the threshold, which joins the list, or with the proof that there is none.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dcreg import text
from dcreg.answer import Answer
from dcreg.driver.checks import FEWER_POINTS, norms_only
from dcreg.driver.modes import run_mode
from dcreg.driver.options import Limits, SolveOptions, check_positive
from dcreg.driver.solve import Finish, Setup
from dcreg.driver.warm_up import warm_up_region
from dcreg.files import plain
from dcreg.names import DEFAULT_RATIO, DEFAULT_REL_GAP, DEFAULT_TIME_LIMIT_S
from dcreg.problem import (
    Candidates,
    InputError,
    Moments,
    Problem,
    angle_between_deg,
    rms_radius,
    rotation_axis,
)
from dcreg.questions.other_poses import Search
from dcreg.result import Result
from dcreg.status import Status

# In RMS radii of the target. Poses with a smaller displacement may differ by rounding.
SMALLEST_DISPLACEMENT = 1e-6
SOLVE_SHARE = 0.5  # of the time, for the best pose
MOST_FOLDS = 12  # of a symmetry that is named
DISTINGUISHING = (
    3.0  # the tolerance of its angle is at most this part of the distance of two such angles
)


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
    axis : (3,) array, optional
        Axis of this rotation, in coordinates of the target; None in 2D, or if the rotation displaces the
        points by at most `min_displacement`, as for a shift.
    fold : int, optional
        The rotation is a multiple of 360 / `fold` degrees, up to `min_displacement` or its default,
        whichever is smaller; None if there is no rotation, or no such number up to `MOST_FOLDS`, or if
        this length is too large to tell.
    """

    T_target_source: np.ndarray
    objective: float
    angle_deg: float
    displacement: float
    axis: np.ndarray | None = None
    fold: int | None = None

    @property
    def motion(self) -> str:
        """How it differs from the best pose, in words."""
        axis = () if self.axis is None else np.round(self.axis, 3) + 0.0  # -0 becomes 0
        about = f" about ({', '.join(f'{x:g}' for x in axis)})" if len(axis) else ""
        article = "an" if self.fold in (8, 11) else "a"
        fold = "" if self.fold is None else f" ({article} {self.fold}-fold turn)"
        return (
            f"rotated by {self.angle_deg:.4g} deg{about}{fold} and displaced by {self.displacement:.4g} "
            "(RMS) relative to the best pose"
        )


@dataclass(frozen=True, repr=False)
class Alternatives(Answer):
    """The poses that are nearly as good as the best one; see `dcreg.alternatives`.

    Attributes
    ----------
    status : Status
        ``optimal`` if the list is proven to be complete.
    result : Result
        The best pose.
    min_displacement : float
        Two poses are distinct if the RMS displacement of the source points between them exceeds this
        length, in units of the target.
    threshold : float
        The objective up to which poses are listed, in squared units of the target.
    lower_bound : float
        No pose that is distinct from all listed ones has a lower objective.
    others : list of Alternative
        Each is distinct from the best pose and from those before it.
    time_s : float
    """

    status: Status
    result: Result
    min_displacement: float
    threshold: float
    lower_bound: float
    others: list[Alternative]
    time_s: float

    question = "other poses"

    @property
    def warnings(self) -> list[str]:
        """The warnings of the search."""
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
        names = (
            "status", "is_complete", "is_unique", "min_displacement", "threshold", "lower_bound",
            "time_s",
        )  # fmt: skip
        values = {name: getattr(self, name) for name in names}
        others = [vars(each) for each in self.others]
        return plain({**values, "others": others, "result": self.result.to_dict()})

    def entries(self) -> Iterator[tuple[str, str]]:
        """Yield names and values of the summary; every warning is an entry of that name."""
        yield "answer", self.answer
        yield "distinct if", f"displaced by more than {self.min_displacement:.4g} (RMS)"
        yield "threshold", f"objective {self.threshold:.6g}"
        residual = math.sqrt(self.lower_bound / self.result.n_inliers)
        residual_shown = text.rounded_down(residual, 4)
        bound = f"{text.rounded_down(self.lower_bound, 6)} (RMS residual {residual_shown})"
        bound += " for every pose that is distinct from all listed ones"
        if not self.result.is_exact:
            ratio = self.lower_bound / self.result.upper_bound
            bound += f"; {text.rounded_down(ratio, 4)} times the objective of the best pose"
        yield "lower bound", bound
        for each in self.others:
            yield "other pose", f"objective {each.objective:.6g}, {each.motion}"
        yield "time", f"{self.time_s:.2f} s"
        yield "best pose", self.result.summary()

    @property
    def answer(self) -> str:
        """The answer in a sentence."""
        others = text.count(len(self.others), "other pose")
        if self.is_unique:
            return "unique: it is proven that no distinct pose is nearly as good"
        if self.is_complete:
            return f"{others} nearly as good: proven to be all"
        if self.others:
            ended = (
                "stopped at the given number" if self.status is Status.CONVERGED else self.status
            )
            return f"at least {others} nearly as good ({ended})"
        return f"no other pose is known, but one may exist ({self.status.value})"


def alternatives(
    source: np.ndarray,
    target: np.ndarray,
    *,
    n_inliers: int | float,
    model: str,
    ratio: float = DEFAULT_RATIO,
    min_displacement: float | None = None,
    noise: float | None = None,
    isolated: float | None = None,
    max_others: int = 20,
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

    Solves the problem of `dcreg.register`. It then minimises over all poses that are distinct from those
    found so far, until the minimum is proven to exceed the threshold. The threshold is the larger of
    `ratio` times the upper bound and ``n_inliers * noise^2``, plus `abs_gap`.

    Parameters
    ----------
    source, target, n_inliers, model, scale_range, candidates
        As in `dcreg.register`. Clouds that `register` would sample are refused.
    ratio : float
        A pose is nearly as good if its objective is at most this multiple of the best one; at least 1.
    min_displacement : float, optional
        Two poses are distinct if the RMS displacement of the source points between them exceeds this
        length, in units of the target. Default: three times the RMS residual of the best pose or
        `noise`, but at least 1 % of the RMS radius of the target.
    noise : float, optional
        A pose is also nearly as good if its RMS residual is at most this length, in units of the target.
        An exact fit needs such a length, because any multiple of its objective is 0. Default: a third of
        `min_displacement`, but at most a third of 1 % of the RMS radius of the target.
    isolated : float, optional
        Replaces `min_displacement`. In addition, the lower bound is raised beyond the threshold, until a
        distinct pose with nearly this objective is known, until a larger bound cannot be proven, or until
        a limit.
    max_others : int
        The search ends when it has found this many other poses. A sphere has infinitely many.
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
        problem, limits, SolveOptions.of(options),
        Question(ratio, min_displacement, noise, isolated, max_others),
    )  # fmt: skip


@dataclass(frozen=True)
class Question:
    """The definition of other poses: the parameters of `dcreg.alternatives`."""

    ratio: float
    min_displacement: float | None
    noise: float | None
    isolated: float | None
    max_others: int

    def check(self, problem: Problem) -> None:
        """Reject values outside their domains.

        Raises
        ------
        InputError
        """
        smallest = SMALLEST_DISPLACEMENT * (rms_radius(problem.target) or 1.0)
        check_positive("ratio", self.ratio, minimum=1.0, optional=False)
        for name in ("min_displacement", "isolated"):
            check_positive(name, getattr(self, name), minimum=smallest)
        check_positive("noise", self.noise)
        check_positive("max_others", self.max_others, such_as=20, optional=False)
        if None not in (self.min_displacement, self.isolated):
            raise InputError("isolated: replaces min_displacement; omit one of the two")


def find_alternatives(
    problem: Problem, limits: Limits, options: SolveOptions, question: Question
) -> Alternatives:
    """Solve a problem, then search for other poses; see `dcreg.alternatives`."""
    question.check(problem)
    _check(problem, options)
    setup = Setup.of([problem], limits, options)
    if setup.is_sampled:
        raise InputError(
            "source, target: clouds of this size are sampled, and a sample proves nothing about all "
            "points; give fewer points, such as keypoints, and no downsample"
        )
    if setup.mode.in_norm_space:
        raise InputError(
            f"alternatives: {norms_only(setup.mode, problem, FEWER_POINTS, bound=options.bound)}"
        )
    warm_up_region(setup.mode)
    with setup.budget() as budget:
        solving = budget.isolated_sub_budget(SOLVE_SHARE)
        normalised = setup.normalised(0, solving)
        solution = run_mode(setup.mode, normalised)
        solution.events = solving.history
        best, minima = (solution.T, solution.upper_bound), solution.minima
        result = Finish(setup, 0, normalised, solving, solving).result(solution)
        searched, distance = replace(normalised, budget=budget), question.isolated
        search = Search(
            setup, result, searched, distance or question.min_displacement, question.ratio, question.noise
        )  # fmt: skip
        status, lower_bound, known = search.run(best, minima, budget, question.max_others)
        if distance is not None and status is Status.OPTIMAL:
            lower_bound = search.raised(lower_bound, known, minima, budget)
        lower_bound = max(lower_bound * setup.frame.area, result.lower_bound)  # also of all poses
        others = [_described(setup, result, search, *each) for each in known[1:]]
        area = setup.frame.area
        return Alternatives(
            status, result, search.distance, search.threshold * area, lower_bound, others,
            budget.elapsed(),
        )  # fmt: skip


def _check(problem: Problem, options: SolveOptions) -> None:
    if problem.pose_range is not None:
        raise InputError("pose_range: alternatives are searched among all poses; omit it")
    if problem.model == "similarity3d":
        raise InputError(
            "model: similarity3d has no search for alternatives; use register, or rescale one cloud and "
            "use model rigid3d"
        )
    if options.certificate:
        raise InputError("certificate: a search for alternatives keeps none; omit it")
    options.refuse_checkpoint()


def _described(
    setup: Setup, result: Result, search: Search, T: np.ndarray, value: float
) -> Alternative:
    pose, best, source = setup.frame.pose(T), result.T_certified, setup.problems[0].source
    moved, angle = Moments.of(source).displacement(pose, best), angle_between_deg(pose, best)
    per_degree = np.radians(result.scale * rms_radius(source))  # displacement, about
    is_turned = angle * per_degree > search.distance
    length = min(search.distance, search.usual_distance)
    return Alternative(
        pose, value * setup.frame.area, angle, moved,
        axis=rotation_axis(pose, best) if len(pose) == 4 and is_turned else None,
        fold=_fold(angle, length / per_degree) if is_turned else None,
    )  # fmt: skip


def _fold(angle: float, tolerance: float) -> int | None:
    """Return the smallest n > 1 such that an angle is a multiple of 360 / n degrees, up to a tolerance.

    Multiples of different 360 / n with numbers up to n are at least 360 / n^2 degrees apart. If the
    tolerance exceeds a third of this, many angles are near such a multiple by chance, and the answer is
    None.

    Examples
    --------
    >>> _fold(119.5, 1.0), _fold(151.6, 20.0)
    (3, None)
    """
    for n in range(2, MOST_FOLDS + 1):
        if tolerance > 360.0 / (DISTINGUISHING * n**2):
            return None
        if abs(angle - 360.0 / n * round(angle * n / 360.0)) <= tolerance:
            return n
    return None
