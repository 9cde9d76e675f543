"""Mode `paper`: the two cases of DC-Reg, similarity in the plane and the two stages in space."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from dcreg.assignment.sparse import is_large
from dcreg.driver.task import Answer, Task
from dcreg.families.protocol import MakeBound, Space
from dcreg.families.registry import make_bound
from dcreg.families.rotation3d.bound import RotationBound
from dcreg.families.rotation3d.sampled import search_sampled_rotation
from dcreg.families.rotation3d.space import Rotation3D
from dcreg.families.similarity2d.space import Similarity2D
from dcreg.families.translation3d.space import Translation3D
from dcreg.search import Budget, Outcome, minimise
from dcreg.status import Status

# Share of the time that the translation search may use before the rotation gets its turn.
TRANSLATION_SHARE = 0.8

# (task, shifted source, budget) -> the best rotation about the origin
Turn = Callable[[Task, np.ndarray, Budget], Outcome]


def space_of(task: Task) -> Similarity2D | Translation3D:
    """The space of the certified search."""
    if task.dim == 2:
        return Similarity2D(
            task.source,
            task.target,
            task.n_inliers,
            task.scale_range,
            task.reduced_box,
            task.candidates,
            task.budget.stop,
        )
    return Translation3D(
        task.source, task.target, task.n_inliers, task.reduced_box, task.candidates,
        task.budget.stop,
    )  # fmt: skip


def pose_of(rotation: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """``x -> rotation (x + shift)`` as a (4, 4) matrix."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, rotation @ shift
    return T


def turn(task: Task, shifted: np.ndarray, budget: Budget) -> Outcome:
    """The best rotation of the shifted source; of large clouds a sampled one."""
    if task.candidates is None and is_large(len(task.source), len(task.target)):
        return search_sampled_rotation(
            shifted, task.target, task.n_inliers, gap_tol=task.turning_tol, budget=budget
        )
    space = Rotation3D(shifted, task.target, task.n_inliers, task.candidates, budget.stop)
    bound = RotationBound(space, threads=task.threads)
    budget = budget.named("start of rotation")
    return minimise(space, bound, budget, gap_tol=task.turning_tol, stage="rotation")


def run(task: Task, make: MakeBound | None = None, turn: Turn = turn) -> Answer:
    """The similarity; or one translation in norm space, then the rotation about the origin.

    Parameters
    ----------
    task : Task
    make : callable, optional
        The bound of the certified search, from ``(space, threads=…)``; default: the task's.
    turn : callable
        The rotation search that follows in space.
    """
    space = space_of(task)
    make = make or partial(make_bound, task.bound)
    bound = make(space, threads=task.threads)
    budget = task.budget if task.dim == 2 else task.budget.sub_budget(TRANSLATION_SHARE)
    found = minimise(space, bound, budget, gap_tol=task.gap_tol, leaves=task.leaves)
    answer = Answer(
        np.empty(0), found.status, found.lower_bound, found.upper_bound, space.scope,
        cover=(bound.roots[0], found),
    )  # fmt: skip
    answer.add("search", found)
    place(task, space, found.theta, task.budget, answer, turn)
    return answer


def place(
    task: Task,
    space: Space,
    theta: np.ndarray,
    budget: Budget,
    answer: Answer,
    turn: Turn = turn,
) -> None:
    """Add the pose to the answer of a search that ended at `theta`, by a rotation search if needed."""
    if space.fixes_rotation:
        answer.T = space.pose(theta)
        answer.ends = space.poses_of_ends()
        return
    found = turn(task, task.source + theta, budget)
    answer.add("rotation", found)
    answer.T = pose_of(Rotation3D.matrix(found.theta), theta)
    if answer.status is Status.OPTIMAL:  # no more is proven than of the weakest stage
        answer.status = found.status
