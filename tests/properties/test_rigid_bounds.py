"""Bounds over boxes of rigid poses: below the objective, and tight where the search needs it."""

from functools import reduce
from itertools import combinations, product
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from dcreg.assignment.objective import k_assignment, objective
from dcreg.certificate.rigid import RigidPoses
from dcreg.families.protocol import Strongest
from dcreg.families.rigid3d import vertex_values
from dcreg.families.rigid3d.bound import RigidBound
from dcreg.families.rigid3d.kernels.cayley import vertex_bound
from dcreg.families.rigid3d.kernels.dual_bounds import (
    allocate_workspace,
    dual_bound_at_pose,
    dual_bound_of_box,
)
from dcreg.families.rigid3d.kernels.poses import (
    empty_view,
    look_from,
    nearest_sums,
    relative_vertices,
)
from dcreg.families.rigid3d.kernels.rough import (
    Auction,
    auction,
    lower_duals,
    rough_costs,
    rough_minima,
)
from dcreg.families.rigid3d.kernels.stationary import (
    BoxGeometry,
    Limits,
    costs_at_vertices,
    joint_loss_of,
    largest_rest,
    loss_of,
    needed,
    proven,
)
from dcreg.families.rigid3d.kernels.vertices import vertex_pose
from dcreg.families.rigid3d.space import Rigid3D, largest_subset_mean_3d
from dcreg.families.rigid3d.vertex_values import VertexValues
from dcreg.families.rotation3d.kernels.caps import cap_costs
from dcreg.search import Box, Boxes, Budget, Tolerance, minimise
from tests.problems import SEEDS, box_about, centred, centred_pairs, facet_boxes, lower_bound


def boxes(**kwargs):
    return facet_boxes(Rigid3D(np.eye(3), np.eye(3), 1, stationary_box=False).roots(), **kwargs)


def noisy_copy(rng, n, k, noise):
    """A model of a cloud and its noisy copy, with the optimum next to the identity."""
    source = centred(rng.standard_normal((n, 3)))
    target = centred(source + noise * rng.standard_normal((n, 3)))
    model = Rigid3D(source, target, k)
    return model, *model.refine(np.array([1.0, 0, 0, 0, 0, 0, 0]))[:2]


def values_in(problem, box):
    """E by the public objective, at poses of the box."""
    space = Rigid3D(*problem)
    thetas = np.concatenate([box.sample(np.random.default_rng(0), 40), box.vertices()[::7]])
    return [objective(*problem[:2], space.pose(theta), problem[2])[0] for theta in thetas]


def best_pose(problem, generator):
    """The best pose of a random matching, and what its pairs leave over."""
    source, target, k = problem
    model = Rigid3D(*problem)
    x = source[generator.permutation(len(source))[:k]]
    y = target[generator.permutation(len(target))[:k]]
    theta = model.fit(x.T, y.T)
    T = model.pose(theta)
    return model.normalised(theta), ((x @ T[:3, :3].T + T[:3, 3] - y) ** 2).sum()


class Parts:
    """What `bound_boxes` computes for one box, each bound on its own."""

    def __init__(self, model, box):
        self.k = model.n_inliers
        buffer = np.empty((8, 3))
        count = relative_vertices(box.centre, box.lower, box.upper, buffer)
        self.vertices = buffer[:count]
        self.tangent = np.linalg.norm(self.vertices, axis=1).max() if count else np.inf
        self.angle = 2.0 * np.arctan(self.tangent)
        self.half = box.half_widths[4:]
        self.view = empty_view(model.clouds)
        look_from(model.clouds, box.centre, self.view)

    def costs(self):
        out = np.empty((self.view.source.shape[1], self.view.target.shape[1]))
        cap_costs(
            self.view.source, self.angle, self.view.target, self.view.infeasibility_penalty, out
        )
        return out

    def squares(self):
        """Squared residuals at the centre."""
        moved, shifted = self.view.source, self.view.target
        return ((moved[:, :, None] - shifted[:, None, :]) ** 2).sum(axis=0)

    @property
    def lost(self):
        """Maximum gain of a matching at a translation other than its best."""
        return self.k * (self.half**2).sum()

    def vertex_bound(self, cutoff=np.inf):
        _, col_of = k_assignment(self.costs(), self.k)
        return vertex_bound(self.view, self.vertices, self.half, -1.0, cutoff, col_of)[0]


