"""Certificates of rigid poses against all matchings of tiny problems."""

import dataclasses
from itertools import combinations, permutations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import dcreg
from dcreg.certificate.assignment import cheapest_pairs, improve_duals, shortest_paths
from dcreg.certificate.rigid import Boxes, RigidPoses
from dcreg.certificate.rigid_proof import WIDE, Vertices
from dcreg.certificate.verification import objective_of
from dcreg.problem.geometry import apply_pose, fit_pose
from tests.problems import SEEDS, cloud_pairs, register

PAIRS = cloud_pairs(3, kinds=("mirrored", "with origin"), max_points=5)


def best_matching(source, target, k):
    """The minimum over all matchings, and its pose."""
    best = np.inf, np.eye(4)
    for rows in combinations(range(len(source)), k):
        x = source[list(rows)]
        for columns in permutations(range(len(target)), k):
            y = target[list(columns)]
            T = fit_pose(x, y, (1.0, 1.0))
            best = min(best, (float(((apply_pose(T, x) - y) ** 2).sum()), T), key=lambda b: b[0])
    return best


@settings(max_examples=40, deadline=None)
@given(PAIRS)
def test_accepted_bounds_enclose_the_minimum_over_all_matchings(problem):
    source, target, k = problem
    result = register(
        source, target, n_inliers=k, model="rigid3d", certificate=True, mode="full",
        node_limit=20_000,
    )  # fmt: skip
    report = dcreg.verify(result.certificate, source, target)
    assert report.accepted, report.reason
    truth, slack = best_matching(source, target, k)[0], 1e-8 * result.certificate.unit**2
    assert report.lower_bound <= truth + slack
    assert truth <= report.upper_bound + slack


@settings(max_examples=25, deadline=None)
@given(PAIRS, st.sampled_from([1e-4, 0.01, 0.5]))
def test_no_bound_above_the_minimum_is_accepted(problem, share):
    """The statement is consistent, of a worse pose; only the proof can find that it is false."""
    source, target, k = problem
    c = register(
        source, target, n_inliers=k, model="rigid3d", certificate=True, mode="full",
        node_limit=2000,
    ).certificate  # fmt: skip
    theta = c.theta + np.array([0.0, 0.2, -0.1, 0.1, 0.1, 0.0, 0.0])
    value = objective_of(c, source, target).value(theta)
    claimed = c.upper_bound + share * (value - c.upper_bound)
    if claimed <= c.upper_bound + 1e-7 or value <= claimed:
        return
    forged = dataclasses.replace(
        c, theta=theta, upper_bound=value, lower_bound=claimed, gap_tol=value - claimed,
        leaf_bounds=np.full(len(c.leaf_bounds), claimed), status="stopped",
    )  # fmt: skip
    assert not dcreg.verify(forged, source, target, n_samples=0, max_boxes=4000).accepted


@settings(max_examples=60, deadline=None)
@given(PAIRS, SEEDS, st.sampled_from([1.0, 0.3, 0.1, 0.03, 1e-3]), st.booleans())
def test_no_box_around_the_optimum_is_proven_above_it(problem, seed, size, is_tilted):
    source, target, k = problem
    source, target = source - source.mean(axis=0), target - target.mean(axis=0)
    truth, T = best_matching(source, target, k)
    if len(source) > len(target):
        source, target, T = target, source, np.linalg.inv(T)
    objective = RigidPoses(source, target, k, (1.0, 1.0))
    theta = quaternion(T)
    assert objective.value(theta) <= truth + 1e-8
    rng = np.random.default_rng(seed)
    half = size * rng.random((20, 7)) * np.repeat([1.0, rng.random()], [4, 3])
    centre = theta + rng.uniform(-1.0, 1.0, (20, 7)) * half
    facet = int(np.argmax(theta[:4]))
    low = np.where(np.arange(7) < 4, -1.0, -np.inf)
    lower, upper = np.maximum(centre - half, low), np.minimum(centre + half, -low)
    lower[:, facet] = upper[:, facet] = 1.0
    if is_tilted:  # a flat axis
        lower[:, 4] = upper[:, 4] = theta[4]
    boxes = objective.boxes(lower, upper)
    optimal = np.array([shortest_paths(objective.costs(theta), k)[1] for theta in boxes.centre])
    near = np.flatnonzero(boxes.tangent <= WIDE)
    for needed in (truth * 1.001 + 1e-6, 2.0 * truth + 1e-3):
        for duals in np.zeros_like(optimal), optimal, rng.random(optimal.shape):
            assert (objective.cap_bound(boxes, duals, needed) <= truth + 1e-8).all()
            if near.size:
                vertices = Vertices(objective, lower[near], upper[near], duals[near])
                assert (vertices.bound(needed) <= truth + 1e-8).all()
                found = objective.cayley_bound(boxes.some(near), duals[near], needed)
                assert (found <= truth + 1e-8).all()


def quaternion(T):
    """The parameter of a pose, on the facet where the quaternion is largest."""
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
    q = np.array([w, x, y, z])
    return np.append(q / q[np.argmax(np.abs(q))], T[:3, 3])


