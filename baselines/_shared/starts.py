"""Initial poses of the local methods. Their option `starts` names one of these lists.

``identity``
    The identity only.
``centroid``
    Identity rotation and scale 1; the centroid of the source is moved to that of the target.
``multi``
    ``centroid``, ``identity``, then rotations about the centroids: in 2D 12 angles (every 30
    degrees) times 3 scales (1/6, 1/2 and 5/6 of the scale range); in 3D the 24 rotations of the
    cube. Their order is mixed, so that a limit leaves poses spread over the whole list.
    The result is the refined pose with the minimum symmetric trimmed distance: the sum of the
    ``n_inliers`` smallest squared nearest-neighbour distances from source to target and of those
    from target to source. Both are needed, since a shrunken source is near the target everywhere.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from baselines._shared.poses import homogeneous
from baselines.contract import Baseline, Instance, Limits, Solution
from dcreg.problem import apply_pose
from dcreg.search import Budget
from dcreg.status import Status

STARTS = ("identity", "centroid", "multi")
GOLDEN = (np.sqrt(5.0) - 1.0) / 2.0  # its multiples modulo 1 spread over the unit interval

# Refines one initial pose until it converges or the budget is over; None if the method fails there.
Refine = Callable[[np.ndarray, Budget], np.ndarray | None]


def check_choice(method: Baseline, option: str, choices: tuple[str, ...]) -> str:
    """Return the value of the option, which must be one of `choices`."""
    value = method.options[option]
    if value not in choices:
        raise ValueError(f"option {option} = {value!r}; choose one of {', '.join(choices)}")
    return str(value)


def start_poses(instance: Instance, starts: str) -> list[np.ndarray]:
    """Return the list named `starts` for this instance; see the module."""
    low, high = instance.scale_range
    unit = float(np.clip(1.0, low, high))
    identity = homogeneous(unit, np.eye(instance.dim), np.zeros(instance.dim))
    centroid = _about_centroids(instance, unit, np.eye(instance.dim))
    if starts == "identity":
        return [identity]
    if starts == "centroid":
        return [centroid]
    if instance.dim == 3:
        rotations = list(Rotation.create_group("O").as_matrix())
        scales = [unit]
    else:
        rotations = [_rotation2d(angle) for angle in np.arange(12) * (np.pi / 6)]
        scales = [low + part * (high - low) for part in (1 / 6, 1 / 2, 5 / 6)]
    grid = [_about_centroids(instance, s, rotation) for s in scales for rotation in rotations]
    spread = np.argsort(np.arange(len(grid)) * GOLDEN % 1.0)
    return [centroid, identity, *(grid[at] for at in spread)]


def best_of_starts(instance: Instance, starts: str, limits: Limits, refine: Refine) -> Solution:
    """Refine the initial poses within the limits (a node is one pose) and return the best."""
    budget = limits.budget()
    poses = start_poses(instance, starts)
    distance = SymmetricDistance(instance)
    best: np.ndarray | None = None
    least, tried = np.inf, 0
    for pose in poses[: limits.nodes]:
        if best is not None and budget.is_over:
            break
        refined = refine(pose, budget)
        tried += 1
        value = np.inf if refined is None else distance(refined)
        if value < least:
            best, least = refined, value
    counters = {"n_starts": tried}
    if best is None:
        return Solution(
            Status.FAILED, None, "no initial pose led to a finite pose", counters=counters
        )
    if budget.is_over or tried < len(poses):
        ended = Status.TIME_LIMIT if budget.is_over else Status.NODE_LIMIT
        message = f"{tried} of {len(poses)} initial poses within the limit"
        return Solution(ended, best, message, counters=counters)
    return Solution(Status.CONVERGED, best, counters=counters)


class SymmetricDistance:
    """The symmetric trimmed distance of a pose."""

    def __init__(self, instance: Instance) -> None:
        self.instance = instance
        self.target_tree = cKDTree(instance.target)

    def __call__(self, pose: np.ndarray) -> float:
        moved = apply_pose(pose, self.instance.source)
        if not np.isfinite(moved).all():
            return np.inf
        forward, _ = self.target_tree.query(moved)
        backward, _ = cKDTree(moved).query(self.instance.target)
        return self._trimmed(forward) + self._trimmed(backward)

    def _trimmed(self, distances: np.ndarray) -> float:
        return float((np.sort(distances)[: self.instance.n_inliers] ** 2).sum())


def _rotation2d(angle: float) -> np.ndarray:
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, -sine], [sine, cosine]])


def _about_centroids(instance: Instance, scale: float, rotation: np.ndarray) -> np.ndarray:
    """Return the pose with this linear part that maps the source's centroid to the target's."""
    moved = scale * rotation @ instance.source.mean(axis=0)
    return homogeneous(scale, rotation, instance.target.mean(axis=0) - moved)
