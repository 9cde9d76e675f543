"""Clouds too large for a dense matrix: same certificate, a good pose, little memory."""

import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

import dcreg
from dcreg.assignment import large, sparse
from dcreg.assignment import objective as objectives
from dcreg.assignment.objective import k_assignment, objective
from dcreg.driver import downsample
from dcreg.driver.modes import find_mode
from dcreg.driver.warm_up import warm_up_mode
from dcreg.families.rigid3d.space import Rigid3D
from dcreg.families.rotation3d.sampled import search_sampled_rotation
from dcreg.families.rotation3d.space import Rotation3D
from dcreg.jit import NEVER
from dcreg.problem import InputError, Problem
from dcreg.search import Budget, Tolerance
from dcreg.status import Status
from tests.problems import register

NOISE = 0.005
ROTATION = Rotation.from_rotvec([0.4, -1.9, 1.1]).as_matrix()
TRANSLATION = np.array([0.3, -0.5, 0.2])


def spiral(rng, size):
    """An asymmetric tube, its longest side 1: no rotation or mirror image comes near it."""
    along = rng.random(size)
    turn = 2 * np.pi * along
    x = np.cos(turn) * (1 + 0.4 * along)
    y = 0.6 * np.sin(turn) + 0.3 * along**2
    curve = np.column_stack([x, y, 0.5 * along + 0.2 * np.sin(3 * turn)])
    points = curve + 0.05 * rng.standard_normal((size, 3))
    return points / np.ptp(points, axis=0).max()


def moved_copy(rng, source):
    noise = NOISE * rng.standard_normal(source.shape)
    return (source @ ROTATION.T + TRANSLATION + noise)[rng.permutation(len(source))]


def pose_errors(T):
    angle = Rotation.from_matrix(T[:3, :3] @ ROTATION.T).magnitude()
    return np.degrees(angle), np.abs(T[:3, 3] - TRANSLATION).max()


def test_all_matched_is_certified_without_a_dense_matrix(rng):
    size = 5000
    source = spiral(rng, size)
    target = moved_copy(rng, source)
    warm_up_mode(find_mode("rigid3d", "paper"), None, large=True)  # compiling takes memory too
    tracemalloc.start()
    result = register(
        source, target, n_inliers=size, model="rigid3d", mode="paper", rel_gap=0.0, tol=0.003
    )
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 8 * size**2 / 2  # half of one dense matrix
    assert result.status is Status.CONVERGED  # the rotation is a sampled one
    assert result.upper_bound - result.lower_bound <= result.gap_tol
    assert result.certificate_scope == "translation in norm space"
    angle, shift = pose_errors(result.T_target_source)
    assert angle < 0.2
    assert shift < 2e-3
    assert result.objective <= result.objective_certified
    rows, columns = result.assignment.T
    assert len(set(rows)) == len(set(columns)) == size
    residuals = source[rows] @ result.rotation.T + result.translation - target[columns]
    assert np.isclose((residuals**2).sum(), result.objective)


def test_large_clouds_with_outliers_end_in_time(rng, processor_clock):
    size, n_inliers, limit = 3000, 2400, 15.0  # time for enough rotations on a slow machine
    source = spiral(rng, size)
    target = moved_copy(rng, source)
    target[n_inliers:] = rng.uniform(target.min(axis=0), target.max(axis=0), (size - n_inliers, 3))
    settings = {"model": "rigid3d", "time_limit": limit, "mode": "paper"}
    result = register(source, target, n_inliers=n_inliers, **settings)
    assert result.status in (Status.CONVERGED, Status.TIME_LIMIT)
    assert sum(stage.time_s for stage in result.stages[:2]) < 2 * limit
    assert len(result.assignment) == n_inliers
    angle, shift = pose_errors(result.T_target_source)
    assert angle < 0.5
    assert shift < 5e-3


