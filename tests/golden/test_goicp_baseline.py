"""Our Go-ICP against the poses of the official one, at the official settings."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from baselines import registry
from baselines.contract import Instance, Limits
from dcreg.problem import apply_pose
from dcreg.status import Status
from workflows.studies.golden import golden_folder, read_case

FOLDER = golden_folder()
# one of two cases, because the other one takes 25 s; ALL_GOLDEN=1 compares both
FILES = sorted(FOLDER.glob("goicp_*.npz")) if FOLDER else []
FILES = FILES if "ALL_GOLDEN" in os.environ else FILES[:1]

pytestmark = pytest.mark.skipif(
    not FILES, reason="needs golden/goicp_*.npz beside the folder that DCREG_DATA_MIRROR names"
)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_is_as_good_as_the_official_pose(path: Path) -> None:
    case = read_case(path)
    source, target = case["source"], case["target"]
    n_kept = int(np.floor(len(source) * (1 - float(case["trim_fraction"]))))
    instance = Instance(path.stem, source, target, "rigid3d", n_kept, (1, 1), 0.01, 0)
    method = registry.load(
        "goicp",
        mse_threshold=float(case["mse_threshold"]),
        normalise=False,  # the official program was given these coordinates
        translation_half_width=float(case["translation_half_width"]),
    )
    method.warm_up(instance)
    solution = method.solve(instance, Limits(time_s=120.0))
    threshold = float(case["mse_threshold"]) * n_kept

    def exact(pose: np.ndarray) -> float:
        distances = np.linalg.norm(apply_pose(pose, source)[:, None] - target, axis=2).min(axis=1)
        return float((np.sort(distances)[:n_kept] ** 2).sum())

    assert exact(case["goicp_T"]) == pytest.approx(float(case["exact_error"]), rel=1e-6)
    assert solution.status is Status.OPTIMAL
    assert solution.gap_tol == pytest.approx(threshold)
    assert exact(solution.T_target_source) == pytest.approx(solution.upper_bound, rel=1e-9)
    assert solution.upper_bound <= float(case["exact_error"]) + threshold
    assert solution.lower_bound <= float(case["exact_error"])
    # The two searches find the same place.
    np.testing.assert_allclose(solution.T_target_source, case["goicp_T"], atol=0.05)