@given(
    centred_pairs(),
    st.sampled_from([1.0, 0.3, 0.1, 0.01, 0.0]),
    st.sampled_from([0.5, 0.95, 1.0, 1.5, 10.0]),
    SEEDS,
)
def test_bound_and_its_caps_are_below_every_matching_at_its_best_pose(
    problem, size, tightness, seed
):
    """So it is below the optimum, wherever in the box that is."""
    generator = np.random.default_rng(seed)
    theta, left_over = best_pose(problem, generator)
    box = box_about(theta, generator, size)
    bound = RigidBound(Rigid3D(*problem))
    assert 0.0 <= lower_bound(bound, box, tightness * left_over + 1e-12) <= left_over + 1e-9
    parts = Parts(bound.space, box)
    caps = k_assignment(parts.costs(), parts.k)[0] - parts.lost
    assert caps <= left_over + 1e-9
    nearest, _ = nearest_sums(parts.costs(), 0.0, parts.k)
    assert nearest - parts.lost <= caps + 1e-9


@given(centred_pairs(), boxes())
def test_other_bounds_alone_are_below_the_objective_anywhere(problem, box):
    lowest = min(values_in(problem, box))
    parts = Parts(Rigid3D(*problem), box)
    _, narrowed = nearest_sums(parts.costs(), np.linalg.norm(parts.half), parts.k)
    assert narrowed <= lowest + 1e-9
    if len(parts.vertices):
        assert parts.vertex_bound() <= lowest + 1e-9


def test_caps_lose_the_square_of_the_shift(rng):
    """In a box of translations about the optimum a first-order bound loses half of the objective."""
    model, theta, best = noisy_copy(rng, 12, 12, 0.1)
    half = 0.05 * np.array([0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0])
    parts = Parts(model, Box(theta - half, theta + half))
    assert k_assignment(parts.costs(), 12)[0] - parts.lost == pytest.approx(
        best - 12 * 3 * 0.05**2, abs=1e-9
    )
    assert nearest_sums(parts.costs(), np.linalg.norm(parts.half), 12)[1] < 0.5 * best


@given(centred_pairs(), boxes())
def test_candidate_value_is_an_upper_bound_at_the_centre(problem, box):
    exact = values_in(problem, Box(box.centre, box.centre))[0]
    found = RigidBound(Rigid3D(*problem)).evaluate(Boxes.of([box]), 2.0 * exact)
    assert found.values[0] >= exact - 1e-9


@given(centred_pairs(), boxes(halves=(0.0,)))
def test_bound_at_a_single_pose_is_the_objective(problem, box):
    exact = values_in(problem, box)[0]
    bound = lower_bound(RigidBound(Rigid3D(*problem)), box, 1.01 * exact + 1e-6)
    assert bound == pytest.approx(exact, abs=1e-7)


@given(centred_pairs(), boxes(halves=(0.5, 0.1)))
def test_rotations_of_a_box_lie_within_its_angle(problem, box):
    parts = Parts(Rigid3D(*problem), box)
    centre = Rotation.from_quat(box.centre[:4], scalar_first=True)
    for theta in box.sample(np.random.default_rng(1), 30):
        turn = Rotation.from_quat(theta[:4], scalar_first=True) * centre.inv()
        assert turn.magnitude() <= parts.angle + 1e-9


@st.composite
def costs_and_duals(draw):
    generator = np.random.default_rng(draw(SEEDS))
    n, m = draw(st.integers(1, 12)), draw(st.integers(1, 12))
    cost = generator.exponential(size=(n, m)).astype(np.float32)
    duals = draw(st.sampled_from([0.0, 0.3, 3.0])) * generator.random(m)
    return cost, duals.astype(np.float32), draw(st.integers(1, min(n, m)))


