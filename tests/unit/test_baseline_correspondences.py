"""Correspondence methods on planted pairs, the front ends, and the official solver's wiring."""

from __future__ import annotations

import dataclasses
import sys
import types
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from baselines import registry
from baselines._shared.front_ends import (
    Estimate,
    FrontEndError,
    Putative,
    all_pairs,
    fpfh_mutual,
    norm_signature,
    oracle_pairs,
    putative_pairs,
)
from baselines._shared.poses import homogeneous, median_spacing
from baselines.contract import Instance, Limits
from dcreg.problem import apply_pose
from dcreg.status import Status
from tests.correspondences import NOISE, planted, rows_as_pairs

LIMITS = Limits(time_s=20.0)


def angle_between(first: np.ndarray, second: np.ndarray) -> float:
    return float(np.degrees(Rotation.from_matrix(first[:3, :3] @ second[:3, :3].T).magnitude()))


@pytest.mark.parametrize(
    ("name", "outlier_share"), [("fpfh_ransac", 0.6), ("fpfh_fgr", 0.3), ("kiss_matcher", 0.8)]
)
def test_planted_pose_is_recovered_despite_outliers(name: str, outlier_share: float) -> None:
    method = registry.load(name)
    if reason := method.available():
        pytest.skip(reason)
    instance, truth = planted("rigid3d", 200, outlier_share)
    pose = method.solve_pairs(instance, rows_as_pairs(200), LIMITS.budget())
    assert angle_between(pose, truth) < 2.0
    np.testing.assert_allclose(
        apply_pose(pose, instance.source).mean(axis=0),
        apply_pose(truth, instance.source).mean(axis=0),
        atol=NOISE,
    )


@pytest.mark.parametrize("name", ["fpfh_ransac", "fpfh_fgr", "kiss_matcher"])
def test_own_front_end_finds_the_pose_of_dense_clouds(name: str) -> None:
    method = registry.load(name, front_end="own")
    if reason := method.available():
        pytest.skip(reason)
    rng = np.random.default_rng(5)
    ground = rng.uniform(-2, 2, (6000, 2))
    x, y = ground.T
    height = 0.5 * np.sin(2 * x + np.cos(3 * y)) + 0.4 * np.exp(-4 * (x - 1) ** 2 - 2 * y**2)
    points = np.column_stack([x, y, height])
    rotation = Rotation.from_rotvec([0.4, -0.3, 1.9]).as_matrix()
    truth = homogeneous(1.0, rotation, np.array([1.0, -2.0, 0.5]))
    kept = rng.random(len(points)) < 0.9
    instance = Instance(
        "dense", points[kept], apply_pose(truth, points[rng.permutation(len(points))]), "rigid3d",
        100, (1.0, 1.0), 0.1, 3,
    )  # fmt: skip
    found = method.solve(instance, LIMITS)
    assert found.status is Status.CONVERGED
    assert found.counters["n_correspondences"] > 0
    assert angle_between(found.T_target_source, truth) < 3.0


def test_a_method_without_its_own_front_end_refuses_it() -> None:
    with pytest.raises(
        registry.BaselineError, match="front_end = 'own'; choose one of fpfh-mutual"
    ):
        registry.load("mac", front_end="own")
    with pytest.raises(
        registry.BaselineError, match="max_pairs = 50 has no effect with front_end: o"
    ):
        registry.load("kiss_matcher", front_end="own", max_pairs=50)


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_kiss_matcher_does_not_depend_on_the_unit_of_length(unit: float) -> None:
    method = registry.load("kiss_matcher")
    if reason := method.available():
        pytest.skip(reason)
    instance, truth = planted("rigid3d", 200, 0.5, unit)
    pose = method.solve_pairs(instance, rows_as_pairs(200), LIMITS.budget())
    assert angle_between(pose, truth) < 1.0
    np.testing.assert_allclose(pose[:3, 3], truth[:3, 3], atol=unit * NOISE)


def test_all_pairs_is_complete_and_capped() -> None:
    instance, _ = planted("rigid3d", 7, 0.0)
    found = all_pairs(instance, max_pairs=49)
    assert sorted(map(tuple, found.pairs)) == [(i, j) for i in range(7) for j in range(7)]
    assert found.note == ""
    fewer = all_pairs(instance, max_pairs=48)
    assert len(fewer.pairs) == 42
    assert "6 of 7 source points" in fewer.note
    assert {tuple(pair) for pair in fewer.pairs} < {tuple(pair) for pair in found.pairs}
    with pytest.raises(FrontEndError, match="49 pairs exceed max_pairs = 20, which leaves 2 of 7"):
        all_pairs(instance, max_pairs=20)


