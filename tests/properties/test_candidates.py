"""Feasible pairs: bounds, answer and errors."""

import dataclasses
import itertools
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import dcreg
from dcreg import certificate
from dcreg.bounds import make_bound
from dcreg.kernels import reference, vertices
from dcreg.models import Similarity2D, Translation3D
from dcreg.polish import fit_pose
from dcreg.problem import InputError, Problem
from dcreg.rotation import RotationBound, RotationModel
from dcreg.verification import verify


def feasible_problem(seed, dim, most=6):
    """Random points, k and a mask that admits k pairs."""
    generator = np.random.default_rng(seed)
    n, m = generator.integers(2, most, 2)
    k = int(generator.integers(1, min(n, m) + 1))
    mask = generator.random((n, m)) < 0.5
    mask[generator.permutation(n)[:k], generator.permutation(m)[:k]] = True
    return generator.standard_normal((n, dim)), generator.standard_normal((m, dim)), k, mask


def feasible_matchings(mask, k):
    n, m = mask.shape
    for rows in itertools.combinations(range(n), k):
        for columns in itertools.permutations(range(m), k):
            if mask[list(rows), list(columns)].all():
                yield list(rows), list(columns)


def least(costs, mask, k):
    """Cheapest feasible k pairs of a cost matrix."""
    return reference.k_assignment(np.where(mask, costs, 1e6), k)


@given(
    st.integers(0, 2**32 - 1), st.sampled_from(["tight", "tight-exact", "shared", "paper", "edges"])
)
def test_bounds_hold_for_the_feasible_pairs(seed, name):
    for dim in (2, 3):
        x, y, k, mask = feasible_problem(seed, dim)
        model = (
            Similarity2D(x, y, k, (0.5, 1.5), candidates=mask)
            if dim == 2
            else Translation3D(x, y, k, candidates=mask)
        )
        generator = np.random.default_rng(seed + 1)
        start = model.start_box()
        lower = generator.uniform(start.lower, start.upper)
        upper = generator.uniform(lower, start.upper)
        if name in ("paper", "edges"):  # the others know the start box's lattice only
            box = (lower[None], upper[None])
        else:
            box = (start.lower[None], start.upper[None])
        bound = make_bound(name, model).evaluate(*box, np.inf).lower_bounds[0]
        free = dim == 2
        for theta in generator.uniform(box[0][0], box[1][0], (20, start.dim)):
            if free and not model.admissible(theta[None])[0]:
                continue
            moved = reference.features(model, theta)
            features = y if dim == 2 else np.linalg.norm(y, axis=1, keepdims=True)
            true = least(((moved[:, None] - features[None]) ** 2).sum(-1), mask, k)
            assert bound <= true + 1e-9
            value, col_of = vertices.objective(
                model.kind, model.source, model.target_features, k, theta
            )
            assert value == pytest.approx(true, abs=1e-9)
            assert mask[np.flatnonzero(col_of >= 0), col_of[col_of >= 0]].all()


@given(st.integers(0, 2**32 - 1))
def test_rotation_bound_holds_for_the_feasible_pairs(seed):
    x, y, k, mask = feasible_problem(seed, 3)
    model = RotationModel(x, y, k, mask)
    generator = np.random.default_rng(seed + 1)
    centre = generator.standard_normal(4)
    lower, upper = centre - 0.2, centre + 0.2
    bound = RotationBound(model).evaluate(lower[None], upper[None], np.inf).lower_bounds[0]
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


def test_candidates_resolve_the_surrogate_in_3d():
    generator = np.random.default_rng(0)
    x = generator.random((20, 3)) * [1.0, 0.7, 0.4]
    y = x[:, [1, 2, 0]] + [0.3, -0.2, 0.1]  # a proper rotation and a shift
    mask = generator.random((20, 20)) < 0.15
    np.fill_diagonal(mask, True)
    found = dcreg.register(
        x, y, n_inliers=20, model="rigid3d", mode="paper", gap_tol=0.01, candidates=mask
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
        ([[0], [1], [2], [3], [5]], "5 for source point 4 is no target index"),
        ([[0], [1], [2], [3], [-1]], "-1 for source point 4 is no target index"),
        ([[0], [1], [2], [3], ["a"]], "neither a boolean mask nor"),
        (7, "neither a boolean mask nor"),
    ],
)
def test_bad_candidates_are_refused(candidates, message):
    points = np.random.default_rng(2).random((5, 2))
    with pytest.raises(InputError, match=message):
        Problem(points, points, 3, "similarity2d", candidates=candidates)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"model": "rigid3d", "mode": "full"}, "mode 'full' treats every pair as feasible"),
        ({"model": "rigid3d", "mode": "multi"}, "mode 'multi' treats every pair as feasible"),
        ({"model": "similarity2d", "bound": "termwise"}, "bound 'termwise-r1' treats every pair"),
    ],
)
def test_what_does_not_take_candidates_says_so(settings, message):
    points = np.random.default_rng(2).random((5, 3 if settings["model"] == "rigid3d" else 2))
    with pytest.raises(InputError, match=message):
        dcreg.register(points, points, n_inliers=3, candidates=np.eye(5, dtype=bool), **settings)


def certified(seed, dim, tmp_path):
    x, y, k, mask = feasible_problem(seed, dim, most=9)
    result = dcreg.register(
        x, y, n_inliers=k, model="similarity2d" if dim == 2 else "rigid3d", mode="paper",
        scale_range=(0.5, 1.5) if dim == 2 else None, candidates=mask, certificate=True,
        gap_tol=1e-3 * k, node_limit=20_000,
    )  # fmt: skip
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
        free = dcreg.register(
            x, y, n_inliers=result.n_inliers, model=result.model, mode="paper", polish=False,
            scale_range=(0.5, 1.5) if dim == 2 else None, gap_tol=result.gap_tol,
        )  # fmt: skip
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
        ([[0, 99]], "candidates: an index beyond the clouds"),
        ([[-1, 0]], "candidates: a negative index"),
        ([[0, 0]], "candidates: no . of them are one to one"),
    ],
)
def test_certificates_with_broken_candidates_are_refused(pairs, reason, tmp_path):
    seed = next(s for s in range(50) if feasible_problem(s, 2, most=9)[2] > 1)
    x, y, _, result, path = certified(seed, 2, tmp_path)
    certificate.write(path, dataclasses.replace(result.certificate, candidates=np.array(pairs)))
    report = verify(path, x, y)
    assert not report.accepted
    assert re.search(reason, report.reason)
