"""Mode `full` on the cases of official Go-ICP, at its threshold and beside its recorded poses.

Official Go-ICP matches many to one. Here both poses are judged by the one-to-one objective, the one
that `full` certifies. Times of this machine are set against a limit only, so the test can be trusted on
a busy one; the ratio to the official times is in the table of ``python -m workflows.studies.golden``.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import dcreg
from workflows.studies.golden import full_row, golden_folder, read_case

FOLDER = golden_folder()
FILES = sorted(FOLDER.glob("goicp_*.npz")) if FOLDER else []
TIME_LIMIT_S = 15.0

pytestmark = pytest.mark.skipif(
    not FILES, reason="needs golden/goicp_*.npz beside the folder that DCREG_DATA_MIRROR names"
)


def solve(case: dict[str, np.ndarray]) -> dcreg.Result:
    n_inliers = int(np.floor(len(case["source"]) * (1 - float(case["trim_fraction"]))))
    return dcreg.register(
        case["source"],
        case["target"],
        n_inliers=n_inliers,
        model="rigid3d",
        rel_gap=0.0,
        abs_gap=float(case["mse_threshold"]) * n_inliers,
        time_limit=TIME_LIMIT_S,
        options=dcreg.SolveOptions(mode="full", prove=True),
    )


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_closes_the_gap_at_a_pose_as_good_as_the_official_one(path: Path) -> None:
    case = read_case(path)
    result = solve(case)
    official, _ = dcreg.objective(case["source"], case["target"], case["goicp_T"], result.n_inliers)
    # where the pose is within Go-ICP's threshold at once, its bound remains 0, which is no proof
    proven = dcreg.Status.OPTIMAL if result.lower_bound > 0.0 else dcreg.Status.CONVERGED
    assert result.status is proven
    assert result.certificate_scope == "rigid pose"
    assert result.upper_bound - result.lower_bound <= result.gap_tol
    # The claim is about a pose that is there, and no pose known from elsewhere contradicts it.
    value, _ = dcreg.objective(case["source"], case["target"], result.T_certified, result.n_inliers)
    assert value == pytest.approx(result.upper_bound, rel=1e-6)
    assert result.objective <= value
    assert result.upper_bound <= official + result.gap_tol
    for pose in (case["goicp_T"], case["T_true"]):
        at_pose, _ = dcreg.objective(case["source"], case["target"], pose, result.n_inliers)
        assert result.lower_bound <= at_pose
    np.testing.assert_allclose(result.T_target_source, case["goicp_T"], atol=0.05)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_row_of_the_comparison_agrees_and_judges_by_value(path: Path) -> None:
    case = read_case(path)
    assert full_row(path.stem, case)["agrees"]