def dual_bound(cost, b, k):
    """The bound of dual variables on the k-assignment."""
    return np.sort((cost + b).min(axis=1))[:k].sum() - b.sum()


@given(costs_and_duals())
def test_auction_and_lowered_duals_never_exceed_the_assignment(problem):
    cost, b, k = problem
    n, m = cost.shape
    best = k_assignment(cost.astype(float), k)[0]
    low = np.empty(n, np.float32)
    rough_minima(cost, b, low)
    assert low == pytest.approx((cost + b).min(axis=1))
    level = np.sort(low)[k - 1]
    before = dual_bound(cost, b, k)
    lower_duals(cost, low, level, b)
    assert (b >= 0.0).all()
    assert before - 1e-5 <= dual_bound(cost, b, k) <= best + 1e-5
    limits = Auction(3 * k, level, np.float32(0.02 * level))
    auction(cost, b, low, limits, np.empty((3, max(n, m)), np.int32))
    assert (b >= 0.0).all()
    assert dual_bound(cost, b, k) <= best + 1e-5


@given(st.integers(1, 40), st.integers(1, 40), SEEDS)
def test_rough_costs_are_squared_distances_with_their_row_minima(n, m, seed):
    generator = np.random.default_rng(seed)
    a, b = (generator.standard_normal((3, size)).astype(np.float32) for size in (n, m))
    duals = generator.random(m).astype(np.float32)
    out, low = np.empty((n, m), np.float32), np.empty(n, np.float32)
    rough_costs(a, b, duals, out, low)
    expected = ((a[:, :, None].astype(float) - b[:, None, :]) ** 2).sum(axis=0)
    assert out == pytest.approx(expected, rel=1e-5, abs=1e-6)
    assert low == pytest.approx((out + duals).min(axis=1))


@given(
    centred_pairs(12),
    boxes(halves=(0.3, 0.1, 0.01, 0.0)),
    st.sampled_from([0.0, 0.1, 1.0]),
    SEEDS,
)
def test_sums_at_vertices_are_below_all_displacements(problem, box, level, seed):
    """The vectorised sums, against each vertex on its own and against displacements in between."""
    parts = Parts(Rigid3D(*problem), box)
    if not len(parts.vertices):
        return
    generator = np.random.default_rng(seed)
    n, k = parts.view.source.shape[1], parts.k
    low = generator.exponential(0.1, n)
    found = np.empty(64)
    geometry = BoxGeometry(parts.vertices, parts.half, parts.tangent, 0.0)
    lowest = costs_at_vertices(parts.view, low, geometry, level, np.empty((5, n)), found)
    assert lowest == found.min()
    weights = np.concatenate(
        [np.eye(len(parts.vertices)), generator.dirichlet(np.ones(len(parts.vertices)), 20)]
    )
    signs = np.array([s[::-1] for s in product([1.0, -1.0], repeat=3)])
    sums = []
    for r in weights @ parts.vertices:
        for s in signs * parts.half:
            displacements = 2.0 * np.cross(r, parts.view.source.T) + s
            sums.append(np.sort(low - (displacements**2).sum(axis=1))[:k].sum())
    at_vertices = 8 * len(parts.vertices)
    assert (found[:at_vertices] <= np.array(sums[:at_vertices]) + 1e-9).all()
    assert np.isinf(found[at_vertices:]).all()
    assert lowest <= min(sums) + 1e-9
    if k == n or (box.lower == box.upper).all():
        assert found[:at_vertices] == pytest.approx(np.array(sums[:at_vertices]), abs=1e-9)


@given(st.floats(0.0, 0.6), st.floats(0.0, 1.0), st.floats(0.0, 50.0), st.floats(0.0, 5.0))
def test_what_is_needed_proves_what_it_is_needed_for(tangent, shift_radius, cutoff, drift):
    box, limits = (
        BoxGeometry(np.empty((0, 3)), np.empty(3), tangent, shift_radius),
        Limits(30.0, drift, 9.0),
    )
    for loss in loss_of(box, limits), joint_loss_of(box, limits):
        assert proven(*loss, needed(*loss, cutoff)) == pytest.approx(cutoff, rel=1e-9, abs=1e-9)


