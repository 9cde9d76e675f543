"""Bounds over boxes of similarities in 3D: below the objective, and equal to it at single poses."""

from itertools import combinations, permutations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import dcreg
from dcreg.assignment.objective import objective
from dcreg.families.rigid3d.kernels.boxes import geometry
from dcreg.families.rigid3d.kernels.poses import empty_view, look_from
from dcreg.families.similarity3d.bound import SimilarityBound
from dcreg.families.similarity3d.kernels.boxes import _by_displacements, _resize, shell_costs
from dcreg.families.similarity3d.space import SCALE, Similarity3D, fit_similarity
from dcreg.problem.geometry import fit_pose
from dcreg.search import Box, Boxes
from tests.problems import SEEDS, box_about, centred, centred_pairs, facet_boxes, lower_bound

RANGES = st.sampled_from([(0.5, 1.5), (1.0, 1.0), (0.9, 1.1), (0.2, 0.4), (2.0, 3.0)])


@st.composite
def similar_problems(draw, max_points=6, all_match=False):
    """A problem and a range of scales; the target may be a scaled copy of the source."""
    source, target, k = draw(centred_pairs(max_points))
    if all_match:
        size = min(len(source), len(target))
        source, target, k = centred(source[:size]), centred(target[:size]), size
    return source, target * draw(st.sampled_from([0.5, 1.0, 1.3])), k, draw(RANGES)


def best_pose(problem, generator):
    """The best pose of a random matching, and what its pairs leave over."""
    source, target, k, scale_range = problem
    x = source[generator.permutation(len(source))[:k]]
    y = target[generator.permutation(len(target))[:k]]
    theta = fit_similarity(x.T, y.T, scale_range)
    model = Similarity3D(*problem)
    T = model.pose(theta)
    return model.normalised(theta), ((x @ T[:3, :3].T + T[:3, 3] - y) ** 2).sum()


def box_in_range(theta, generator, size, scale_range, only_rotates):
    """A box as of `box_about`, with scales in the range."""
    box = box_about(theta, generator, size)
    lower, upper = box.lower, box.upper
    lower[SCALE], upper[SCALE] = np.clip([lower[SCALE], upper[SCALE]], *scale_range)
    if only_rotates:
        lower[4:], upper[4:] = [0.0, 0.0, 0.0, scale_range[0]], [0.0, 0.0, 0.0, scale_range[1]]
    return Box(lower, upper)


@given(
    st.one_of(similar_problems(), similar_problems(all_match=True)),
    st.sampled_from([1.0, 0.3, 0.1, 0.01, 0.0]),
    st.sampled_from([0.5, 0.95, 1.0, 1.5, 10.0]),
    SEEDS,
)
def test_bound_is_below_every_matching_at_its_best_pose(problem, size, tightness, seed):
    """So it is below the optimum, wherever in the box that is, also at an end of the range."""
    generator = np.random.default_rng(seed)
    theta, left_over = best_pose(problem, generator)
    bound = SimilarityBound(Similarity3D(*problem))
    box = box_in_range(theta, generator, size, problem[3], bound.space.only_rotates)
    assert 0.0 <= lower_bound(bound, box, tightness * left_over + 1e-12) <= left_over + 1e-9


@given(st.integers(2, 6), RANGES, st.sampled_from([0.2, 0.05]), SEEDS)
def test_bound_is_below_the_best_pose_of_the_only_matching(k, scale_range, size, seed):
    """Where no other matching makes the bound small; the best scale may be outside the range."""
    generator = np.random.default_rng(seed)
    feasible = np.eye(k, dtype=bool)
    for _ in range(20):
        source = generator.standard_normal((k, 3)) + generator.choice([0.0, 2.0])
        factor = generator.choice([0.7, 1.0, 1.4]) * generator.uniform(*scale_range)
        noise = generator.choice([0.0, 0.1, 1.0])
        target = factor * source + noise * generator.standard_normal((k, 3)) + 1.0
        model = Similarity3D(source, target, k, scale_range, feasible)
        theta = model.normalised(fit_similarity(source.T, target.T, scale_range))
        best = objective(source, target, model.pose(theta), k, feasible)[0]
        # the best pose at a vertex, where the loss is largest; often along few axes
        ends = np.stack([theta, theta + size * generator.choice([-1.0, 1.0], 8)])
        for axes in (slice(0, 4), slice(4, SCALE), slice(SCALE, 8)):
            if generator.random() < 0.5:
                ends[:, axes] = theta[axes]
        ends[:, np.argmax(np.abs(theta[:4]))] = 1.0
        ends[:, SCALE] = np.clip(ends[:, SCALE], *scale_range)
        box = Box(ends.min(axis=0), ends.max(axis=0))
        found = lower_bound(SimilarityBound(model), box, 2.0 * best + 1.0)
        assert found <= best + 1e-9 * (1.0 + best)