@pytest.mark.parametrize("model", ["rigid3d", "similarity2d"])
def test_norm_signature_finds_true_pairs_for_any_pose(model: str) -> None:
    generator = np.random.default_rng(6)
    dim = 3 if model == "rigid3d" else 2
    source = generator.random((60, dim)) * [1.0, 0.6, 0.4][:dim]
    turn = Rotation.from_rotvec([0.0, 0.0, 2.0]).as_matrix()[:dim, :dim]
    scale = 1.0 if dim == 3 else 0.6
    order = generator.permutation(60)
    moved = apply_pose(homogeneous(scale, turn, np.ones(dim)), source)[order]
    scale_range = (1.0, 1.0) if dim == 3 else (0.5, 1.5)
    instance = Instance("moved", source, moved, model, 60, scale_range, NOISE, 0)
    pairs = norm_signature(instance, neighbours=1)
    right = order[pairs[:, 1]] == pairs[:, 0]
    assert set(pairs[right, 0]) == set(range(60))
    assert len(np.unique(pairs, axis=0)) == len(pairs)
    clutter = np.vstack([moved, generator.random((20, dim)) + 4.0])
    cluttered = Instance("cluttered", source, clutter, model, 60, scale_range, NOISE, 0)
    pairs = norm_signature(cluttered, neighbours=3)
    true = {(int(i), j) for j, i in enumerate(order)}
    assert len({tuple(map(int, pair)) for pair in pairs} & true) > 50


def test_the_least_similar_pairs_are_dropped_with_a_note() -> None:
    instance, _ = planted("rigid3d", 40, 0.0)
    options = {"front_end": "norm-signature", "signature_neighbours": 3, "max_pairs": 50}
    few = putative_pairs(instance, options)
    all_of_them = putative_pairs(instance, {**options, "max_pairs": 10_000})
    np.testing.assert_array_equal(few.pairs, all_of_them.pairs[:50])
    assert few.note == f"norm-signature: 50 of {len(all_of_them.pairs)} pairs kept (max_pairs)"
    assert all_of_them.note == ""


def test_oracle_pairs_are_all_true_ones_among_random_ones() -> None:
    true = np.column_stack([np.arange(30), np.arange(30)[::-1]])
    pairs = oracle_pairs(true, n=40, m=35, outliers=0.75, seed=1)
    given = list(map(tuple, pairs))
    assert len(given) == len(set(given)) == 120
    assert set(map(tuple, true)) <= set(given)
    assert given[:30] != sorted(given[:30])  # unmarked: not the true ones first
    assert sum(pair in set(map(tuple, true)) for pair in given[:60]) < 30
    np.testing.assert_array_equal(pairs, oracle_pairs(true, 40, 35, 0.75, seed=1))
    assert len(oracle_pairs(true, 40, 35, 0.0, seed=1)) == 30
    assert len(oracle_pairs(true, 6 * 5, 30, 0.999, seed=1)) == 900  # there are no more


def test_oracle_pairs_come_from_the_harness() -> None:
    solution = registry.load("teaser", front_end="oracle").solve(
        planted("rigid3d", 200, 0.0)[0], LIMITS
    )
    assert solution.status is Status.FAILED
    assert "has no oracle pairs" in solution.message


def test_oracle_pairs_are_used_where_they_are_given() -> None:
    instance, truth = planted("rigid3d", 60, 0.0)
    pairs = oracle_pairs(rows_as_pairs(60), 60, 60, 0.8, seed=2)
    given = dataclasses.replace(instance, oracle_pairs=pairs)
    method = registry.load("teaser", front_end="oracle", oracle_outliers=0.8)
    solution = method.solve(given, LIMITS)
    assert solution.counters["n_correspondences"] == 300
    assert angle_between(solution.T_target_source, truth) < 1.0


def test_fpfh_is_for_3d_only() -> None:
    points = np.random.default_rng(0).random((10, 2))
    flat = Instance("flat", points, points, "similarity2d", 10, (0.5, 1.5), NOISE, 0)
    reason = registry.load("teaser", front_end="fpfh-mutual").supports(flat)
    assert "similarity2d" in reason
    assert registry.load("teaser").supports(flat) is None


def test_without_a_pose_at_the_limit_all_pairs_give_one(monkeypatch: pytest.MonkeyPatch) -> None:
    method = registry.load("sc2_pcr")
    monkeypatch.setattr(method, "estimate", lambda *_: Estimate(None, finished=False))
    solution = method.solve(planted("rigid3d", 20, 0.0)[0], LIMITS)
    assert solution.status is Status.TIME_LIMIT
    assert "least-squares fit to all pairs" in solution.message
    assert np.isfinite(solution.T_target_source).all()


def test_too_many_pairs_is_a_failure_with_a_reason() -> None:
    method = registry.load("kiss_matcher", front_end="all-pairs", max_pairs=10)
    if reason := method.available():
        pytest.skip(reason)
    solution = method.solve(planted("rigid3d", 200, 0.0)[0], LIMITS)
    assert solution.status is Status.FAILED
    assert "max_pairs = 10" in solution.message


