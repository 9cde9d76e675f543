"""Fits, lengths and lists of initial poses shared by the adapters."""

from __future__ import annotations

import inspect
import time
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

import dcreg
from baselines import registry
from baselines._shared.poses import homogeneous, median_spacing, rigid_pose, unit_of
from baselines._shared.starts import STARTS, best_of_starts, start_poses
from baselines.contract import Instance, Limits
from dcreg.problem import apply_pose, nearest_rotation
from dcreg.problem.geometry import fit_pose
from dcreg.search import Budget
from dcreg.status import Status


def instance_of(model: str, seed: int = 0, n: int = 30) -> Instance:
    generator = np.random.default_rng(seed)
    d = 2 if model == "similarity2d" else 3
    source = generator.standard_normal((n, d)) + 4.0
    target = 1.2 * generator.standard_normal((n + 5, d)) - 2.0
    scale_range = (0.6, 1.4) if d == 2 else (1.0, 1.0)
    return Instance("random", source, target, model, n // 2, scale_range, 0.1, seed)


@given(seed=st.integers(0, 10_000), d=st.sampled_from([2, 3]), low=st.floats(0.3, 1.5))
@settings(max_examples=50, deadline=None)
def test_fit_recovers_an_exact_pose_inside_the_range(seed: int, d: int, low: float) -> None:
    generator = np.random.default_rng(seed)
    rotation = nearest_rotation(generator.standard_normal((d, d)))
    truth = homogeneous(low + 0.1, rotation, generator.standard_normal(d))
    source = generator.standard_normal((8, d))
    found = fit_pose(source, apply_pose(truth, source), (low, low + 0.2))
    np.testing.assert_allclose(found, truth, atol=1e-9)


def test_clipped_fit_is_the_constrained_optimum() -> None:
    generator = np.random.default_rng(2)
    source = generator.standard_normal((12, 2))
    target = 2.0 * source @ np.array([[0.0, 1.0], [-1.0, 0.0]])
    target += 0.3 * generator.standard_normal((12, 2))

    def cost(parameters: np.ndarray) -> float:
        scale, angle, *shift = parameters
        c, s = np.cos(angle), np.sin(angle)
        pose = homogeneous(scale, np.array([[c, -s], [s, c]]), np.array(shift))
        return float(((apply_pose(pose, source) - target) ** 2).sum())

    pose = fit_pose(source, target, (0.5, 1.5))
    value = ((apply_pose(pose, source) - target) ** 2).sum()
    others = [
        minimize(cost, [1.0, angle, 0, 0], bounds=[(0.5, 1.5), (None, None)] + 2 * [(None, None)])
        for angle in (-1.5, 0.0, 1.5)
    ]
    assert value == pytest.approx(min(other.fun for other in others), rel=1e-6)
    assert np.linalg.det(pose[:2, :2]) == pytest.approx(1.5**2)


def test_fit_of_mirrored_points_stays_a_rotation() -> None:
    source = np.random.default_rng(0).standard_normal((10, 3))
    pose = fit_pose(source, source * [-1, 1, 1], (1.0, 1.0))
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)


def test_fit_of_one_pair_moves_it_there() -> None:
    pose = fit_pose(np.array([[1.0, 2.0]]), np.array([[3.0, 5.0]]), (0.5, 1.5))
    np.testing.assert_allclose(apply_pose(pose, np.array([[1.0, 2.0]])), [[3.0, 5.0]])


def test_rigid_pose_cleans_single_precision_and_refuses_nan() -> None:
    rotation = Rotation.random(random_state=0).as_matrix().astype(np.float32)
    pose = rigid_pose(homogeneous(1.0, rotation, np.ones(3)))
    np.testing.assert_allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=1e-14)
    assert rigid_pose(np.full((4, 4), np.nan)) is None


def test_lengths() -> None:
    square = np.array([[0, 0], [2, 0], [2, 2], [0, 2], [0, 2]], dtype=float)
    assert median_spacing(square) == 2.0
    assert median_spacing(np.zeros((3, 2))) == 1.0


def test_the_unit_is_that_of_the_library() -> None:
    """The RMS radius of the target; that of the source if it has no extent; 1 if neither has one."""
    square, point = np.array([[0, 0], [2, 0], [2, 2], [0, 2]], dtype=float), np.ones((3, 2))

    def unit(source: np.ndarray, target: np.ndarray) -> float:
        return unit_of(Instance("unit", source, target, "similarity2d", 3, (0.5, 1.5), 0.1, 0))

    assert unit(point, square) == pytest.approx(np.sqrt(2))
    assert unit(square, point) == pytest.approx(np.sqrt(2))
    assert unit(point, point) == 1.0


