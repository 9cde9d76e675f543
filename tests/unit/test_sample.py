"""Samples of clouds: spread out, without outliers."""

import numpy as np
import pytest

from dcreg.driver.downsample import default_sample, to_search
from dcreg.problem import (
    InputError,
    Problem,
    farthest_points,
    geometry,
    median_spacing,
    representative_points,
)
from dcreg.problem.geometry import isolated, sampled_pairs


def surface(rng, size):
    """Points of an ellipsoid."""
    points = rng.standard_normal((size, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True) * [1.0, 0.7, 0.5]


def test_samples_leave_out_outliers(rng):
    points = surface(rng, 5000)
    outliers = rng.uniform(-2.0, 2.0, (450, 3))
    cloud = np.concatenate([points, outliers])
    taken = representative_points(cloud, 300)
    assert len(taken) == 300
    assert (taken >= 5000).mean() < 0.15
    assert (farthest_points(cloud, 300) >= 5000).mean() > 0.8  # without the removal of outliers


def test_scans_of_uneven_density_keep_their_extent(rng):
    """A lidar's points are sparser at larger distances; none is an outlier."""
    angle = rng.uniform(0.0, 2.0 * np.pi, 20_000)
    range_ = np.exp(rng.uniform(0.0, 3.0, 20_000))
    cloud = np.column_stack(
        [range_ * np.cos(angle), range_ * np.sin(angle), 0.02 * rng.standard_normal(20_000)]
    )
    assert isolated(cloud).mean() < 0.01
    taken = cloud[representative_points(cloud, 500)]
    assert np.linalg.norm(taken, axis=1).max() > 0.9 * range_.max()


@pytest.mark.parametrize("kind", ["few", "equal", "half equal"])
def test_degenerate_clouds_keep_all_points(kind, rng):
    points = rng.standard_normal((40, 2))
    if kind == "few":
        points = points[:3]
    elif kind == "equal":
        points[:] = 1.0
    else:
        points[:25] = 1.0
    assert not isolated(points).any()
    assert len(representative_points(points, 10)) == min(
        10, len(np.unique(points, axis=0)), len(points)
    )


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("queries", [5, 1000])
def test_the_spacing_of_few_points_is_that_of_the_search_tree(dim, queries, rng, monkeypatch):
    points = 100.0 + rng.standard_normal((200, dim))
    points[:20] = points[20:40]  # equal points
    found = median_spacing(points, queries)
    monkeypatch.setattr(geometry, "_FEW_POINTS", 0)
    assert found == pytest.approx(median_spacing(points, queries), rel=1e-12)
    assert found > 0.0


def test_a_sample_keeps_model_and_scales(rng):
    problem = Problem(rng.random((60, 2)), rng.random((50, 2)), 40, "similarity2d", (0.9, 1.1))
    (searched,) = to_search([problem], 20, None, None)
    assert (searched.model, searched.scale_range) == ("similarity2d", (0.9, 1.1))
    assert (len(searched.source), len(searched.target), searched.n_inliers) == (20, 20, 13)


def test_samples_of_a_part_and_the_whole_have_the_pairs_of_the_smaller_share(rng):
    whole = rng.random((900, 3))
    clouds, samples = [whole[:300], whole], [whole[:300], whole[:450]]
    assert sampled_pairs(300, clouds, samples) == 150
    assert sampled_pairs(300, clouds[::-1], samples[::-1]) == 150
    assert sampled_pairs(1, clouds, [whole[:3], whole[:3]]) == 1


def test_a_sample_that_is_too_large_for_farthest_points_is_drawn_at_random(rng, monkeypatch):
    points = np.concatenate([surface(rng, 500), [[50.0, 0.0, 0.0]]])
    monkeypatch.setattr(geometry, "_MAX_DISTANCES", 100_000)
    monkeypatch.setattr(geometry, "farthest_points", lambda points, count: np.arange(count) + 100)
    taken = representative_points(points, 300)
    assert len(np.unique(taken)) == 300
    assert taken.min() < 100 < taken.max() < 500  # without the outlier
    assert representative_points(points, 100).min() >= 100  # few are farthest points


@pytest.mark.parametrize(
    ("sizes", "n_inliers", "sample"),
    [
        ((30_000, 150), 150, 6000),  # 400 points would leave 2 pairs, which determine no pose
        ((150, 30_000), 75, 6666),
        ((5000, 1000), 1000, 400),
        ((5000, 5000), 10, 400),  # 2500 points of each would take too long
        ((30_000, 100), 100, None),
        ((20_000, 60), 60, 1334),
    ],
)
def test_a_much_larger_cloud_has_a_larger_sample(sizes, n_inliers, sample, rng):
    dim, model = (2, "similarity2d") if sizes[1] == 60 else (3, "rigid3d")
    problem = Problem(*(rng.random((size, dim)) for size in sizes), n_inliers, model)
    assert default_sample(problem, None, certificate=False) == sample


def test_an_error_about_a_sample_states_enough_points(rng):
    problem = Problem(rng.random((5000, 3)), rng.random((5000, 3)), 10, "rigid3d")
    with pytest.raises(InputError, match=r"400 points leave 1 pair of 10.*at least 2500 points"):
        to_search([problem], None, None, None)
    (sample,) = to_search([problem], 2500, None, None)
    assert sample.n_inliers == 5
