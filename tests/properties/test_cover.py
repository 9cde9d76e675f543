"""The cover by congruent triples keeps every stationary pose below its cutoff."""

import itertools

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from dcreg.families.rigid3d.bound import RigidBound
from dcreg.families.rigid3d.cover import (
    CongruentCover,
    best_grouping,
    distances_to,
    factor_of,
    limits_around,
)
from dcreg.families.rigid3d.kernels.exclusion import allocate_rows, fill_distances
from dcreg.families.rigid3d.kernels.regions import meeting_regions
from dcreg.families.rigid3d.kernels.tuples import Thresholds, allocate_regions, cover_triples
from dcreg.families.rigid3d.space import Rigid3D
from dcreg.search import Boxes, Budget, Confined, Interrupted, Tolerance, minimise
from dcreg.search.space_search import SHORT

SEEDS = st.integers(0, 2**32 - 1)
AFFORDED_S = 0.02  # nominal: only covers that are made quickly
KINDS = ("cloud", "plane", "line", "lattice", "clusters")
# With more noise most covers are given up, which takes long and checks nothing.
NOISES = {"line": (0.01, 0.03), "clusters": (0.01, 0.03, 0.1)}


def make_space(
    seed: int,
    kind: str = "cloud",
    n: int = 9,
    m: int = 9,
    k: int = 7,
    noise: float | None = None,
) -> Rigid3D:
    """Return the space of a random problem whose source partly matches the target."""
    rng = np.random.default_rng(seed)
    points = rng.standard_normal((max(n, m), 3))
    if kind == "plane":
        points[:, 2] *= 0.01
    elif kind == "line":
        points[:, 1:] *= 0.02
    elif kind == "lattice":
        points = rng.integers(-1, 2, points.shape).astype(float)
    elif kind == "clusters":
        points = points[rng.integers(3, size=len(points))] + 0.05 * points
    target = points[:m] - points[:m].mean(axis=0)
    turned = points @ Rotation.random(random_state=seed % 2**31).as_matrix().T
    noise = rng.choice([0.01, 0.1, 0.3]) if noise is None else noise
    source = (turned + noise * rng.standard_normal(points.shape))[:n]
    unit = np.sqrt((target**2).sum(axis=1).mean())
    return Rigid3D.between((source - source.mean(axis=0)) / unit, target / unit, k)


def local_minima(space: Rigid3D) -> list[tuple[np.ndarray, float]]:
    """Return where local searches from regular poses end."""
    seeds = space.seeds()
    scores, _ = space.score(seeds)
    return [space.refine(seed)[:2] for seed in seeds[np.argsort(scores)[:24]]]


def contains(boxes, theta: np.ndarray) -> bool:
    """Whether one of the boxes contains the pose."""
    scaled = np.tile(theta, (4, 1))
    for axis in range(4):  # in the units of each facet
        scaled[axis, :4] /= theta[axis] if theta[axis] else 1e-300
    inside = (boxes.lower[:, None] <= scaled + 1e-9) & (scaled - 1e-9 <= boxes.upper[:, None])
    return bool(inside.all(axis=2).any())


def superposition(x: np.ndarray, y: np.ndarray) -> float:
    """Return the minimum sum of squared residuals of paired points over all poses."""
    x, y = x - x.mean(axis=0), y - y.mean(axis=0)
    u, s, v = np.linalg.svd(x.T @ y)
    s[2] *= np.sign(np.linalg.det(u @ v))
    return float((x**2).sum() + (y**2).sum() - 2.0 * s.sum())


@settings(max_examples=30)
@given(seed=SEEDS, reach=st.sampled_from([0.1, 1.0, 3.0, 30.0]))
def test_grid_distances_are_lower_bounds_near_and_far(seed, reach):
    rng = np.random.default_rng(seed)
    target, points = rng.standard_normal((12, 3)), reach * rng.standard_normal((3, 20))
    turn, centroid = Rotation.random(random_state=seed % 2**31).as_matrix(), rng.standard_normal(3)
    field, rows = distances_to(target), allocate_rows(points)
    fill_distances(rows, turn, centroid, field)
    moved = points.T @ turn.T + centroid
    exact = np.linalg.norm(moved[:, None] - target, axis=2).min(axis=1)
    found = np.sqrt(rows.squares)
    assert (found <= exact).all()
    upper = field.origin + field.cell * np.array(field.values.shape)
    is_inside = ((moved > field.origin) & (moved < upper)).all(axis=1)
    assert (exact - found)[is_inside].max(initial=0.0) <= 1.01 * np.sqrt(3.0) * field.cell
    assert (found >= np.linalg.norm(np.maximum(0.0, moved - upper), axis=1) * 0.999).all()


