"""The covariance of a pose, and the directions that clouds leave open, against independent references."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

import dcreg
from data import registry
from dcreg.problem import apply_pose
from dcreg.problem.geometry import fit_pose
from dcreg.problem.uncertainty import (
    LEAST_POINTS,
    OPEN,
    open_directions,
    pose_covariance,
)


def hat(xi: np.ndarray, d: int) -> np.ndarray:
    """The matrix whose exponential is the motion xi: rotation, translation, logarithm of the scale."""
    out = np.zeros((d + 1, d + 1))
    if d == 2:
        out[:2, :2] = [[xi[3], -xi[0]], [xi[0], xi[3]]]
        out[:2, 2] = xi[1:3]
        return out
    x, y, z = xi[:3]
    out[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    out[:3, 3] = xi[3:6]
    out[:3, :3] += (xi[6] if len(xi) > 6 else 0.0) * np.eye(3)
    return out


def random_rotation(rng: np.random.Generator, d: int) -> np.ndarray:
    if d == 3:
        return Rotation.random(random_state=rng).as_matrix()
    angle = rng.uniform(-np.pi, np.pi)
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


def random_pose(rng: np.random.Generator, d: int) -> np.ndarray:
    pose = np.eye(d + 1)
    pose[:d, :d] = random_rotation(rng, d) * (rng.uniform(0.5, 1.5) if d == 2 else 1.0)
    pose[:d, d] = rng.standard_normal(d)
    return pose


@given(st.integers(0, 2**32 - 1), st.sampled_from([(2, True), (3, True), (3, False)]))
def test_covariance_follows_from_the_curvature_of_the_objective(seed, kind):
    d, has_scale = kind
    rng = np.random.default_rng(seed)
    source, pose = rng.standard_normal((12, d)), random_pose(rng, d)
    target = apply_pose(pose, source) + 0.1 * rng.standard_normal((12, d))
    p = 6 + has_scale if d == 3 else 4
    columns = []
    for step in 1e-6 * np.eye(p):
        ends = [
            apply_pose(pose @ expm(hat(sign * step, d)), source) - target for sign in (1.0, -1.0)
        ]
        columns.append((ends[0] - ends[1]).ravel() / 2e-6)
    jacobian = np.array(columns).T
    variance = ((apply_pose(pose, source) - target) ** 2).sum() / (12 * d - p)
    expected = variance * np.linalg.inv(jacobian.T @ jacobian)
    found = pose_covariance(pose, source, target, has_scale=has_scale)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-9 * variance)


def fitted(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The pose of least squares and its pairs, from the identity: assignments and fits in turns."""
    d, last = source.shape[1], None
    pose = np.eye(d + 1)
    while True:
        columns = linear_sum_assignment(cdist(apply_pose(pose, source), target) ** 2)[1]
        if last is not None and (columns == last).all():
            return pose, columns
        last, matched = columns, target[columns]
        x, y = source - source.mean(axis=0), matched - matched.mean(axis=0)
        u, s, vt = np.linalg.svd(y.T @ x)
        signs = np.ones(d)
        signs[-1] = np.sign(np.linalg.det(u @ vt))
        pose = np.eye(d + 1)
        pose[:d, :d] = (u * signs) @ vt * ((s * signs).sum() / (x**2).sum() if d == 2 else 1.0)
        pose[:d, d] = matched.mean(axis=0) - pose[:d, :d] @ source.mean(axis=0)


def normalised(name: str, n: int = 60) -> np.ndarray:
    """A shape, or points in a ball, with the longest side 1."""
    if name.startswith("normal"):
        points = np.random.default_rng(3).standard_normal((n, int(name[-2])))
    else:
        source = registry.dataset("embedded" if name in ("fish", "pony") else name)
        points = source.points(name if name in ("fish", "pony") else source.shapes()[0], n)
    return (points - points.mean(axis=0)) / np.ptp(points, axis=0).max()


