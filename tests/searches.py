"""Single searches, as the modes put them together, with what tests look at."""

from types import SimpleNamespace

import numpy as np

from dcreg.assignment.objective import pairs_of
from dcreg.driver.modes import find_mode, run_mode
from dcreg.driver.normalised import NormalisedProblem
from dcreg.families.rotation3d.bound import RotationBound
from dcreg.families.rotation3d.space import Rotation3D
from dcreg.problem import Frame
from dcreg.search import Budget, Tolerance, minimise
from dcreg.status import Status


def search_rotation(source, target, k, *, gap_tol, candidates=None, threads=1, **limits):
    """The best rotation about the origin; `limits` are those of a `Budget`."""
    budget = Budget(**limits)
    space = Rotation3D(source, target, k, candidates, budget.stop)
    bound = RotationBound(space, threads=threads)
    found = minimise(space, bound, budget, tolerance=Tolerance(abs=gap_tol), stage="rotation")
    return SimpleNamespace(
        **vars(found),
        rotation=space.matrix(found.theta),
        assignment=pairs_of(space.objective(found.theta)[1]),
    )


def normalised(
    source, target, k, *, gap_tol, candidates=None, threads=1, stationary_box=True, **limits
):  # fmt: skip
    """A rigid problem in the coordinates of the clouds themselves; `limits` are those of a `Budget`."""
    return NormalisedProblem(
        source, target, k, (1.0, 1.0), candidates, Frame(np.zeros(3), np.zeros(3), 1.0), "rigid",
        stationary_box, Tolerance(abs=gap_tol), threads, Budget(**limits),
    )  # fmt: skip


def search_rigid(source, target, k, **settings):
    """Mode `full` over the centred clouds, with the work of its one search."""
    x, y = source.mean(axis=0), target.mean(axis=0)
    problem = normalised(source - x, target - y, k, **settings)
    solution = run_mode(find_mode("rigid3d", "full"), problem)
    solution.T[:3, 3] += y - solution.T[:3, :3] @ x
    names = ("n_nodes", "n_assignments", "time_s")
    work = {name: sum(getattr(stage, name) for stage in solution.stages) for name in names}
    return SimpleNamespace(**vars(solution), **work)


def is_certified(found, optimum, gap_tol):
    """Check the bounds against the true optimum; return whether the optimum is certified."""
    slack = 1e-8 * (1 + optimum)
    assert found.lower_bound <= optimum + slack
    assert found.upper_bound >= optimum - slack
    if found.status is not Status.OPTIMAL:
        return False
    assert found.upper_bound <= optimum + gap_tol + slack
    assert found.upper_bound - found.lower_bound <= gap_tol + slack
    return True
