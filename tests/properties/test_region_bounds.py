"""Boxes of poses against a region: tests of boxes are certain, and bounds hold for every pose in them."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import dcreg
from dcreg.families.region import Far, Near, angles
from dcreg.families.rigid3d.region import RegionBound, rigid_in_region
from dcreg.families.similarity2d.region import similarity_in_region
from dcreg.problem import Frame, Moments, Problem, apply_pose
from dcreg.problem.geometry import fit_pose
from dcreg.questions.other_poses import Search
from dcreg.search import Boxes, LongestEdge

seeds = st.integers(0, 10_000)
RANGES = (
    {"max_angle": 40.0},
    {"max_angle": 120.0, "max_translation": 0.5},
    {"axis": (0.0, 1.0, 1.0), "max_angle": 70.0},
    {"axis": (0.0, 0.0, 1.0), "max_translation": 0.3},
    {"max_angle": 0.0, "max_translation": 0.8},
)


def space_of(seed, kind, dim):
    """A small problem's space in a region: a range (its number), or far from two poses."""
    rng = np.random.default_rng(seed)
    n, m = rng.integers(4, 8, 2)
    source, target = rng.standard_normal((n, dim)), rng.standard_normal((m, dim))
    k = int(rng.integers(2, min(n, m) + 1))
    model = "rigid3d" if dim == 3 else "similarity2d"
    pose_range = None
    if kind != "far":
        given_range = {key: v for key, v in RANGES[kind].items() if dim == 3 or key != "axis"}
        pose_range = dcreg.PoseRange(**given_range, pivot=0.5 * rng.standard_normal(dim))
    problem = Problem(source, target, k, model, pose_range=pose_range)
    frame = Frame.of(problem)
    x, y = frame.source(source), frame.target(target)
    if kind == "far":
        region = Far.of([_pose(rng, dim) for _ in range(2)], 0.5, x)
    else:
        region = Near(frame.pose_range(problem.pose_range))
    if dim == 3:
        return rigid_in_region(x, y, k, None, region=region)
    return similarity_in_region(x, y, k, (0.5, 1.5), None, region=region)


def _pose(rng, dim):
    T = np.eye(dim + 1)
    if dim == 3:
        T[:3, :3] = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
    T[:dim, dim] = 0.3 * rng.standard_normal(dim)
    return T


def boxes_of(space, rng, n_divisions):
    """Boxes made by repeated bisection, of random ones each time."""
    boxes, branching = Boxes.of(space.roots()), LongestEdge(space.axis_weights)
    for _ in range(n_divisions):
        boxes = branching(boxes)
        boxes = boxes[np.sort(rng.permutation(len(boxes))[:12])]
    return boxes


