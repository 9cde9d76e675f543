"""Initial poses from congruent triples, also if many points have no partner or clouds are degenerate."""

import time
from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import dcreg
from dcreg.families import starts
from dcreg.families.kernels import overlap
from dcreg.families.parallel import in_threads, stopped_after
from dcreg.families.rigid3d.space import Rigid3D
from dcreg.families.rigid3d.starts import (
    AGREEING,
    SCALES,
    best_descents,
    congruent_poses,
    is_confirmed,
    rounds_for,
)
from dcreg.problem.geometry import fit_pose
from dcreg.search import Budget


def partial_overlap(seed, n_common=30, n_clutter=30, noise=0.005):
    """Clouds of which half has no partner: next to the shape, on either side."""
    rng = np.random.default_rng(seed)
    shape = rng.standard_normal((n_common, 3)) * [1.0, 0.6, 0.3]
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0.4, 1.9, -0.8]).as_matrix()
    T[:3, 3] = [0.5, -0.3, 0.8]
    target = shape @ T[:3, :3].T + T[:3, 3] + noise * rng.standard_normal((n_common, 3))
    beside = rng.uniform(-0.5, 0.5, (2, n_clutter, 3))
    beside += np.array([[[-2.0, 0.0, 0.0]], [[1.5, 1.0, 0.0]]])
    source, target = np.concatenate([shape, beside[0]]), np.concatenate([target, beside[1]])
    return source, rng.permutation(target), T


def angle(T, truth):
    return Rotation.from_matrix(T[:3, :3] @ truth[:3, :3].T).magnitude()


@pytest.mark.parametrize("seed", range(5))
def test_some_pose_is_near_the_true_one(seed):
    source, target, truth = partial_overlap(seed)
    poses = np.concatenate([congruent_poses(source, target, scale) for scale in SCALES])
    assert all(np.linalg.det(T[:3, :3]) == pytest.approx(1.0) for T in poses)
    assert min(angle(T, truth) for T in poses) < 0.1


@pytest.mark.parametrize("seed", range(5))
def test_default_mode_is_right_on_partial_overlap(seed):
    source, target, truth = partial_overlap(seed)
    result = dcreg.register(source, target, n_inliers=30, model="rigid3d", time_limit=8.0)
    assert angle(result.T_target_source, truth) < 0.05
    assert np.linalg.norm(result.translation - truth[:3, 3]) < 0.05


def test_only_feasible_triples_are_used():
    source, target, truth = partial_overlap(0)
    moved = source @ truth[:3, :3].T + truth[:3, 3]
    near = np.linalg.norm(moved[:, None] - target[None], axis=2) < 0.1
    poses = congruent_poses(source, target, SCALES[0], ~near)
    assert all(angle(T, truth) > 0.02 for T in poses)
    poses = congruent_poses(source, target, SCALES[1], near)
    assert angle(poses[0], truth) < 0.1


rigid_fit = partial(fit_pose, scale_range=(1.0, 1.0))


def test_best_descents_keep_the_right_pose_among_wrong_ones():
    source, target, truth = partial_overlap(1, n_common=200, n_clutter=200)
    wrong = [truth @ _turned(a) for a in (0.8, 1.6, 2.4)]
    nearly = truth @ _turned(0.05)
    (best,) = best_descents(
        np.array([*wrong, nearly]), source, target, 200, count=1, fit_pairs=rigid_fit
    )
    assert angle(best, truth) < 0.02


def test_best_descents_differ():
    """Else three ends near one pose would hide the other poses of a symmetric shape."""
    rng = np.random.default_rng(5)
    box = rng.uniform(-1.0, 1.0, (300, 3)) * [3.0, 2.0, 1.0]
    near = [_turned(by) for by in (0.0, 0.01, 0.02, 0.03)]
    poses = best_descents(
        np.array([*near, _turned(np.pi)]), box, box + 0.01, 250, fit_pairs=rigid_fit
    )
    assert len(poses) == 2
    np.testing.assert_allclose(sorted(angle(T, np.eye(4)) for T in poses), [0.0, np.pi], atol=0.05)


def _turned(by):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0.0, by, 0.0]).as_matrix()
    return T


@pytest.mark.parametrize("kind", ["few", "one place", "line", "plane"])
def test_degenerate_clouds_still_give_an_initial_pose(kind, rng):
    source = rng.standard_normal((8, 3))
    if kind == "few":
        source = source[:2]
    elif kind == "one place":
        source[:] = 1.0
    elif kind == "line":
        source[:, 1:] = 0.0
    else:
        source[:, 2] = 0.0
    target = source[::-1] + 0.5
    k = len(source) - 1
    theta, value, spent = Rigid3D.between(source, target, k).start(Budget())
    assert np.isfinite(theta).all()
    assert value == pytest.approx(0.0, abs=1e-9)
    assert spent >= 1


def test_what_is_within_the_tolerance_ends_the_starts(monkeypatch):
    """No objective is below 0, so the gap is closed; a few more starts may still find a better pose."""
    source, target, _ = partial_overlap(3)
    space = Rigid3D.between(source, target, 30)
    descents = []
    refine = space.refine
    monkeypatch.setattr(space, "refine", lambda theta: descents.append(theta) or refine(theta))
    space.start(Budget(), enough=np.inf)
    assert len(descents) == space.n_descents
    space.start(Budget())
    assert len(descents) > 3 * space.n_descents


