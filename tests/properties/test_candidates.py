"""Feasible pairs: bounds, answer and errors."""

import dataclasses
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import dcreg
from dcreg import certificate
from dcreg.certificate.verification import verify
from dcreg.families.registry import make_bound
from dcreg.families.rigid3d.bound import RigidBound
from dcreg.families.rigid3d.space import Rigid3D
from dcreg.families.rotation3d.bound import RotationBound
from dcreg.families.rotation3d.space import Rotation3D
from dcreg.families.similarity2d.space import Similarity2D
from dcreg.families.translation3d.space import Translation3D
from dcreg.names import BOUND_NAMES
from dcreg.problem import InputError, Problem
from dcreg.problem.geometry import fit_pose
from dcreg.search import Box, Boxes
from tests.fuzz.reference import optimum as true_optimum
from tests.oracles import kernels as reference
from tests.oracles.matchings import matchings
from tests.problems import register
from tests.properties.test_rigid_bounds import Parts, box_about
from tests.searches import search_rigid


def feasible_problem(seed, dim, most=6):
    """Random points, k and a mask that admits k pairs."""
    generator = np.random.default_rng(seed)
    n, m = generator.integers(2, most, 2)
    k = int(generator.integers(1, min(n, m) + 1))
    mask = generator.random((n, m)) < 0.5
    mask[generator.permutation(n)[:k], generator.permutation(m)[:k]] = True
    return generator.standard_normal((n, dim)), generator.standard_normal((m, dim)), k, mask


def feasible_matchings(mask, k):
    return (pairs for pairs in matchings(*mask.shape, k) if mask[pairs].all())


def least(costs, mask, k):
    """Cheapest feasible k pairs of a cost matrix."""
    return reference.k_assignment(np.where(mask, costs, 1e6), k)


@given(st.integers(0, 2**32 - 1), st.sampled_from(list(BOUND_NAMES)))
def test_bounds_hold_for_the_feasible_pairs(seed, name):
    for dim in (2, 3):
        x, y, k, mask = feasible_problem(seed, dim)
        model = (
            Similarity2D(x, y, k, (0.5, 1.5), candidates=mask)
            if dim == 2
            else Translation3D(x, y, k, candidates=mask)
        )
        generator = np.random.default_rng(seed + 1)
        (start,) = model.roots()
        lower = generator.uniform(start.lower, start.upper)
        upper = generator.uniform(lower, start.upper)
        if name in ("tight", "shared"):  # they know the start box's lattice only
            lower, upper = start.lower, start.upper
        bound = (
            make_bound(name, model).evaluate(Boxes.of([Box(lower, upper)]), np.inf).lower_bounds[0]
        )
        free = dim == 2
        for theta in generator.uniform(lower, upper, (20, start.dim)):
            if free and not model.admissible(theta[None])[0]:
                continue
            moved = reference.features(model, theta)
            features = y if dim == 2 else np.linalg.norm(y, axis=1, keepdims=True)
            true = least(((moved[:, None] - features[None]) ** 2).sum(-1), mask, k)
            assert bound <= true + 1e-9
            value, col_of = model.objective(theta)
            assert value == pytest.approx(true, abs=1e-9)
            assert mask[np.flatnonzero(col_of >= 0), col_of[col_of >= 0]].all()


@given(st.integers(0, 2**32 - 1))
def test_rotation_bound_holds_for_the_feasible_pairs(seed):
    x, y, k, mask = feasible_problem(seed, 3)
    model = Rotation3D(x, y, k, mask)
    generator = np.random.default_rng(seed + 1)
    centre = generator.standard_normal(4)
    lower, upper = centre - 0.2, centre + 0.2
    bound = RotationBound(model).evaluate(Boxes(lower[None], upper[None]), np.inf).lower_bounds[0]
    for theta in generator.uniform(lower, upper, (10, 4)):
        moved = x @ model.matrix(theta).T
        true = least(((moved[:, None] - y[None]) ** 2).sum(-1), mask, k)
        assert bound <= true + 1e-9
        assert model.objective(theta)[0] == pytest.approx(true, abs=1e-9)


@given(st.integers(0, 2**32 - 1))
def test_the_optimum_over_feasible_pairs_is_found(seed):
    x, y, k, mask = feasible_problem(seed, 2, most=5)
    optimum = np.inf
    for rows, columns in feasible_matchings(mask, k):
        T = fit_pose(x[rows], y[columns], (0.5, 1.5))
        moved = x[rows] @ T[:2, :2].T + T[:2, 2]
        optimum = min(optimum, float(((moved - y[columns]) ** 2).sum()))
    found = dcreg.register(x, y, n_inliers=k, model="similarity2d", candidates=mask, gap_tol=0.05)
    assert found.status is dcreg.Status.OPTIMAL
    assert found.lower_bound <= optimum + 1e-9
    assert optimum - 1e-9 <= found.upper_bound <= optimum + 0.05 + 1e-9
    assert mask[found.assignment[:, 0], found.assignment[:, 1]].all()