def poses_in(boxes, rng, count=20):
    """(B, count, dim) random parameters of the boxes, among them vertices."""
    shares = rng.random((len(boxes), count, boxes.lower.shape[1]))
    shares[:, : count // 4] = np.round(shares[:, : count // 4])
    return boxes.lower[:, None] + shares * (boxes.upper - boxes.lower)[:, None]


cases = pytest.mark.parametrize("dim", [2, 3])
kinds = pytest.mark.parametrize("kind", ["far", *range(len(RANGES))])


@cases
@kinds
@given(seed=seeds)
@settings(deadline=None, max_examples=15)
def test_tests_of_boxes_are_certain(dim, kind, seed):
    space, rng = space_of(seed, kind, dim), np.random.default_rng(seed)
    boxes = boxes_of(space, rng, int(rng.integers(0, 12)))
    about = space.box_poses(boxes.lower, boxes.upper)
    touches, inside = space.region.touches(about), space.region.inside(about)
    for at, thetas in enumerate(poses_in(boxes, rng)):
        found = space.box_poses(thetas, thetas)
        own = space.region.touches(found)
        assert touches[at] or not own.any()
        assert own.all() or not inside[at]
        gaps = np.linalg.norm(found.linear - about.linear[at], ord=2, axis=(1, 2))
        assert (gaps <= about.linear_radius[at] + 1e-9).all()
        shifts = np.linalg.norm(found.shift - about.shift[at], axis=1)
        assert (shifts <= about.shift_radius[at] + 1e-9).all()
        turns = angles(found.linear @ about.linear[at].T)
        assert (turns <= about.angle_radius[at] + 1e-7).all()


@kinds
@given(seed=seeds)
@settings(deadline=None, max_examples=15)
def test_bounds_at_the_limit_hold_for_every_pose(kind, seed):
    space, rng = space_of(seed, kind, 3), np.random.default_rng(seed)
    boxes = boxes_of(space, rng, int(rng.integers(0, 30)))
    outside = ~space.inside(boxes.lower, boxes.upper)
    found = RegionBound(space).evaluate(boxes, None)
    # boxes apart from all stationary poses are bounded for poses at the limit only
    own = space.region.touches(space.box_poses(boxes.lower, boxes.upper))
    for at in np.flatnonzero(outside & own):
        for theta in poses_in(boxes[at : at + 1], rng)[0]:
            if space.admissible(theta[None])[0]:
                value = space.objective(theta)[0]
                assert found.lower_bounds[at] <= value + 1e-9


@cases
@given(seed=seeds)
@settings(deadline=None, max_examples=20)
def test_roots_contain_the_poses_of_a_range(dim, seed):
    rng = np.random.default_rng(seed)
    kind = int(rng.integers(len(RANGES)))
    space = space_of(seed, kind, dim)
    # the best pose of a random matching is a candidate for the optimum
    rows = rng.permutation(space.n_source)[: space.n_inliers]
    columns = rng.permutation(space.n_target)[: space.n_inliers]
    col_of = np.full(space.n_source, -1)
    col_of[rows] = columns
    theta = space.normalised(space.fit_matching(space.roots()[0].centre, col_of))
    assert space.admissible(theta[None])[0]
    assert any(
        (theta >= root.lower - 1e-7).all() and (theta <= root.upper + 1e-7).all()
        for root in space.roots()
    )


@cases
@given(seed=seeds)
@settings(deadline=None, max_examples=30)
def test_roots_contain_the_poses_at_a_distance_from_known_ones(dim, seed):
    space, rng = space_of(seed, "far", dim), np.random.default_rng(seed)
    for T in space.region.poses:
        step, moved = rng.standard_normal(dim), T.copy()
        moved[:dim, dim] += space.region.distance * step / np.linalg.norm(step)
        theta = space.normalised(space.parameter(moved))
        assert any(
            (theta >= root.lower - 1e-7).all() and (theta <= root.upper + 1e-7).all()
            for root in space.roots()
        )


@cases
@given(seed=seeds)
@settings(deadline=None, max_examples=30)
def test_a_pose_near_any_pose_is_in_the_range(dim, seed):
    rng = np.random.default_rng(seed)
    kind = int(rng.integers(len(RANGES)))
    chosen = {key: v for key, v in RANGES[kind].items() if dim == 3 or key != "axis"}
    source = rng.standard_normal((5, dim))
    own = dcreg.PoseRange(**chosen, around=_pose(rng, dim)).checked(source, (1.0, 1.0))
    T = own.nearest(_pose(rng, dim))
    assert own.contains(T)
    assert np.allclose(own.nearest(T), T, atol=1e-9)
    fitted = own.fit(source, apply_pose(_pose(rng, dim), source), (1.0, 1.0))
    assert own.contains(fitted)
    perfect = own.fit(source, apply_pose(T, source), (1.0, 1.0))
    assert np.allclose(perfect, T, atol=1e-7)


@given(seed=seeds, noise=st.floats(0.0, 0.3), turn=st.floats(0.0, 0.6))
def test_the_cost_of_a_matching_grows_with_the_distance_from_its_best_pose(seed, noise, turn):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(3, 12))
    source = rng.standard_normal((n, 3)) * rng.random(3)
    target = source + noise * rng.standard_normal((n, 3))
    best, moved = fit_pose(source, target, (1.0, 1.0)), np.eye(4)
    axis = rng.standard_normal(3)
    moved[:3, :3] = Rotation.from_rotvec(turn * axis / np.linalg.norm(axis)).as_matrix()
    moved[:3, 3] = 0.1 * rng.standard_normal(3)
    moved = moved @ best
    least, cost = (float(((apply_pose(T, source) - target) ** 2).sum()) for T in (best, moved))
    searched = SimpleNamespace(source=source, n_inliers=n, scale_range=(1.0, 1.0))
    asked = SimpleNamespace(
        normalised=searched, setup=SimpleNamespace(frame=SimpleNamespace(area=1.0, unit=1.0)),
        result=SimpleNamespace(lower_bound=least), distance=Moments.of(source).displacement(moved, best),
    )  # fmt: skip
    grown = Search._grown(asked, 1.0, cost)
    assert grown <= cost * (1.0 + 1e-9) + 1e-12