@given(
    centred_pairs(10),
    st.sampled_from([0.3, 0.1, 0.01, 0.0]),
    st.sampled_from([0.0, 0.1, 10.0]),
    st.sampled_from([0.0, 1.0, np.inf]),
    SEEDS,
)
def test_any_dual_variables_stay_below_every_matching_at_its_best_pose(
    problem, size, scale, goal, seed
):
    generator = np.random.default_rng(seed)
    theta, left_over = best_pose(problem, generator)
    parts = Parts(Rigid3D(*problem), box_about(theta, generator, size))
    if not len(parts.vertices) or parts.tangent > 0.6:
        return
    source, target, k = problem
    squares = (source**2).sum(axis=1)
    inertia, drift = np.sort(squares)[-k:].sum(), k * largest_subset_mean_3d(source, k)
    shift_radius = np.linalg.norm(parts.half)
    box = BoxGeometry(parts.vertices, parts.half, parts.tangent, shift_radius)
    loss = loss_of(box, Limits(inertia, drift, inertia))
    kept = (scale * 6000 * generator.random(len(target))).astype(np.uint16)
    farthest = np.sqrt(squares.max())
    room = allocate_workspace(len(source), len(target))
    out = np.empty(64)
    found, guess = dual_bound_of_box(parts.view, box, farthest, goal, kept, room, out)
    assert found == out.min()
    assert proven(*loss, found) <= left_over + 1e-9
    assert guess <= k_assignment(parts.squares(), k)[0] + 1e-5 * (1.0 + guess)


def test_inherited_dual_variables_come_near_an_assignment(rng):
    """Along a chain of ever smaller boxes, each elsewhere in the one before."""
    source, target = centred(rng.standard_normal((40, 3))), centred(rng.standard_normal((45, 3)))
    model, kept = Rigid3D(source, target, 30), np.zeros(45, np.uint16)
    room, out = allocate_workspace(40, 45), np.empty(64)
    centre = np.array([1.0, 0.2, -0.3, 0.1, 0.05, 0.02, -0.04])
    for size in 0.2 * 0.8 ** np.arange(15):
        half = size * np.array([0.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0])
        centre = centre + 0.3 * rng.choice([-1.0, 1.0], 7) * half
        parts = Parts(model, Box(centre - half, centre + half))
        box = BoxGeometry(parts.vertices, parts.half, parts.tangent, np.linalg.norm(parts.half))
        _, inherited = dual_bound_of_box(parts.view, box, 4.0, np.inf, kept, room, out)
    best = k_assignment(parts.squares(), 30)[0]
    assert 0.95 * best < inherited <= best + 1e-5
    value, is_final = dual_bound_at_pose(parts.view, 4.0, np.inf, kept, room)
    assert is_final
    assert 0.95 * best < value <= best
    value, is_final = dual_bound_at_pose(parts.view, 4.0, 0.5 * best, kept, room)
    assert not is_final
    assert 0.5 * best <= value <= best


def flat_cloud(generator, count):
    """Points in an ellipsoid, perhaps flat, perhaps far from the origin."""
    axes = generator.choice([0.0, 0.01, 1.0], 3)
    axes[generator.integers(3)] = 1.0
    points = axes * generator.standard_normal((count, 3))
    points += generator.choice([0.0, 1.0, 5.0]) * generator.standard_normal(3)
    return points @ Rotation.random(rng=generator).as_matrix().T


