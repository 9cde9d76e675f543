"""The cover by nearest distances keeps every optimum below its cutoff."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dcreg.families.similarity2d import cover as cover_2d
from dcreg.families.similarity2d.bound import TightBound
from dcreg.families.similarity2d.cover import NearestCover, distances_to, sides_of
from dcreg.families.similarity2d.kernels.exclusion import (
    _target_loss,
    fill_squares,
    is_excluded,
    joint_loss,
)
from dcreg.families.similarity2d.space import Similarity2D
from dcreg.search import Budget, Interrupted, Tolerance, minimise

SEEDS = st.integers(0, 2**32 - 1)
RANGES = ((0.5, 1.5), (0.95, 1.05), (1.0, 1.0), (0.3, 0.7), (1.4, 2.0))


def make_space(seed: int, n: int = 9, m: int = 10, k: int = 6, noise: float = 0.05) -> Similarity2D:
    """Return the space of a random problem; the scale of its optimum is often at an end of the range."""
    rng = np.random.default_rng(seed)
    points = rng.standard_normal((max(n, m), 2))
    if seed % 3 == 0:
        points[:, 1] *= 0.02
    angle, scale = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.6, 1.6)
    turn = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    target = (points @ turn.T + noise * rng.standard_normal(points.shape))[
        rng.permutation(len(points))
    ][:m]
    candidates = rng.random((n, m)) < 0.9 if seed % 4 == 0 else None
    source = points[:n]
    source, target = source - source.mean(axis=0), target - target.mean(axis=0)
    return Similarity2D(source, target, k, RANGES[seed % len(RANGES)], candidates)


def optima(space: Similarity2D) -> list[tuple[np.ndarray, float]]:
    """Return where local searches from many poses end."""
    rng = np.random.default_rng(0)
    root = space.roots()[0]
    seeds = [*space.seeds(), *root.sample(rng, 40)]
    return [space.refine(seed)[:2] for seed in seeds]


SIZES = [(9, 10, 6), (6, 10, 6), (10, 6, 6), (5, 5, 4)]  # n, m, k: also all points of one cloud


@pytest.mark.parametrize("sizes", SIZES)
@settings(max_examples=30)
@given(SEEDS)
def test_no_excluded_box_contains_an_optimum_below_the_cutoff(sizes, seed):
    """An end of a local search is stationary, except where its scale is clipped."""
    noise = (0.05, 0.5, 2.0)[seed % 3]  # some matched points are then far from all others
    space = make_space(seed, *sizes, noise)
    sides, rng = sides_of(space), np.random.default_rng(seed)
    work = *map(np.empty, sizes[:2]), *(np.empty(size, np.int32) for size in sizes[:2])
    for theta, value in optima(space):
        for width in (0.02, 0.1, 0.3, 0.8):
            half = width * rng.uniform(0.1, 1.0, 4)
            centre = theta + rng.uniform(-1.0, 1.0, 4) * half
            cutoff = value * (1.0 + 1e-6) + 1e-9
            levels = np.full(2, 10.0 ** rng.integers(-3, 2))  # of an earlier box
            assert not is_excluded(sides, centre, half, cutoff, work, levels)[0]


@settings(max_examples=30)
@given(SEEDS)
def test_target_loss_is_not_below_that_of_any_subset(seed):
    """It is attained if all points are equal."""
    rng = np.random.default_rng(seed)
    space = make_space(seed)
    x = space.source @ np.array([1.0, 1.0j])
    reach, shift = rng.random(2)
    found = plain(_target_loss)(sides_of(space), reach, shift)
    w, t = (size * np.exp(2j * np.pi * rng.random(100))[:, None] for size in (reach, shift))
    subsets = np.sort(abs(w * x + t) ** 2, axis=1)[:, -space.n_inliers :]
    assert subsets.sum(axis=1).max() <= found
    equal = sides_of(space)._replace(sum=6.0 * 0.7, square_sum=6.0 * 0.49)
    assert plain(_target_loss)(equal, reach, shift) == pytest.approx(6 * (shift + 0.7 * reach) ** 2)


@given(SEEDS)
def test_joint_loss_is_the_maximum_over_the_vertices(seed):
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((7, 2)) @ np.array([1.0, 1.0j])
    share, half = rng.random(7), rng.random(4)
    weights = (
        share.sum(),
        (share * x).sum().real,
        (share * x).sum().imag,
        (share * abs(x) ** 2).sum(),
    )
    signs = 1.0 - 2.0 * ((np.arange(16)[:, None] >> np.arange(4)) & 1)
    worst = 0.0
    for a, b, c, d in signs * half:
        worst = max(worst, float((share * abs(c + 1j * d + (a + 1j * b) * x) ** 2).sum()))
    assert joint_loss(weights, half) == pytest.approx(worst)


@given(SEEDS)
def test_grid_distances_are_lower_bounds(seed):
    rng = np.random.default_rng(seed)
    points = rng.standard_normal((12, 2)) * rng.choice([1.0, 1e-3], 2)
    field, pose = distances_to(points), rng.standard_normal(4)
    moving, squares = rng.uniform(-4.0, 4.0, (2, 50)), np.empty(50)
    fill_squares(moving, tuple(pose), field, np.empty(50, np.int32), squares)
    a, b, *shift = pose
    moved = moving.T @ np.array([[a, -b], [b, a]]).T + shift
    true = np.linalg.norm(moved[:, None] - points, axis=2).min(axis=1)
    assert (np.sqrt(squares) <= true + 1e-12).all()
    cells = (moved - field.origin) * field.density
    inside = ((cells >= 0.0) & (cells < field.squares.shape)).all(axis=1)
    assert (true - np.sqrt(squares))[inside].max(initial=0.0) <= 2.0 / field.density


def plain(kernel):
    """Return the Python function of a kernel that has no entry of its own."""
    return getattr(kernel, "py_func", kernel)


@settings(max_examples=12)
@given(SEEDS)
def test_boxes_contain_the_optimum_and_confirm_the_search(seed):
    """The whole cutoff, by the cover, leads to the same minimum as boxes alone."""
    space = make_space(seed)
    tolerance = Tolerance(rel=1e-2, abs=1e-9)
    alone = minimise(space, TightBound(space), Budget(), tolerance=tolerance)
    confined = NearestCover(space).confine(alone.upper_bound * 1.001 + 1e-9, Budget(), np.inf)
    assert confined is not None
    inside = (confined.boxes.lower <= alone.theta + 1e-9) & (
        alone.theta - 1e-9 <= confined.boxes.upper
    )
    assert inside.all(axis=1).any()
    below = NearestCover(space).confine(0.5 * alone.lower_bound, Budget(), np.inf)
    assert below is not None
    assert below.outside == 0.5 * alone.lower_bound


@pytest.mark.usefixtures("thin_slices")
def test_a_long_search_uses_it_and_threads_do_not_matter(monkeypatch):
    space = make_space(1, n=40, m=40, k=20)
    monkeypatch.setattr("dcreg.search.space_search.SHORT", 512)
    found = [
        minimise(
            space, TightBound(space, threads=threads), Budget(), tolerance=Tolerance(rel=0.01),
            make_cover=lambda threads=threads: NearestCover(space, threads),
        )
        for threads in (1, 2)
    ]  # fmt: skip
    alone = minimise(space, TightBound(space), Budget(), tolerance=Tolerance(rel=0.01))
    assert [len(each.confined) for each in found] == [1, 1]
    assert found[0].confined[0].n_tried == found[1].confined[0].n_tried
    assert found[0].n_nodes == found[1].n_nodes < alone.n_nodes
    assert found[0].upper_bound == pytest.approx(alone.upper_bound, rel=0.011)


def test_it_gives_up_if_there_is_too_much_work_or_too_much_is_left(monkeypatch):
    space = make_space(1, n=30, m=30, k=15)
    assert NearestCover(space).confine(0.1, Budget(), 1e-4) is None
    monkeypatch.setattr(cover_2d, "MAX_LEFT", 3)
    assert NearestCover(space).confine(5.0, Budget(), np.inf) is None


def test_it_stops_at_once():
    budget = Budget()
    stop = np.ones(1, np.uint8)
    space = make_space(1).with_stop_flag(stop)
    with pytest.raises(Interrupted):
        NearestCover(space).confine(0.1, budget, np.inf)


def test_it_applies_only_if_points_are_left_out_of_many():
    assert NearestCover(make_space(1, n=40, m=40, k=30)).applies
    assert not NearestCover(make_space(1, n=40, m=40, k=40)).applies
    assert not NearestCover(make_space(1)).applies
