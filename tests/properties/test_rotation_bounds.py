"""Bounds over boxes of rotations: below the objective, exact at a point, of second order."""

from itertools import combinations_with_replacement

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from dcreg.assignment.kernels.dense import cheapest_pairs
from dcreg.families.rotation3d.bound import RotationBound
from dcreg.families.rotation3d.kernels import rotation as kernels
from dcreg.families.rotation3d.kernels.caps import cap_costs
from dcreg.families.rotation3d.space import Rotation3D
from dcreg.search import Box, Boxes, LongestEdge
from tests.problems import KINDS, cloud


def rotation_of(theta):
    return Rotation.from_quat(theta, scalar_first=True)


def exact_assignment(cost, k):
    """A second solver: SciPy on the padded square."""
    n, m = cost.shape
    padded = np.zeros((n + m - k, n + m - k))
    padded[:n, :m] = cost
    padded[n:, m:] = 1e3 * (1.0 + np.abs(cost).max())
    rows, columns = linear_sum_assignment(padded)
    return padded[rows, columns].sum()


def objective(source, target, k, theta):
    moved = rotation_of(theta).apply(source)
    return exact_assignment(((moved[:, None] - target[None]) ** 2).sum(axis=-1), k)


def exact_b1(source, target, k, box):
    """B1 from its definition, with angles."""
    centre = rotation_of(box.centre)
    reach = max((rotation_of(v) * centre.inv()).magnitude() for v in box.vertices())
    moved = centre.apply(source)
    a, y = np.linalg.norm(source, axis=1), np.linalg.norm(target, axis=1)
    products = np.maximum(a[:, None] * y, 1e-300)
    between = np.arccos(np.clip(moved @ target.T / products, -1.0, 1.0))
    cost = (a**2)[:, None] + y**2 - 2.0 * a[:, None] * y * np.cos(np.maximum(0, between - reach))
    return exact_assignment(cost, k)


def exact_b2(source, target, k, box):
    """B2 from its definition: every pair of corners, each assignment solved."""
    squares = (source**2).sum(axis=1)[:, None] + (target**2).sum(axis=1)
    values = []
    for q, r in combinations_with_replacement(box.vertices(), 2):
        B = (np.outer(q, r) + np.outer(r, q)) / (2.0 * q @ r)
        # R is linear in q q^T: a weighted sum of the rotations of the eigenvectors
        weights, vectors = np.linalg.eigh(B)
        M = sum(w * rotation_of(v).as_matrix() for w, v in zip(weights, vectors.T, strict=True))
        values.append(exact_assignment(squares - 2.0 * (source @ M.T) @ target.T, k))
    return min(values)


@st.composite
def problems(draw, max_points=6):
    generator = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    n, m = draw(st.integers(1, max_points)), draw(st.integers(1, max_points))
    kind = draw(st.sampled_from([*KINDS, "with origin"]))
    source, target = cloud(generator, n, 3, kind), cloud(generator, m, 3, kind)
    if kind == "noisy copy":
        both = min(n, m)
        target[:both] = source[:both] + 0.05 * generator.standard_normal((both, 3))
    if kind == "with origin":
        source[0] = target[-1] = 0.0
    return source, target, draw(st.integers(1, min(n, m)))


@st.composite
def facet_boxes(draw, halves=(1.0, 0.5, 0.1, 0.01)):
    """A box inside one of the four root facets, of any place and size, perhaps flat."""
    generator = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    root = draw(st.sampled_from(Rotation3D.roots()))
    centre = generator.uniform(-1.0, 1.0, 4)
    half = draw(st.sampled_from(halves)) * generator.uniform(0.2, 1.0, 4)
    half[generator.random(4) < 0.1] = 0.0
    return Box(
        np.clip(centre - half, root.lower, root.upper),
        np.clip(centre + half, root.lower, root.upper),
    )


def corners_of(box):
    corners = np.empty((16, 4))
    return corners[: kernels.box_corners(box.lower, box.upper, corners)]


def evaluate(problem, box, cutoff=np.inf):
    return RotationBound(Rotation3D(*problem)).evaluate(Boxes.of([box]), cutoff)


def rotations_in(box, count=40):
    return np.concatenate([box.sample(np.random.default_rng(0), count), box.vertices()])


