"""Single searches, as the modes put them together, with what tests look at."""

from types import SimpleNamespace

import numpy as np

from dcreg.assignment.k_assignment import pairs_of
from dcreg.driver import full, multi
from dcreg.driver.task import Task
from dcreg.families.rotation3d.bound import RotationBound
from dcreg.families.rotation3d.space import Rotation3D
from dcreg.search import Budget, minimise


def search_rotation(source, target, k, *, gap_tol, candidates=None, threads=1, **limits):
    """The best rotation about the origin; `limits` are those of a `Budget`."""
    budget = Budget(**limits)
    space = Rotation3D(source, target, k, candidates, budget.stop)
    bound = RotationBound(space, threads=threads)
    found = minimise(space, bound, budget, gap_tol=gap_tol, stage="rotation")
    return SimpleNamespace(
        **vars(found),
        rotation=space.matrix(found.theta),
        assignment=pairs_of(space.objective(found.theta)[1]),
    )


def task(
    source, target, k, *, gap_tol, candidates=None, threads=1, bound="tight",
    reduced_box=True, **limits,
):  # fmt: skip
    """A task in the coordinates of the clouds themselves."""
    scale_range = (1.0, 1.0) if np.shape(source)[1] == 3 else (0.5, 1.5)
    return Task(
        source, target, k, scale_range, candidates, bound, reduced_box, gap_tol, threads,
        Budget(**limits),
    )  # fmt: skip


def search_rigid(source, target, k, **settings):
    """Mode `full`, with the work of its one search."""
    answer = full.run(task(source, target, k, bound="rigid", **settings))
    return _with_work(answer)


def search_multi(source, target, k, *, basins=None, **settings):
    """Mode `multi`; `basins` are its `Settings`."""
    given = task(source, target, k, **settings)
    return _with_work(multi.run(given, basins or multi.Settings()))


def _with_work(answer):
    names = ("n_nodes", "n_assignments", "time_s")
    work = {name: sum(getattr(stage, name) for stage in answer.stages) for name in names}
    return SimpleNamespace(**vars(answer), **work)