def rigid_box(model, generator, size):
    """Poses within the start box, `size` of it wide."""
    root = model.roots()[generator.integers(4)]
    lower = generator.uniform(root.lower, root.upper)
    return Box(lower, lower + size * (root.upper - lower))


def least_at(theta, x, y, mask, k):
    """The objective at a rigid pose by the reference assignment."""
    T = Rigid3D(x, y, k).pose(theta)
    moved = x @ T[:3, :3].T + T[:3, 3]
    return least(((moved[:, None] - y[None]) ** 2).sum(-1), mask, k)


def rigid_model(seed, **settings):
    """Centred clouds and their model."""
    x, y, k, mask = feasible_problem(seed, 3)
    x, y = x - x.mean(axis=0), y - y.mean(axis=0)
    return Rigid3D(x, y, k, candidates=mask, **settings), (x, y, mask, k)


@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from([1.0, 0.3, 0.1, 0.01]),
    st.sampled_from([0.5, 0.95, 1.0, 1.5, 10.0]),
    st.booleans(),
)
def test_rigid_bound_holds_for_the_feasible_pairs(seed, size, tightness, reduced):
    model, problem = rigid_model(seed, stationary_box=reduced)
    generator = np.random.default_rng(seed + 1)
    theta, best, _ = model.refine(rigid_box(model, generator, 0.0).centre)
    box = box_about(model.normalised(theta), generator, size)
    found = RigidBound(model).evaluate(Boxes.of([box]), tightness * best + 1e-12)
    assert 0.0 <= found.lower_bounds[0] <= best + 1e-9
    assert found.values[0] >= least_at(box.centre, *problem) - 1e-9


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.5, 0.1, 0.01]))
def test_each_rigid_bound_alone_holds_for_the_feasible_pairs(seed, size):
    model, problem = rigid_model(seed)
    generator = np.random.default_rng(seed + 1)
    theta, best, _ = model.refine(rigid_box(model, generator, 0.0).centre)
    parts = Parts(model, box_about(model.normalised(theta), generator, size))
    costs = parts.costs()
    assert reference.k_assignment(costs, model.n_inliers) - parts.lost <= best + 1e-9
    mask = problem[2]
    assert (costs[~mask] > model.n_inliers * costs[mask].max()).all()
    if len(parts.corners):
        assert parts.vertex_bound() <= best + 1e-9


@given(st.integers(0, 2**32 - 1))
def test_rigid_bound_at_a_pose_is_the_objective_of_the_feasible_pairs(seed):
    model, problem = rigid_model(seed)
    theta = rigid_box(model, np.random.default_rng(seed + 1), 0.0).centre
    true = least_at(theta, *problem)
    bound = RigidBound(model).evaluate(Boxes(theta[None], theta[None]), 1.01 * true + 1e-6)
    assert bound.lower_bounds[0] == pytest.approx(true, abs=1e-7)
    refined, refined_value, _ = model.refine(theta)
    assert refined_value <= true + 1e-9
    for at, expected in ((theta, true), (refined, refined_value)):
        value, col_of = model.objective(at)
        assert value == pytest.approx(expected, abs=1e-9)
        rows = np.flatnonzero(col_of >= 0)
        assert len(rows) == model.n_inliers
        assert problem[2][rows, col_of[rows]].all()


def test_rigid_vertex_bound_is_tight_where_only_forbidden_pairs_are_better():
    generator = np.random.default_rng(5)
    x, y = generator.standard_normal((2, 10, 3))
    x, y = x - x.mean(axis=0), y - y.mean(axis=0)
    model = Rigid3D(x, y, 10, candidates=np.eye(10, dtype=bool))
    theta, best, _ = model.refine(np.array([1.0, 0, 0, 0, 0, 0, 0]))
    half = 0.01 * np.array([0.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0])
    parts = Parts(model, Box(theta - half, theta + half))
    assert Rigid3D(x, y, 10).objective(theta)[0] < 0.7 * best
    assert 0.98 * best <= parts.vertex_bound() <= best + 1e-9