@given(similar_problems(), st.data())
def test_bound_at_a_single_pose_is_the_objective(problem, data):
    space = Similarity3D(*problem)
    if space.only_rotates:
        return
    box = data.draw(facet_boxes(space.roots(), halves=(0.0,)))
    centre = box.centre
    exact = objective(*problem[:2], space.pose(centre), problem[2])[0]
    bound = SimilarityBound(space)
    found = bound.evaluate(Boxes.of([Box(centre, centre)]), 1.01 * exact + 1e-6)
    if np.isfinite(found.values[0]):
        assert found.values[0] == pytest.approx(exact, abs=1e-9)
    # the scale of a stationary pose is inside the range or at one of its ends
    assert found.lower_bounds[0] == pytest.approx(exact, abs=1e-7)


@given(similar_problems(), st.data())
def test_shells_are_below_the_objective_at_their_translation(problem, data):
    source, target, k, _ = problem
    space = Similarity3D(*problem)
    if space.only_rotates:
        return
    box = data.draw(facet_boxes(space.roots(), halves=(1.0, 0.3, 0.1, 0.0)))
    box.lower[4:SCALE] = box.upper[4:SCALE] = box.centre[4:SCALE]
    bound = SimilarityBound(space)
    bound._scales = lambda boxes: np.full(len(boxes), np.nan)  # no argument about stationary poses
    thetas = np.concatenate([box.sample(np.random.default_rng(0), 40), box.vertices()[::11]])
    lowest = min(objective(source, target, space.pose(theta), k)[0] for theta in thetas)
    assert lower_bound(bound, box, np.inf) <= lowest + 1e-9


def relative(model, box, scale):
    """The geometry of a box and its clouds, as seen from its centre."""
    view, centre, half = empty_view(model.clouds), np.empty(7), np.empty(3)
    seen = geometry(box.lower, box.upper, centre, half, np.empty((8, 3)))
    look_from(model.clouds, centre, view)
    _resize(view.source, scale)
    return view, seen


