"""The adapters of pygcransac and pysuperansac, judged by stand-in modules: wiring, units and frames."""

from __future__ import annotations

import sys
import types

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from baselines import registry
from baselines._shared.poses import homogeneous
from baselines.contract import Instance
from dcreg.problem import apply_pose
from dcreg.problem.geometry import fit_pose
from dcreg.search import Budget
from tests.correspondences import rows_as_pairs

NAMES = ["pygcransac", "pysuperansac"]


def row_pose(correspondences: np.ndarray) -> np.ndarray:
    """The pose of all rows as both packages give it: for row vectors, hence transposed."""
    assert correspondences.flags.c_contiguous
    assert (correspondences >= 0).all()
    return fit_pose(correspondences[:, :3], correspondences[:, 3:], (1.0, 1.0)).T


class Calls:
    """What the stand-ins were called with."""

    threshold: float
    finds: bool = True


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> Calls:
    calls = Calls()

    def find(correspondences: np.ndarray, **options: object) -> tuple[np.ndarray | None, None]:
        calls.threshold = options["threshold"]
        return row_pose(correspondences) if calls.finds else None, None

    def estimate(correspondences: np.ndarray, sizes: np.ndarray, config: object) -> tuple:
        np.testing.assert_array_equal(sizes, correspondences.max(axis=0))
        calls.threshold = config.inlier_threshold
        return row_pose(correspondences) if calls.finds else None, [], 0.0, 1

    gc = types.SimpleNamespace(findRigidTransform=find)
    super_ = types.SimpleNamespace(
        estimateRigidTransform=estimate,
        RANSACSettings=types.SimpleNamespace,
        ScoringType=types.SimpleNamespace(MAGSAC=1),
        LocalOptimizationType=types.SimpleNamespace(NestedRANSAC=1, LSQ=2),
    )
    monkeypatch.setitem(sys.modules, "pygcransac", gc)
    monkeypatch.setitem(sys.modules, "pysuperansac", super_)
    return calls


def problem() -> tuple[Instance, np.ndarray]:
    generator = np.random.default_rng(1)
    source = generator.uniform(-3, -2, (30, 3))
    truth = homogeneous(1.0, Rotation.from_rotvec([0.4, 1.2, -2]).as_matrix(), [5.0, -70.0, 1.0])
    return Instance("x", source, apply_pose(truth, source), "rigid3d", 30, (1, 1), 0.02, 0), truth


@pytest.mark.parametrize("name", NAMES)
def test_pose_is_in_the_coordinates_of_the_clouds(name: str, calls: Calls) -> None:
    instance, truth = problem()
    method = registry.load(name, noise_factor=1.5)
    found = method.estimate(instance, rows_as_pairs(30), Budget()).pose
    np.testing.assert_allclose(found, truth, atol=1e-9)
    assert calls.threshold == pytest.approx(0.03)


@pytest.mark.parametrize("name", NAMES)
def test_a_package_that_finds_no_pose_gives_none(name: str, calls: Calls) -> None:
    calls.finds = False
    found = registry.load(name).estimate(problem()[0], rows_as_pairs(30), Budget())
    assert found.pose is None


@pytest.mark.parametrize("name", NAMES)
def test_without_the_package_it_says_how_to_install_it(name: str) -> None:
    if registry.load(name).available() is None:
        pytest.skip(f"{name} is installed here")
    assert f"pip install {name}" in registry.load(name).available()
