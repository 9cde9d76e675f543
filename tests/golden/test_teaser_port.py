"""The own TEASER beside recorded answers of the official TEASER++ on the same correspondences."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from baselines._shared.kernels.lengths import consistency_graph
from baselines._shared.poses import homogeneous
from baselines.teaser.pipeline import register
from dcreg.problem import apply_pose
from dcreg.search import Budget
from workflows.studies.golden import golden_folder, main, pose_difference, read_case, teaser_row

FOLDER = golden_folder()
PATHS = sorted(FOLDER.glob("correspondences_*.npz")) if FOLDER else []
REASON = "no recorded cases: set DCREG_DATA_MIRROR, with golden beside it"
recorded = pytest.mark.skipif(not PATHS, reason=REASON)


@recorded
@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.stem)
def test_clique_and_pose_agree_with_the_official_solver(path: Path) -> None:
    row = teaser_row(path.stem, read_case(path))
    assert row["clique"] == row["official_clique"]
    assert row["proven_maximum"]
    assert row["agrees"], row


@recorded
@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.stem)
def test_official_cliques_are_cliques_of_our_graph(path: Path) -> None:
    """Both solve the same problem: the graphs must agree, not only the sizes."""
    case = read_case(path)
    n = len(case["source"])
    pairs = np.column_stack([np.arange(n), np.arange(n)])
    rows = consistency_graph(
        case["source"], case["target"], pairs, 2 * float(case["noise_bound"]), 1.0
    )
    members = case["teaserpp_clique"]
    inside = np.unpackbits(rows[members].view(np.uint8), axis=1, bitorder="little")[:, members]
    assert inside.sum() == len(members) * (len(members) - 1)


def hard_case(seed: int, n: int = 1000, outlier_share: float = 0.95) -> tuple:
    generator = np.random.default_rng(seed)
    source = generator.uniform(-0.5, 0.5, (n, 3))
    angle = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])
    truth = homogeneous(1.0, angle, np.array([1.0, -2.0, 0.5]))
    target = apply_pose(truth, source) + 0.003 * generator.standard_normal((n, 3))
    wrong = round(outlier_share * n)
    target[:wrong] = generator.uniform(-0.5, 0.5, (wrong, 3)) + truth[:3, 3]
    return source, target, truth


def test_a_thousand_correspondences_with_95_percent_outliers_are_solved() -> None:
    pairs = np.column_stack([np.arange(1000), np.arange(1000)])
    for seed in range(5):
        source, target, truth = hard_case(seed)
        found = register(source, target, pairs, 0.01, (1.0, 1.0), Budget())
        assert found.clique.is_maximum
        angle, shift = pose_difference(found.pose, truth)
        assert angle < 1.0
        assert shift < 0.01


@recorded
def test_the_command_writes_the_tables(tmp_path: Path) -> None:
    assert main(["teaser", "--out", str(tmp_path)]) == 0
    text = (tmp_path / "teaser.md").read_text()
    assert all(path.stem in text for path in PATHS)
    assert (tmp_path / "teaser.csv").read_text().count("\n") == len(PATHS) + 1


def test_without_cases_the_command_says_so(tmp_path: Path, capsys) -> None:
    assert main(["--golden", str(tmp_path / "none"), "--out", str(tmp_path)]) == 2
    assert "--golden" in capsys.readouterr().err
