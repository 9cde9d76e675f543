"""Initial poses of the search over matches: poses on which many compatible matches agree.

Two matches are compatible if they preserve the distance of their points. Each match forms a set with
the compatible matches that share most compatible matches with it (second-order compatibility, Chen et
al. 2022). A pose is fitted to each set, and local searches start from the best distinct poses.
"""

from __future__ import annotations

import numpy as np

from dcreg.assignment.descent import alternate
from dcreg.families.matches.kernels.compatible import closest_allies, compatible_matches
from dcreg.families.matches.problem import MIN_MATCHES, MatchProblem
from dcreg.families.matches.surfaces import Surfaces
from dcreg.problem.geometry import fit_pose
from dcreg.search import Budget

MAX_LOOKED = 5000  # first matches of the list, which form sets; all their pairs are compared
ALLIES = 20  # in the set of a match
SHORTEST = 2.0  # distance of two compatible matches, in inlier thresholds
POWER_STEPS = 10
MIN_WEIGHT = 0.3  # of a member of a set, relative to the maximum
MAX_DESCENTS = 30
# Poses that differ by less, in radians and inlier thresholds, count as one.
MIN_ROTATION, MIN_SHIFT = np.deg2rad(5.0), 2.0
PULLING_STEPS, EXACT_STEPS = 10, 10  # of a descent
MIN_GAIN = 1e-9  # relative decrease of the cost below which a descent ends
WIDE = 4.0  # initial residual, in inlier thresholds, up to which a match has an effect in a descent


def promising_poses(problem: MatchProblem, budget: Budget) -> list[tuple[float, np.ndarray]]:
    """Return costs and centred (3, 4) poses of local searches from distinct poses, best first.

    There is at least one pose, and it selects at least one match. The budget receives improvements.
    """
    poses = _agreed_poses(problem)
    order = np.argsort(-problem.scores(poses), kind="stable")
    best = problem.max_cardinality * problem.inlier_threshold**2  # the cost of no match
    ends: list[tuple[float, np.ndarray]] = []
    seen: list[np.ndarray] = []  # where local searches began and ended
    for pose in poses[order]:
        if len(ends) == MAX_DESCENTS or (ends and budget.is_over):
            break
        if not any(is_near(pose, other, problem.inlier_threshold) for other in seen):
            end, value = descend(problem, pose)
            ends.append((value, end))
            seen += [pose, end]
            if value < best:
                best = value
                budget.report_incumbent(value)
    if best == problem.max_cardinality * problem.inlier_threshold**2:
        first = problem.list.target[0] - problem.list.source[0]
        end, value = descend(problem, np.column_stack([np.eye(3), first]))
        ends.append((value, end))
    return sorted(ends, key=lambda end: end[0])


def surface_consistent_poses(
    problem: MatchProblem, budget: Budget
) -> list[tuple[float, np.ndarray]]:
    """Return scores and centred poses of local searches from distinct poses, best first.

    The score is the product of match score and surface score. Local searches for a maximum of it start
    from the poses on which matches agree. If no matches agree, the best of `promising_poses` is returned.
    """
    poses = _agreed_poses(problem)
    if not len(poses):
        return [(0.0, promising_poses(problem, budget)[0][1])]
    surfaces = Surfaces(problem.source - problem.centre, problem.target, problem.inlier_threshold)
    seen: list[np.ndarray] = []
    ends: list[np.ndarray] = []
    evidence = surfaces.scores(poses, quick=True) * problem.scores(poses)
    for pose in poses[np.argsort(-evidence, kind="stable")]:
        if len(ends) == MAX_DESCENTS or (ends and budget.is_over):
            break
        if not any(is_near(pose, other, problem.inlier_threshold) for other in seen):
            ends.append(surfaces.descend(pose, *_around(problem, pose)))
            seen += [pose, ends[-1]]
    found = np.array(ends)
    evidence = surfaces.scores(found) * problem.scores(found)
    return [(float(evidence[at]), ends[at]) for at in np.argsort(-evidence, kind="stable")]


def descend(problem: MatchProblem, centred: np.ndarray) -> tuple[np.ndarray, float]:
    """Return a better centred pose and its cost.

    First the pose is fitted to all near matches, with larger weights for nearer ones. Then the best
    one-to-one choice and the least-squares pose alternate.
    """
    x, y = problem.list.source, problem.list.target
    around_x, around_y = _around(problem, centred)
    for _ in range(PULLING_STEPS):
        moved = around_x @ centred[:, :3].T + centred[:, 3]
        square = ((moved - around_y) ** 2).sum(axis=1) / problem.inlier_threshold**2
        near = square < 1.0
        if near.sum() < 3:
            break
        weights = 1.0 / (1.0 + 4.0 * square[near])
        centred = fit_pose(around_x[near], around_y[near], (1.0, 1.0), weights)[:3]
    value, chosen = problem.cost(centred)

    def fit(_: np.ndarray, chosen: np.ndarray) -> np.ndarray | None:
        return None if len(chosen) < MIN_MATCHES else fit_pose(x[chosen], y[chosen], (1.0, 1.0))[:3]

    return alternate(centred, value, chosen, fit, problem.cost, MIN_GAIN, EXACT_STEPS)[:2]


def _around(problem: MatchProblem, centred: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the points of the matches that can have an effect in a descent from a pose."""
    around = problem.residuals(centred) < (WIDE * problem.inlier_threshold) ** 2
    return problem.list.source[around], problem.list.target[around]


def _agreed_poses(problem: MatchProblem) -> np.ndarray:
    """Return (P, 3, 4) centred poses, one for each match with enough compatible ones."""
    looked = problem.part(np.arange(min(MAX_LOOKED, len(problem.pairs))))
    bits = compatible_matches(looked, SHORTEST * looked.reach)
    allies = closest_allies(bits, ALLIES)
    allies = np.column_stack([np.arange(len(allies)), allies])
    allies = allies[(allies >= 0).sum(axis=1) >= 3]
    present = allies >= 0
    x, y = looked.source[allies], looked.target[allies]
    weights = _leading_weights(x, y, present, looked.reach)
    enough = (weights > 0.0).sum(axis=1) >= 3
    if not enough.any():
        return np.empty((0, 3, 4))
    return fit_pose(x[enough], y[enough], (1.0, 1.0), weights[enough])[:, :3]


def _leading_weights(x: np.ndarray, y: np.ndarray, present: np.ndarray, reach: float) -> np.ndarray:
    """Return the weights of members of sets: the leading eigenvector of their compatibility."""
    changes = np.abs(_distances(x) - _distances(y))
    agree = ((changes <= reach) & present[:, None] & present[:, :, None]).astype(float)
    weights = present.astype(float)
    for _ in range(POWER_STEPS):
        weights = np.einsum("sij,sj->si", agree, weights)
        weights /= np.maximum(np.linalg.norm(weights, axis=1, keepdims=True), 1e-300)
    return np.where(weights > MIN_WEIGHT * weights.max(axis=1, keepdims=True), weights, 0.0)


def _distances(points: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points[:, :, None] - points[:, None], axis=-1)


def is_near(a: np.ndarray, b: np.ndarray, reach: float) -> bool:
    """Tell whether two centred poses count as one."""
    if np.linalg.norm(a[:, 3] - b[:, 3]) >= MIN_SHIFT * reach:
        return False
    return bool((a[:, :3] * b[:, :3]).sum() > 1.0 + 2.0 * np.cos(MIN_ROTATION))  # trace of a b^T