def mean_at_centre_and_vertices(generator):
    """Make pairs whose best pose is a mean of the vertices of a box about the identity.

    Returns E*, half the mean over the vertices of the cost at the centre, less the squared displacement,
    plus the cost at the vertex, the terms of the loss, and the size of the sums.
    """
    x = flat_cloud(generator, generator.integers(1, 8))
    centre = np.append(1.0, generator.uniform(-1.0, 1.0, 3))
    half = np.append(0.0, generator.choice([0.01, 0.1, 0.3]) * generator.random(3))
    buffer = np.empty((8, 3))
    count = relative_vertices(centre, centre - half, centre + half, buffer)
    turns = buffer[:count]
    tangent = np.linalg.norm(turns, axis=1).max()
    turn_weights = generator.dirichlet(np.full(count, generator.choice([0.05, 0.3, 1.0])))
    shift = generator.choice([0.0, 0.1, 1.0, 3.0]) * generator.random(3)
    shifts = np.array(list(product([1.0, -1.0], repeat=3))) * shift
    share = generator.random(3) ** generator.choice([0.2, 1.0, 5.0])
    shift_weights = reduce(np.kron, np.stack([share, 1.0 - share], axis=1))
    turn = Rotation.from_quat(np.append(1.0, turn_weights @ turns), scalar_first=True)
    moved = turn.apply(x) + shift_weights @ shifts
    # targets that fit nowhere better than where the sources lie now
    y = moved + generator.choice([1e-3, 0.1, 1.0, 3.0]) * generator.standard_normal(x.shape)
    back = Rigid3D(y, moved, len(y)).fit(y.T, moved.T)
    y = Rotation.from_quat(back[:4], scalar_first=True).apply(y) + back[4:]
    mean = 0.0
    for r, share in zip(turns, turn_weights, strict=True):
        turned = Rotation.from_quat(np.append(1.0, r), scalar_first=True).apply(x)
        for s, other in zip(shifts, shift_weights, strict=True):
            less = ((x - y) ** 2).sum() - ((2.0 * np.cross(r, x) + s) ** 2).sum()
            mean += share * other * 0.5 * (less + ((turned + s - y) ** 2).sum())
    moments = np.linalg.eigvalsh(x.T @ x)
    box = BoxGeometry(turns, shift, tangent, np.linalg.norm(shift))
    limits = Limits((x**2).sum(), np.linalg.norm(x.sum(axis=0)), moments[-1] - moments[0])
    return ((moved - y) ** 2).sum(), mean, box, limits, (x**2).sum() + ((x - y) ** 2).sum()


def test_mean_of_centre_and_vertices_loses_no_more_than_stated_and_nearly_that(rng):
    """The inequality for one matching; without any of three of its terms it would fail."""
    fails = np.zeros(4, int)
    for _ in range(600):
        best, mean, box, limits, size = mean_at_centre_and_vertices(rng)
        if box.tangent > 0.6:
            continue
        without = (
            limits,
            limits._replace(inertia=0.0),
            limits._replace(drift=0.0),
            limits._replace(spread=0.0),
        )
        for at, terms in enumerate(without):
            loss = joint_loss_of(box, terms)
            if at == 1:  # the term of fourth order stays
                loss = loss._replace(rest=joint_loss_of(box, limits).rest)
            fails[at] += mean > best + loss.root * np.sqrt(best) + loss.rest + 1e-11 * size
    assert fails[0] == 0
    assert (fails[1:] > 0).all(), fails


def near_optimum(generator):
    """A problem with enough pairs for values at vertices, and a local optimum of it."""
    n, m = generator.integers(33, 42, 2)
    both = min(n, m)
    axes = generator.choice([0.0, 0.1, 1.0], 3)
    axes[generator.integers(3)] = 1.0
    source, target = axes * generator.standard_normal((n, 3)), generator.standard_normal((m, 3))
    noise = generator.choice([0.0, 1e-3, 0.1, 0.3]) * generator.standard_normal((both, 3))
    target[:both] = generator.choice([0.5, 1.0, 1.2, 2.0]) * source[:both] + noise
    model = Rigid3D(centred(source), centred(target), int(generator.choice([0.6, 0.9, 1.0]) * both))
    turn = generator.choice([1e-3, 0.3]) * generator.standard_normal(6)
    theta, best, _ = model.refine(model.normalised(np.append(1.0, turn)))
    return model, theta, best


SIZES = [0.3, 0.15, 0.08, 0.03]