def test_the_default_tolerances_are_the_library_s() -> None:
    options = registry.load("dcreg").options
    for solve in (dcreg.register, dcreg.register_matches):
        parameters = inspect.signature(solve).parameters
        for name in ("rel_gap", "abs_gap"):
            assert options[name] == parameters[name].default


@pytest.mark.parametrize(("model", "count"), [("similarity2d", 2 + 36), ("rigid3d", 2 + 24)])
def test_start_lists_are_as_documented(model: str, count: int) -> None:
    instance = instance_of(model)
    d = instance.dim
    assert [len(start_poses(instance, starts)) for starts in STARTS] == [1, 1, count]
    np.testing.assert_array_equal(start_poses(instance, "identity")[0], np.eye(d + 1))
    for index, pose in enumerate(start_poses(instance, "multi")):
        scale = np.linalg.det(pose[:d, :d]) ** (1 / d)
        assert instance.scale_range[0] <= scale <= instance.scale_range[1] + 1e-12
        if index != 1:  # the identity is the one that does not align the centroids
            moved = apply_pose(pose, instance.source).mean(axis=0)
            np.testing.assert_allclose(moved, instance.target.mean(axis=0), atol=1e-12)


def test_out_of_time_gives_the_best_so_far() -> None:
    def slow(pose: np.ndarray, _budget: Budget) -> np.ndarray:
        time.sleep(0.06)
        return pose

    solution = best_of_starts(instance_of("rigid3d"), "multi", Limits(time_s=0.1), slow)
    assert solution.status is Status.TIME_LIMIT
    assert solution.T_target_source is not None
    assert 1 <= solution.counters["n_starts"] <= 3


@pytest.mark.parametrize("count", [8, 14])
def test_the_first_starts_are_spread_over_all(count: int) -> None:
    instance = instance_of("similarity2d")
    tried: list[np.ndarray] = []

    def refine(pose: np.ndarray, _budget: Budget) -> np.ndarray:
        tried.append(pose)
        return pose

    solution = best_of_starts(instance, "multi", Limits(time_s=60.0, nodes=count), refine)
    assert (solution.status, solution.counters["n_starts"]) == (Status.NODE_LIMIT, count)
    assert solution.message == f"{count} of 38 initial poses within the limit"
    grid = np.array([pose[:2, 0] for pose in tried[2:]])  # scale times cosine and sine
    scales = np.unique(np.round(np.hypot(*grid.T), 9))
    angles = np.sort(np.arctan2(grid[:, 1], grid[:, 0]))
    assert len(scales) == 3
    assert np.diff(np.append(angles, angles[0] + 2 * np.pi)).max() <= np.deg2rad(125)


def test_breakdown_everywhere_is_a_failure() -> None:
    solution = best_of_starts(
        instance_of("rigid3d"), "multi", Limits(time_s=5.0), lambda pose, _budget: None
    )
    assert solution.status is Status.FAILED
    assert solution.counters["n_starts"] == 26


def test_the_node_limit_counts_initial_poses_and_is_deterministic() -> None:
    limits = Limits(time_s=60.0, nodes=3)
    first, again = (
        best_of_starts(instance_of("rigid3d"), "multi", limits, lambda pose, budget: pose)
        for _ in range(2)
    )
    assert first.status is Status.NODE_LIMIT
    assert first.counters["n_starts"] == 3
    assert first.message == "3 of 26 initial poses within the limit"
    np.testing.assert_array_equal(first.T_target_source, again.T_target_source)
    one = best_of_starts(instance_of("rigid3d"), "identity", limits, lambda pose, budget: pose)
    assert one.status is Status.CONVERGED


@pytest.mark.parametrize("angle", [2.5, -1.7, np.pi])
def test_multi_start_icp_finds_a_large_rotation(angle: float) -> None:
    generator = np.random.default_rng(4)
    source = generator.standard_normal((60, 2)) * [1.0, 0.4] + [0.5, 0.0]
    c, s = np.cos(angle), np.sin(angle)
    truth = homogeneous(0.8, np.array([[c, -s], [s, c]]), np.array([1.0, 2.0]))
    target = apply_pose(truth, source)
    instance = Instance("turned", source, target, "similarity2d", 60, (0.5, 1.5), 0.01, 0)
    found = registry.load("icp").solve(instance, Limits(time_s=20.0))
    np.testing.assert_allclose(found.T_target_source, truth, atol=1e-6)


