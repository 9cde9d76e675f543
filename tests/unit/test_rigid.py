"""The rigid search: its optimum, its limits, and noise that misleads the norm space."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data import registry
from dcreg.assignment.objective import objective
from dcreg.driver.modes import find_mode, run_mode
from dcreg.families.rigid3d import vertex_values
from dcreg.families.rigid3d.bound import RigidBound
from dcreg.families.rigid3d.kernels.vertices import bound_vertices_by_duals
from dcreg.families.rigid3d.space import FEW_DESCENTS, Rigid3D
from dcreg.families.rigid3d.starts import ALIKE
from dcreg.problem.geometry import fit_pose
from dcreg.search import Boxes, Budget
from dcreg.status import Status
from tests.fuzz import reference
from tests.problems import KINDS, cloud, register
from tests.searches import normalised, search_rigid
from workflows.disturb import make_instance


def planted(rng, n, noise, outliers=0):
    """Normalised clouds with a known pose; `outliers` uniform points are added to both."""
    source = rng.standard_normal((n, 3)) * [1.0, 0.7, 0.4]
    source /= np.sqrt((source**2).sum(axis=1).mean())
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.random(random_state=3).as_matrix(), [0.2, -0.1, 0.3]
    target = source @ T[:3, :3].T + T[:3, 3] + noise * rng.standard_normal((n, 3))
    source = np.concatenate([source, rng.uniform(-1.5, 1.5, (outliers, 3))])
    target = np.concatenate([target, rng.uniform(-1.5, 1.5, (outliers, 3))])
    return source, target[rng.permutation(len(target))], T


def check_result(result, source, target, k):
    """What must hold whatever the status."""
    R = result.T[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(R) == pytest.approx(1.0)
    assert objective(source, target, result.T, k)[0] == pytest.approx(result.upper_bound, abs=1e-9)
    assert 0.0 <= result.lower_bound <= result.upper_bound
    assert result.events[-1].kind == "end"


def error_of(T, truth):
    """Rotation error in radians, translation error."""
    turn = Rotation.from_matrix(T[:3, :3] @ truth[:3, :3].T).magnitude()
    return turn, np.linalg.norm(T[:3, 3] - truth[:3, 3])


@pytest.mark.parametrize("kind", [*KINDS, "mirrored"])
@pytest.mark.parametrize(
    "sizes", [(4, 4, 4), (4, 5, 3), (5, 4, 4), (4, 4, 3), (4, 4, 1), (1, 3, 1)]
)
def test_search_finds_the_exhaustive_optimum(kind, sizes, rng):
    n, m, k = sizes
    source, target = cloud(rng, n, 3, kind), cloud(rng, m, 3, kind)
    if kind == "mirrored":
        target[: min(n, m)] = source[: min(n, m)] * [1.0, 1.0, -1.0]
    gap_tol = 1e-2 * k
    result = search_rigid(source, target, k, gap_tol=gap_tol)
    best = reference.optimum(source, target, np.ones((n, m), bool), k, 1.0, 1.0)
    check_result(result, source, target, k)
    assert result.status is Status.OPTIMAL
    assert result.lower_bound <= best + 1e-9
    assert best - 1e-9 <= result.upper_bound <= best + gap_tol + 1e-9


@pytest.mark.parametrize("start_box", ["stationary", "radius"])
def test_start_box_holds_the_optimum(start_box, rng):
    for _ in range(20):
        source, target = rng.standard_normal((5, 3)), rng.standard_normal((5, 3))
        source, target = source - source.mean(axis=0), target - target.mean(axis=0)
        for k in (2, 4, 5):
            box = Rigid3D(
                source, target, k, stationary_box=start_box == "stationary"
            ).translations()
            rows, columns = rng.permutation(5)[:k], rng.permutation(5)[:k]
            t = fit_pose(source[rows], target[columns], (1.0, 1.0))[:3, 3]
            assert (t >= box.lower - 1e-12).all()
            assert (t <= box.upper + 1e-12).all()


def test_all_matched_leaves_only_the_rotation(rng):
    source, target, truth = planted(rng, 60, 0.05)
    result = search_rigid(source, target, 60, gap_tol=60 * 0.03**2)
    check_result(result, source, target, 60)
    assert result.status is Status.OPTIMAL
    assert result.lower_bound > 0.5 * result.upper_bound  # not closed by U <= gap_tol alone
    turn, shift = error_of(result.T, truth)
    assert turn < 0.05
    assert shift < 0.03
    assert result.n_nodes < 2000


@pytest.mark.parametrize(("n", "outliers", "k"), [(14, 3, 14), (16, 0, 13)])
def test_planted_pose_is_certified_among_outliers(n, outliers, k, rng):
    source, target, truth = planted(rng, n, 0.03, outliers)
    gap_tol = k * 0.03**2
    result = search_rigid(source, target, k, gap_tol=gap_tol, nodes=400_000)
    check_result(result, source, target, k)
    assert result.status is Status.OPTIMAL
    assert result.lower_bound > 0.0
    turn, shift = error_of(result.T, truth)
    assert turn < 0.1
    assert shift < 0.05


def test_swapped_roles_give_the_inverse_pose(rng):
    source, target, _ = planted(rng, 12, 0.02)
    target = np.concatenate([target, rng.uniform(-1.5, 1.5, (3, 3))])
    there = search_rigid(source, target, 12, gap_tol=0.002)
    back = search_rigid(target, source, 12, gap_tol=0.002)
    check_result(back, target, source, 12)
    np.testing.assert_allclose(there.T @ back.T, np.eye(4), atol=1e-6)


def test_threads_do_not_change_the_outcome(rng):
    source, target, _ = planted(rng, 10, 0.05, 3)
    runs = [
        search_rigid(source, target, 10, gap_tol=0.005, nodes=8000, threads=threads)
        for threads in (1, 3)
    ]
    for name in ("n_nodes", "n_assignments", "lower_bound", "upper_bound", "status"):
        assert getattr(runs[0], name) == getattr(runs[1], name)
    np.testing.assert_array_equal(runs[0].T, runs[1].T)


@pytest.mark.parametrize(
    ("limits", "status"),
    [
        ({"nodes": 50}, Status.NODE_LIMIT),
        ({"time_s": 1e-6}, Status.TIME_LIMIT),
        ({"memory_mb": 1e-3}, Status.MEMORY_LIMIT),
    ],
)
def test_limits_leave_valid_bounds(limits, status, rng):
    source, target = rng.standard_normal((8, 3)), rng.standard_normal((9, 3))
    result = search_rigid(source, target, 6, gap_tol=1e-9, **limits)
    check_result(result, source, target, 6)
    assert result.status is status
    assert result.lower_bound < result.upper_bound


def test_few_exact_assignments_are_solved_for_large_clouds(rng):
    """Each takes as long as several bounds, and one thread solves them while the others wait."""
    source, target, _ = planted(rng, 450, 0.05, outliers=150)
    result = search_rigid(source, target, 450, gap_tol=1e-3, nodes=6000)
    assert result.status is Status.NODE_LIMIT
    assert result.n_assignments < result.n_nodes / 40


@pytest.mark.parametrize(
    ("solved", "pruned", "fewer"), [(400, 200, False), (400, 20, True), (150, 0, False)]
)
def test_assignments_that_prune_little_are_solved_for_the_smallest_boxes_only(
    solved, pruned, fewer, rng
):
    source, target, _ = planted(rng, 60, 0.05)
    space = Rigid3D(source, target, 60)
    theta, value, _ = space.start(Budget())
    theta = space.normalised(theta)
    sizes = np.geomspace(1e-4, 0.3, 40)[:, None] * (np.abs(theta) != 1.0)  # within its facet
    boxes = Boxes(theta - sizes, theta + sizes)
    bound, always = RigidBound(space), RigidBound(space)
    bound.restore({**bound.state(), "solved": (solved, pruned)})
    fresh = bound.fresh()
    for each in (bound, fresh, always):
        each.evaluate(boxes, 1.01 * value)
    assert (bound.n_assignments < 0.8 * always.n_assignments) == fewer
    assert fresh.n_assignments == bound.n_assignments
    assert bound.state()["solved"][0] > solved  # the smallest boxes need them
    assert bound.state()["solved"][1] == pruned  # all boxes hold a pose below the cutoff


def test_boxes_that_exact_assignments_prune_are_counted(rng):
    source, target, _ = planted(rng, 60, 0.05)
    space = Rigid3D(source, target, 60)
    theta, value, _ = space.start(Budget())
    theta = space.normalised(theta)
    free = np.abs(theta) != 1.0
    centres = theta + free * rng.uniform(-0.15, 0.15, (200, 7))
    boxes, bound = Boxes(centres - 1e-3 * free, centres + 1e-3 * free), RigidBound(space)
    found = bound.evaluate(boxes, cutoff := 10.0 * value)
    solved, pruned = bound.state()["solved"]
    exact = np.isfinite(found.values)
    assert abs(solved - exact.sum()) <= 1  # one value is computed without a bound
    assert 0 < pruned < solved
    assert pruned <= (found.lower_bounds[exact] >= cutoff).sum()
    bound.evaluate(boxes, None)  # without a cutoff, none can be pruned
    assert bound.state()["solved"] == (solved, pruned)


def test_duplicates_that_nearest_neighbours_cannot_tell(rng):
    """Sources in pairs over one target each: many to one costs nothing, one to one does."""
    source = np.repeat(rng.standard_normal((3, 3)), 2, axis=0)
    target = np.concatenate([source[::2], rng.standard_normal((3, 3))])
    result = search_rigid(source, target, 6, gap_tol=0.05)
    check_result(result, source, target, 6)
    assert result.status is Status.OPTIMAL
    assert result.lower_bound > 0.1


def test_full_mode_is_free_of_the_bias_of_the_norm_objective():
    """Where noise is large and all points match, the norm optimum is off by much; its pose too."""
    instance = make_instance(registry.dataset("embedded"), "saurian", "noise", 0.05, 0, 60)
    source, target, truth = instance.source, instance.target, instance.T_true
    centre = np.append(source.mean(axis=0), 1.0)  # where no rotation error counts

    def shift(T):
        return np.linalg.norm(((T - truth) @ centre)[:3])

    found = {
        mode: register(source, target, n_inliers=60, model="rigid3d", mode=mode)
        for mode in ("paper", "full")
    }
    assert shift(found["full"].T_target_source) < 0.02  # of the longest side
    # the certified pose, before any polish, is free of it too
    assert shift(found["full"].T_certified) < 0.02 < shift(found["paper"].T_certified)


def test_vertex_values_see_the_stop_flag(rng, monkeypatch):
    """A stop that comes before the values at the vertices ends their kernel at once."""
    source, target = rng.standard_normal((36, 3)), rng.standard_normal((40, 3))
    given = normalised(source, target, 30, gap_tol=0.05, nodes=2000)
    untouched = []

    def bounds_after_stop(known, requests, *arguments):
        before = known.values[requests.slots]
        if len(requests.slots):
            given.budget.stop[0] = 1
        bound_vertices_by_duals(known, requests, *arguments)
        if len(requests.slots):
            untouched.append((known.values[requests.slots] == before).all())

    monkeypatch.setattr(vertex_values, "bound_vertices_by_duals", bounds_after_stop)
    run_mode(find_mode("rigid3d", "full"), given)
    assert untouched
    assert all(untouched)


@pytest.mark.parametrize("noise", [0.01, 0.3])
def test_local_searches_from_a_grid_end_when_they_agree(noise, rng):
    """All points match. Only for large clouds, and only if nothing else fits nearly as well."""
    points = rng.standard_normal((210, 3)) * [3.0, 2.0, 1.0]
    moved = points @ Rotation.random(random_state=3).as_matrix().T
    moved += noise * rng.standard_normal(moved.shape)
    few, many = (
        Rigid3D(points[:n] - points[:n].mean(axis=0), moved[:n] - moved[:n].mean(axis=0), n)
        for n in (150, 210)
    )
    few.start(Budget())
    assert len(few.ends) == Rigid3D.n_descents
    _, value, _ = many.start(Budget())
    assert many.is_confirmed
    assert FEW_DESCENTS <= len(many.ends) < Rigid3D.n_descents
    ends = sorted(end for _, end in many.ends)
    assert ends[0] == value
    assert ends[1] <= ALIKE * value


def test_local_searches_of_a_symmetric_cloud_do_not_agree(rng):
    half = rng.standard_normal((105, 3))
    points = np.concatenate([half, half * [-1.0, -1.0, 1.0]])
    moved = points + 0.01 * rng.standard_normal(points.shape)
    space = Rigid3D(points - points.mean(axis=0), moved - moved.mean(axis=0), len(points))
    space.start(Budget())
    assert not space.is_confirmed
    assert len(space.ends) == Rigid3D.n_descents


@pytest.mark.parametrize("k", [9, 14])
def test_a_local_search_gives_a_pose_with_its_objective(k, rng):
    """Its assignments start from dual variables of the previous pose."""
    space = Rigid3D(rng.standard_normal((14, 3)), rng.standard_normal((16, 3)), k)
    for seed in space.seeds()[::100]:
        theta, value, _ = space.refine(seed)
        assert value == pytest.approx(space.objective(theta)[0], rel=1e-9)
        assert value <= space.objective(seed)[0]


def test_poses_that_fit_few_pairs_of_a_sample_exactly_are_kept(rng):
    source = rng.random((6000, 3))  # of 5 pairs, the 1,200 points of the first searches have one
    target = source[:40] + 1.0
    found = register(source, target, n_inliers=5, model="rigid3d", node_limit=1, time_limit=1.0)
    assert found.rmse_matched < 0.05
