"""Rules on the solutions of a method, for each of its models."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from baselines.conformance.candidate import (
    LIMITS,
    BrokenRuleError,
    Candidate,
    NotCheckedError,
    easy_instance,
    hard_instance,
    require,
)
from baselines.contract import Instance, Limits, Solution
from dcreg.problem import apply_pose, rms_radius
from dcreg.status import Status

MOST_OF_A_STEP = 250  # assignments between two checks of their limit
SHORT_S = 0.05  # a time limit; a call of another library cannot be stopped and may take MOST_LATE_S
MOST_LATE_S = 3.0


def n_inliers_is_stated(method: Candidate, model: str) -> None:
    """The card states whether the method reads n_inliers."""
    method.solved(model)
    is_read = "n_inliers" in method.given(model).__dict__["_read"]
    require(
        is_read == method.card.uses_n_inliers,
        f"card.yaml: uses_n_inliers is {method.card.uses_n_inliers}, but solve "
        f"{'reads' if is_read else 'does not read'} instance.n_inliers; correct the card",
    )


def pose_is_proper(method: Candidate, model: str) -> None:
    """The pose is a finite homogeneous matrix of the model, with an admissible scale."""
    solution, instance = method.solved(model), easy_instance(model)
    if _has_failed(solution):
        return
    pose, d = np.asarray(solution.T_target_source), instance.dim
    shape = (d + 1, d + 1)
    require(pose.shape == shape, f"the pose has shape {pose.shape}; return {shape}, homogeneous")
    require(np.isfinite(pose).all(), "the pose is not finite; return FAILED with a message instead")
    require(
        (pose[d] == np.eye(d + 1)[d]).all(), f"the last row of the pose is {pose[d]}, not 0 … 0 1"
    )
    scale = np.linalg.det(pose[:d, :d]) ** (1 / d)
    low, high = instance.scale_range
    require(
        low - 1e-9 <= scale <= high + 1e-9,
        f"the pose has scale {scale:.9g}, outside instance.scale_range = ({low:g}, {high:g})",
    )
    gram = pose[:d, :d].T @ pose[:d, :d]
    require(
        np.allclose(gram, scale**2 * np.eye(d), rtol=0, atol=1e-8),
        f"the {d} x {d} part of the pose is not a rotation times a scale; project it",
    )


def _has_failed(solution: Solution) -> bool:
    """Whether there is no pose; then the status is FAILED, with a message."""
    if solution.T_target_source is not None:
        return False
    require(
        solution.status is Status.FAILED and solution.message,
        f"no pose, but the status is {solution.status!r} and the message {solution.message!r}; "
        "return Status.FAILED with a message",
    )
    return True


def status_is_consistent(method: Candidate, model: str) -> None:
    """Only methods with bounds report OPTIMAL; others CONVERGED, FAILED or a limit."""
    solution, card = method.solved(model), method.card
    if solution.status is Status.OPTIMAL:
        require(card.provides_bounds, "status OPTIMAL, but the card says provides_bounds: false")
        require(solution.certificate_scope, "status OPTIMAL without certificate_scope; state it")
        return
    ends = (Status.CONVERGED, Status.FAILED)
    require(
        solution.status in ends or solution.status.is_limit,
        f"status {solution.status!r}; return CONVERGED, FAILED, OPTIMAL or a limit",
    )


def bounds_are_consistent(method: Candidate, model: str) -> None:
    """The lower bound is below the upper one, and both improve monotonically in the trace."""
    solution = method.solved(model)
    lower, upper = solution.lower_bound, solution.upper_bound
    if not method.card.provides_bounds:
        require(
            lower is None and upper is None and solution.trace == [],
            "bounds or a trace, but the card says provides_bounds: false; correct one of them",
        )
        return
    if lower is None or upper is None or not solution.trace:
        raise BrokenRuleError("the card says provides_bounds: true; return both bounds and a trace")
    slack = 1e-9 * max(1.0, abs(upper))
    require(lower <= upper + slack, f"lower bound {lower} above the upper bound {upper}")
    if solution.status is Status.OPTIMAL:
        require(
            solution.gap_tol is not None and upper - lower <= solution.gap_tol + slack,
            f"status OPTIMAL with gap {upper - lower:g} above gap_tol = {solution.gap_tol}",
        )
    for stage in {row.get("stage", "") for row in solution.trace}:
        rows = [row for row in solution.trace if row.get("stage", "") == stage]
        for key, sign in (("lower_bound", 1), ("upper_bound", -1), ("n_nodes", 1)):
            values = np.array([row[key] for row in rows], dtype=float)
            before, after = values[:-1], values[1:]
            require(
                (sign * after >= sign * before - slack).all(),
                f"trace, stage {stage!r}: {key} is not monotonic",
            )


def results_repeat(method: Candidate, model: str) -> None:
    """A deterministic method repeats status, counters and pose exactly, also with more threads."""
    first = method.solved(model)
    if not method.card.deterministic or first.status.is_limit:
        return
    second = method.runnable().solve(easy_instance(model), replace(LIMITS, threads=2))
    same = second.status is first.status and second.counters == first.counters
    if first.T_target_source is not None and second.T_target_source is not None:
        same = same and np.array_equal(first.T_target_source, second.T_target_source)
    require(
        same,
        "a second run, with two threads, differs; draw random numbers from instance.seed only, let the "
        "order of sums not depend on threads, or state deterministic: false in card.yaml",
    )


def inputs_are_not_changed(method: Candidate, model: str) -> None:
    """The arrays of the instance stay as they are."""
    method.solved(model)
    given, fresh = method.given(model), easy_instance(model)
    for key in ("source", "target"):
        require(
            np.array_equal(getattr(given, key), getattr(fresh, key)),
            f"solve changes instance.{key}; copy it first",
        )


def stops_near_its_time_limit(method: Candidate, model: str) -> None:
    """With a short time limit, the method returns soon with its best pose."""
    method.solved(model)  # imports and compilation are done
    instance = easy_instance(model)
    start = time.process_time()
    solution = method.load().solve(instance, Limits(time_s=SHORT_S))
    taken = time.process_time() - start
    require(
        taken < MOST_LATE_S,
        f"{taken:.1f} s of CPU time with limits.time_s = {SHORT_S}; check limits.budget()",
    )
    finished = solution.status in (Status.CONVERGED, Status.OPTIMAL, Status.FAILED)
    require(
        finished or solution.status is Status.TIME_LIMIT,
        f"status {solution.status!r} at the time limit; return TIME_LIMIT",
    )
    _has_failed(solution)


def stops_near_a_limit_on_assignments(method: Candidate, model: str) -> None:
    """A method that counts assignments stops soon after their limit."""
    card, first = method.card, method.solved(model)
    counts_them = "n_assignments" in first.counters
    require(
        card.solves_assignments == counts_them,
        f"card.yaml: solves_assignments is {card.solves_assignments}, but the counters are "
        f"{sorted(first.counters)}; correct one of them",
    )
    if not card.solves_assignments:
        return
    searches = 2 if model == "rigid3d" else 1
    counts = []
    for limit in (1, 300):
        limits = Limits(time_s=20.0, assignments=limit)
        found = method.load().solve(hard_instance(model), limits)
        in_time = found.status is not Status.TIME_LIMIT and found.T_target_source is not None
        require(in_time, f"status {found.status!r} with limits.assignments = {limit}")
        counts.append(found.counters["n_assignments"])
    begun = f"{counts[0]} assignments with a limit of 1; the limit also holds for initial poses"
    require(counts[0] <= searches * MOST_OF_A_STEP, begun)
    most = counts[0] + searches * 300 + MOST_OF_A_STEP
    require(counts[1] <= most, f"{counts[1]} assignments with a limit of 300; stop at the limit")
    if found.status is Status.ASSIGNMENT_LIMIT:
        require(counts[1] >= 300, f"ASSIGNMENT_LIMIT after {counts[1]} of 300 assignments")


def awkward_sizes_are_handled(method: Candidate, model: str) -> None:
    """Few points, one pair, n != m and coinciding points give a pose or a message, no exception."""
    loaded, easy = method.runnable(), easy_instance(model)
    cases = [
        (easy.source[:5], easy.target[:9], 4),
        (easy.source[:6], easy.target[:4], 1),
        (np.repeat(easy.source[:2], 3, axis=0), easy.target[:7], 3),
    ]
    for source, target, n_inliers in cases:
        instance = Instance(
            "awkward", source, target, easy.model, n_inliers, easy.scale_range, 0.02, 0
        )
        size = f"{len(source)} and {len(target)} points, n_inliers = {n_inliers}"
        try:
            solution = loaded.solve(instance, Limits(time_s=2.0, nodes=200))
        except Exception as error:
            raise BrokenRuleError(
                f"{size}: {type(error).__name__}: {error}; return Status.FAILED with a message"
            ) from error
        if not _has_failed(solution):
            require(
                np.isfinite(np.asarray(solution.T_target_source)).all(), f"{size}: pose not finite"
            )


def solves_the_easy_instance(method: Candidate, model: str) -> None:
    """The method registers 25 or 42 points that are slightly moved.

    FPFH needs more points, so methods that use it are not checked.
    """
    if method.card.input.startswith("FPFH"):
        raise NotCheckedError(f"its input is {method.card.input}")
    solution, instance = method.solved(model), easy_instance(model)
    if solution.status.is_limit:
        raise NotCheckedError(f"it stopped at {solution.status.value}")
    require(solution.T_target_source is not None, f"no pose: {solution.message}")
    moved = apply_pose(np.asarray(solution.T_target_source), instance.source)
    distances = np.linalg.norm(moved[:, None] - instance.target[None], axis=2).min(axis=0)
    error, most = np.sqrt((distances**2).mean()), 0.05 * rms_radius(instance.target)
    require(
        error < most,
        f"the RMS distance of the target points to the moved source is {error:.3g}, above {most:.3g}",
    )


RULES: tuple[Callable[[Candidate, str], None], ...] = (
    n_inliers_is_stated, pose_is_proper, status_is_consistent, bounds_are_consistent, results_repeat,
    inputs_are_not_changed, stops_near_its_time_limit, stops_near_a_limit_on_assignments,
    awkward_sizes_are_handled, solves_the_easy_instance,
)  # fmt: skip