@given(SEEDS)
def test_no_box_with_a_local_optimum_is_bounded_above_it(seed):
    """The cutoffs are just above the optimum; one bound serves all boxes."""
    generator = np.random.default_rng(seed)
    model, theta, best = near_optimum(generator)
    bound = RigidBound(model)
    for _ in range(8):
        boxes = Boxes.of([box_about(theta, generator, generator.choice(SIZES))])
        for beyond in 10.0 ** generator.uniform(-4.5, 0.5, 3):
            cutoff = best + beyond * max(best, 0.01)
            boxes.warm_start = None
            for _ in range(2):  # the second time with a warm start
                found = bound.evaluate(boxes, cutoff)
                assert found.lower_bounds[0] <= best + 1e-9
                boxes.warm_start = found.warm_start


def test_limits_of_a_matching_hold_for_every_choice_of_points(rng):
    source = centred(rng.standard_normal((7, 3)) * [2.0, 1.0, 0.5])
    for k in range(1, 8):
        limits = RigidBound(Rigid3D(source, source, k))._limits
        chosen = [source[list(rows)] for rows in combinations(range(7), k)]
        inertia = max((points**2).sum() for points in chosen)
        drift = max(np.linalg.norm(points.sum(axis=0)) for points in chosen)
        spread = max(np.ptp(np.linalg.eigvalsh(points.T @ points)) for points in chosen)
        assert limits.inertia == pytest.approx(inertia)
        assert drift - 1e-9 <= limits.drift <= 1.1 * drift + 1e-9
        assert spread <= limits.spread + 1e-9


@given(st.lists(st.floats(0.0, 10.0), min_size=3, max_size=3))
def test_the_joint_loss_is_slightly_above_its_maximum(parts):
    drift, spread, inertia = parts
    u = np.linspace(0.0, 1.0, 2001)
    most = (drift * u**2 + (spread * u + inertia * u**2) * (1.0 - u**2)).max()
    assert most - 1e-9 <= largest_rest(drift, spread, inertia) <= 1.02 * most + 1e-9


def test_the_joint_loss_of_a_box_is_that_of_its_certificate(rng):
    inertia, mean, spread = rng.uniform(0.0, 5.0, 3)
    check = SimpleNamespace(k=7, inertia=inertia, mean=mean, spread=spread)
    tangents, shifts = rng.uniform(0.0, 0.6, (2, 50))
    found = RigidPoses.joint_loss(check, SimpleNamespace(tangent=tangents, shift=shifts))
    for tangent, shift, *theirs in zip(tangents, shifts, *found, strict=True):
        box = BoxGeometry(np.empty((0, 3)), np.zeros(3), tangent, shift)
        ours = joint_loss_of(box, Limits(inertia, 7 * mean, spread))
        np.testing.assert_allclose(ours, theirs, rtol=1e-12)


def test_without_its_loss_the_bound_would_exceed_local_optima(rng):
    """The preceding test can fail."""
    passed = 0
    for _ in range(60):
        model, theta, best = near_optimum(rng)
        bound = RigidBound(model)
        bound._limits = Limits(0.0, 0.0, 0.0)
        for _ in range(8):
            box = box_about(theta, rng, rng.choice(SIZES))
            cutoff = best + 10.0 ** rng.uniform(-4.5, 0.5) * max(best, 0.01)
            passed += lower_bound(bound, box, cutoff) > best + 1e-6
    assert passed


def test_vertices_have_one_order(rng):
    """At a vertex the displacement and the pose agree to second order."""
    source, target = (centred(rng.standard_normal((size, 3))) for size in (35, 36))
    model = Rigid3D(source, target, 30)
    centre, half = np.array([1.0, 0.2, -0.3, 0.1, 0.05, 0.02, -0.04]), np.full(7, 1e-3)
    half[[0, 2]] = 0.0
    parts = Parts(model, Box(centre - half, centre + half))
    _, col_of = model.objective(centre)
    matched = parts.view.target[:, col_of[col_of >= 0]], parts.view.source[:, col_of >= 0]
    for index in range(8 * len(parts.vertices)):
        pose = np.empty(7)
        vertex_pose(centre - half, centre + half, index, pose)
        signs = 1.0 - 2.0 * np.array([index & 1, index >> 1 & 1, index >> 2 & 1])
        displacements = (
            2.0 * np.cross(parts.vertices[index >> 3], matched[1].T) + signs * parts.half
        )
        turned = model.pose(pose)[:3, :3] @ source[col_of >= 0].T + pose[4:, None]
        turned -= centre[4:, None]
        assert turned == pytest.approx(matched[1] + displacements.T, abs=1e-5)