@given(similar_problems(), st.data(), SEEDS)
def test_shell_costs_are_the_squared_distances_of_the_shells(problem, data, seed):
    """The kernel against a fine sample of the shell, and against the pose that it assumes."""
    generator = np.random.default_rng(seed)
    space = Similarity3D(*problem)
    box = data.draw(facet_boxes(space.roots(), halves=(1.0, 0.3, 0.1, 0.0)))
    view, seen = relative(space, box, 1.0)
    angle = 2.0 * np.arctan(seen.tangent)
    least, most = box.lower[SCALE], box.upper[SCALE]
    costs = np.empty((space.n_source, space.n_target))
    shell_costs(view.source, angle, least, most, view.target, view.infeasibility_penalty, costs)
    axes = generator.standard_normal((300, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    turns = Rotation.from_rotvec(axes * (angle * generator.random(300) ** 0.3)[:, None])
    scales = generator.uniform(least, most, 300)
    for i, x in enumerate(view.source.T):
        images = scales[:, None] * turns.apply(x)
        for j, y in enumerate(view.target.T):
            assert costs[i, j] <= ((images - y) ** 2).sum(axis=1).min() + 1e-9
            # turned towards y as far as allowed, and scaled to the nearest admissible length
            between = np.arctan2(np.linalg.norm(np.cross(x, y)), x @ y)
            dot = np.linalg.norm(x) * np.linalg.norm(y) * np.cos(max(0.0, between - angle))
            scale = np.clip(dot / max(x @ x, 1e-300), least, most)
            assert costs[i, j] == pytest.approx(
                scale**2 * x @ x - 2 * scale * dot + y @ y, abs=1e-7
            )


@given(similar_problems(8), st.data(), SEEDS)
def test_displacements_are_those_of_a_direct_computation(problem, data, seed):
    """The kernel against NumPy: losses of all rows at all vertices, then the k smallest."""
    generator = np.random.default_rng(seed)
    model, k = Similarity3D(*problem), problem[2]
    box = data.draw(facet_boxes(model.roots(), halves=(0.3, 0.1, 0.01, 0.0)))
    scale = box.centre[SCALE]
    view, seen = relative(model, box, scale)
    least, most = box.lower[SCALE] / scale, box.upper[SCALE] / scale
    limits = SimilarityBound(model)._limits
    low = generator.exponential(size=model.n_source)
    work = np.empty((5, low.size))
    work[0] = low
    found = _by_displacements(view, seen, (scale, least, most), limits, work, np.empty(64), 0.1)
    stretch = max(1.0 - least, most - 1.0)
    rows = low - stretch**2 * (view.source**2).sum(axis=0)
    signs = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T
    sums = [
        np.sort(rows - ((2 * most**0.5 * np.cross(r, view.source.T) + s) ** 2).sum(axis=1))[
            :k
        ].sum()
        for r in seen.vertices
        for s in signs * seen.half
    ]
    t, rho = seen.tangent, seen.shift_radius
    uneven = max(abs(most - most**0.5), abs(least - least**0.5))
    crossed = 2 * stretch + 4 * uneven * t + 4 * most * t**2 / (1 + t**2) ** 0.5
    left = min(sums) - 0.1 - crossed * rho * scale * limits.drift
    root = 4 * t**2 / (1 + t**2) * scale * limits.inertia**0.5
    expected = max(0.0, (root**2 + 4 * left) ** 0.5 - root) ** 2 / 4 if left > 0 else 0.0
    # the kernel's sums of the k smallest rows are bounds from below, exact for all rows
    assert found <= expected + 1e-9
    if k == low.size:
        assert found == pytest.approx(expected, abs=1e-9)


def minimum(source, target, k, scale_range):
    """The minimum over all matchings."""
    rows = np.array(list(combinations(range(len(source)), k)))
    columns = np.array(list(permutations(range(len(target)), k)))
    best = np.inf
    for chosen in rows:
        x = np.broadcast_to(source[chosen], (len(columns), k, 3))
        T = fit_pose(x, target[columns], scale_range)
        moved = x @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3]
        best = min(best, ((moved - target[columns]) ** 2).sum(axis=(1, 2)).min())
    return best


@given(st.one_of(similar_problems(5), similar_problems(5, all_match=True)), st.booleans())
def test_bounds_enclose_the_minimum_over_all_matchings(problem, stationary):
    source, target, k, scale_range = problem
    exact = minimum(source, target, k, scale_range)
    found = dcreg.register(
        source, target, n_inliers=k, model="similarity3d", scale_range=scale_range, node_limit=3000,
        options=dcreg.SolveOptions(start_box="stationary" if stationary else "radius", prove=True),
    )  # fmt: skip
    slack = 1e-7 * (1.0 + exact)
    assert found.lower_bound - slack <= exact <= found.upper_bound + slack
    low, high = scale_range
    assert low * (1.0 - 1e-9) <= found.scale <= high * (1.0 + 1e-9)
    if found.status is dcreg.Status.OPTIMAL:
        assert found.upper_bound - found.gap_tol - slack <= exact


@given(centred_pairs(5), RANGES, SEEDS)
def test_infeasible_pairs_stay_out_and_the_bounds_hold(problem, scale_range, seed):
    source, target, k = problem
    generator = np.random.default_rng(seed)
    candidates = generator.random((len(source), len(target))) < 0.6
    candidates[np.arange(k), np.arange(k)] = True  # a matching exists
    found = dcreg.register(
        source, target, n_inliers=k, model="similarity3d", scale_range=scale_range, node_limit=1500,
        candidates=candidates,
    )  # fmt: skip
    assert candidates[tuple(found.assignment.T)].all()
    columns = np.array(list(permutations(range(len(target)), k)))
    best = np.inf
    for chosen in combinations(range(len(source)), k):
        allowed = columns[candidates[np.array(chosen), columns].all(axis=1)]
        for each in allowed:
            T = fit_pose(source[list(chosen)], target[each], scale_range)
            moved = source[list(chosen)] @ T[:3, :3].T + T[:3, 3]
            best = min(best, ((moved - target[each]) ** 2).sum())
    slack = 1e-7 * (1.0 + best)
    assert found.lower_bound - slack <= best <= found.upper_bound + slack


@pytest.mark.parametrize("scale_range", [(0.5, 1.5), (0.5, 0.9), (1.1, 1.5), (1.0, 1.0)])
def test_loss_about_an_optimum_is_of_second_order(rng, scale_range):
    """Also where the scale of the optimum is at an end of the range."""
    source = centred(rng.standard_normal((12, 3)))
    target = centred(source + 0.3 * rng.standard_normal((12, 3)))
    model = Similarity3D(source, target, 10, scale_range)
    start = np.array([1.0, 0, 0, 0, 0, 0, 0, np.clip(1.0, *scale_range)])
    theta, best, _ = model.refine(start)
    losses = []
    for size in (0.02, 0.01):
        half = size * np.array([0.0, 1, 1, 1, 1, 1, 1, 1])
        lower, upper = theta - half, theta + half
        lower[SCALE], upper[SCALE] = np.clip([lower[SCALE], upper[SCALE]], *scale_range)
        losses.append(best - lower_bound(SimilarityBound(model), Box(lower, upper), best))
    assert losses[0] < 0.2 * best
    assert 0.0 < losses[1] < 0.3 * losses[0]


@pytest.mark.usefixtures("thin_slices")
@pytest.mark.parametrize("k", [10, 12])
def test_bounds_do_not_depend_on_the_number_of_threads(rng, k):
    model = Similarity3D(
        centred(rng.standard_normal((12, 3))), centred(rng.standard_normal((12, 3))), k, (0.5, 1.5)
    )
    centres = rng.uniform(-0.5, 0.5, (40, 8))
    centres[:, 0], centres[:, SCALE] = 1.0, 1.0
    half = 0.05 * np.array([0.0, 1, 1, 1, 1, 1, 1, 1])
    if model.only_rotates:
        centres[:, 4:SCALE] = half[4:SCALE] = 0.0
    boxes = Boxes(centres - half, centres + half)
    found = [SimilarityBound(model, threads=n).evaluate(boxes, 5.0) for n in (1, 2)]
    assert np.array_equal(found[0].lower_bounds, found[1].lower_bounds)
    assert np.array_equal(found[0].values, found[1].values)
