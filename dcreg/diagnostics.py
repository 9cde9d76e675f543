"""Warnings and hints before a search, warnings about its result, and the runner-up pose.

Each rule about a result is a function from a solved problem to one line of text, or None if it does not
apply. The line says what is wrong and what to do. `warnings_for` applies all `RULES`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dcreg import text
from dcreg.assignment.objective import is_large
from dcreg.assignment.sparse import nearest_pairs
from dcreg.names import MAX_RMS_MET, NO_PROOF_EXPECTED, WITHIN_TOLERANCE
from dcreg.problem import (
    Problem,
    apply_pose,
    exact_objective,
    median_spacing,
    rms_radius,
    typical_radius,
)
from dcreg.problem.trees import tree_of
from dcreg.result import Result
from dcreg.status import Status

_MANY_POINTS, _VERY_MANY_POINTS = 1000, 4000
_MUCH_LARGER = 100.0
FAR = 10.0  # RMS radius divided by typical radius, from which points count as far
_OTHER_SIZE = 10.0
TOO_MANY_PAIRS = "pairs are probably too many"  # part of the line of `loose_pairs`
TOO_FEW_PAIRS = "pairs are too few"  # ... of `few_pairs`
_VAGUE = 5.0  # objective divided by its lower bound; it is below 3 if there are enough near pairs
_ROUGH = 1.01  # objective divided by upper bound; a larger ratio is more than rounding
_CLOSE = 1.5  # objective ratio of the runner-up; lower for 45 of 45 wrong and 18 of 135 right poses
_LOOSE = 2.0  # RMSE in point spacings of the target; lower for one object and the right n_inliers
_FEW_PAIRS = 20  # more pairs hardly fit by chance, except on surfaces
_MORE_PAIRS = "Match more pairs (n_inliers), of distinct points"
_NO_NUMBER = "Changing n_inliers does not help"
_REMEDY = (
    "Use downsample=200 (--downsample 200): it searches with a sample of the points and refines the "
    "pose on all points"
)


def advice(problem: Problem) -> Iterator[str]:
    """Yield warnings and hints about a problem before it is solved, one line each.

    Parameters
    ----------
    problem : Problem

    Yields
    ------
    str
        Starts with ``warning:`` or ``hint:``.

    Examples
    --------
    >>> import numpy as np, dcreg
    >>> cube = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    >>> for line in dcreg.advice(dcreg.Problem(cube, 1000 * cube, 4, "rigid3d")):
    ...     print(line[:65])
    hint: the RMS radii differ a lot (source 0.75, target 750), and r
    """
    n, m = len(problem.source), len(problem.target)
    if max(n, m) > _VERY_MANY_POINTS:
        yield f"warning: a search with {n} x {m} points is slow. {_remedy(problem)}."
    for name, points in (("source", problem.source), ("target", problem.target)):
        if FAR * typical_radius(points) < rms_radius(points):
            yield (
                f"warning: {name}: some points are far from all others (the RMS radius is more than "
                f"{FAR:g} times the median distance from the centre). They make the bounds weak. Remove "
                "them first if they are invalid."
            )
    radii = rms_radius(problem.source), rms_radius(problem.target)
    if problem.model == "rigid3d" and max(radii) > 2.0 * min(radii):
        yield (
            f"hint: the RMS radii differ a lot (source {radii[0]:.4g}, target {radii[1]:.4g}), and "
            "rigid3d has no scale. If the units differ, use model similarity3d, or rescale one cloud. "
            "Views that overlap only partially can have different radii."
        )


@dataclass(frozen=True)
class Case:
    """A solved problem.

    Attributes
    ----------
    problem : Problem
        As given, before any downsampling.
    result : Result
    in_norm_space : bool
        Whether the bounds refer to norms, not to residuals.
    """

    problem: Problem
    result: Result
    in_norm_space: bool

    @cached_property
    def undetermined(self) -> str | None:
        """The warning that the pairs do not determine the pose; it makes others meaningless."""
        k, clouds = self.result.n_inliers, (self.problem.source, self.problem.target)
        if k == 1:
            is_all = min(map(len, clouds)) == 1
            return f"one pair does not determine the pose. {_NO_NUMBER if is_all else _MORE_PAIRS}"
        extent = max(map(rms_radius, clouds))
        for name, points, rows in zip(
            ("source", "target"), clouds, self.result.assignment.T, strict=True
        ):
            shape = _shape(points[rows], extent)
            if shape is None:
                continue
            is_all = k == min(map(len, clouds)) or _shape(points, extent) is not None
            remedy = _NO_NUMBER if is_all else _MORE_PAIRS
            return f"the {k} matched {name} points {shape} and do not determine the pose. {remedy}"
        return None

    @cached_property
    def lowest_rmse(self) -> float:
        """Lower bound on the RMS residual of any one-to-one pairs at the pose.

        That of the pairs, or of nearest target points if the pairs may be rough or greedy.
        """
        problem, result = self.problem, self.result
        if not (is_large(len(problem.source), len(problem.target)) or result.is_greedy):
            return result.rmse_matched
        moved = apply_pose(result.T_target_source, problem.source)
        nearest = nearest_pairs(moved, tree_of(problem.target), result.n_inliers)[1]
        return math.sqrt(nearest / result.n_inliers)


def _is_rounding(value: float, case: Case) -> bool:
    """Tell whether an objective is 0 up to rounding."""
    problem = case.problem
    return value <= exact_objective(problem.source, problem.target, case.result.n_inliers)


def nothing_proven(case: Case) -> str | None:
    """The lower bound is 0, which proves nothing."""
    result = case.result
    if result.lower_bound > 0.0 or result.is_exact or result.reason == MAX_RMS_MET:
        return None
    known = "the lower bound is 0, which holds for every sum of squares: nothing is proven"
    if result.reason == WITHIN_TOLERANCE:
        what = "norms fit" if case.in_norm_space else "pose fits"
        return (
            f"{known}. The search ended because the {what} within the tolerance "
            f"(upper_bound={result.upper_bound:.3g}, gap_tol={result.gap_tol:.3g}). Omit abs_gap "
            "and tol (--abs-gap, --tol)"
        )
    if result.reason == NO_PROOF_EXPECTED:
        return f"{known}, and no proof is expected soon"
    if result.status is Status.STOPPED:
        return f"{known}, because the search was stopped"
    other = ", or mode 'full'" if case.in_norm_space else ""
    return f"{known}. Increase time_limit, or use fewer points{other}"


def surrogate_mismatch(case: Case) -> str | None:
    """The pose fits much worse than the bounds in norm space suggest."""
    result = case.result
    found, bounded = result.objective / result.n_inliers, result.upper_bound / result.n_bounded
    ratio = float(found) / float(max(bounded, np.finfo(float).tiny))
    is_expected = not case.in_norm_space or ratio <= _MUCH_LARGER or result.is_greedy
    if is_expected or _is_rounding(result.objective, case):
        return None
    times = f"{ratio:.3g}" if ratio < 1e6 else "over a million"
    return (
        f"the mean cost of a pair at this pose is {found:.3g}, {times} times its value in norm space, "
        f"{bounded:.3g}. The norms do not determine the pose, which may be wrong. Use "
        "mode 'full' (with downsample=200 for large clouds), or another n_inliers"
    )


def rough_pairs(case: Case) -> str | None:
    """The pairs cost more than the best pairs at the pose, or may cost more."""
    result = case.result
    if _is_rounding(result.objective, case):
        return None
    of_other = case.in_norm_space or result.downsampled is not None
    if not of_other and result.objective > _ROUGH * result.upper_bound:
        what = (
            f"the listed pairs cost {result.objective:.3g}, the best pairs at this pose at most "
            f"{result.upper_bound:.3g}"
        )
    elif of_other and result.is_greedy:
        what = (
            f"the pairs were chosen greedily and cost {result.objective:.3g}; the best pairs at this "
            "pose can cost much less"
        )
    else:
        return None
    if result.status is Status.STOPPED:
        return f"the search was stopped before all pairs were matched: {what}"
    fewer = "" if result.downsampled else ", or use downsample=200 (--downsample 200)"
    return f"the time limit was hit before all pairs were matched: {what}. Allow more time{fewer}"


def distant_pairs(case: Case) -> str | None:
    """Some pairs of large clouds connect distant points, so that better ones may exist."""
    result = case.result
    if result.is_greedy or _is_rounding(result.objective, case):
        return None
    # the squared residuals, without the costs of attributes
    found, lowest = (result.n_inliers * rmse**2 for rmse in (result.rmse_matched, case.lowest_rmse))
    if found <= _VAGUE * lowest:
        return None
    return (
        f"objective={found:.3g} is far above {lowest:.3g}, a lower bound at this pose: fewer "
        f"than {result.n_inliers} pairs are near, so some connect distant points, and better pairs may "
        "exist. Try a smaller n_inliers (`dcreg sweep` tries several)"
    )


def scale_at_limit(case: Case) -> str | None:
    """The scale is at the limit of its range."""
    low, high = case.problem.scale_range
    scale = case.result.scale
    if case.undetermined is not None:  # any scale fits as well
        return None
    if low == high or not (scale <= low * (1.0 + 1e-6) or scale >= high * (1.0 - 1e-6)):
        return None
    return (
        f"the scale {scale:.4g} is at the limit of scale_range ({low:g}, {high:g}); a better fit may lie "
        "outside. Widen the range, or rescale one cloud"
    )


def undetermined(case: Case) -> str | None:
    """Several poses fit the pairs equally well."""
    return case.undetermined


def _shape(points: np.ndarray, extent: float) -> str | None:
    """Return why points cannot determine a pose, in words; None if they can."""
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    spread = np.append(spread, np.zeros(points.shape[1]))
    smallest = 1e-9 * extent
    if spread[points.shape[1] - 2] > smallest > 0.0:
        return None
    return "coincide" if points.shape[1] == 2 or spread[0] <= smallest else "lie on one line"


def sliding(case: Case) -> str | None:
    """The clouds can slide on each other, so other pairs fit as well elsewhere."""
    if case.undetermined is not None:
        return None
    return slide_warning(case.result, "restrict the poses (pose_range)")


def slide_warning(result: Result, remedy: str) -> str | None:
    """Return the warning that clouds can slide on each other, with a remedy besides other clouds."""
    n = len(result.open_directions or [])
    if n == 0:
        return None
    return (
        f"the clouds can slide along {text.count(n, 'direction')}, as planes do, and the pose is "
        "uncertain along them (`open_directions` of the result). Use clouds with more shape, or "
        f"{remedy}"
    )


def other_size(case: Case) -> str | None:
    """One cloud is much larger than the other, and the scale of the pose does not explain it."""
    source, target = rms_radius(case.problem.source), rms_radius(case.problem.target)
    scale = 1.0 if scale_at_limit(case) else case.result.scale
    for size in (source, scale * source):
        smaller, larger = sorted((size, target))
        if larger < _OTHER_SIZE * smaller or larger == 0.0:
            return None
    return (
        f"the sizes of the clouds differ by a factor of 10 or more (RMS radii: source {source:.3g}, "
        f"target {target:.3g}). If their units differ, rescale one cloud; otherwise crop the larger one"
    )


def few_pairs(case: Case) -> str | None:
    """The pairs are so few that unrelated clouds of the same sizes may fit as well."""
    problem, k = case.problem, case.result.n_inliers
    is_few = problem.dim <= k <= _FEW_PAIRS and 2 * k < min(
        len(problem.source), len(problem.target)
    )
    if not is_few or problem.weights is not None:  # the chance is that of squared residuals
        return None
    from dcreg.problem.chance import log_chance_fits  # few results need it

    if log_chance_fits(problem, k, case.result.objective) < 0.0:
        return None
    return (
        f"{k} {TOO_FEW_PAIRS} for a meaningful pose: unrelated clouds of these sizes may fit as well "
        "by chance. Match more pairs (a larger n_inliers; `dcreg sweep` tries several)"
    )


def loose_pairs(case: Case) -> str | None:
    """Matched points are farther apart than neighbours, so some pairs are probably wrong.

    No line is returned if another cause is more likely: a search that was cut short, clouds of different
    scales, or too few pairs.
    """
    problem, result = case.problem, case.result
    if _was_cut_short(result):
        return None
    spacing = median_spacing(problem.target)
    # that of the pairs is known and no lower: it often saves the search for nearest points
    if spacing == 0.0 or result.rmse_matched <= _LOOSE * spacing:
        return None
    rmse = case.lowest_rmse
    if rmse <= _LOOSE * spacing:
        return None
    if scale_at_limit(case) or other_size(case) or few_pairs(case):
        return None
    return (
        f"at this pose, the RMS residual of the pairs is at least {rmse:.3g}, but the point spacing of "
        f"the target is only {spacing:.3g}: {result.n_inliers} {TOO_MANY_PAIRS}, and the pose may be "
        "wrong. Try a smaller n_inliers (`dcreg sweep` tries several), or remove outliers first"
    )


def _was_cut_short(result: Result) -> bool:
    """Tell whether a limit ended the search before it bounded boxes, or while poses still improved."""
    events = result.trace.events
    if result.status in (Status.OPTIMAL, Status.CONVERGED) or not events:
        return False
    last = events[-1]
    worse_s = [each.time_s for each in events if each.upper_bound > _ROUGH * last.upper_bound]
    return result.n_nodes == 0 or 2.0 * max(worse_s, default=0.0) > last.time_s


def ambiguous(case: Case) -> str | None:
    """Another pose fits nearly as well."""
    other = case.result.runner_up
    if other is None or other.objective_ratio >= _CLOSE or case.undetermined is not None:
        return None
    percent = 100.0 * (other.objective_ratio - 1.0)
    more = f"an objective only {percent:.2g} % higher" if percent >= 0.1 else "no higher objective"
    return (
        f"another pose, {other.difference} relative to this one, has {more}: "
        "the matched pairs hardly distinguish the two. The shape may be symmetric, the noise large, or "
        "the number of pairs wrong (`dcreg sweep` tries several). Look at both poses (`runner_up` of the "
        "result)"
    )


def too_many_points(case: Case) -> str | None:
    """There are too many points for the time limit."""
    n, m = len(case.problem.source), len(case.problem.target)
    is_late = case.result.status is Status.TIME_LIMIT
    if max(n, m) < _MANY_POINTS or not is_late or case.result.downsampled is not None:
        return None
    return f"{n} x {m} points are too many for this time limit. {_remedy(case.problem)}"


def _remedy(problem: Problem) -> str:
    """Return what to do about too many points; a sample uses no candidates, weights or attributes."""
    return _REMEDY if problem.candidates is problem.weights is None else "Give fewer points"


RULES: tuple[Callable[[Case], str | None], ...] = (
    nothing_proven,
    surrogate_mismatch,
    rough_pairs,
    distant_pairs,
    scale_at_limit,
    undetermined,
    sliding,
    other_size,
    few_pairs,
    loose_pairs,
    ambiguous,
    too_many_points,
)

# They compare residuals, which the objective of weighted points does not give.
OF_RESIDUALS = loose_pairs, ambiguous


def warnings_for(case: Case) -> list[str]:
    """Return one line for each rule that applies; none if it is proven that no pose is good enough."""
    if case.result.status is Status.REFUTED:
        return []
    weights = case.problem.weights
    are_weighted = weights is not None and weights.are_weighted
    rules = [each for each in RULES if not (are_weighted and each in OF_RESIDUALS)]
    return [line for rule in rules if (line := rule(case)) is not None]
