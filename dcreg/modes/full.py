"""Mode `full`: translation and rotation searched together for the true rigid objective."""

from __future__ import annotations

from dcreg.bounds import RigidBound
from dcreg.modes.task import Answer, Task
from dcreg.search import minimise
from dcreg.spaces import Rigid3D


def run(task: Task) -> Answer:
    """The rigid pose, certified."""
    space = Rigid3D.between(
        task.source, task.target, task.n_inliers, task.reduced_box, task.candidates
    )
    bound = RigidBound(space, threads=task.threads)
    found = minimise(space, bound, task.budget, gap_tol=task.gap_tol, stage="rigid")
    answer = Answer(
        space.pose(found.theta), found.status, found.lower_bound, found.upper_bound, space.scope
    )
    answer.add("rigid", found)
    return answer