@settings(max_examples=200, deadline=None)
@given(SEEDS, st.integers(2, 6), st.sampled_from([0.1, 1.0, 3.0]))
def test_displacements_bound_a_stationary_pose(seed, k, noise):
    """Also where the third-order terms matter: far from the centre, with noise and an eccentric cloud."""
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((k, 3)) + rng.uniform(-3.0, 3.0, 3)
    y = x + noise * rng.standard_normal((k, 3))
    T = fit_pose(x, y, (1.0, 1.0))
    optimum = float(((apply_pose(T, x) - y) ** 2).sum())
    objective = RigidPoses(x, y, k, (1.0, 1.0))
    for _ in range(20):
        axis = rng.standard_normal(3)
        r = rng.uniform(0.05, 0.6) * axis / np.linalg.norm(axis)
        s = rng.uniform(0.0, 2.0) * rng.standard_normal(3)
        if rng.random() < 0.5:  # along the drift of the cloud
            s = np.linalg.norm(s) * np.cross(r, np.cross(r, x.mean(axis=0))) / (r @ r)
        turn = Rotation.from_quat(np.append(r, 1.0)).as_matrix()
        moved = x @ (turn.T @ T[:3, :3]).T  # at the centre of the box; the optimum is turned by r
        fixed = y - (T[:3, 3] - s)
        cost = ((moved - fixed) ** 2 - (2.0 * np.cross(r, moved) + s) ** 2).sum()
        boxes = Boxes(
            np.zeros((1, 7)), np.tile(r, (1, 8, 1)), np.array([np.linalg.norm(r)]),
            np.abs(s)[None], np.array([np.linalg.norm(s)]),
        )  # fmt: skip
        found = objective.loss(boxes).proven(np.array([cost]))[0]
        assert found <= optimum * (1.0 + 1e-9) + 1e-9


@settings(max_examples=200, deadline=None)
@given(PAIRS, SEEDS, st.sampled_from([0.5, 0.2]), st.sampled_from([0.0, 0.3, 1.0]))
def test_cayleys_form_bounds_every_pose_of_a_box(problem, seed, turn, shift):
    source, target, k = problem
    if len(source) > len(target):
        source, target = target, source
    objective, rng = RigidPoses(source, target, k, (1.0, 1.0)), np.random.default_rng(seed)
    centre = np.concatenate([[1.0], rng.uniform(-0.5, 0.5, 3), rng.standard_normal(3)])
    half = np.concatenate([[0.0], turn * rng.random(3), shift * rng.random(3)])
    lower, upper = (centre - half)[None], (centre + half)[None]
    boxes = objective.boxes(lower, upper)
    ends = rng.choice([-1.0, 1.0], (60, 7))
    thetas = centre + half * np.concatenate([ends, rng.uniform(-1.0, 1.0, (40, 7))])
    least = min(objective.value(theta) for theta in thetas)
    for duals in np.zeros((1, len(target))), rng.random((1, len(target))):
        assert objective.cayley_bound(boxes, duals, least)[0] <= least + 1e-8


@settings(max_examples=200, deadline=None)
@given(SEEDS, st.integers(1, 12), st.integers(0, 4), st.integers(0, 4), st.booleans())
def test_duals_in_numpy_bound_the_cheapest_pairs(seed, k, free, more, has_ties):
    """Shortest paths are exact; an auction improves any duals."""
    rng = np.random.default_rng(seed)
    n = k + free
    cost = rng.random((n, n + more))
    if has_ties:
        cost = np.round(3.0 * cost)
    wide, columns = cheapest_pairs(cost, k)
    exact = wide[np.arange(n), columns].sum()
    value, duals = shortest_paths(cost, k)
    assert value == np.float64(exact) or abs(value - exact) <= 1e-12 * n
    assert abs(bound_by(cost, duals, k) - exact) <= 1e-12 * n
    given = rng.random(n + more)
    (found,), (better,) = improve_duals(cost[None], given[None], k)
    assert (duals >= -1e-15).all()
    assert (better >= 0.0).all()
    assert bound_by(cost, given, k) - 1e-12 <= found <= exact + 1e-12 * n
    assert found <= bound_by(cost, better, k) + 1e-12


@settings(max_examples=100)
@given(SEEDS, st.integers(1, 6), st.integers(0, 3), st.integers(0, 3))
def test_an_auction_treats_each_pose_as_if_it_were_alone(seed, k, free, more):
    rng = np.random.default_rng(seed)
    costs, duals = rng.random((5, k + free, k + free + more)), rng.random((5, k + free + more))
    together, better = improve_duals(costs, duals, k)
    for at in range(5):
        alone, own = improve_duals(costs[at : at + 1], duals[at : at + 1], k)
        assert alone[0] == together[at]
        np.testing.assert_array_equal(own[0], better[at])
    enough = rng.uniform(0.5, 1.1, 5) * together
    sooner, fewer = improve_duals(costs, duals, k, enough)
    assert (sooner >= np.minimum(enough, together)).all()
    assert (sooner <= together).all()
    proven = [bound_by(cost, dual, k) for cost, dual in zip(costs, fewer, strict=True)]
    assert (sooner <= np.array(proven) + 1e-12).all()


def bound_by(cost, duals, k):
    """The bound of weak duality."""
    return np.sort((cost + duals).min(axis=1))[:k].sum() - duals.sum()


@settings(max_examples=100)
@given(SEEDS, st.sampled_from([0.1, 1.0, 30.0]), st.booleans())
def test_values_in_single_precision_are_lower_and_near(seed, size, is_near):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 30))
    source = size * rng.standard_normal((n, 3))
    target = source + 1e-3 * is_near * size * rng.standard_normal((n, 3))
    k = int(rng.integers(1, n + 1))
    objective = RigidPoses(source, target, k, (1.0, 1.0), None)
    thetas = np.hstack([rng.standard_normal((5, 4)), size * rng.standard_normal((5, 3))])
    thetas[0] = [1.0, 0, 0, 0, 0, 0, 0]
    duals = size**2 * rng.random((5, n)).astype(np.float32)
    rough, exact = objective.rough_values(thetas, duals), objective.values_from(thetas, duals)
    assert (rough <= exact).all()
    assert (rough >= exact - 1e-6 * k * (8.0 * size + np.abs(thetas).max()) ** 2).all()