def twists(poses: np.ndarray) -> np.ndarray:
    """Small motions on the right of poses: rotation, translation, logarithm of the scale."""
    d = poses.shape[1] - 1
    linear, shift = poses[:, :d, :d], poses[:, :d, d]
    scale = np.linalg.det(linear) ** (1.0 / d)
    if d == 3:
        turn = Rotation.from_matrix(linear / scale[:, None, None]).as_rotvec()
    else:
        turn = np.arctan2(linear[:, 1, 0], linear[:, 0, 0])[:, None]
    moved = np.linalg.solve(linear, shift[:, :, None])[:, :, 0]
    return np.column_stack([turn, moved, np.log(scale)])


def assert_within_a_fifth(stated: np.ndarray, drawn: np.ndarray) -> None:
    """In every direction, the standard deviations differ by less than 20 %."""
    free = np.diag(stated) > 0
    whitened = np.linalg.solve(np.linalg.cholesky(stated[np.ix_(free, free)]), drawn[:, free].T)
    ratios = np.linalg.eigvalsh(np.atleast_2d(np.cov(whitened)))
    assert 0.8**2 < ratios[0] <= ratios[-1] < 1.2**2, np.sqrt(ratios)


@pytest.mark.parametrize("noise", [0.01, 0.03])
@pytest.mark.parametrize(
    ("shape", "has_scale"),
    [
        ("fish", True),
        ("fish", False),
        ("normal 2D", True),
        ("pony", False),
        ("bunny", False),
        ("horse", True),
        ("normal 3D", False),
    ],
)
def test_covariance_is_within_a_fifth_of_monte_carlo_in_every_direction(shape, has_scale, noise):
    rng, source = np.random.default_rng(5), normalised(shape)
    d = source.shape[1]
    targets = source + noise * rng.standard_normal((2000, *source.shape))
    scales = (0.1, 10.0) if has_scale else (1.0, 1.0)
    poses = fit_pose(np.broadcast_to(source, targets.shape), targets, scales)
    stated = [
        pose_covariance(pose, source, target, has_scale=has_scale)
        for pose, target in zip(poses[:200], targets[:200], strict=True)
    ]
    drawn = twists(poses)[:, : None if has_scale or d == 2 else -1]
    assert_within_a_fifth(np.mean(stated, axis=0), drawn)


@pytest.mark.parametrize("shape", ["fish", "pony"])
def test_covariance_holds_for_pairs_that_are_found(shape):
    rng, source, drawn, stated = np.random.default_rng(5), normalised(shape), [], []
    d = source.shape[1]
    for _ in range(300):
        target = source + 0.03 * rng.standard_normal(source.shape)
        pose, columns = fitted(source, target)
        stated.append(pose_covariance(pose, source, target[columns], has_scale=d == 2))
        drawn.append(pose)
    assert_within_a_fifth(np.mean(stated, axis=0), twists(np.array(drawn))[:, : 6 if d == 3 else 4])


RANGES = [
    ("bunny", {"axis": (0.2, -0.4, 1.0)}, 4),
    ("bunny", {"max_angle": 0.0}, 3),
    ("bunny", {"axis": (1.0, 0.0, 0.0), "max_translation": 0.0}, 1),
    ("bunny", {"max_translation": 0.0}, 3),
    ("bunny", {"max_angle": 60.0, "max_translation": 9.0}, 6),
    ("fish", {"max_angle": 0.0}, 3),
    ("fish", {"max_translation": 0.0}, 2),
]


@pytest.mark.parametrize(("shape", "limits", "rank"), RANGES)
def test_covariance_in_a_range_is_that_of_its_free_directions(shape, limits, rank):
    """Poses of the range, fitted to draws of the noise, vary in the stated directions only."""
    rng, source = np.random.default_rng(8), normalised(shape)
    d, noise = source.shape[1], 0.01
    truth = np.eye(d + 1)
    truth[:d, :d], truth[:d, d] = random_rotation(rng, d), rng.standard_normal(d)
    pose_range = dcreg.PoseRange(**limits, around=truth).checked(source, (0.5, 2.0))
    scales = (0.5, 2.0) if d == 2 else (1.0, 1.0)
    targets = apply_pose(truth, source) + noise * rng.standard_normal((400, *source.shape))
    poses = np.array([pose_range.fit(source, target, scales) for target in targets])
    stated = np.mean(
        [
            pose_covariance(pose, source, target, has_scale=d == 2, pose_range=pose_range)
            for pose, target in zip(poses[:100], targets[:100], strict=True)
        ],
        axis=0,
    )
    drawn = twists(np.linalg.inv(truth) @ poses)[:, : 4 if d == 2 else 6]
    size, axes = np.linalg.eigh(stated)
    assert (size > 1e-9 * size[-1]).sum() == rank
    assert np.abs(drawn @ axes[:, :-rank]).max(initial=0.0) < 1e-3 * noise
    assert_within_a_fifth(np.diag(size[-rank:]), drawn @ axes[:, -rank:])