@settings(max_examples=30)
@given(SEEDS, st.integers(7, 9))
def test_costs_of_triples_add_up_to_the_bound(seed, k):
    """E* >= c v, by the costs of all triples of the groups and all ordered target triples."""
    space = make_space(seed, k=k)
    source, target = space.clouds.source.T, space.clouds.target.T
    grouping = best_grouping(source, k)
    assert grouping is not None
    c = min(
        superposition(source[list(triple)], target[list(other)])
        for triple in grouping.triples
        for other in itertools.permutations(range(len(target)), 3)
    )
    best = min(value for _, value in local_minima(space))
    assert c * grouping.factor <= best * (1.0 + 1e-9)


@given(st.lists(st.integers(1, 6), min_size=1, max_size=5), st.integers(3, 20))
def test_the_factor_is_the_minimum_over_all_divisions(sizes, k):
    """v is at most the minimum of sum k_a / 3 over groups with at least three matched points."""
    sizes = np.array(sizes)
    if k > sizes.sum() or sizes.max() < 3:
        return
    totals = [
        sum(part / 3.0 for part in parts if part >= 3)
        for parts in itertools.product(*(range(size + 1) for size in sizes))
        if sum(parts) == k
    ]
    assert factor_of(sizes, k) <= min(totals) + 1e-9


def poses_kept(space: Rigid3D, factor: float) -> int:
    """Check that a cover keeps all local minima below its cutoff; return their number.

    The cutoff is slightly above `factor` times the lowest one. Covers that take long are not checked.
    """
    minima = local_minima(space)
    cutoff = factor * min(value for _, value in minima) + 1e-6
    confined = CongruentCover(space).confine(cutoff, Budget(nodes=1), AFFORDED_S)
    assume(confined is not None)
    below = [theta for theta, value in minima if value < cutoff]
    assert all(contains(confined.boxes, theta) for theta in below)
    return len(below)


@pytest.mark.parametrize("kind", KINDS)
def test_no_stationary_pose_below_the_cutoff_is_lost(kind):
    kept = []

    @settings(max_examples=8)
    @given(
        SEEDS, st.integers(6, 9), st.sampled_from([1.001, 1.3, 3.0]),
        st.sampled_from(NOISES.get(kind, (0.01, 0.1, 0.3))),
    )  # fmt: skip
    def judge(seed, k, factor, noise):
        kept.append(poses_kept(make_space(seed, kind, k=k, noise=noise), factor))

    judge()
    assert len(kept) >= 5  # others are given up
    assert min(kept) > 0


def test_no_feasible_optimum_is_lost():
    kept = []

    @settings(max_examples=6)
    @given(SEEDS)
    def judge(seed):
        full = make_space(seed, n=8, m=9, k=6)
        feasible = np.random.default_rng(seed).random((8, 9)) < 0.8
        space = Rigid3D(full.clouds.source.T, full.clouds.target.T, 6, feasible)
        kept.append(poses_kept(space, 1.5))

    judge()
    assert len(kept) >= 5
    assert min(kept) > 0


@settings(max_examples=25)
@given(SEEDS, st.sampled_from(KINDS), st.floats(0.01, 3.0))
def test_regions_contain_every_pose_of_their_triple(seed, kind, limit):
    """A pose that moves a triple to within the limit of a target triple lies in a region of the two."""
    space = make_space(seed, kind)
    source, target = (np.ascontiguousarray(c.T) for c in (space.clouds.source, space.clouds.target))
    rng = np.random.default_rng(seed)
    triple = np.append(rng.permutation(len(source))[:3], 0)[None]
    if seed % 3 == 0:  # a degenerate triple
        source[triple[0, 1]] = source[triple[0, 0]]
    distances = np.linalg.norm(target[:, None] - target, axis=2)
    first, second = np.nonzero(~np.eye(len(target), dtype=bool))
    order = np.argsort(distances[first, second], kind="stable")
    pairs = first[order], second[order], distances[first, second][order], distances
    frames, regions = np.empty((1, 7)), allocate_regions(5000)
    never = Thresholds(limit, 1e12, 7, 1.0)  # nothing is excluded
    _, count = cover_triples(
        triple, frames, (source, target), np.empty((0, 0), np.bool_), pairs,
        (never, distances_to(target)), np.zeros(1, np.uint8), regions,
    )  # fmt: skip
    ids = np.arange(count, dtype=np.int32)
    for turn in Rotation.random(40, random_state=seed % 2**31):
        turned = turn.apply(source[triple[0, :3]])
        other = rng.permutation(len(target))[:3]
        t = target[other].mean(axis=0) - turned.mean(axis=0) + 0.1 * rng.standard_normal(3)
        if ((turned + t - target[other]) ** 2).sum() > limit:
            continue
        x, y, z, w = turn.as_quat()
        pose = np.array([[w, x, y, z, *t]])
        out = np.empty(2 * count, np.int32)
        two = np.repeat(pose, 2, axis=0)
        ends = meeting_regions(two, two, np.array([0, count]), ids, frames, regions, out)
        assert ends[1] > 0


