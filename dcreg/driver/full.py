"""Mode `full`: translation and rotation searched together for the true rigid objective."""

from __future__ import annotations

from dcreg.driver.task import Answer, Task
from dcreg.families.registry import make_bound
from dcreg.families.rigid3d.space import Rigid3D
from dcreg.search import minimise


def rigid_space(task: Task) -> Rigid3D:
    """Return the space of the search."""
    return Rigid3D.between(
        task.source, task.target, task.n_inliers, task.reduced_box, task.candidates,
        task.budget.stop,
    )  # fmt: skip


def run(task: Task) -> Answer:
    """The rigid pose, certified."""
    space = rigid_space(task)
    bound = make_bound(task.bound, space, threads=task.threads)
    found = minimise(space, bound, task.budget, gap_tol=task.gap_tol, stage="rigid")
    answer = Answer(
        space.pose(found.theta), found.status, found.lower_bound, found.upper_bound, space.scope
    )
    answer.add("rigid", found)
    answer.ends = space.poses_of_ends()
    return answer