def test_a_pose_at_a_limit_of_its_range_has_no_covariance(rng):
    source = rng.random((20, 3))
    target = source + [0.3, 0.0, 0.0] + 0.01 * rng.standard_normal((20, 3))
    for limits in ({"max_translation": 0.1}, {"max_angle": 0.01, "axis": (0, 0, 1)}):
        given = dcreg.PoseRange(**limits)
        found = dcreg.register(source, target, n_inliers=20, model="rigid3d", pose_range=given)
        assert found.covariance is None
    wide = dcreg.PoseRange(max_translation=0.5)
    found = dcreg.register(source, target, n_inliers=20, model="rigid3d", pose_range=wide)
    assert np.linalg.matrix_rank(found.covariance) == 6


def test_a_fixed_scale_has_no_variance(rng):
    source = rng.random((20, 2))
    target = source + 0.01 * rng.standard_normal((20, 2))
    found = pose_covariance(np.eye(3), source, target)
    assert not found[3].any()
    assert not found[:, 3].any()
    assert np.linalg.eigvalsh(found[:3, :3]).min() > 0


def test_pairs_that_determine_no_pose_have_no_covariance(rng):
    on_a_line = np.outer(rng.random(10), [1.0, 2.0, 3.0])
    noisy = on_a_line + 0.1 * rng.standard_normal((10, 3))
    assert pose_covariance(np.eye(4), on_a_line, noisy) is None
    two = rng.random((2, 3))
    assert pose_covariance(np.eye(4), two, two) is None  # as many equations as unknowns
    same = np.ones((5, 3))
    assert pose_covariance(np.eye(4), same, noisy[:5]) is None


@pytest.mark.parametrize("d", [2, 3])
def test_covariance_far_from_the_origin_keeps_its_digits(d, rng):
    source, offset = rng.random((30, d)), 5e5
    target = source + 0.01 * rng.standard_normal((30, d))
    near = pose_covariance(np.eye(d + 1), source, target, has_scale=True)
    far = pose_covariance(np.eye(d + 1), source + offset, target + offset, has_scale=True)
    # a twist about the shifted origin moves the points like the one about the old origin
    moved = np.eye(len(near))
    for at, step in enumerate(np.eye(len(near))):
        speed = hat(step, d) @ np.append(np.full(d, -offset), 1.0)
        moved[slice(3, 6) if d == 3 else slice(1, 3), at] = speed[:d]
    expected = moved @ near @ moved.T
    size = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        far / np.outer(size, size), expected / np.outer(size, size), atol=1e-6
    )


# --- open directions ------------------------------------------------------------------------------


def plane(rng, n):
    return np.column_stack([rng.random((n, 2)), np.zeros(n)])


def cylinder(rng, n):
    angle = 2 * np.pi * rng.random(n)
    return np.column_stack([0.3 * np.cos(angle), 0.3 * np.sin(angle), 1.5 * rng.random(n)])


def sphere(rng, n):
    points = rng.standard_normal((n, 3))
    return points / np.linalg.norm(points, axis=1)[:, None]


def line(rng, n):
    return np.column_stack([rng.random(n), np.zeros((n, 2))])


def line_2d(rng, n):
    return line(rng, n)[:, :2]


def circle(rng, n):
    return cylinder(rng, n)[:, :2]


def box(rng, n):
    points, axes = rng.random((n, 3)), rng.integers(0, 3, n)
    points[np.arange(n), axes] = rng.integers(0, 2, n)
    return points