@pytest.mark.parametrize("start_box", ["stationary", "radius"])
@pytest.mark.parametrize("seed", range(15))
def test_mode_full_finds_the_rigid_optimum_over_feasible_pairs(seed, start_box):
    x, y, k, mask = feasible_problem(seed, 3)
    optimum = true_optimum(x, y, mask, k, 1.0, 1.0)
    found = register(
        x,
        y,
        n_inliers=k,
        model="rigid3d",
        candidates=mask,
        gap_tol=0.05,
        mode="full",
        start_box=start_box,
    )
    assert found.status is dcreg.Status.OPTIMAL
    assert found.certificate_scope == "rigid pose"
    assert found.lower_bound <= optimum + 1e-9
    assert optimum - 1e-9 <= found.upper_bound <= optimum + 0.05 + 1e-9
    assert optimum - 1e-9 <= found.objective <= found.objective_certified + 1e-9
    assert mask[found.assignment[:, 0], found.assignment[:, 1]].all()


@given(st.integers(0, 2**32 - 1))
def test_prices_of_zero_change_no_step_of_the_rigid_search(seed):
    x, y, k, mask = feasible_problem(seed, 3)
    runs = [
        search_rigid(x, y, k, gap_tol=0.05, nodes=2000, candidates=candidates)
        for candidates in (None, np.ones_like(mask))
    ]
    for name in ("n_nodes", "n_assignments", "lower_bound", "upper_bound", "status"):
        assert getattr(runs[0], name) == getattr(runs[1], name)
    np.testing.assert_array_equal(runs[0].T, runs[1].T)


@pytest.mark.parametrize("mode", ["full", "auto"])
def test_a_feasible_optimum_stays_the_optimum_and_a_forbidden_one_does_not(mode):
    generator = np.random.default_rng(4)
    x = generator.standard_normal((10, 3)) * [1.0, 0.7, 0.4]
    y = x[:, [1, 2, 0]] + [0.3, -0.2, 0.1] + 0.05 * generator.standard_normal((10, 3))
    settings = {
        "n_inliers": 10,
        "model": "rigid3d",
        "options": dcreg.SolveOptions(mode=mode),
        "gap_tol": 0.05,
    }
    free = dcreg.register(x, y, **settings)
    i, j = free.assignment.T
    wide = generator.random((10, 10)) < 0.2
    wide[i, j] = True
    kept = dcreg.register(x, y, candidates=wide, **settings)
    assert kept.objective == pytest.approx(free.objective, abs=1e-9)
    assert kept.assignment.tolist() == free.assignment.tolist()
    narrow = np.ones((10, 10), dtype=bool)
    narrow[i[:6], j[:6]] = False
    other = dcreg.register(x, y, candidates=narrow, **settings)
    assert narrow[other.assignment[:, 0], other.assignment[:, 1]].all()
    assert other.objective > free.objective + 1e-3


@pytest.mark.parametrize("clutter", [0, 40])
def test_mode_auto_takes_candidates(clutter):
    generator = np.random.default_rng(0)
    x = generator.random((20, 3)) * [1.0, 0.7, 0.4]
    y = x[:, [1, 2, 0]] + [0.3, -0.2, 0.1] + 0.005 * generator.standard_normal((20, 3))
    x, y = (np.concatenate([points, generator.random((clutter, 3))]) for points in (x, y))
    mask = generator.random((len(x), len(y))) < 0.1
    np.fill_diagonal(mask[:20, :20], True)
    found = dcreg.register(x, y, n_inliers=20, model="rigid3d", gap_tol=0.01, candidates=mask)
    assert found.mode == "full"
    assert found.status is dcreg.Status.OPTIMAL
    assert mask[found.assignment[:, 0], found.assignment[:, 1]].all()
    assert found.rotation == pytest.approx(np.eye(3)[[1, 2, 0]], abs=0.02)


def test_candidates_resolve_the_surrogate_in_3d():
    generator = np.random.default_rng(0)
    x = generator.random((20, 3)) * [1.0, 0.7, 0.4]
    y = x[:, [1, 2, 0]] + [0.3, -0.2, 0.1]  # a proper rotation and a shift
    mask = generator.random((20, 20)) < 0.15
    np.fill_diagonal(mask, True)
    found = register(
        x, y, n_inliers=20, model="rigid3d", gap_tol=0.01, candidates=mask, mode="paper"
    )
    assert mask[found.assignment[:, 0], found.assignment[:, 1]].all()
    assert found.rotation == pytest.approx(np.eye(3)[[1, 2, 0]], abs=1e-6)