@pytest.mark.usefixtures("thin_slices")
@pytest.mark.parametrize("threads", [1, 2])
def test_a_bound_that_forgets_vertices_finds_the_same(rng, monkeypatch, threads):
    model, _, _ = noisy_copy(rng, 36, 30, 0.1)

    def search():
        budget = Budget(nodes=60_000)
        return minimise(
            model, RigidBound(model, threads=threads), budget, tolerance=Tolerance(abs=0.3)
        )

    whole = search()
    monkeypatch.setattr(vertex_values, "_REMEMBERED", 2**12)
    forgetful = search()
    assert forgetful.status == whole.status == "optimal"
    assert forgetful.upper_bound == whole.upper_bound
    assert forgetful.n_nodes != whole.n_nodes


def test_values_at_vertices_prune_boxes_that_nothing_else_prunes(rng, monkeypatch):
    model, theta, best = noisy_copy(rng, 40, 30, 0.1)
    centres = theta + rng.choice([-1.0, 1.0], (200, 7)) * rng.uniform(0.1, 0.3, (200, 7))
    half = 0.11 * np.array([0.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0])
    centres[:, 0] = 1.0
    boxes = Boxes(centres - half, centres + half)
    with_vertices = RigidBound(model).evaluate(boxes, best).lower_bounds
    monkeypatch.setattr(VertexValues, "raise_bounds", lambda *_: None)
    without = RigidBound(model).evaluate(boxes, best).lower_bounds
    assert (with_vertices >= without).all()
    assert (with_vertices >= best).sum() > 20 + 2 * (without >= best).sum()


def test_the_strongest_of_two_bounds_is_searched_without_warm_starts(rng):
    model, _, _ = noisy_copy(rng, 8, 6, 0.05)
    one, both = RigidBound(model), Strongest([RigidBound(model), RigidBound(model)])
    found = [
        minimise(model, each, Budget(nodes=3000), tolerance=Tolerance(abs=1e-6))
        for each in (one, both)
    ]
    assert found[0].upper_bound == pytest.approx(found[1].upper_bound)
    assert max(each.lower_bound for each in found) <= found[0].upper_bound


def test_cayley_residual_is_below_the_true_one(rng):
    """The inequality under the second bound, at any rotation and translation."""
    for _ in range(200):
        x, y, t, r = rng.standard_normal((4, 3))
        R = Rotation.from_quat(np.append(1.0, r), scalar_first=True)
        true = ((R.apply(x) + t - y) ** 2).sum() * (1.0 + r @ r)
        s = t - np.cross(r, t)
        assert ((x - y + s + np.cross(r, x + y)) ** 2).sum() <= true + 1e-9


@pytest.mark.parametrize(("k", "size"), [(12, 0.02), (10, 0.002)])
def test_boxes_about_the_optimum_lose_little(k, size, rng):
    """Curvature costs nothing while the matching stays optimal: the loss is far below first order."""
    model, theta, best = noisy_copy(rng, 12, k, 0.03)
    half = size * np.array([0.0, 1.0, 1.0, 1.0, 2.0, 2.0, 2.0])
    parts = Parts(model, Box(theta - half, theta + half))
    assert k_assignment(parts.costs(), k)[0] < 0.7 * best  # first order only
    assert parts.vertex_bound(0.8 * best) >= 0.8 * best


@given(SEEDS, st.integers(1, 7))
def test_subset_mean_is_bounded(seed, count):
    points = np.random.default_rng(seed).standard_normal((7, 3))
    means = [points[list(rows)].mean(axis=0) for rows in combinations(range(7), count)]
    longest = np.linalg.norm(means, axis=1).max()
    assert longest <= largest_subset_mean_3d(points, count) + 1e-12
    assert largest_subset_mean_3d(points, count) <= 1.02 * longest + 1e-12