@given(problems(), facet_boxes(), st.sampled_from([0.0, 0.5, 0.95, 1.5, np.inf]))
def test_bound_is_below_the_objective_anywhere_in_the_box(problem, box, tightness):
    lowest = min(objective(*problem, theta) for theta in rotations_in(box))
    cutoff = tightness * lowest if tightness < np.inf else np.inf
    bound = evaluate(problem, box, cutoff).lower_bounds[0]
    assert 0.0 <= bound <= lowest + 1e-9


@given(problems(), facet_boxes(halves=(0.3, 0.1, 0.01)))
def test_each_bound_alone_is_below_the_objective(problem, box):
    lowest = min(objective(*problem, theta) for theta in rotations_in(box))
    assert exact_b1(*problem, box) <= lowest + 1e-9
    if (box.vertices() @ box.vertices().T).min() > 0.0:
        assert exact_b2(*problem, box) <= lowest + 1e-9


@given(problems(), facet_boxes())
def test_angular_bound_agrees_with_its_definition(problem, box):
    space = Rotation3D(*problem)
    caps, moved = np.empty((space.n_source, space.n_target)), space.matrix(box.centre)
    angle = kernels.box_angle(box.centre, corners_of(box))
    clouds = space.clouds
    cap_costs(moved @ clouds.source, angle, clouds.target, clouds.infeasibility_penalty, caps)
    assert cheapest_pairs(caps, problem[2])[0] == pytest.approx(exact_b1(*problem, box), abs=1e-7)


@given(problems(), facet_boxes(halves=(0.3, 0.1, 0.01)))
def test_lifted_bound_decides_like_its_exact_vertices(problem, box):
    """Lazily solved vertices reach any cutoff that B2 reaches and none that it does not."""
    corners = corners_of(box)
    if (corners @ corners.T).min() <= 0.0:
        return
    exact = exact_b2(*problem, box)
    space = Rotation3D(*problem)
    centre = np.empty((space.n_source, space.n_target))
    kernels.pair_costs(space.matrix(box.centre), space.clouds, centre)
    duals = cheapest_pairs(centre, problem[2])[2]
    for cutoff in (exact - 1e-7, exact + 1e-7):
        value, _ = kernels.vertex_bound(corners, space.clouds, duals, -np.inf, cutoff)
        assert (value >= cutoff) == (exact >= cutoff)
        assert value <= exact + 1e-9


@given(facet_boxes())
def test_box_angle_covers_every_rotation_of_the_box(box):
    corners = corners_of(box)
    angle = kernels.box_angle(box.centre, corners)
    centre = rotation_of(box.centre)
    angles = [(rotation_of(q) * centre.inv()).magnitude() for q in rotations_in(box, 200)]
    assert max(angles) <= angle + 1e-7
    assert max(angles) == pytest.approx(angle, abs=1e-6)  # attained: a corner is among them


@given(problems(), facet_boxes())
def test_bound_and_candidate_equal_the_objective_at_one_rotation(problem, box):
    theta = box.centre
    found = evaluate(problem, Box(theta, theta))
    expected = objective(*problem, theta)
    assert found.lower_bounds[0] == pytest.approx(expected, abs=1e-7)
    assert found.values[0] == pytest.approx(expected, abs=1e-7)


@given(problems(), facet_boxes())
def test_candidates_are_upper_bounds_at_the_centre(problem, box):
    found = evaluate(problem, box)
    assert found.values[0] >= objective(*problem, found.thetas[0]) - 1e-9


@given(problems(), facet_boxes(), st.sampled_from([-1.0, 2.5, -0.1]))
def test_length_and_sign_of_a_quaternion_do_not_matter(problem, box, factor):
    model = Rotation3D(*problem)
    theta = box.centre
    np.testing.assert_allclose(model.matrix(factor * theta), model.matrix(theta), atol=1e-12)
    assert model.objective(factor * theta)[0] == pytest.approx(model.objective(theta)[0], abs=1e-9)


@given(facet_boxes())
def test_matrix_agrees_with_scipy(box):
    matrix = Rotation3D.matrix(box.centre)
    np.testing.assert_allclose(matrix, rotation_of(box.centre).as_matrix(), atol=1e-12)


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
        delta = kernels.box_angle(theta, corners_of(box))
        cutoff = value - 1.05 * delta**2 * (source**2).sum()
        assert evaluate(problem, box, cutoff).lower_bounds[0] >= cutoff
    assert exact_b1(*problem, box) < cutoff
