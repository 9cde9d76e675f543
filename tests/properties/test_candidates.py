"""Feasible pairs: bounds, answer and errors."""

import dataclasses
import functools
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import dcreg
from dcreg import certificate
from dcreg.certificate.verification import verify
from dcreg.families.registry import make_bound
from dcreg.families.rigid3d.bound import RigidBound
from dcreg.families.rigid3d.space import Rigid3D
from dcreg.families.rotation3d.bound import RotationBound
from dcreg.families.rotation3d.space import Rotation3D
from dcreg.names import BOUND_NAMES
from dcreg.problem import InputError, Problem, apply_pose
from dcreg.problem.geometry import fit_pose
from dcreg.search import Box, Boxes
from tests.fuzz.reference import optimum as true_optimum
from tests.oracles import kernels as reference
from tests.oracles.matchings import cheapest_fit
from tests.problems import SEEDS, lower_bound, model_of, register
from tests.properties.test_rigid_bounds import Parts, box_about, centred
from tests.searches import is_certified, search_rigid


def feasible_problem(seed, dim, most=6):
    """Random points, k and a mask that admits k pairs."""
    generator = np.random.default_rng(seed)
    n, m = generator.integers(2, most, 2)
    k = int(generator.integers(1, min(n, m) + 1))
    mask = generator.random((n, m)) < 0.5
    mask[generator.permutation(n)[:k], generator.permutation(m)[:k]] = True
    return generator.standard_normal((n, dim)), generator.standard_normal((m, dim)), k, mask


def minimum_cost(moved, target, mask, k):
    """Sum of squared residuals of the cheapest k feasible pairs."""
    costs = ((moved[:, None] - target[None]) ** 2).sum(axis=-1)
    return reference.k_assignment(np.where(mask, costs, 1e6), k)


@given(SEEDS, st.sampled_from(BOUND_NAMES))
def test_bounds_hold_for_the_feasible_pairs(seed, name):
    for dim in (2, 3):
        x, y, k, mask = feasible_problem(seed, dim)
        family = "similarity2d" if dim == 2 else "norm3d"
        model = model_of(family, x, y, k, candidates=mask)
        features = y if dim == 2 else np.linalg.norm(y, axis=1, keepdims=True)
        generator = np.random.default_rng(seed + 1)
        (box,) = model.roots()
        if name not in ("tight", "shared"):  # these know the lattice of the start box only
            lower = generator.uniform(box.lower, box.upper)
            box = Box(lower, generator.uniform(lower, box.upper))
        bound = lower_bound(make_bound(name, model), box)
        thetas = box.sample(generator, 20)
        for theta in thetas[model.admissible(thetas)]:
            true = minimum_cost(reference.features(model, theta), features, mask, k)
            assert bound <= true + 1e-9
            value, col_of = model.objective(theta)
            assert value == pytest.approx(true, abs=1e-9)
            assert mask[np.flatnonzero(col_of >= 0), col_of[col_of >= 0]].all()


@given(SEEDS)
def test_rotation_bound_holds_for_the_feasible_pairs(seed):
    x, y, k, mask = feasible_problem(seed, 3)
    model = Rotation3D(x, y, k, mask)
    generator = np.random.default_rng(seed + 1)
    centre = generator.standard_normal(4)
    box = Box(centre - 0.2, centre + 0.2)
    bound = lower_bound(RotationBound(model), box)
    for theta in box.sample(generator, 10):
        true = minimum_cost(x @ model.matrix(theta).T, y, mask, k)
        assert bound <= true + 1e-9
        assert model.objective(theta)[0] == pytest.approx(true, abs=1e-9)


@given(SEEDS)
def test_the_optimum_over_feasible_pairs_is_found(seed):
    x, y, k, mask = feasible_problem(seed, 2, most=5)
    optimum = cheapest_fit(
        x, y, k, lambda a, b: apply_pose(fit_pose(a, b, (0.5, 1.5)), a), allowed=mask
    )
    found = dcreg.register(x, y, n_inliers=k, model="similarity2d", candidates=mask)
    assert is_certified(found, optimum, found.gap_tol)
    assert mask[found.assignment[:, 0], found.assignment[:, 1]].all()