def test_trimming_lets_icp_ignore_outliers() -> None:
    generator = np.random.default_rng(6)
    source = generator.standard_normal((50, 2))
    target = source + 0.02
    cluttered = np.vstack([source, [[8.0, 8.0]] * 10])
    instance = Instance("clutter", cluttered, target, "similarity2d", 50, (0.5, 1.5), 0.01, 0)
    errors = {}
    for trim in (True, False):
        method = registry.load("icp", starts="identity", trim=trim)
        pose = method.solve(instance, Limits(time_s=20.0)).T_target_source
        moved = apply_pose(pose, source)
        errors[trim] = np.abs(moved - target).max()
    assert errors[True] < 1e-9 < 0.05 < errors[False]


class TestCpd:
    @pytest.fixture
    def exact(self) -> Instance:
        source = np.random.default_rng(8).standard_normal((40, 2)) * [1.0, 0.5]
        target = 1.3 * source + [0.1, -0.1]
        return Instance("exact", source, target, "similarity2d", 40, (0.5, 1.5), 0.01, 0)

    @pytest.fixture(autouse=True)
    def _installed(self) -> None:
        if reason := registry.load("cpd").available():
            pytest.skip(reason)

    def test_keeps_the_scale_in_its_range(self, exact: Instance) -> None:
        narrow = replace(exact, scale_range=(0.9, 1.1))
        found = registry.load("cpd").solve(narrow, Limits(time_s=20.0))
        assert np.linalg.det(found.T_target_source[:2, :2]) == pytest.approx(1.1**2)

    def test_more_starts_find_what_one_misses(self, exact: Instance) -> None:
        turn = homogeneous(1.0, np.array([[-0.8, -0.6], [0.6, -0.8]]), np.zeros(2))
        far = replace(exact, target=apply_pose(turn, exact.source))
        limits = Limits(time_s=60.0)
        one, many = (
            registry.load("cpd", starts=starts).solve(far, limits)
            for starts in ("identity", "multi")
        )
        assert np.abs(one.T_target_source - turn).max() > 0.5
        np.testing.assert_allclose(many.T_target_source, turn, atol=0.02)

    def test_does_not_depend_on_the_unit(self, exact: Instance) -> None:
        big = replace(exact, source=1e3 * exact.source, target=1e3 * exact.target, noise_bound=10.0)
        small, large = (
            registry.load("cpd").solve(each, Limits(time_s=20.0)).T_target_source
            for each in (exact, big)
        )
        np.testing.assert_allclose(large[:2, :2], small[:2, :2], atol=1e-6)
        np.testing.assert_allclose(large[:2, 2] / 1e3, small[:2, 2], atol=1e-6)


def test_weights_of_a_fit_count_pairs_more_than_once() -> None:
    generator = np.random.default_rng(3)
    source, target = generator.standard_normal((2, 9, 3))
    times = np.array([3, 0, 1, 2, 0, 1, 1, 4, 1])
    found = fit_pose(source, target, (0.5, 1.5), 0.7 * times)
    repeated = (np.repeat(cloud, times, axis=0) for cloud in (source, target))
    expected = fit_pose(*repeated, (0.5, 1.5))
    np.testing.assert_allclose(found, expected, atol=1e-12)


@pytest.mark.parametrize("weighted", [False, True])
def test_fits_of_many_clouds_at_once_are_those_one_by_one(weighted: bool) -> None:
    generator = np.random.default_rng(4)
    source, target = generator.standard_normal((2, 5, 7, 2))
    target[0] = source[0] * [-1, 1]  # mirrored
    source[1] = source[1, 0]  # without extent
    weights = generator.random((5, 7)) if weighted else [None] * 5
    together = fit_pose(source, target, (0.5, 1.5), weights if weighted else None)
    for k in range(5):
        alone = fit_pose(source[k], target[k], (0.5, 1.5), weights[k])
        np.testing.assert_allclose(together[k], alone, atol=1e-12)
        assert 0.5 - 1e-12 <= np.sqrt(np.linalg.det(alone[:2, :2])) <= 1.5 + 1e-12


@pytest.mark.parametrize(
    ("text", "files"),
    [
        # Singular values serve a compiled fit, and ranks; every other pose is fitted by the library.
        ("linalg.svd", {"_shared/kernels/samples.py", "_shared/concave.py"}),
        # A second deadline made from the same limits would differ from the budget.
        ("perf_counter", set()),
    ],
)
def test_methods_fit_poses_and_read_the_clock_by_the_library(text: str, files: set[str]) -> None:
    users = [path for path in registry.ROOT.rglob("*.py") if text in path.read_text()]
    assert {path.relative_to(registry.ROOT).as_posix() for path in users} == files


def test_the_budget_of_a_run_is_made_of_all_its_limits() -> None:
    budget = Limits(time_s=7.0, nodes=11, memory_mb=13, threads=2).budget()
    assert (budget.nodes, budget.memory_mb) == (11, 13)
    left = budget.left()
    assert left is not None
    assert 6.0 < left <= 7.0
