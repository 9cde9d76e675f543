"""Adapters of Go-ICP, FRS and GoTS: units, options, limits and messages."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from baselines import registry
from baselines._shared.closest_point import ClosestPoint
from baselines._shared.consensus import Consensus
from baselines._shared.cubes import Incumbent, OutOfTimeError
from baselines._shared.poses import homogeneous
from baselines.contract import Instance, Limits
from baselines.frs.search import matching_translations
from baselines.goicp.adapter import contains_translation
from baselines.gots import adapter as gots
from data.registry import dataset
from dcreg.problem import apply_pose
from dcreg.status import Status
from workflows.disturb import make_instance

METHODS = ["goicp", "frs", "gots"]


def planted(n: int = 25, outliers: int = 5, unit: float = 1.0, noise: float = 0.005) -> tuple:
    """Return an instance with `outliers` outlier points in each cloud, and its true pose."""
    generator = np.random.default_rng(4)
    shape = generator.uniform(-0.5, 0.5, (n, 3)) * [1.0, 0.7, 0.4]
    turn = Rotation.from_rotvec([2.0, -1.0, 0.6]).as_matrix()
    truth = homogeneous(1.0, turn, np.array([0.4, -0.2, 0.3]))
    target = apply_pose(truth, shape) + noise * generator.standard_normal(shape.shape) / np.sqrt(3)
    source = np.vstack([shape, generator.uniform(-0.5, 0.5, (outliers, 3))])
    others = generator.uniform(-0.5, 0.5, (outliers, 3)) + truth[:3, 3]
    target = generator.permutation(np.vstack([target, others]))
    truth[:3, 3] *= unit
    clouds = unit * source, unit * target
    return Instance("p", *clouds, "rigid3d", n, (1, 1), unit * noise, 3), truth


@pytest.mark.parametrize("name", METHODS)
def test_planted_pose_is_found_under_any_rotation(name: str) -> None:
    instance, truth = planted()
    solution = registry.load(name).solve(instance, Limits(time_s=20.0))
    moved, expected = (apply_pose(T, instance.source) for T in (solution.T_target_source, truth))
    assert np.sqrt(((moved - expected) ** 2).sum(axis=1).mean()) < 0.02
    assert solution.status in (Status.OPTIMAL, Status.TIME_LIMIT)
    assert solution.lower_bound <= solution.upper_bound


@pytest.mark.parametrize("name", METHODS)
def test_lower_bound_holds_for_the_harness_objective(name: str) -> None:
    """Below the sum of n_inliers one-to-one squared residuals at the truth, for any end."""
    instance, truth = planted()
    moved = apply_pose(truth, instance.source[: instance.n_inliers])
    distances = np.linalg.norm(moved[:, None] - instance.target, axis=2).min(axis=1)
    for limits in (Limits(time_s=20.0, nodes=300), Limits(time_s=0.2)):
        solution = registry.load(name).solve(instance, limits)
        assert solution.lower_bound <= (distances**2).sum()
        for row in solution.trace:
            assert row["lower_bound"] <= (distances**2).sum()


@pytest.mark.parametrize("name", METHODS)
def test_bounds_are_in_squared_units_of_the_target(name: str) -> None:
    limits = Limits(time_s=20.0, nodes=200)
    (one, _), (kilo, _) = planted(), planted(unit=1e3)
    small, large = (registry.load(name).solve(i, limits) for i in (one, kilo))
    assert large.status is small.status
    assert large.lower_bound == pytest.approx(1e6 * small.lower_bound, rel=1e-6, abs=1e-3)
    assert large.upper_bound == pytest.approx(1e6 * small.upper_bound, rel=1e-6, abs=1e-3)
    kilo_shift, shift = (solution.T_target_source[:3, 3] for solution in (large, small))
    np.testing.assert_allclose(kilo_shift / 1e3, shift, atol=1e-6)


@pytest.mark.parametrize("name", METHODS)
def test_a_hard_problem_ends_at_its_limit_with_a_pose(name: str, processor_clock: None) -> None:
    clouds = np.random.default_rng(0).uniform(size=(2, 60, 3))
    instance = Instance("hard", *clouds, "rigid3d", 50, (1, 1), 0.02, 0)
    method = registry.load(name)
    method.warm_up(instance)
    began = time.process_time()
    solution = method.solve(instance, Limits(time_s=0.3))
    assert time.process_time() - began < 4 * 0.3
    assert solution.status is Status.TIME_LIMIT
    assert solution.T_target_source is not None
    assert solution.lower_bound < solution.upper_bound


def test_goicp_keeps_to_its_cube_of_translations_and_says_so() -> None:
    instance, _ = planted()
    shifted, limits = replace(instance, target=instance.target + 10.0), Limits(time_s=5.0, nodes=50)
    solution = registry.load("goicp", normalise=False).solve(shifted, limits)
    assert np.abs(solution.T_target_source[:3, 3]).max() <= 0.5
    assert "within 0.5" in solution.certificate_scope
    everywhere = registry.load("goicp", translation_half_width=None).solve(shifted, limits)
    assert "all translations" in everywhere.certificate_scope
    assert everywhere.upper_bound < solution.upper_bound


@pytest.mark.parametrize("test", ["noise", "separate_outliers", "occlusion_outliers"])
def test_cube_of_all_translations_contains_the_reference_pose(test: str) -> None:
    """Under the true number of pairs and half of it; the published cube excludes some."""
    pony, published = dataset("embedded"), registry.read_card("goicp").parameters
    outside = 0
    for trial in range(10):
        raw = make_instance(pony, "pony", test, 0.4, trial, 40)
        for k in (len(raw.pairs), len(raw.pairs) // 2):
            instance = Instance("i", raw.source, raw.target, "rigid3d", k, (1, 1), 0.01, 0)
            assert contains_translation(instance, raw.T_true, None)
        outside += not contains_translation(
            instance, raw.T_true, published["translation_half_width"]
        )
        assert not contains_translation(instance, raw.T_true + np.eye(4)[3] * 1e3, None)
    assert outside > 0 or test == "noise"


def test_goicp_by_default_refines_only_the_identity_before_its_search(monkeypatch) -> None:
    begun = []
    descend = ClosestPoint.descend_until

    def recorded(self, poses, *settings):
        begun.append(poses.copy())
        return descend(self, poses, *settings)

    monkeypatch.setattr(ClosestPoint, "descend_until", recorded)
    instance, _ = planted()
    registry.load("goicp").solve(instance, Limits(time_s=10.0, nodes=50))
    np.testing.assert_array_equal(begun[0], np.eye(4)[None])


def test_frs_keeps_its_own_incumbents_and_refines_only_its_answer(monkeypatch) -> None:
    """Incumbents are rotations at centres of cubes, exact there; ICP begins at the best of them."""
    offered, refined = [], []
    offer, descend = Incumbent.offer, ClosestPoint.descend

    def recorded(self, value, pose):
        offered.append((value, pose))
        return offer(self, value, pose)

    def descending(self, poses, *settings):
        refined.append(poses.copy())
        return descend(self, poses, *settings)

    monkeypatch.setattr(Incumbent, "offer", recorded)
    monkeypatch.setattr(ClosestPoint, "descend", descending)
    instance, _ = planted()
    solution = registry.load("frs").solve(instance, Limits(time_s=20.0, nodes=300))
    problem = Consensus(instance, instance.noise_bound)
    centre, half = matching_translations(problem.source, problem.target, problem.radius)
    for value, pose in offered:
        assert value == -problem.count(pose)
        lattice = (pose[:3, 3] - centre) / half * 2**20  # centres of octants, and nothing else
        np.testing.assert_allclose(lattice, np.round(lattice), atol=1e-3)
    best = min(offered, key=lambda entry: entry[0])
    assert solution.extra["matched"] == -best[0]
    assert len(refined) == 1
    np.testing.assert_array_equal(refined[0], best[1][None])


def test_gots_refuses_clouds_with_too_many_pairs() -> None:
    instance, _ = planted()
    assert registry.load("gots").supports(instance) is None
    reason = registry.load("gots", max_source_points=10).supports(instance)
    assert "30 source points, more than max_source_points = 10" in reason


def test_gots_searches_without_initial_poses(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("GoTS refined a pose before its search")

    monkeypatch.setattr(ClosestPoint, "descend", refuse)
    instance, truth = planted()
    solution = registry.load("gots", polish=False).solve(instance, Limits(time_s=20.0))
    moved, expected = (apply_pose(T, instance.source) for T in (solution.T_target_source, truth))
    assert np.abs(moved - expected).max() < 0.1
    with pytest.raises(AssertionError, match="refined a pose"):
        registry.load("gots").solve(instance, Limits(time_s=20.0, nodes=20))


def test_gots_is_not_optimal_where_its_rotation_ran_out_of_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    instance, _ = planted(n=6, outliers=0)
    method, limits = registry.load("gots"), Limits(time_s=60.0)
    assert method.solve(instance, limits).status is Status.OPTIMAL

    def too_late(*_: object) -> None:
        raise OutOfTimeError

    monkeypatch.setattr(gots, "most_matches", too_late)
    solution = method.solve(instance, limits)
    assert solution.status is Status.TIME_LIMIT
    assert solution.T_target_source is not None


@pytest.mark.parametrize("name", METHODS)
def test_results_do_not_depend_on_the_node_limit_met_before(name: str) -> None:
    """No state is kept between two solves of one adapter."""
    instance, _ = planted(n=12, outliers=2)
    method, limits = registry.load(name), Limits(time_s=20.0, nodes=100)
    first = method.solve(instance, limits)
    method.solve(instance, Limits(time_s=20.0, nodes=9))
    second = method.solve(instance, limits)
    assert first.counters == second.counters
    np.testing.assert_array_equal(first.T_target_source, second.T_target_source)
