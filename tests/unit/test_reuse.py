"""Pairs of one pose reused for fewer pairs at a pose close by, with exact values."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import dcreg
from dcreg.assignment.objective import Matched, objective, quick_objective
from dcreg.driver.downsample import refined
from dcreg.problem import Problem
from dcreg.result import RunnerUp
from dcreg.search import Budget
from dcreg.status import Status

OVER, UNDER_WAY = np.ones(1, np.uint8), np.zeros(1, np.uint8)


@pytest.fixture
def clouds(rng):
    source = rng.random((60, 3)) * [2.0, 1.0, 0.5]
    return source, source[rng.permutation(60)] + 0.02 * rng.standard_normal((60, 3))


@pytest.fixture
def known(clouds):
    _, pairs = objective(*clouds, np.eye(4), 50)
    return Matched(np.eye(4), pairs)


def turned(angle):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix()
    return T


@pytest.fixture
def sample(clouds):
    """A part of the clouds, and a result on it."""
    part = Problem(clouds[0][:30], clouds[1][:30], 20, "rigid3d")
    return part, dcreg.register(
        part.source, part.target, n_inliers=20, model="rigid3d", node_limit=1
    )


@pytest.fixture
def nothing_after_the_limit(monkeypatch):
    monkeypatch.setattr("dcreg.search.budget._CLOSING_SHARE", 0.0)
    monkeypatch.setattr("dcreg.search.budget._CLOSING_S", 0.0)


@pytest.mark.parametrize(("angle", "stop"), [(1.5, OVER), (0.01, UNDER_WAY)])
def test_elsewhere_and_in_time_points_are_looked_up(clouds, known, angle, stop):
    found = quick_objective(Problem(*clouds, 40, "rigid3d"), turned(angle), known, stop=stop)
    alone = objective(*clouds, turned(angle), 40, stop=stop)
    assert found[0] == alone[0]
    np.testing.assert_array_equal(found[1], alone[1])


def test_pairs_of_a_bad_pose_do_not_pass_for_those_of_a_good_one(clouds):
    _, pairs = objective(*clouds, turned(1.5), 60)
    bad = Matched(turned(1.5), pairs)
    found = quick_objective(Problem(*clouds, 40, "rigid3d"), np.eye(4), bad, stop=OVER)
    assert found[0] == objective(*clouds, np.eye(4), 40)[0]


def test_small_clouds_are_matched_to_the_end_past_the_limit(rng):
    source = rng.random((400, 3))
    target = source[rng.permutation(400)] + 0.05 * rng.standard_normal((400, 3))
    late, in_time = (objective(source, target, turned(0.3), 300, stop=s) for s in (OVER, UNDER_WAY))
    assert late[0] == in_time[0]
    np.testing.assert_array_equal(late[1], in_time[1])


def test_a_sweep_past_its_limit_states_the_pairs_of_its_poses(rng, nothing_after_the_limit):
    source = rng.random((300, 3)) * [2.0, 1.0, 0.5]
    target = source + 0.01 * rng.standard_normal((300, 3))
    target[150:] = rng.random((150, 3)) + 1.0
    found = dcreg.sweep(source, target, [100, 150, 300], model="rigid3d", time_limit=0.2)
    for result in found.results:
        best, _ = objective(source, target, result.T_target_source, result.n_inliers)
        assert result.objective == pytest.approx(best, rel=1e-9)


@pytest.mark.parametrize(("known_angle", "taken"), [(0.0, True), (3.0, False)])
def test_the_better_pose_of_other_pairs_is_taken(clouds, sample, known_angle, taken):
    """A larger cardinality's pose, refined on all points, may be better than that of a sample."""
    _, pairs = objective(*clouds, turned(known_angle), 50)
    known = Matched(turned(known_angle), pairs)
    part, found = sample
    found.T_target_source[:] = turned(0.2)
    whole = Problem(*clouds, 40, "rigid3d")
    result = refined(found, whole, part, Budget(0.0), known)
    np.testing.assert_array_equal(result.T_target_source, turned(0.0 if taken else 0.2))
    rows, columns = result.assignment.T
    residuals = clouds[0][rows] @ result.rotation.T - clouds[1][columns]
    assert result.objective == pytest.approx((residuals**2).sum())
    assert (result.objective < result.objective_certified) == taken


def test_one_greedy_matching_of_large_clouds_serves_all_cardinalities_of_its_pose(rng):
    source = rng.random((1200, 3))
    target = source[rng.permutation(1200)] + 0.01 * rng.standard_normal((1200, 3))
    T = turned(0.05)
    known = Matched(T, objective(source, target, T, 900, stop=OVER)[1], greedy=True)
    given = quick_objective(Problem(source, target, 400, "rigid3d"), T.copy(), known, stop=OVER)
    own = objective(source, target, T, 400, stop=OVER)
    assert given[0] == pytest.approx(own[0], rel=1e-12)
    np.testing.assert_array_equal(given[1], own[1])