def test_fpfh_pairs_are_mutual_and_mostly_right_on_a_moved_surface() -> None:
    pytest.importorskip("open3d", exc_type=ImportError)
    generator = np.random.default_rng(1)
    x, y = generator.uniform(-1, 1, (2, 1500))
    surface = np.column_stack([x, y, 0.3 * np.sin(4 * x) * np.cos(3 * y + x) + 0.2 * x**2])
    pose = homogeneous(1.0, Rotation.from_rotvec([0.3, 0.2, -0.4]).as_matrix(), np.ones(3))
    order = generator.permutation(len(surface))
    moved = apply_pose(pose, surface)[order]
    instance = Instance("moved", surface, moved, "rigid3d", 1500, (1, 1), NOISE, 0)
    pairs = fpfh_mutual(instance, normal_radius=3.2, feature_radius=8.0)
    assert len(np.unique(pairs[:, 0])) == len(np.unique(pairs[:, 1])) == len(pairs) > 300
    off = apply_pose(pose, instance.source[pairs[:, 0]]) - instance.target[pairs[:, 1]]
    right = np.linalg.norm(off, axis=1) < 2 * median_spacing(instance.target)
    assert right.mean() > 0.5


class StandInSolver:
    """The parts of ``teaserpp_python.RobustRegistrationSolver`` that the adapter uses."""

    clique_size = 5
    ROTATION_ESTIMATION_ALGORITHM = types.SimpleNamespace(GNC_TLS="gnc")
    last: Any = None

    class Params(types.SimpleNamespace):
        pass

    def __init__(self, settings: Any) -> None:
        self.settings = settings
        StandInSolver.last = self

    def solve(self, source: np.ndarray, target: np.ndarray) -> None:
        self.shapes = source.shape, target.shape
        centred = [points - points.mean(axis=1, keepdims=True) for points in (source, target)]
        self.rotation = Rotation.align_vectors(centred[1].T, centred[0].T)[0].as_matrix()
        self.translation = target.mean(axis=1) - self.rotation @ source.mean(axis=1)

    def getSolution(self) -> Any:
        return types.SimpleNamespace(
            scale=1.0, rotation=self.rotation, translation=self.translation
        )

    def getInlierMaxClique(self) -> list[int]:
        return list(range(self.clique_size))


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch) -> type[StandInSolver]:
    module = types.ModuleType("teaserpp_python")
    module.RobustRegistrationSolver = StandInSolver
    monkeypatch.setitem(sys.modules, "teaserpp_python", module)
    return StandInSolver


def test_official_teaser_gets_columns_and_the_noise_bound(stand_in: type[StandInSolver]) -> None:
    instance, truth = planted("rigid3d", 200, 0.0)
    method = registry.load("teaserpp", noise_factor=2.0)
    pose = method.solve_pairs(instance, rows_as_pairs(200), LIMITS.budget())
    assert angle_between(pose, truth) < 0.5
    assert stand_in.last.shapes == ((3, 200), (3, 200))
    settings = stand_in.last.settings
    assert settings.noise_bound == pytest.approx(2 * NOISE)
    assert settings.estimate_scaling is False
    assert settings.max_clique_time_limit == pytest.approx(LIMITS.time_s, abs=1.0)


def test_a_clique_of_one_is_a_failure(
    stand_in: type[StandInSolver], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stand_in, "clique_size", 1)
    method = registry.load("teaserpp", front_end="all-pairs")
    solution = method.solve(planted("rigid3d", 20, 0.0)[0], LIMITS)
    assert solution.status is Status.FAILED
    assert "no consistent" in solution.message
    assert solution.counters["n_correspondences"] == 400


def test_two_pairs_are_too_few(monkeypatch: pytest.MonkeyPatch) -> None:
    method = registry.load("fpfh_ransac")
    if reason := method.available():
        pytest.skip(reason)
    monkeypatch.setattr(
        "baselines._shared.front_ends.putative_pairs",
        lambda *_: Putative(np.array([[0, 0], [1, 1]])),
    )
    solution = method.solve(planted("rigid3d", 200, 0.0)[0], LIMITS)
    assert solution.status is Status.FAILED
    assert solution.message == "2 correspondences; a pose needs at least 3"


@pytest.mark.parametrize("name", ["fpfh_ransac", "fpfh_fgr", "kiss_matcher"])
def test_the_warm_up_of_an_own_front_end_finds_a_pose(name: str) -> None:
    """A library that crashes in its warm-up costs the first run of every worker."""
    method = registry.load(name, front_end="own")
    if reason := method.available():
        pytest.skip(reason)
    seen, solve = [], method.solve_clouds
    method.solve_clouds = lambda instance: seen.append(solve(instance)) or seen[-1]
    method.warm_up(planted("rigid3d", 200, 0.0)[0])
    assert seen[0][0] is not None
