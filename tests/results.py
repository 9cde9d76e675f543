"""Results and events with hypothetical values, and calls of the command line."""

import numpy as np
from typer.testing import CliRunner

from dcreg import Event, Result, Status, SweepResult, Trace
from dcreg.cli.program import app


def run(*arguments):
    """The outcome of a command."""
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def event(kind="bound", stage="search", time_s=0.0, n_nodes=1, lower=0.0, upper=1.0, status=""):
    return Event(kind, stage, time_s, n_nodes, 16 * n_nodes, 3, lower, upper, status)


def made_result(**changes):
    """An optimum in 2D: rotation by 90 degrees, scale 2, 100 pairs."""
    T = np.array([[0.0, -2.0, 5.0], [2.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
    values = {
        "status": Status.OPTIMAL,
        "model": "similarity2d",
        "mode": "paper",
        "bound": "tight",
        "T_target_source": T,
        "T_certified": T,
        "assignment": np.array([[i, i] for i in range(100)]),
        "n_inliers": 100,
        "lower_bound": 0.75,
        "upper_bound": 1.0,
        "gap_tol": 0.5,
        "is_exact": False,
        "certificate_scope": "similarity pose",
        "objective": 1.0,
        "objective_certified": 1.25,
        "n_nodes": 40,
        "n_assignments": 160,
        "time_setup_s": 0.1,
        "time_solve_s": 2.0,
        "trace": Trace(),
    }
    return Result(**values | changes)


def made_sweep(*statuses, **changes):
    """Optima for 50, 60, 70 ... pairs, one for each status; the residuals increase at the third one."""
    cases = zip(
        range(50, 100, 10), (0.5, 0.6, 9.0, 18.0), statuses or 3 * [Status.OPTIMAL], strict=False
    )
    results = [
        made_result(
            n_inliers=k, status=s, lower_bound=0.9 * x, upper_bound=x, objective=x, **changes
        )
        for k, x, s in cases
    ]
    return SweepResult(results, [None, *(result.n_inliers for result in results[1:])])
