"""Bounds over boxes of rotations: below the objective, exact at a point, of second order."""

from itertools import combinations_with_replacement

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from baselines.hbsp.rotation import SemidefiniteRotationBound
from dcreg.assignment.kernels.dense import cheapest_pairs
from dcreg.families.rotation3d.bound import RotationBound
from dcreg.families.rotation3d.kernels import rotation as kernels
from dcreg.families.rotation3d.kernels.caps import cap_costs
from dcreg.families.rotation3d.space import Rotation3D
from dcreg.search import Box, Boxes, LongestEdge
from tests.oracles.kernels import k_assignment
from tests.problems import cloud_pairs, facet_boxes, lower_bound, thetas_in


def rotation_of(theta):
    return Rotation.from_quat(theta, scalar_first=True)


def objective(source, target, k, theta):
    moved = rotation_of(theta).apply(source)
    return k_assignment(((moved[:, None] - target[None]) ** 2).sum(axis=-1), k)


def exact_b1(source, target, k, box):
    """B1 from its definition, with angles."""
    centre = rotation_of(box.centre)
    reach = max((rotation_of(v) * centre.inv()).magnitude() for v in box.vertices())
    moved = centre.apply(source)
    a, y = np.linalg.norm(source, axis=1), np.linalg.norm(target, axis=1)
    products = np.maximum(a[:, None] * y, 1e-300)
    between = np.arccos(np.clip(moved @ target.T / products, -1.0, 1.0))
    cost = (a**2)[:, None] + y**2 - 2.0 * a[:, None] * y * np.cos(np.maximum(0, between - reach))
    return k_assignment(cost, k)


def exact_b2(source, target, k, box):
    """B2 from its definition: every pair of vertices, each assignment solved."""
    squares = (source**2).sum(axis=1)[:, None] + (target**2).sum(axis=1)
    values = []
    for q, r in combinations_with_replacement(box.vertices(), 2):
        B = (np.outer(q, r) + np.outer(r, q)) / (2.0 * q @ r)
        # R is linear in q q^T: a weighted sum of the rotations of the eigenvectors
        weights, vectors = np.linalg.eigh(B)
        M = sum(w * rotation_of(v).as_matrix() for w, v in zip(weights, vectors.T, strict=True))
        values.append(k_assignment(squares - 2.0 * (source @ M.T) @ target.T, k))
    return min(values)


problems = cloud_pairs(3, kinds=("with origin",))
boxes = facet_boxes(Rotation3D.roots())
small_boxes = facet_boxes(Rotation3D.roots(), halves=(0.3, 0.1, 0.01))


def vertices_of(box):
    vertices = np.empty((16, 4))
    return vertices[: kernels.box_corners(box.lower, box.upper, vertices)]


@pytest.mark.parametrize("bound", [RotationBound, SemidefiniteRotationBound])
@given(problems, boxes, st.sampled_from([0.0, 0.5, 0.95, 1.5, np.inf]))
def test_bound_is_below_the_objective_anywhere_in_the_box(bound, problem, box, tightness):
    lowest = min(objective(*problem, theta) for theta in thetas_in(box))
    cutoff = tightness * lowest if tightness < np.inf else np.inf
    found = bound(Rotation3D(*problem)).evaluate(Boxes.of([box]), cutoff)
    assert found.lower_bounds[0] <= lowest + 1e-9
    assert found.values[0] >= objective(*problem, found.thetas[0]) - 1e-9
    if bound is RotationBound:
        assert found.lower_bounds[0] >= 0.0


@pytest.mark.parametrize("bound", [RotationBound, SemidefiniteRotationBound])
@given(problems, boxes)
def test_bound_and_candidate_equal_the_objective_at_one_rotation(bound, problem, box):
    source, target, k = problem
    theta = box.centre
    found = bound(Rotation3D(*problem)).evaluate(Boxes.of([Box(theta, theta)]), np.inf)
    expected = objective(*problem, theta)
    size = 1.0 if bound is RotationBound else 10 * k * (1 + (source**2).sum() + (target**2).sum())
    assert found.lower_bounds[0] == pytest.approx(expected, abs=1e-7 * size)
    assert found.values[0] == pytest.approx(expected, abs=1e-7)