@pytest.mark.parametrize(("angle", "is_near"), [(0.0, True), (2.0, False)])
def test_clouds_of_some_hundred_points_are_matched_exactly(rng, monkeypatch, angle, is_near):
    """At a good pose without a dense matrix."""
    size, k = 560, 400
    source = spiral(rng, size)
    target = moved_copy(rng, source)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = (
        Rotation.from_rotvec([0.0, angle, 0.0]).as_matrix() @ ROTATION,
        TRANSLATION,
    )
    moved = source @ T[:3, :3].T + T[:3, 3]
    best, _ = k_assignment(((moved[:, None] - target) ** 2).sum(axis=2), k)
    dense = []
    monkeypatch.setattr(
        objectives, "k_assignment", lambda *given: dense.append(1) or k_assignment(*given)
    )
    value, pairs = objective(source, target, T, k)
    assert value == pytest.approx(best, rel=1e-12)
    assert value == pytest.approx(((moved[pairs[:, 0]] - target[pairs[:, 1]]) ** 2).sum())
    assert bool(dense) != is_near


def test_no_local_search_begins_at_a_poor_box_of_large_clouds(rng, monkeypatch):
    """One from the first boxes took a third of the time of a run."""
    size = 220
    source = spiral(rng, size)
    target = moved_copy(rng, source)
    begun, refine = [], Rigid3D.refine
    monkeypatch.setattr(
        Rigid3D,
        "refine",
        lambda self, theta: begun.append(self.is_confirmed) or refine(self, theta),
    )
    result = register(source, target, n_inliers=150, model="rigid3d", node_limit=256)
    assert result.n_nodes >= 256
    assert len(begun) > 0
    assert not any(begun)  # `is_confirmed` is set at the end of the start stage


def test_sampled_rotation_claims_only_what_its_bounds_prove(rng):
    source = spiral(rng, 2100)
    source -= source.mean(axis=0)
    target = source @ ROTATION.T + NOISE * rng.standard_normal(source.shape)
    loose = search_sampled_rotation(
        source, target, 2100, tolerance=Tolerance(abs=1.0), budget=Budget()
    )
    strict = search_sampled_rotation(
        source, target, 2100, tolerance=Tolerance(abs=1e-9), budget=Budget()
    )
    assert loose.status is Status.OPTIMAL
    assert strict.status is Status.CONVERGED
    assert strict.lower_bound < strict.upper_bound
    rotation = Rotation3D.matrix(strict.theta)
    assert np.degrees(Rotation.from_matrix(rotation @ ROTATION.T).magnitude()) < 0.5
    squared = _squared(source @ rotation.T, target)
    value = squared[linear_sum_assignment(squared)].sum()
    assert strict.lower_bound <= value <= strict.upper_bound + 1e-9


@given(st.integers(0, 2**32 - 1))
def test_sparse_matching_against_the_dense_one(seed):
    rng = np.random.default_rng(seed)
    n, m = rng.integers(1, 15, 2)
    k = int(rng.integers(1, min(n, m) + 1))
    points, target = rng.standard_normal((n, 3)), rng.standard_normal((m, 3))
    if rng.random() < 0.3:  # ties
        points, target = np.round(points), np.round(target)
    optimum, _ = k_assignment(_squared(points, target), k)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sparse, "_FIRST_NEIGHBOURS", int(rng.integers(1, 5)))
        patch.setattr(sparse, "DENSE_PAIRS", int(rng.integers(1, 200)))
        for prove, over in ((True, 0), (False, 0), (False, 1)):
            stop = np.array([over], np.uint8)
            found = sparse.sparse_matching(points, target, k, prove=prove, stop=stop)
            rows, columns = found.pairs.T
            assert len(set(rows)) == len(set(columns)) == k
            assert np.isclose(_squared(points, target)[rows, columns].sum(), found.value)
            assert found.value >= optimum - 1e-9
            if found.exact:
                assert np.isclose(found.value, optimum)


@pytest.mark.parametrize("n_inliers", [700, 800])
def test_sparse_matching_proves_itself_near_the_truth(rng, n_inliers):
    points = spiral(rng, 800)
    target = points + NOISE * rng.standard_normal(points.shape)
    found = sparse.sparse_matching(points, target, n_inliers)
    optimum, _ = k_assignment(_squared(points, target), n_inliers)
    assert found.exact
    assert np.isclose(found.value, optimum)


