"""Poses over matches judged by the surfaces of the clouds too."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import dcreg
from dcreg.families.matches.surfaces import Surfaces, normals_of

REACH = 0.1
NONE = np.empty((0, 3))


def room(n, seed):
    """Points of a floor, two walls of different lengths, a crate and a ball, without noise."""
    rng = np.random.default_rng(seed)
    u = rng.random((n, 2))
    which = rng.integers(5, size=n)
    zero = np.zeros(n)
    floor = np.column_stack([3.0 * u[:, 0], 2.0 * u[:, 1], zero])
    wall = np.column_stack([3.0 * u[:, 0], zero, 1.5 * u[:, 1]])
    side = np.column_stack([zero, 2.0 * u[:, 0], 1.5 * u[:, 1]])
    crate = np.column_stack([0.7 * u[:, 0] + 1.2, np.full(n, 1.2), 0.6 * u[:, 1]])
    ball = rng.standard_normal((n, 3))
    ball = np.array([2.4, 1.5, 0.35]) + 0.35 * ball / np.linalg.norm(ball, axis=1, keepdims=True)
    return np.choose(which[:, None], [floor, wall, side, crate, ball])


def pose(seed):
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    T[:3, 3] = np.random.default_rng(seed).uniform(-2, 2, 3)
    return T


@pytest.fixture(scope="module")
def scene():
    """Two views of a room, and matches: a few right ones, more that agree on a wrong pose, and noise."""
    rng = np.random.default_rng(5)
    source, T, wrong = room(2500, 0), pose(1), pose(2)
    target = room(2500, 7)
    target = target[target[:, 0] > 0.8] @ T[:3, :3].T + T[:3, 3]
    target += 0.005 * rng.standard_normal(target.shape)
    distances, nearest = nearest_after(source, target, T)
    right = rng.permutation(np.flatnonzero(distances < 0.05))[:25]
    liars = rng.permutation(len(source))[:40]
    lies = len(target) + np.arange(40)
    target = np.concatenate([target, source[liars] @ wrong[:3, :3].T + wrong[:3, 3]])
    chance = rng.integers(len(source), size=300), rng.integers(len(target), size=300)
    matches = (right, nearest[right]), (liars, lies), chance
    pairs = np.concatenate([np.column_stack(rows) for rows in matches])
    return source, target, pairs, T, wrong


@pytest.fixture(scope="module")
def found(scene):
    source, target, pairs, *_ = scene
    return dcreg.register_matches(source, target, pairs, inlier_distance=REACH, score="surfaces")


def nearest_after(source, target, T):
    moved = source @ T[:3, :3].T + T[:3, 3]
    apart = np.linalg.norm(moved[:, None] - target[None], axis=-1)
    return apart.min(axis=1), apart.argmin(axis=1)


def error(result, T):
    turned = Rotation.from_matrix(result.rotation @ T[:3, :3].T).magnitude()
    return np.rad2deg(turned), np.linalg.norm(result.translation - T[:3, 3])


def test_surfaces_tell_the_right_pose_where_more_matches_agree_on_a_wrong_one(scene, found):
    source, target, pairs, T, wrong = scene
    by_matches = dcreg.register_matches(source, target, pairs, inlier_distance=REACH, certify=False)
    assert error(by_matches, wrong) < (2.0, 0.1)
    degrees, shift = error(found, T)
    assert degrees < 1.5
    assert shift < 0.05
    assert found.status is dcreg.Status.CONVERGED
    assert found.lower_bound == 0.0
    assert found.score.reached < by_matches.score.reached


def test_the_result_states_the_matches_of_its_pose(scene, found):
    source, target, *_ = scene
    rows, columns = found.assignment.T
    assert len(set(rows)) == len(set(columns)) == found.n_inliers
    residuals = source[rows] @ found.rotation.T + found.translation - target[columns]
    assert found.objective == pytest.approx((residuals**2).sum())
    assert (np.linalg.norm(residuals, axis=1) <= REACH).all()


def test_scores_are_those_of_their_definition():
    source, target = room(300, 1), room(400, 2)
    poses = np.array([np.eye(3, 4), pose(3)[:3], np.eye(3, 4) + [[0, 0, 0, 0.03]] * 3])
    surfaces = Surfaces(source, target, REACH)
    grid = surfaces._grid
    found = surfaces.scores(poses)
    source, target = surfaces._points, grid.points  # the same in another order
    normals, others = normals_of(source, source), normals_of(target, target)
    for at, T in enumerate(poses):
        moved = source @ T[:, :3].T + T[:, 3]
        cells = np.floor((moved - grid.origin) / grid.cell).astype(int)
        inside = ((cells >= 0) & (cells < grid.nearest.shape)).all(axis=1)
        total = 0.0
        for i in np.flatnonzero(inside):
            centre = grid.origin + (cells[i] + 0.5) * grid.cell
            j = int(((target - centre) ** 2).sum(axis=1).argmin())
            near = 1.0 - ((moved[i] - target[j]) ** 2).sum() / REACH**2
            along = others[j] @ T[:, :3] @ normals[i]
            total += max(0.0, near) * max(0.0, 2.0 * along**2 - 1.0)
        assert found[at] == pytest.approx(total, rel=1e-9, abs=1e-9)
    assert found[0] > 5.0 * found[1]


def test_a_descent_brings_surfaces_together():
    source = room(2000, 1)
    near = np.eye(4)
    near[:3, :3] = Rotation.from_rotvec([0.0, 0.0, 0.05]).as_matrix()
    near[:3, 3] = [0.05, -0.04, 0.03]
    surfaces = Surfaces(source, room(2000, 2), REACH)
    end = surfaces.descend(near[:3], NONE, NONE)
    assert np.abs(end - np.eye(3, 4)).max() < 0.02
    scores = surfaces.scores(np.array([near[:3], end]))
    assert scores[1] > scores[0]
    far = near[:3] + [[0, 0, 0, 50.0]] * 3
    np.testing.assert_array_equal(surfaces.descend(far, NONE, NONE), far)


def test_matches_hold_a_pose_that_surfaces_alone_leave_free():
    rng = np.random.default_rng(3)
    floor, other = (np.column_stack([rng.uniform(0, 3, (2000, 2)), np.zeros(2000)]) for _ in "ab")
    surfaces = Surfaces(floor, other, REACH)
    shifted = np.eye(3, 4)
    shifted[:2, 3] = 0.12, -0.08
    matched = floor[:20]
    with_matches = surfaces.descend(shifted, matched, matched)
    assert np.abs(with_matches - np.eye(3, 4)).max() < 0.03
    alone = surfaces.descend(shifted, NONE, NONE)
    assert np.abs(alone - np.eye(3, 4)).max() > 0.06
    wrong = matched + np.array([0.0, 0.0, 5.0])  # beyond the reach: no effect
    np.testing.assert_array_equal(surfaces.descend(shifted, matched, wrong), alone)


def test_normals_of_a_plane():
    points = np.column_stack([np.random.default_rng(0).random((50, 2)), np.full(50, 2.0)])
    assert np.abs(normals_of(points, points)[:, 2]) == pytest.approx(np.ones(50))


def test_few_points_without_agreement_still_give_a_pose():
    rng = np.random.default_rng(0)
    source, target = rng.random((4, 3)), 10.0 * rng.random((4, 3))
    rows = np.column_stack([np.arange(4)] * 2)
    found = dcreg.register_matches(source, target, rows, inlier_distance=1e-3, score="surfaces")
    assert np.isfinite(found.T_target_source).all()
    assert found.warnings


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"score": "surface"}, "score: 'surface' is unknown.*surfaces"),
        ({"score": "surfaces", "certify": True}, "certify: bounds refer to the cost of matches"),
    ],
)
def test_impossible_options_are_refused(options, message):
    points, rows = np.random.default_rng(0).random((8, 3)), np.column_stack([np.arange(8)] * 2)
    with pytest.raises(dcreg.InputError, match=message):
        dcreg.register_matches(points, points, rows, inlier_distance=0.1, **options)


def test_an_outlier_does_not_blur_the_grid():
    source, target = room(2000, 1), room(2000, 2)
    alone = Surfaces(source, target, REACH).scores(np.eye(3, 4)[None])
    with_outlier = Surfaces(source, np.vstack([target, [[500.0, 0.0, 0.0]]]), REACH)
    assert with_outlier.scores(np.eye(3, 4)[None]) == pytest.approx(alone, rel=0.03)


def test_a_sample_of_the_source_has_the_normals_of_all_points(monkeypatch):
    cloud = room(3000, 1)
    whole = Surfaces(cloud, cloud, REACH).scores(np.eye(3, 4)[None])[0] / 3000
    monkeypatch.setattr("dcreg.families.matches.surfaces.MAX_SOURCE", 300)
    some = Surfaces(cloud, cloud, REACH).scores(np.eye(3, 4)[None])[0] / 300
    assert some == pytest.approx(whole, abs=0.03)