@pytest.mark.parametrize(("angle", "taken"), [(0.0, True), (3.0, False)])
def test_the_initial_pose_is_compared_on_all_points(clouds, sample, angle, taken):
    """A sample may prefer another pose to that of the user."""
    part, found = sample
    found.T_target_source[:] = turned(1.5)
    whole = Problem(*clouds, 40, "rigid3d")
    result = refined(found, whole, part, Budget(), initial=[turned(angle)])
    assert np.allclose(result.rotation, np.eye(3), atol=0.05) == taken


@pytest.mark.parametrize(("angle", "taken"), [(0.0, True), (3.0, False)])
def test_the_runner_up_of_a_sample_is_compared_on_all_points(clouds, sample, angle, taken):
    """It may be the better pose there; the runner-up is then the other one."""
    part, found = sample
    found.T_target_source[:] = turned(1.5)
    found = replace(found, runner_up=RunnerUp(turned(angle), 1.02, 86.0, 0.5))
    result = refined(found, Problem(*clouds, 40, "rigid3d"), part, Budget())
    near = np.allclose(result.rotation, np.eye(3), atol=0.05)
    assert near == taken
    other = result.runner_up.T_target_source
    value, _ = objective(*clouds, other, 40)
    assert result.runner_up.objective_ratio == pytest.approx(value / result.objective, rel=1e-6)
    assert result.runner_up.objective_ratio >= 1.0
    apart = clouds[0] @ (other[:3, :3] - result.rotation).T + other[:3, 3] - result.translation
    assert np.sqrt((apart**2).sum(axis=1).mean()) > 0.1


def test_the_runner_up_of_an_exact_fit_costs_more(sample, rng):
    """The pose of the sample is slightly wrong, as is the runner-up; only the former is refined."""
    part, found = sample
    source = rng.random((2100, 3)) * [2.0, 1.0, 0.5]
    found.T_target_source[:] = turned(0.01)
    found = replace(found, runner_up=RunnerUp(turned(3.0), 1.02, 172.0, 0.5))
    result = refined(found, Problem(source, source, 2100, "rigid3d"), part, Budget())
    assert result.rmse_matched < 1e-9
    assert result.runner_up.objective_ratio > 1000.0


def test_a_sample_whose_pose_is_not_refined_to_the_end_ended_at_the_limit(clouds):
    sample = Problem(clouds[0][:30], clouds[0][:30], 20, "rigid3d")
    found = dcreg.register(sample.source, sample.target, n_inliers=20, model="rigid3d")
    assert found.status is Status.OPTIMAL
    whole = Problem(*clouds, 40, "rigid3d")
    assert refined(found, whole, sample, Budget()).status is Status.OPTIMAL
    assert refined(found, whole, sample, Budget(0.0)).status is Status.TIME_LIMIT


def test_pairs_matched_to_the_end_do_not_stand_in_for_fewer(rng):
    """The cheapest few of the best pairs of all points cost more than the nearest few."""
    source, target = rng.random((1200, 3)), rng.random((1200, 3))
    known = Matched(np.eye(4), objective(source, target, np.eye(4), 1200, prove=False)[1])
    given = quick_objective(Problem(source, target, 300, "rigid3d"), np.eye(4), known, stop=OVER)
    own = objective(source, target, np.eye(4), 300, stop=OVER)
    assert given[0] <= own[0] < known.cheapest(source, target, np.eye(4), 300)[0]


@pytest.mark.parametrize(("size", "greedy"), [(60, None), (1200, True)])
def test_pairs_are_called_greedy_where_they_are(rng, size, greedy):
    source = rng.random((size, 3))
    sample = Problem(source[:30], source[:30], 20, "rigid3d")
    found = dcreg.register(sample.source, sample.target, n_inliers=20, model="rigid3d")
    whole = Problem(source, source, size // 2, "rigid3d")
    over = Budget(0.0)
    over.hard_stop[0] = 1
    assert refined(found, whole, sample, over).stages[-1].greedy_assignment is greedy


def test_known_pairs_of_small_clouds_are_not_called_greedy(rng):
    """They are the optimum too, up to rounding."""
    for _ in range(30):
        source, target = rng.random((2, 40, 3))
        known = Matched(np.eye(4), objective(source, target, np.eye(4), 40)[1])
        problem = Problem(source, target, 40, "rigid3d")
        assert not quick_objective(problem, np.eye(4), known, stop=OVER)[2]


def test_pairs_of_a_sample_are_not_called_greedy(rng, nothing_after_the_limit):
    """They are not returned; so few pairs of all points are not chosen greedily."""
    source = rng.random((400, 2)) * [2.0, 1.0]
    target = source[rng.permutation(400)] + 0.01 * rng.standard_normal((400, 2))
    found = dcreg.sweep(
        source, target, [100, 200, 300, 400], model="similarity2d", time_limit=0.2,
        options=dcreg.SolveOptions(downsample=200),
    )  # fmt: skip
    assert found.status is Status.TIME_LIMIT
    assert not any(result.is_greedy for result in found.results)
