"""Verdicts on runs, and certified intervals of their regret, on made-up runs."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from workflows.attribution import COLUMNS, attribute, tolerance

RUN = {
    "instance_id": "i", "n_inliers": 10, "status": "converged", "outcome": "finished",
    "certificate_scope": "", "lower_bound": np.nan, "upper_bound": np.nan, "gap_tol": np.nan,
    "rmse": 1.0, "success": False, "admissible": True, "objective": 1.0, "objective_true": 1.5,
    "objective_best": 1.0,
}  # fmt: skip
PROOF = {
    **RUN, "status": "optimal", "certificate_scope": "similarity pose", "success": True,
    "lower_bound": 0.95, "upper_bound": 1.0, "gap_tol": 0.1,
}  # fmt: skip


def judged(proof: dict, **changes) -> pd.Series:
    """The second of two runs on one problem; the first has a certified optimum (tolerance 0.1)."""
    return attribute(pd.DataFrame([proof, RUN | changes])).iloc[1]


@pytest.mark.parametrize(
    ("changes", "verdict"),
    [
        ({"success": True, "objective": 1.05}, "right"),
        ({"success": True, "objective": 1.2}, "right_not_optimal"),
        ({"objective": 1.2}, "search_error"),
        ({"objective": 9.0}, "search_error"),
        ({"objective": 1.05}, "model_error"),
        ({"objective": 1.05, "objective_true": 1.02}, "undecided"),
        ({"objective": 0.2, "admissible": False}, "inadmissible"),
        ({"objective": np.nan}, "not_evaluated"),
        ({"objective": np.nan, "success": True}, "not_evaluated"),
        ({"objective": np.nan, "rmse": np.nan, "outcome": "failed"}, "no_pose"),
        ({"objective": np.nan, "rmse": np.nan, "outcome": "unavailable"}, ""),
    ],
)
def test_errors_are_attributed(changes, verdict):
    assert judged(PROOF, **changes)["verdict"] == verdict


@pytest.mark.parametrize(
    ("proof", "gap_tol", "expected"),
    [
        (PROOF, 0.01, 0.1),  # of the proof, although another run states less
        (PROOF | {"status": "time_limit"}, 0.01, 0.1),  # the least stated for this objective
        # none stated for this objective: 1 % of that at the reference
        (PROOF | {"gap_tol": np.nan}, np.nan, 0.015),
        (PROOF | {"certificate_scope": "translation in norm space"}, 0.01, 0.015),
        (PROOF | {"certificate_scope": "number of inliers", "gap_tol": 0.0}, np.nan, 0.015),
    ],
)
def test_the_tolerance_is_that_of_proofs_or_the_minimum_or_a_share(proof, gap_tol, expected):
    runs = pd.DataFrame([proof, RUN | {"gap_tol": gap_tol}])
    np.testing.assert_allclose(tolerance(runs), expected, rtol=1e-6)


def test_another_runs_certificate_bounds_the_regret():
    run = judged(PROOF, objective=1.2)
    assert run["optimum_at_least"] == 0.95
    assert run["regret_at_most"] == pytest.approx(0.25)


def test_an_open_gap_gives_a_wider_interval():
    stopped = PROOF | {"status": "time_limit", "lower_bound": 0.3}
    assert judged(stopped, objective=1.2)["regret_at_most"] == pytest.approx(0.9)


@pytest.mark.parametrize(
    "other",
    [
        {"certificate_scope": "translation in norm space"},
        {"n_inliers": 5},
        {"instance_id": "j"},
        {"lower_bound": np.nan},
    ],
)
def test_a_certificate_of_something_else_bounds_nothing(other):
    run = judged(PROOF | other)
    assert np.isnan(run["optimum_at_least"])
    assert np.isnan(run["regret_at_most"])


def test_no_interval_for_a_pose_outside_the_range():
    assert np.isnan(judged(PROOF, objective=0.2, admissible=False)["regret_at_most"])


def test_rounding_makes_no_interval_empty_but_a_wrong_bound_stays_visible():
    assert judged(PROOF | {"lower_bound": 1.0 + 1e-12})["regret_at_most"] == 0
    assert judged(PROOF | {"lower_bound": 1.2})["regret_at_most"] < 0


def test_columns_are_those_documented():
    assert set(attribute(pd.DataFrame([PROOF]))) - set(PROOF) == set(COLUMNS)
