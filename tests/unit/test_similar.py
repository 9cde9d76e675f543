"""Initial poses in 2D from pairs of points, also if half of the points have no partner."""

import numpy as np
import pytest

from dcreg.families import starts
from dcreg.families.similarity2d.space import Similarity2D
from dcreg.families.similarity2d.starts import MAX_CELLS, similar_poses
from dcreg.search import Budget

RANGE = (0.5, 1.5)


def partial_overlap(seed, n_common=40, n_clutter=40, scale=0.8):
    """Clouds of which half has no partner: next to the shape, on either side; and the true parameter."""
    rng = np.random.default_rng(seed)
    shape = rng.standard_normal((n_common, 2)) * [1.0, 0.6]
    turn = scale * np.exp(2.1j)
    theta = np.array([turn.real, turn.imag, 0.7, -0.2])
    R = np.array([[turn.real, -turn.imag], [turn.imag, turn.real]])
    target = shape @ R.T + theta[2:] + 0.005 * rng.standard_normal((n_common, 2))
    beside = rng.uniform(-0.5, 0.5, (2, n_clutter, 2))
    beside += np.array([[[-2.5, 0.0]], [[1.5, 1.5]]])
    source, target = np.concatenate([shape, beside[0]]), np.concatenate([target, beside[1]])
    return source, rng.permutation(target), theta


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("scale", [0.6, 1.3])
def test_the_true_pose_is_among_them(seed, scale):
    source, target, theta = partial_overlap(seed, scale=scale)
    found = similar_poses(source, target, 40, RANGE)
    assert np.abs(found - theta).max(axis=1).min() < 0.1


@pytest.mark.parametrize("seed", range(3))
def test_the_search_begins_at_the_true_pose(seed):
    source, target, theta = partial_overlap(seed)
    found, value, _ = Similarity2D(source, target, 40, RANGE).start(Budget())
    assert np.abs(found - theta).max() < 0.01
    assert value < 40 * 3 * 0.005**2


def test_what_is_within_the_tolerance_needs_no_pairs(monkeypatch):
    """No objective is below 0, so the gap is closed: the poses of pairs are not even made."""
    source, target, _ = partial_overlap(2)
    space = Similarity2D(source, target, 40, RANGE)
    made = []
    monkeypatch.setattr(Similarity2D, "_similar", lambda *_: made.append(1) or np.empty((0, 4)))
    space.start(Budget(), enough=np.inf)
    assert not made
    space.start(Budget())
    assert made


def test_starts_are_distinct_admissible_and_the_same_every_time():
    source, target, _ = partial_overlap(7)
    first, second = (similar_poses(source, target, 40, (0.7, 0.9)) for _ in range(2))
    np.testing.assert_array_equal(first, second)
    scales = np.hypot(*first[:, :2].T)
    assert len(first) > 3
    assert ((scales >= 0.7 - 1e-9) & (scales <= 0.9 + 1e-9)).all()
    apart = np.abs(first[:, None] - first[None]).max(axis=-1) + np.eye(len(first))
    assert apart.min() > 0.1


def test_pairs_that_are_not_feasible_give_no_pose():
    source, target, theta = partial_overlap(3)
    T = np.array([[theta[0], -theta[1]], [theta[1], theta[0]]])
    gaps = np.linalg.norm((source @ T.T + theta[2:])[:, None] - target[None], axis=-1)
    near = gaps < 0.3
    assert np.abs(similar_poses(source, target, 40, RANGE, near)[0] - theta).max() < 0.1
    others = similar_poses(source, target, 40, RANGE, ~near)
    assert (np.abs(others - theta).max(axis=1) > 0.1).all()
    assert len(similar_poses(source, target, 40, RANGE, np.zeros_like(near))) == 0


@pytest.mark.parametrize("kind", ["one", "one place", "line"])
def test_degenerate_clouds_still_give_an_initial_pose(kind, rng):
    source = rng.standard_normal((8, 2))
    if kind == "one":
        source = source[:1]
    elif kind == "one place":
        source[:] = 1.0
    else:
        source[:, 1] = 0.0
    target = np.concatenate([source, source[:1] + 3.0])
    theta, value, spent = Similarity2D(source, target, len(source), RANGE).start(Budget())
    assert np.isfinite(theta).all()
    assert value == pytest.approx(0.0, abs=1e-9)
    assert spent >= 1


def test_a_far_outlier_costs_no_memory(rng, monkeypatch):
    sizes, fill = [], starts.fill_nearness

    def filled(*given):
        sizes.append(given[-1].values.nbytes)
        return fill(*given)

    monkeypatch.setattr(starts, "fill_nearness", filled)
    points = rng.standard_normal((1000, 2))
    target = np.concatenate([points, [[1e6, 0.0]]])
    similar_poses(points, target, 1000, RANGE)
    assert sizes[0] <= 8 * (MAX_CELLS + 10) ** 2
