"""The initial pose in 2D if only some of the points are to be matched."""

import numpy as np
import pytest

from dcreg.families.protocol import Space
from dcreg.families.similarity2d.space import COARSE_PAIRS, MAX_SCORED, Similarity2D
from dcreg.search import Budget

SHAPES = range(12)


class SeedsAlone(Similarity2D):
    starts = Space.starts


class WithoutPairs(Similarity2D):
    """Descents with more pairs, without the poses that pairs of points suggest."""

    def _similar(self, budget):
        return np.empty((0, 4))


def contours(seed):
    """Two noisy copies of a closed contour, turned and scaled, each with outliers on one side."""
    generator = np.random.default_rng(seed)
    angle = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    waves = [
        generator.normal(0, 0.3) / q * np.cos(q * angle + generator.uniform(0, 6))
        for q in (1, 2, 3, 4)
    ]
    source = ((1 + sum(waves)) * np.stack([np.cos(angle), 0.6 * np.sin(angle)])).T
    cos, sin = np.cos(turn := generator.uniform(0, 2 * np.pi)), np.sin(turn)
    target = source + 0.01 * generator.standard_normal(source.shape)
    target = generator.uniform(0.8, 1.2) * target @ np.array([[cos, sin], [-sin, cos]])
    source, target = (
        np.vstack([cloud, [side, 0] + 0.5 * generator.random((12, 2))])
        for cloud, side in ((source, -2), (target, 2))
    )
    return source - source.mean(axis=0), target - target.mean(axis=0)


def first_value(kind, n_inliers, seed):
    return kind(*contours(seed), n_inliers, (0.5, 1.5)).start(Budget())


@pytest.mark.parametrize("kind", [Similarity2D, WithoutPairs])
def test_half_of_the_pairs_fit_at_once_where_seeds_alone_mostly_miss(kind):
    values = [first_value(kind, 30, seed)[1] for seed in SHAPES]
    alone = [first_value(SeedsAlone, 30, seed)[1] for seed in SHAPES]
    assert (np.array(values) <= np.array(alone)).all()
    tolerated = 30 * 0.03**2
    assert (np.array(values) <= tolerated).sum() >= 10 > (np.array(alone) <= tolerated).sum() + 4


@pytest.mark.parametrize("seed", SHAPES[:3])
def test_start_is_a_pose_with_its_objective(seed):
    space = Similarity2D(*contours(seed), 30, (0.5, 1.5))
    theta, value, spent = space.start(Budget())
    assert space.admissible(theta[None])[0]
    assert value == pytest.approx(space.objective(theta)[0], abs=1e-9)
    assert spent > len(space.seeds())


def test_all_points_take_no_other_start():
    """Nothing is spent where there are no more pairs to begin with."""
    n_all = len(contours(0)[0])
    assert first_value(Similarity2D, n_all, 0)[1:] == first_value(SeedsAlone, n_all, 0)[1:]


def test_seeds_of_large_clouds_are_scored_by_some_of_their_points(rng):
    """The best seeds are the same, in far less time."""
    points = rng.standard_normal((2 * MAX_SCORED, 2)) * [2.0, 1.0]
    angle = 0.4
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    moved = points @ turn.T + 0.02 * rng.standard_normal(points.shape)
    space = Similarity2D(
        points - points.mean(axis=0), moved - moved.mean(axis=0), len(points), (0.5, 1.5)
    )
    scores, spent = space.score(space.seeds())
    assert spent == len(scores)
    values = [space.objective(seed)[0] for seed in space.seeds()]
    np.testing.assert_array_equal(np.argsort(scores)[:2], np.argsort(values)[:2])
    assert max(scores) < 0.75 * max(values)  # a sum over fewer pairs


class OfAllPoints(Similarity2D):
    """Local searches that do not begin with a sample."""

    _coarse = None


def test_local_searches_of_large_clouds_begin_with_a_sample(rng):
    """They end as low, and match all points less often."""
    points = rng.standard_normal((round(COARSE_PAIRS**0.5) + 20, 2)) * [2.0, 1.0]
    points -= points.mean(axis=0)
    start = np.array([np.cos(0.3), np.sin(0.3), 0.1, 0.0])
    ends = {}
    for kind in (Similarity2D, OfAllPoints):
        space, matched = kind(points, points, len(points) - 50, (0.5, 1.5)), []
        costs = space._costs
        space._costs = lambda theta, costs=costs, matched=matched: matched.append(1) or costs(theta)
        theta, value, spent = space.refine(start)
        assert value == pytest.approx(space.objective(theta)[0], abs=1e-9)
        ends[kind] = value, len(matched), spent
    (value, n_matched, spent), (of_all, n_of_all, spent_of_all) = ends.values()
    assert value <= of_all + 1e-9
    assert n_matched < n_of_all == spent_of_all + 1
    assert spent > n_matched - 1  # the assignments of the sample count


def test_small_clouds_and_candidates_have_no_sample():
    source, target = contours(0)
    every = np.ones((len(source), len(target)), bool)
    assert Similarity2D(source, target, 30, (0.5, 1.5))._coarse is None
    large = np.tile(source, (6, 1))
    assert Similarity2D(large, large, 30, (0.5, 1.5))._coarse is not None
    assert Similarity2D(large, large, 30, (0.5, 1.5), np.tile(every, (6, 6)))._coarse is None