def volume(rng, n):
    return rng.random((n, 3))


def two(shape, rng, n=2000):
    clouds = [shape(rng, n) for _ in range(2)]
    return [points + 0.003 * rng.standard_normal(points.shape) for points in clouds]


@pytest.mark.parametrize(
    ("shape", "count"),
    [
        (plane, 3),
        (cylinder, 2),
        (sphere, 3),
        (line, 1),
        (line_2d, 1),
        (circle, 1),
        (box, 0),
        (volume, 0),
    ],
)
def test_directions_in_which_shapes_slide(shape, count, rng):
    moved, target = two(shape, rng)
    found = open_directions(moved, target)
    assert len(found) == count
    assert all(0.0 <= each.rise < OPEN for each in found)
    assert [each.rise for each in found] == sorted(each.rise for each in found)


def test_motions_are_those_of_the_shape(rng):
    (slide,) = open_directions(*two(line, rng))
    assert abs(slide.translation[0]) == pytest.approx(1.0, abs=0.02)
    about, along = sorted(
        open_directions(*two(cylinder, rng)), key=lambda each: abs(each.translation[2])
    )
    assert abs(along.translation[2]) > 0.8  # the two may be mixed
    assert abs(about.rotation[2]) > 0.95 * np.linalg.norm(about.rotation)
    for each in open_directions(*two(plane, rng)):
        assert abs(each.translation[2]) < 0.05
        assert np.linalg.norm(each.rotation[:2]) < 0.1


@pytest.mark.parametrize("shape", ["pony", "saurian"])
@pytest.mark.parametrize("n", [200, 400])
def test_shapes_of_animals_do_not_slide(shape, n):
    points = registry.dataset("embedded").points(shape, 2 * n)
    order = np.random.default_rng(1).permutation(2 * n)
    assert open_directions(points[order[:n]], points[order[n:]]) == []


def ring(rng, n):
    return np.column_stack([circle(rng, n), np.zeros(n)])


@pytest.mark.parametrize("n", [20, 50, 100, 199])
@pytest.mark.parametrize(
    ("shape", "count"),
    [(plane, 3), (cylinder, 2), (sphere, 3), (line, 1), (line_2d, 1), (circle, 1), (ring, 1)],
)
def test_few_points_of_surfaces_slide(shape, count, n):
    """All motions from 30 points on; with fewer, at least one in nearly all draws."""
    found = [
        len(open_directions(*two(shape, np.random.default_rng([n, seed]), n))) for seed in range(6)
    ]
    assert sum(number == count for number in found) >= (3 if n < 30 else 5)
    assert sum(number > 0 for number in found) >= 5


@pytest.mark.parametrize("n", [LEAST_POINTS, 20, 50, 199])
@pytest.mark.parametrize(
    "shape", [box, volume, "bunny", "horse", "pony", "fish", "normal 2D", "normal 3D"]
)
def test_few_points_of_other_shapes_do_not_slide(shape, n):
    for seed in range(4):
        rng = np.random.default_rng([n, seed])
        if callable(shape):
            one, other = two(shape, rng, n)
        else:
            points = rng.permutation(normalised(shape, 100 if shape == "fish" else 2 * n))
            half = len(points) // 2
            one, other = points[:half][:n], points[half:][:n]
        assert open_directions(one, other) == []


def test_motions_of_few_points_keep_their_surface(rng):
    (turn,) = open_directions(*two(circle, rng, 60))
    assert turn.translation == pytest.approx([0.0, 0.0], abs=0.1 * abs(turn.rotation[0]))
    assert turn.rotation[0] ** 2 == pytest.approx(
        1.0 / 0.09, rel=0.05
    )  # RMS displacement of one unit
    about, along = sorted(
        open_directions(*two(cylinder, rng, 60)), key=lambda each: abs(each.translation[2])
    )
    assert abs(along.translation[2]) == pytest.approx(1.0, abs=0.02)
    assert abs(about.rotation[2]) > 0.99 * np.linalg.norm(about.rotation)
    slides = open_directions(*two(line_2d, rng, 60), has_scale=True)
    assert sorted(each.scale > 0.0 for each in slides) == [False, True]