def rigid_case(seed, **settings):
    """A model of centred clouds, a pose of its start box, and the objective at a pose."""
    x, y, k, mask = feasible_problem(seed, 3)
    x, y = centred(x), centred(y)
    model = Rigid3D(x, y, k, candidates=mask, **settings)
    generator = np.random.default_rng(seed + 1)
    root = model.roots()[generator.integers(4)]

    def value_at(theta):
        return minimum_cost(apply_pose(model.pose(theta), x), y, mask, k)

    return model, generator.uniform(root.lower, root.upper), value_at, mask


@given(
    SEEDS,
    st.sampled_from([1.0, 0.3, 0.1, 0.01]),
    st.sampled_from([0.5, 0.95, 1.0, 1.5, 10.0]),
    st.booleans(),
)
def test_rigid_bound_and_its_parts_hold_for_the_feasible_pairs(seed, size, tightness, reduced):
    model, start, value_at, mask = rigid_case(seed, stationary_box=reduced)
    theta, best, _ = model.refine(start)
    box = box_about(model.normalised(theta), np.random.default_rng(seed), size)
    found = RigidBound(model).evaluate(Boxes.of([box]), tightness * best + 1e-12)
    assert 0.0 <= found.lower_bounds[0] <= best + 1e-9
    assert found.values[0] >= value_at(box.centre) - 1e-9
    parts = Parts(model, box)
    costs = parts.costs()
    assert reference.k_assignment(costs, model.n_inliers) - parts.lost <= best + 1e-9
    assert (costs[~mask] > model.n_inliers * costs[mask].max()).all()
    if len(parts.vertices):
        assert parts.vertex_bound() <= best + 1e-9


@given(SEEDS)
def test_rigid_bound_at_a_pose_is_the_objective_of_the_feasible_pairs(seed):
    model, theta, value_at, mask = rigid_case(seed)
    true = value_at(theta)
    bound = lower_bound(RigidBound(model), Box(theta, theta), 1.01 * true + 1e-6)
    assert bound == pytest.approx(true, abs=1e-7)
    refined, refined_value, _ = model.refine(theta)
    assert refined_value <= true + 1e-9
    for at, expected in ((theta, true), (refined, refined_value)):
        value, col_of = model.objective(at)
        assert value == pytest.approx(expected, abs=1e-9)
        rows = np.flatnonzero(col_of >= 0)
        assert len(rows) == model.n_inliers
        assert mask[rows, col_of[rows]].all()


def test_rigid_vertex_bound_is_tight_where_only_forbidden_pairs_are_better():
    generator = np.random.default_rng(5)
    x, y = generator.standard_normal((2, 10, 3))
    x, y = centred(x), centred(y)
    model = Rigid3D(x, y, 10, candidates=np.eye(10, dtype=bool))
    theta, best, _ = model.refine(np.array([1.0, 0, 0, 0, 0, 0, 0]))
    half = 0.01 * np.array([0.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0])
    parts = Parts(model, Box(theta - half, theta + half))
    assert Rigid3D(x, y, 10).objective(theta)[0] < 0.7 * best
    assert 0.98 * best <= parts.vertex_bound() <= best + 1e-9


@functools.cache
def rigid_optimum(seed):
    x, y, k, mask = feasible_problem(seed, 3)
    return true_optimum(x, y, mask, k, 1.0, 1.0)


