"""Certificates of rigid poses against all matchings of tiny problems."""

import dataclasses
from itertools import combinations, permutations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import dcreg
from dcreg.certificate.rigid import RigidPoses
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
    assert not dcreg.verify(forged, source, target, n_samples=0, max_boxes=20_000).accepted


@settings(max_examples=150, deadline=None)
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
    half = size * rng.random((60, 7)) * np.repeat([1.0, rng.random()], [4, 3])
    centre = theta + rng.uniform(-1.0, 1.0, (60, 7)) * half
    facet = int(np.argmax(theta[:4]))
    low = np.where(np.arange(7) < 4, -1.0, -np.inf)
    lower, upper = np.maximum(centre - half, low), np.minimum(centre + half, -low)
    lower[:, facet] = upper[:, facet] = 1.0
    if is_tilted:  # a flat axis
        lower[:, 4] = upper[:, 4] = theta[4]
    for needed in (truth * 1.001 + 1e-6, 2.0 * truth + 1e-3):
        for bound in objective.own_bounds():
            assert (bound(lower, upper, needed) <= truth + 1e-8).all()


def quaternion(T):
    """The parameter of a pose, on the facet where the quaternion is largest."""
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
    q = np.array([w, x, y, z])
    return np.append(q / q[np.argmax(np.abs(q))], T[:3, 3])