def test_triples_leave_half_of_the_time(monkeypatch):
    source, target, _ = partial_overlap(3)
    space = Rigid3D.between(source, target, 30)
    seen = []
    monkeypatch.setattr(
        Rigid3D,
        "_congruent",
        lambda self, seed, budget: seen.append(budget.left()) or [],
    )
    with Budget(100.0) as budget:
        next(iter(space.starts(budget)))
    assert 40.0 < seen[0] <= 50.0


def test_rounds_in_threads_keep_their_order():
    begun = []

    def work(seed):
        begun.append(seed)
        time.sleep(0.01 * (seed % 2 == 0))  # odd ones end first
        return seed

    results = in_threads(work, range(40), 2)
    assert [next(results) for _ in range(6)] == list(range(6))
    results.close()
    assert len(begun) < 40  # the others are cancelled


def test_rounds_grow_with_the_outliers():
    assert rounds_for(100, 100, 100, 1e-9) == AGREEING
    assert (
        rounds_for(100, 100, 100, 1e-9)
        <= rounds_for(100, 100, 50, 1e-9)
        < rounds_for(100, 100, 30, 1e-9)
    )
    assert rounds_for(100, 100, 30, 1e-3) < rounds_for(100, 100, 30, 1e-9)
    assert rounds_for(100, 100, 90, 1e-9) < rounds_for(
        100, 900, 90, 1e-9
    )  # few of them form triples


def _rounds(*rounds):
    """Rounds whose ends are given as a shift of the tetrahedron and an objective."""
    return [[(np.full(12, shift), value) for shift, value in each] for each in rounds]


@pytest.mark.parametrize(
    ("rounds", "confirmed"),
    [
        (_rounds([(0.0, 1.0)]), False),  # one round
        (_rounds([(0.0, 1.0)], [(0.0, 1.05)]), True),
        (_rounds([(0.0, 1.0)], [(0.0, 1.2)]), False),  # the second round found it less well
        (_rounds([(0.0, 1.0)], [(2.0, 2.0)]), False),  # the second round did not find it
        (_rounds([(0.0, 1.0), (2.0, 1.1)], [(0.0, 1.0)]), False),  # an alternative
        (_rounds([(0.0, 1.0), (2.0, 1.5)], [(0.0, 1.0)]), True),
        (_rounds([(0.0, 1.0), (0.3, 1.02)], [(0.0, 1.0)]), True),  # it slides
        (_rounds([], []), False),
    ],
)
def test_starts_are_confirmed_if_rounds_agree_and_no_other_pose_is_as_good(rounds, confirmed):
    assert is_confirmed(rounds) == confirmed


def test_starts_are_the_same_every_time():
    source, target, _ = partial_overlap(2)
    first, second = (congruent_poses(source, target, SCALES[0]) for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_a_far_outlier_costs_no_memory(rng, monkeypatch):
    """The field of nearness spans the target, whose extent one point may stretch without bound."""
    sizes, fill = [], starts.fill_nearness

    def filled(*given):
        sizes.append(given[-1].values.nbytes)
        return fill(*given)

    monkeypatch.setattr(starts, "fill_nearness", filled)
    points = rng.standard_normal((1000, 3))
    points[0] = 1e6
    congruent_poses(points[:50], points, SCALES[0])
    assert max(sizes) < 200e6


@pytest.mark.parametrize("share", [0.0, 0.2, 0.5])
def test_an_overlap_ends_early_only_where_it_is_far_below_the_floor(rng, share):
    target, is_near = rng.random((50, 3)), rng.random(60) < share
    field = starts.nearness_field(target, 0.1, 64)
    points = np.where(is_near[:, None], target[rng.integers(50, size=60)], 9.0)
    whole = overlap(np.eye(3), np.zeros(3), points, field, 0.0)
    assert 0.9 * is_near.sum() <= whole <= is_near.sum()  # cells are a third of the reach
    assert overlap(np.eye(3), np.zeros(3), points, field, 0.5 * whole) == whole
    assert overlap(np.eye(3), np.zeros(3), points, field, 1.5 * whole + 10.0) == 0.0


@pytest.mark.parametrize("by", ["time", "stop", "end"])
def test_a_flag_is_set_after_its_time_with_the_other_flag_and_at_the_end(by):
    stop = np.zeros(1, np.uint8)
    with stopped_after(0.05 if by == "time" else 60.0, stop) as flag:
        assert not flag[0]
        stop[0] = by == "stop"
        until = time.monotonic() + 20.0
        while by != "end" and not flag[0] and time.monotonic() < until:
            time.sleep(0.01)
        assert bool(flag[0]) == (by != "end")
    assert flag[0]
    assert bool(stop[0]) == (by == "stop")


def test_without_a_time_the_other_flag_itself_is_used():
    stop = np.zeros(1, np.uint8)
    with stopped_after(np.inf, stop) as flag:
        assert flag is stop