def test_pairs_beyond_the_overlap_are_matched_by_distance(rng):
    """With more pairs than neighbour lists provide, the rest is matched by distance."""
    flat = np.array([1.0, 1.0, 0.01])
    points, target = rng.random((900, 3)) * flat, rng.random((900, 3)) * flat + [0.45, 0.0, 0.0]
    found = sparse.sparse_matching(points, target, 600, prove=False)
    optimum, _ = k_assignment(_squared(points, target), 600)
    assert len(set(found.pairs[:, 0])) == len(set(found.pairs[:, 1])) == 600
    assert optimum <= found.value <= 6.0 * optimum


def nearly_registered(rng, size, n_inliers):
    """A problem whose second cloud is another sample, and a pose near the true one."""
    source, target = spiral(rng, size), spiral(rng, size) + NOISE * rng.standard_normal((size, 3))
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0.02, 0.03, -0.02]).as_matrix()
    return Problem(source, target, n_inliers, "rigid3d"), T


@pytest.mark.parametrize("huge", [False, True])
def test_a_descent_on_large_clouds_ends_below_its_start(rng, huge, monkeypatch):
    problem, T = nearly_registered(rng, 3000, 2100)
    if huge:
        monkeypatch.setattr(large, "HUGE", 100)
    found = large.descend(problem, T, Budget())
    assert found.value == pytest.approx(large.residual(problem, found.T_target_source, found.pairs))
    assert found.value < 0.95 * found.before
    assert not found.greedy
    assert found.n_assignments == 1 if huge else found.n_assignments <= 6
    assert Rotation.from_matrix(found.T_target_source[:3, :3]).magnitude() < 0.035  # of 0.041


def test_an_exact_fit_of_all_points_is_optimal_whatever_the_sample_proves(rng):
    target = spiral(rng, 300)
    source = (target[:240] - TRANSLATION) @ ROTATION
    options = {"n_inliers": 240, "model": "rigid3d", "mode": "full", "downsample": 100}
    found = register(source, target, **options)
    assert found.status is Status.OPTIMAL
    assert found.is_exact
    assert found.lower_bound == 0.0 <= found.upper_bound == found.objective < 1e-20
    assert found.upper_bound <= found.gap_tol
    assert found.downsampled is None  # the bounds refer to all points
    assert found.certificate_scope == "rigid pose"
    assert found.warnings == []
    np.testing.assert_allclose(found.T_certified, found.T_target_source)
    noisy = target + 1e-3 * rng.standard_normal(target.shape)
    sampled = register(source, noisy, **options)
    assert sampled.downsampled is not None
    assert sampled.certificate_scope == "rigid pose of the sample"


def test_the_objective_before_the_refinement_is_that_of_good_pairs(rng):
    problem, T = nearly_registered(rng, 3000, 2100)
    optimum, _ = objective(problem.source, problem.target, T, 2100)
    found = downsample._refined_large(problem, T, [], Budget(), None)
    assert optimum <= found.before * (1.0 + 1e-9)
    assert found.before <= 1.05 * optimum


def test_an_interrupted_proof_does_not_make_pairs_greedy(rng, monkeypatch):
    problem, T = nearly_registered(rng, 3000, 2100)
    matched = large._matched

    def interrupted(problem, T, stop, prove=False):
        stop[0] |= prove
        return matched(problem, T, stop, prove)

    monkeypatch.setattr(large, "_matched", interrupted)
    found = large.descend(problem, T, Budget())
    assert not found.greedy
    assert (
        found.value
        <= 1.1 * objective(problem.source, problem.target, found.T_target_source, 2100)[0]
    )


@given(st.integers(0, 2**32 - 1))
def test_a_matching_for_a_smaller_penalty_continues_to_the_cheapest_one(seed):
    rng = np.random.default_rng(seed)
    n, m = rng.integers(1, 15, 2)
    costs = rng.random((n, m))
    columns = np.argsort(costs, axis=1)[:, : min(m, 4)]
    costs = np.take_along_axis(costs, columns, axis=1)

    def cost(found, penalty):
        own = sparse._own_costs(columns, costs, found.col_of, penalty)
        return own.sum(), found.size

    empty, never = sparse._Partial.of(n, m), np.zeros(1, np.uint8)
    found = empty
    for penalty in np.sort(rng.random(3)):
        found = found.continued(columns, costs, penalty, never)
        at_once = empty.continued(columns, costs, penalty, never)
        assert cost(found, penalty) == pytest.approx(cost(at_once, penalty))
        rows = np.flatnonzero(found.col_of >= 0)
        np.testing.assert_array_equal(found.row_of[found.col_of[rows]], rows)