@pytest.mark.usefixtures(
    "processor_clock"
)  # a search ends early where it gets little of a processor
@pytest.mark.parametrize("start_box", ["stationary", "radius"])
@pytest.mark.parametrize("seed", range(15))
def test_mode_full_finds_the_rigid_optimum_over_feasible_pairs(seed, start_box):
    x, y, k, mask = feasible_problem(seed, 3)
    optimum = rigid_optimum(seed)
    gap = min(0.05, 0.5 * optimum)  # so that the lower bound is above 0 at the end
    settings = {"mode": "full", "start_box": start_box, "rel_gap": 0.0, "abs_gap": gap}
    found = register(x, y, n_inliers=k, model="rigid3d", candidates=mask, **settings)
    assert is_certified(found, optimum, found.gap_tol)
    assert found.certificate_scope == "rigid pose"
    assert optimum - 1e-9 <= found.objective <= found.objective_certified + 1e-9
    assert mask[found.assignment[:, 0], found.assignment[:, 1]].all()


@settings(max_examples=15)
@given(SEEDS)
def test_candidates_of_all_pairs_change_no_step_of_the_rigid_search(seed):
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
    settings = {"n_inliers": 10, "model": "rigid3d", "mode": mode, "rel_gap": 0.0, "abs_gap": 0.05}
    free = register(x, y, **settings)
    i, j = free.assignment.T
    wide = generator.random((10, 10)) < 0.2
    wide[i, j] = True
    kept = register(x, y, candidates=wide, **settings)
    assert kept.objective == pytest.approx(free.objective, abs=1e-9)
    assert kept.assignment.tolist() == free.assignment.tolist()
    narrow = np.ones((10, 10), dtype=bool)
    narrow[i[:6], j[:6]] = False
    other = register(x, y, candidates=narrow, **settings)
    assert narrow[other.assignment[:, 0], other.assignment[:, 1]].all()
    assert other.objective > free.objective + 1e-3


@pytest.mark.parametrize(
    ("mode", "clutter", "noise"), [("auto", 0, 0.005), ("auto", 40, 0.005), ("paper", 0, 0.0)]
)
def test_candidates_lead_to_the_planted_pose(mode, clutter, noise):
    """In mode `paper` they resolve the ambiguity of the norms."""
    generator = np.random.default_rng(0)
    x = generator.random((20, 3)) * [1.0, 0.7, 0.4]
    y = x[:, [1, 2, 0]] + [0.3, -0.2, 0.1] + noise * generator.standard_normal((20, 3))
    x, y = (np.concatenate([points, generator.random((clutter, 3))]) for points in (x, y))
    mask = generator.random((len(x), len(y))) < (0.1 if noise else 0.15)
    np.fill_diagonal(mask[:20, :20], True)
    found = register(x, y, n_inliers=20, model="rigid3d", candidates=mask, mode=mode, prove=True)
    assert found.mode == {"auto": "full"}.get(mode, mode)
    assert found.status is dcreg.Status.OPTIMAL
    assert mask[found.assignment[:, 0], found.assignment[:, 1]].all()
    assert found.rotation == pytest.approx(np.eye(3)[[1, 2, 0]], abs=1e-6 + 4 * noise)


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


def settings_of(dim):
    if dim == 2:
        return {"model": "similarity2d", "scale_range": (0.5, 1.5), "mode": "paper"}
    return {"model": "rigid3d", "mode": "paper"}


def certified(seed, dim, tmp_path):
    x, y, k, mask = feasible_problem(seed, dim, most=9)
    limits = {"rel_gap": 0.0, "abs_gap": 1e-3 * k, "node_limit": 20_000}
    result = register(
        x, y, n_inliers=k, candidates=mask, certificate=True, **limits, **settings_of(dim)
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
    """With every pair feasible, many optima are below the bounds proven for the candidates."""
    refused = 0
    for seed in range(15):
        x, y, mask, result, path = certified(seed, dim, tmp_path)
        k, gap_tol = result.n_inliers, result.gap_tol
        free = register(
            x, y, n_inliers=k, rel_gap=0.0, abs_gap=gap_tol, polish=False, **settings_of(dim)
        )
        every_pair = np.argwhere(np.ones_like(mask))
        forged = dataclasses.replace(result.certificate, candidates=every_pair)
        certificate.write(path, forged)
        report = verify(path, x, y)
        if free.upper_bound < result.lower_bound - 1e-9:
            assert not report.accepted
            refused += 1
    assert refused >= 2


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