def test_what_cannot_be_told_is_not_reported(rng):
    moved, target = two(plane, rng, LEAST_POINTS - 1)
    assert open_directions(moved, target) == []
    for n in (100, 500):
        same = plane(rng, n)
        assert open_directions(same, same) == []
    assert open_directions(np.ones((300, 3)), np.ones((300, 3))) == []


def test_open_directions_do_not_depend_on_how_neighbours_are_found(rng, monkeypatch):
    moved, target = two(cylinder, rng)
    found = open_directions(moved, target)
    monkeypatch.setattr("dcreg.problem.uncertainty._DENSE", 0)
    for one, other in zip(found, open_directions(moved, target), strict=True):
        assert one.rise == pytest.approx(other.rise, rel=1e-9)


# --- in results -----------------------------------------------------------------------------------


def test_a_result_states_both(rng):
    source, target = two(plane, rng, 250)
    result = dcreg.register(source, target, n_inliers=250, model="rigid3d", time_limit=3)
    assert result.covariance.shape == (6, 6)
    assert len(result.open_directions) == 3
    stated = result.to_dict()
    assert len(stated["covariance"]) == 6
    assert set(stated["open_directions"][0]) == {"rotation", "translation", "scale", "rise"}
    assert dict(result.entries())["open directions"].startswith("3; ")
    assert [line for line in result.warnings if "the clouds can slide along 3 directions" in line]


@pytest.mark.parametrize(("shape", "n_open"), [(plane, 3), (cylinder, 2), (box, 0), (volume, 0)])
def test_registration_over_matches_warns_if_the_clouds_can_slide(shape, n_open, rng):
    source, target = two(shape, rng, 1000)
    target[:30] = source[:30]  # matches that determine the pose
    pairs = np.column_stack([np.arange(30)] * 2)
    found = dcreg.register_matches(source, target, pairs, inlier_distance=0.1, certify=False)
    assert found.n_inliers == 30
    assert len(found.open_directions) == n_open
    assert any("the clouds can slide" in line for line in found.warnings) == bool(n_open)


def test_matches_on_one_face_do_not_leave_a_box_open(rng):
    source, target = two(box, rng)
    (on_top,) = np.nonzero((source[:, 2] > 0.99) & (np.abs(source[:, :2] - 0.5) < 0.4).all(axis=1))
    nearest = np.linalg.norm(source[on_top, None] - target, axis=2).argmin(axis=1)
    pairs = np.column_stack([on_top, nearest])
    found = dcreg.register_matches(source, target, pairs, inlier_distance=0.1, certify=False)
    matched = source[found.assignment[:, 0]]
    assert len(open_directions(matched, target)) > 0 == len(found.open_directions)


def test_a_range_of_poses_has_a_covariance(rng):
    source, target = two(plane, rng, 250)
    pose_range = dcreg.PoseRange(axis=(0, 0, 1), max_angle=5.0)
    result = dcreg.register(
        source, target, n_inliers=250, model="rigid3d", pose_range=pose_range, node_limit=1
    )
    covariance = result.covariance
    assert np.linalg.matrix_rank(covariance) == 4
    # rotations about x and y
    assert np.abs(covariance[:2]).max() < 1e-12 * np.abs(covariance).max()
    assert result.to_dict()["open_directions"] is None
    assert "uncertainty" in dict(result.entries())


def test_matches_and_similarities_have_a_covariance(rng):
    source = rng.random((30, 3))
    target = source + 0.01 * rng.standard_normal((30, 3))
    pairs = np.column_stack([np.arange(30)] * 2)
    over_matches = dcreg.register_matches(source, target, pairs, inlier_distance=0.1, certify=False)
    assert over_matches.covariance.shape == (6, 6)
    free, fixed = (
        dcreg.register(
            source[:, :2], target[:, :2], n_inliers=30, model="similarity2d", scale_range=scales
        )
        for scales in ((0.5, 1.5), (1.0, 1.0))
    )
    assert free.covariance[3, 3] > 0.0 == fixed.covariance[3, 3]