def test_a_descent_without_time_for_a_matching_is_greedy(rng, monkeypatch):
    problem, T = nearly_registered(rng, 3000, 2100)
    monkeypatch.setattr(large, "_MATCHING_S", 1.0)
    with Budget(5.0) as budget:
        found = large.descend(problem, T, budget)
    assert found.greedy
    assert len(set(found.pairs[:, 0])) == len(set(found.pairs[:, 1])) == 2100
    assert found.value <= found.before


def test_rough_matchings_are_near_the_optimum(rng):
    problem, _ = nearly_registered(rng, 2500, 1800)
    clouds = problem.source, problem.target
    rough, exact = (sparse.sparse_matching(*clouds, 1800, prove=prove) for prove in (False, True))
    assert exact.exact
    assert exact.value <= rough.value <= 1.1 * exact.value


def test_a_stop_during_a_query_leaves_few_neighbours_of_the_rest(rng, monkeypatch):
    problem, _ = nearly_registered(rng, 2500, 1800)
    monkeypatch.setattr(sparse, "_QUERY_ROWS", 500)
    stop, tree = np.zeros(1, np.uint8), sparse.tree_of(problem.target)

    class Stopping:
        def neighbours(self, points, count, **settings):
            stop[0] = 1
            return tree.neighbours(points, count, **settings)

    columns, costs = sparse._near(Stopping(), problem.source, 8, stop)
    assert np.isfinite(costs[:500]).all()
    assert np.isfinite(costs[500:, :2]).all()
    assert np.isinf(costs[500:, 2:]).all()
    assert columns.max() < 2500


@pytest.mark.parametrize(
    ("dim", "options"), [(2, {"mode": "paper"}), (3, {"mode": "full"}), (3, {"bound": "dc"})]
)
def test_dense_searches_refuse_what_would_not_fit(rng, dim, options):
    points = rng.random((10_001, dim))
    model = "similarity2d" if dim == 2 else "rigid3d"
    with pytest.raises(InputError, match=r"10001 x 10001 pairs exceed .* downsample"):
        register(points, points, n_inliers=10_001, model=model, **options)


def _squared(a, b):
    return ((a[:, None] - b[None]) ** 2).sum(axis=-1)


def test_a_sample_whose_pairs_determine_no_pose_is_refused(rng):
    points = rng.random((40, 2))
    with pytest.raises(dcreg.InputError, match="downsample: 5 points leave 2 pairs of 20"):
        dcreg.register(
            points,
            points + 1.0,
            n_inliers=20,
            model="similarity2d",
            options=dcreg.SolveOptions(downsample=5),
        )


def test_many_rows_are_queried_in_an_order_of_places(rng, monkeypatch):
    monkeypatch.setattr(sparse, "_MANY_ROWS", 200)
    points, target = rng.random((500, 3)), rng.random((300, 3))
    order = sparse._by_place(points)
    assert sorted(order) == list(range(500))
    steps = np.linalg.norm(np.diff(points[order], axis=0), axis=1)
    assert steps.mean() < 0.7 * np.linalg.norm(np.diff(points, axis=0), axis=1).mean()
    columns, costs = sparse._near(sparse.tree_of(target), points, 1, NEVER)
    squares = ((points[:, None] - target) ** 2).sum(axis=2)
    np.testing.assert_array_equal(columns[:, 0], squares.argmin(axis=1))
    np.testing.assert_allclose(costs[:, 0], squares.min(axis=1))


def test_a_refinement_that_fails_leaves_the_pose_of_the_sample(rng, monkeypatch):
    problem, T = nearly_registered(rng, 3000, 2100)
    best = large.descend(problem, T, Budget()).T_target_source
    worse = best.copy()
    worse[:3, 3] += 0.2
    monkeypatch.setattr(large, "_near_fit", lambda *_: worse)
    monkeypatch.setattr(large, "_MAX_MATCHINGS", 1)
    found = downsample._refined_large(problem, best, [], Budget(), None)
    value, pose, pairs = min(found.poses, key=lambda each: each[0])
    assert value <= found.before
    np.testing.assert_array_equal(pose, best)
    assert large.residual(problem, pose, pairs) == pytest.approx(value)