def test_lists_and_mask_say_the_same():
    points = np.random.default_rng(1).random((6, 2))
    lists = [[i, (i + 1) % 6] for i in range(6)]
    mask = np.zeros((6, 6), dtype=bool)
    for i, row in enumerate(lists):
        mask[i, row] = True
    from_lists = Problem(points, points, 4, "similarity2d", candidates=lists)
    assert (from_lists.candidates == mask).all()
    everything = Problem(points, points, 4, "similarity2d", candidates=np.ones((6, 6), dtype=bool))
    assert everything.candidates is None


@pytest.mark.parametrize(
    ("candidates", "message"),
    [
        (np.ones((3, 4), dtype=bool), r"candidates: mask of shape \(3, 4\)"),
        ([[0]] * 5, "at most 1 pairs can be matched one to one, fewer than n_inliers = 3"),
        ([[0], [1], [2], [3]], "4 index lists for 5 source points"),
        ([[0], [1], [2], [3], [5]], "5 for source point 4 is not a target index"),
        ([[0], [1], [2], [3], [-1]], "-1 for source point 4 is not a target index"),
        ([[0], [1], [2], [3], ["a"]], "neither a boolean mask nor"),
        (7, "neither a boolean mask nor"),
    ],
)
def test_bad_candidates_are_refused(candidates, message):
    points = np.random.default_rng(2).random((5, 2))
    with pytest.raises(InputError, match=message):
        Problem(points, points, 3, "similarity2d", candidates=candidates)


@pytest.mark.parametrize("mode", ["paper", "full", "auto"])
def test_too_few_feasible_pairs_are_refused_in_every_mode(mode):
    points = np.random.default_rng(2).random((5, 3))
    mask = np.zeros((5, 5), dtype=bool)
    mask[:, :2] = True  # ten pairs, of which two are one to one
    message = "at most 2 pairs can be matched one to one, fewer than n_inliers = 3"
    with pytest.raises(InputError, match=message):
        register(points, points, n_inliers=3, model="rigid3d", candidates=mask, mode=mode)


def certified(seed, dim, tmp_path):
    x, y, k, mask = feasible_problem(seed, dim, most=9)
    result = register(
        x,
        y,
        n_inliers=k,
        model="similarity2d" if dim == 2 else "rigid3d",
        scale_range=(0.5, 1.5) if dim == 2 else None,
        candidates=mask,
        gap_tol=1e-3 * k,
        node_limit=20_000,
        mode="paper",
        certificate=True,
    )
    path = tmp_path / "certificate.npz"
    certificate.write(path, result.certificate)
    return x, y, mask, result, path


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("seed", range(12))
def test_a_certificate_over_candidates_is_accepted(seed, dim, tmp_path):
    x, y, mask, _, path = certified(seed, dim, tmp_path)
    report = verify(path, x, y)
    assert report.accepted, report.reason
    assert f"among {mask.sum()} candidates" in report.statement
    assert certificate.read(path).candidates.tolist() == np.argwhere(mask).tolist()


@pytest.mark.parametrize("dim", [2, 3])
def test_a_certificate_does_not_hold_for_more_candidates(dim, tmp_path):
    """With every pair feasible many an optimum falls below the bounds proven for a few."""
    refused = 0
    for seed in range(30):
        x, y, mask, result, path = certified(seed, dim, tmp_path)
        wider = np.ones_like(mask)
        free = register(
            x,
            y,
            n_inliers=result.n_inliers,
            model=result.model,
            scale_range=(0.5, 1.5) if dim == 2 else None,
            gap_tol=result.gap_tol,
            mode="paper",
            polish=False,
        )
        forged = dataclasses.replace(result.certificate, candidates=np.argwhere(wider))
        certificate.write(path, forged)
        report = verify(path, x, y)
        if free.upper_bound < result.lower_bound - 1e-9:
            assert not report.accepted
            refused += 1
    assert refused >= 4


@pytest.mark.parametrize(
    ("pairs", "reason"),
    [
        ([[0, 99]], "candidates: an index exceeds the clouds"),
        ([[-1, 0]], "candidates: a negative index"),
        ([[0, 0]], "candidates: fewer than . can be matched"),
    ],
)
def test_certificates_with_broken_candidates_are_refused(pairs, reason, tmp_path):
    seed = next(s for s in range(50) if feasible_problem(s, 2, most=9)[2] > 1)
    x, y, _, result, path = certified(seed, 2, tmp_path)
    certificate.write(path, dataclasses.replace(result.certificate, candidates=np.array(pairs)))
    report = verify(path, x, y)
    assert not report.accepted
    assert re.search(reason, report.reason)