@settings(max_examples=20)
@given(SEEDS)
def test_limits_hold_around_any_centre(seed):
    rng = np.random.default_rng(seed)
    points, centres, k = rng.standard_normal((12, 3)), rng.standard_normal((4, 3)), 5
    for centre, (inertia, drift, spread) in zip(
        centres, limits_around(centres, points, k), strict=True
    ):
        for _ in range(20):
            chosen = points[rng.permutation(12)[:k]] - centre
            moments = np.linalg.eigvalsh(chosen.T @ chosen)
            assert (chosen**2).sum() <= inertia + 1e-9
            assert np.linalg.norm(chosen.sum(axis=0)) <= drift + 1e-9
            assert moments[-1] - moments[0] <= spread + 1e-9


@pytest.mark.parametrize("seed", range(4))
def test_a_search_with_a_cover_proves_the_same_optimum_with_fewer_boxes(seed):
    space = make_space(seed, n=32, m=35, k=26, noise=0.02)
    settings = {"tolerance": Tolerance(rel=0.1), "start": space.start(Budget())[:2]}
    plain = minimise(space, RigidBound(space), Budget(nodes=100_000), **settings)
    cover = CongruentCover(space)
    assert cover.applies
    found = minimise(
        space, RigidBound(space), Budget(nodes=100_000), make_cover=lambda: cover, **settings
    )
    assert plain.status == found.status == "optimal"
    assert found.lower_bound <= plain.upper_bound * (1.0 + 1e-9)
    assert plain.lower_bound <= found.upper_bound * (1.0 + 1e-9)
    assert found.confined
    assert found.n_nodes < plain.n_nodes


class EverythingIsExcluded:
    """A cover that leaves no boxes, whatever the cutoff."""

    stage, threads, applies, shares, box_s = "everything", 1, True, (0.25, 1.0), 1.0

    @staticmethod
    def confine(cutoff: float, budget: Budget, allowed_s: float) -> Confined:
        return Confined(Boxes(np.empty((0, 7)), np.empty((0, 7))), cutoff)


@settings(max_examples=30, deadline=None)
@given(seed=SEEDS, rel=st.floats(1e-4, 0.3))
def test_a_search_ends_when_a_cover_has_proved_the_whole_cutoff(seed, rel):
    """The part for the whole cutoff must close the gap to the last bit, or the boxes are searched too."""
    space = make_space(seed, n=36, m=40, k=26, noise=0.2)
    found = minimise(
        space, RigidBound(space), Budget(nodes=4 * SHORT), tolerance=Tolerance(rel=rel),
        make_cover=EverythingIsExcluded,
    )  # fmt: skip
    assert found.status == "optimal"
    assert found.n_nodes < 2 * SHORT


@pytest.mark.parametrize("threads", [1, 2])
def test_the_cover_does_not_depend_on_threads(threads):
    space = make_space(3, n=36, m=40, k=26, noise=0.03)
    cutoff = 0.9 * space.start(Budget())[1]
    found = CongruentCover(space, threads).confine(cutoff, Budget(), 1e9)
    again = CongruentCover(space, 1).confine(cutoff, Budget(), 1e9)
    assert found is not None
    assert again is not None
    assert found.n_tried == again.n_tried
    np.testing.assert_array_equal(found.boxes.lower, again.boxes.lower)


def test_a_cover_that_would_take_too_long_is_given_up():
    space = make_space(0, n=36, m=40, k=26, noise=0.3)
    cutoff = space.start(Budget())[1]
    assert CongruentCover(space).confine(cutoff, Budget(), 1e-6) is None


def test_a_cover_stops_when_the_time_is_over():
    stop = np.ones(1, np.uint8)
    space = make_space(0, n=36, m=40, k=26, noise=0.03).with_stop_flag(stop)
    with pytest.raises(Interrupted):
        CongruentCover(space).confine(1.0, Budget(), 1e9)
