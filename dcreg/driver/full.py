"""Mode `full`: translation and rotation searched together for the true rigid objective."""

from __future__ import annotations

import numpy as np

from dcreg.driver.task import Answer, Task
from dcreg.families.rigid3d.bound import RigidBound
from dcreg.families.rigid3d.space import Rigid3D
from dcreg.search import minimise


def rigid_space(task: Task) -> tuple[Rigid3D, bool]:
    """The space of the search, and whether source and target change places in it.

    The smaller cloud is taken for the source, as nearest distances are taken from there; the inverse pose
    has the same residuals.
    """
    source, target, candidates = task.source, task.target, task.candidates
    swapped = len(source) > len(target)
    if swapped:
        source, target = target, source
        # in C order: kernels are compiled for no other
        candidates = None if candidates is None else np.ascontiguousarray(candidates.T)
    space = Rigid3D.centred(
        source, target, task.n_inliers, task.reduced_box, candidates, task.budget.stop
    )
    return space, swapped


def pose_in(space: Rigid3D, theta: np.ndarray, swapped: bool) -> np.ndarray:
    """The (4, 4) pose of the source, from a space of `rigid_space`."""
    T = space.pose(theta)
    return np.linalg.inv(T) if swapped else T


def ends_in(space: Rigid3D, swapped: bool) -> list[tuple[np.ndarray, float]]:
    """Where descents ended, as poses of the source with their objectives."""
    return [(pose_in(space, theta, swapped), value) for theta, value in space.ends]


def run(task: Task) -> Answer:
    """The rigid pose, certified."""
    space, swapped = rigid_space(task)
    bound = RigidBound(space, threads=task.threads)
    found = minimise(space, bound, task.budget, gap_tol=task.gap_tol, stage="rigid")
    answer = Answer(
        pose_in(space, found.theta, swapped), found.status, found.lower_bound, found.upper_bound,
        space.scope,
    )  # fmt: skip
    answer.add("rigid", found)
    answer.ends = ends_in(space, swapped)
    return answer