@settings(max_examples=30)
@given(problems, small_boxes)
def test_each_bound_alone_is_below_the_objective(problem, box):
    lowest = min(objective(*problem, theta) for theta in thetas_in(box))
    assert exact_b1(*problem, box) <= lowest + 1e-9
    if (box.vertices() @ box.vertices().T).min() > 0.0:
        assert exact_b2(*problem, box) <= lowest + 1e-9


@given(problems, boxes)
def test_angular_bound_agrees_with_its_definition(problem, box):
    space = Rotation3D(*problem)
    caps, moved = np.empty((space.n_source, space.n_target)), space.matrix(box.centre)
    angle = kernels.box_angle(box.centre, vertices_of(box))
    clouds = space.clouds
    cap_costs(moved @ clouds.source, angle, clouds.target, clouds.infeasibility_penalty, caps)
    assert cheapest_pairs(caps, problem[2])[0] == pytest.approx(exact_b1(*problem, box), abs=1e-7)


@settings(max_examples=30)
@given(problems, small_boxes)
def test_lifted_bound_decides_like_its_exact_vertices(problem, box):
    """Lazily solved vertices reach any cutoff that B2 reaches and none that it does not."""
    vertices = vertices_of(box)
    if (vertices @ vertices.T).min() <= 0.0:
        return
    exact = exact_b2(*problem, box)
    space = Rotation3D(*problem)
    centre = np.empty((space.n_source, space.n_target))
    kernels.pair_costs(space.matrix(box.centre), space.clouds, centre)
    duals = cheapest_pairs(centre, problem[2])[2]
    for cutoff in (exact - 1e-7, exact + 1e-7):
        value, _ = kernels.vertex_bound(vertices, space.clouds, duals, -np.inf, cutoff)
        assert (value >= cutoff) == (exact >= cutoff)
        assert value <= exact + 1e-9


@given(boxes)
def test_box_angle_covers_every_rotation_of_the_box(box):
    vertices = vertices_of(box)
    angle = kernels.box_angle(box.centre, vertices)
    centre = rotation_of(box.centre)
    angles = [(rotation_of(q) * centre.inv()).magnitude() for q in thetas_in(box, 200)]
    assert max(angles) <= angle + 1e-7
    assert max(angles) == pytest.approx(angle, abs=1e-6)  # attained: a vertex is among them


@given(problems, boxes, st.sampled_from([1.0, -1.0, 2.5, -0.1]))
def test_length_and_sign_of_a_quaternion_do_not_matter(problem, box, factor):
    model, theta = Rotation3D(*problem), box.centre
    expected = rotation_of(theta).as_matrix()
    np.testing.assert_allclose(model.matrix(factor * theta), expected, atol=1e-12)
    assert model.objective(factor * theta)[0] == pytest.approx(model.objective(theta)[0], abs=1e-9)


def test_roots_and_their_children_hold_every_rotation(rng):
    boxes = Boxes.of(Rotation3D.roots())
    for _ in range(6):
        boxes = LongestEdge(np.ones(4))(boxes)
    assert len(boxes) == 4 * 64
    for q in Rotation.random(500, random_state=1).as_quat(scalar_first=True):
        theta = q / q[np.argmax(np.abs(q))]
        assert ((boxes.lower <= theta) & (theta <= boxes.upper)).all(axis=1).any()


def test_bound_is_second_order_at_the_optimum(rng):
    """It loses at most delta^2 sum |a|^2, delta the half-diagonal angle; B1 alone loses more.

    A vertex of B2 lies by the factor 1 / cos(delta) outside the rotations at most, which changes E
    by about delta^2 / 2 times twice the matched products of lengths.
    """
    source = rng.standard_normal((12, 3))
    target = source + 0.05 * rng.standard_normal((12, 3))
    problem = (source, target, 12)
    theta, value, _ = Rotation3D(*problem).refine(np.array([1.0, 0.0, 0.0, 0.0]))
    width = np.array([0.0, 1.0, 1.0, 1.0])
    for half in (0.02, 0.01, 0.005, 0.0025):
        box = Box(theta - half * width, theta + half * width)
        delta = kernels.box_angle(theta, vertices_of(box))
        cutoff = value - 1.05 * delta**2 * (source**2).sum()
        assert lower_bound(RotationBound(Rotation3D(*problem)), box, cutoff) >= cutoff
    assert exact_b1(*problem, box) < cutoff
