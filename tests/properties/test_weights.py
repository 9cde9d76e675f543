"""Weights of points: bounds, optimum, covariance and errors."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import dcreg
from dcreg.families.means import mean_of_largest
from dcreg.families.registry import make_bound
from dcreg.families.rigid3d.bound import RigidBound
from dcreg.families.rigid3d.space import Rigid3D
from dcreg.families.similarity2d.space import Similarity2D
from dcreg.families.similarity3d.bound import SimilarityBound
from dcreg.families.similarity3d.space import SCALE, Similarity3D
from dcreg.names import BOUND_NAMES
from dcreg.problem import InputError, PointWeights, apply_pose, pose_covariance
from dcreg.problem.geometry import fit_pose
from dcreg.search import Box, Boxes
from tests.oracles import kernels as reference
from tests.oracles.matchings import every_matching
from tests.problems import SEEDS, lower_bound, register
from tests.properties.test_rigid_bounds import box_about, centred
from tests.properties.test_similarity3d_bounds import box_in_range
from tests.searches import is_certified

POINTS = np.random.default_rng(2).random((6, 2))
SCALES = {2: (0.5, 1.5), 3: (1.0, 1.0)}
MODELS = {2: "similarity2d", 3: "rigid3d"}
SCALE_RANGES = st.sampled_from([(0.5, 1.5), (1.0, 1.0), (0.9, 1.1), (0.2, 0.4)])


def weighted_problem(seed, dim, most=6, whole=False):
    """Random points, k and weights; with `whole`, all source points match and only they have weights."""
    generator = np.random.default_rng(seed)
    n, m = generator.integers(2, most, 2)
    x, y = generator.standard_normal((n, dim)), generator.standard_normal((m, dim))
    if whole:
        n = int(min(n, m))
        return x[:n], y, n, PointWeights(source=generator.uniform(0.05, 1.0, n))
    k = int(generator.integers(1, min(n, m) + 1))
    rows, columns = (generator.uniform(0.2, 3.0, size) for size in (n, m))
    sides = [{"source": rows}, {"target": columns}, {"source": rows, "target": columns}]
    given = sides[generator.integers(3)]
    return x, y, k, PointWeights(**given, distance=generator.choice([0.1, 1.0]))


def costs_of(x, y, weights, T):
    """The cost of each pair, from the definition."""
    rows = np.ones(len(x)) if weights.source is None else weights.source / weights.source.max()
    columns = np.ones(len(y)) if weights.target is None else weights.target / weights.target.max()
    factors = np.outer(rows, columns)
    squares = ((apply_pose(T, x)[:, None] - y[None]) ** 2).sum(axis=-1)
    return factors * squares + (1.0 - factors) * (weights.distance or 0.0) ** 2


def true_optimum(x, y, k, weights, scale_range):
    """Minimum over all matchings, each with its closed-form pose."""
    dim = x.shape[1]
    rows, columns = every_matching(len(x), len(y), k)
    factors = weights.of_pairs(len(x), len(y), k).factors[rows, columns]
    poses = fit_pose(x[rows], y[columns], scale_range, factors)
    moved = x[rows] @ poses[:, :dim, :dim].swapaxes(1, 2) + poses[:, None, :dim, dim]
    squares = ((moved - y[columns]) ** 2).sum(axis=-1)
    extra = (1.0 - factors) * (weights.distance or 0.0) ** 2
    return float((factors * squares + extra).sum(axis=1).min())


def space_of(x, y, k, weights, **options):
    """A space of weighted pairs, and what it minimises at a parameter."""
    pairs = weights.of_pairs(len(x), len(y), k)
    if x.shape[1] == 2:
        space = Similarity2D(x, y, k, SCALES[2], **options)
    else:
        space = Rigid3D.between(x, y, k, **options)
    if pairs is not None:
        space = space.weighted(pairs)

    def value_at(theta):
        return reference.k_assignment(costs_of(x, y, weights, space.pose(theta)), k)

    return space, value_at


@given(SEEDS, st.sampled_from(BOUND_NAMES), st.booleans())
@settings(max_examples=60)
def test_2d_bounds_hold_for_weighted_points(seed, name, whole):
    x, y, k, weights = weighted_problem(seed, 2, whole=whole)
    space, value_at = space_of(x, y, k, weights)
    generator = np.random.default_rng(seed + 1)
    (box,) = space.roots()
    if name not in ("tight", "shared"):  # these know the lattice of the start box only
        lower = generator.uniform(box.lower, box.upper)
        box = Box(lower, generator.uniform(lower, box.upper))
    bound = lower_bound(make_bound(name, space), box)
    thetas = box.sample(generator, 20)
    for theta in thetas[space.admissible(thetas)]:
        true = value_at(theta)
        assert bound <= true + 1e-9
        assert space.objective(theta)[0] == pytest.approx(true, abs=1e-9)


@given(
    SEEDS,
    st.sampled_from([1.0, 0.3, 0.1, 0.01]),
    st.sampled_from([0.5, 0.95, 1.0, 1.5, 10.0]),
    st.sampled_from([6, 6, 6, 40]),
)
@settings(max_examples=40)
def test_rigid_bound_holds_for_weighted_points(seed, size, tightness, most):
    """It holds for the optima of a box; more than 1,000 pairs are bounded by dual variables."""
    x, y, k, weights = weighted_problem(seed, 3, whole=bool(seed % 2))
    if most > 6:
        generator = np.random.default_rng(seed)
        x = generator.standard_normal((36, 3))
        y = x + 0.1 * generator.standard_normal((36, 3))
        k = 36 if seed % 2 else 30
        weights = PointWeights(source=generator.uniform(0.1, 1.0, 36), distance=0.2)
    x, y = centred(x), centred(y)
    space, value_at = space_of(x, y, k, weights)
    generator = np.random.default_rng(seed + 1)
    root = space.roots()[generator.integers(4)]
    start = generator.uniform(root.lower, root.upper)
    if most > 6:
        start = np.array([1.0, 0, 0, 0, 0, 0, 0])
    theta, best, _ = space.refine(start)
    assert best == pytest.approx(value_at(theta), abs=1e-9)
    box = box_about(space.normalised(theta), generator, size)
    found = RigidBound(space).evaluate(Boxes.of([box]), tightness * best + 1e-12)
    assert 0.0 <= found.lower_bounds[0] <= best + 1e-9
    assert found.values[0] >= value_at(box.centre) - 1e-9


@given(SEEDS)
@settings(max_examples=40)
def test_rigid_bound_at_a_pose_is_the_objective_of_weighted_points(seed):
    x, y, k, weights = weighted_problem(seed, 3)
    space, value_at = space_of(x, y, k, weights)
    theta = np.random.default_rng(seed + 1).uniform(space.roots()[0].lower, space.roots()[0].upper)
    true = value_at(theta)
    bound = lower_bound(RigidBound(space), Box(theta, theta), 1.01 * true + 1e-6)
    assert bound == pytest.approx(true, abs=1e-7)


@given(
    SEEDS,
    SCALE_RANGES,
    st.sampled_from([1.0, 0.3, 0.1, 0.01, 0.0]),
    st.sampled_from([0.5, 0.95, 1.0, 1.5, 10.0]),
)
@settings(max_examples=100)
def test_similarity_bound_holds_for_weighted_points(seed, scale_range, size, tightness):
    """It is below the cost of every matching at its best pose, wherever in the box that is."""
    x, y, k, weights = weighted_problem(seed, 3, whole=bool(seed % 2))
    x, y, generator = centred(x), centred(y), np.random.default_rng(seed + 1)
    space = Similarity3D(x, y, k, scale_range)
    if pairs := weights.of_pairs(len(x), len(y), k):
        space = space.weighted(pairs)
    rows, columns = every_matching(len(x), len(y), k)
    at = generator.integers(len(rows))
    col_of = np.full(len(x), -1)
    col_of[rows[at]] = columns[at]
    theta = space.normalised(space.fit_matching(np.empty(0), col_of))
    for end in scale_range:  # which rounding must not exclude from the box
        theta[SCALE] = end if np.isclose(theta[SCALE], end) else theta[SCALE]
    costs = costs_of(x, y, weights, space.pose(theta))
    best = costs[rows[at], columns[at]].sum()
    assert space.objective(theta)[0] == pytest.approx(reference.k_assignment(costs, k), abs=1e-9)
    box = box_in_range(theta, generator, size, scale_range, space.only_rotates)
    assert 0.0 <= lower_bound(SimilarityBound(space), box, tightness * best + 1e-12) <= best + 1e-9


@given(SEEDS)
@settings(max_examples=40)
def test_start_boxes_contain_the_weighted_optima(seed):
    for dim in (2, 3):
        x, y, k, weights = weighted_problem(seed, dim)
        space, _ = space_of(x, y, k, weights)
        generator = np.random.default_rng(seed)
        root = space.roots()[0]
        theta, value, _ = space.refine(generator.uniform(root.lower, root.upper))
        if np.isfinite(value):
            assert (theta[-dim:] >= root.lower[-dim:] - 1e-9).all()
            assert (theta[-dim:] <= root.upper[-dim:] + 1e-9).all()


@given(SEEDS, st.sampled_from([0.0, 0.1, 0.5, 1.0]))
def test_means_with_weights_do_not_exceed_their_bound(seed, lightest):
    generator = np.random.default_rng(seed)
    values, count = generator.standard_normal(5), int(generator.integers(1, 6))
    ends = [lightest, 1.0]
    means = [
        np.average(values[list(rows)], weights=weights)
        for rows in itertools.combinations(range(5), count)
        for weights in itertools.product(ends, repeat=count)
        if sum(weights) > 0.0
    ]
    assert mean_of_largest(values, count, lightest) == pytest.approx(max(means))


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("whole", [False, True])
@pytest.mark.parametrize("seed", [2, 3, 4, 7])
def test_the_weighted_optimum_is_found(seed, whole, dim):
    x, y, k, weights = weighted_problem(seed, dim, most=6 if dim == 3 else 7, whole=whole)
    optimum = true_optimum(x, y, k, weights, SCALES[dim])
    gap = {2: 0.05, 3: 0.5}[dim] * optimum
    found = register(
        x, y, n_inliers=k, model=MODELS[dim], weights=weights, rel_gap=0.0, abs_gap=gap, prove=True
    )
    assert is_certified(found, optimum, found.gap_tol)
    assert found.certificate_scope.endswith("pose, weighted points")
    assert optimum - 1e-9 <= found.objective <= found.objective_certified + 1e-9
    costs = costs_of(x, y, weights, found.T_target_source)
    rows, columns = found.assignment.T
    assert found.objective == pytest.approx(costs[rows, columns].sum())


@pytest.mark.parametrize("whole", [False, True])
@pytest.mark.parametrize("seed", [2, 4, 11])
def test_the_weighted_similarity_is_found(seed, whole):
    x, y, k, weights = weighted_problem(seed, 3, most=5, whole=whole)
    optimum = true_optimum(x, y, k, weights, (0.8, 1.2))
    found = register(
        x, y, n_inliers=k, model="similarity3d", scale_range=(0.8, 1.2), weights=weights,
        rel_gap=0.0, abs_gap=0.5 * optimum, prove=True,
    )  # fmt: skip
    assert is_certified(found, optimum, found.gap_tol)
    assert found.certificate_scope == "similarity pose, weighted points"
    assert optimum - 1e-9 <= found.objective <= found.objective_certified + 1e-9


@pytest.mark.parametrize("seed", range(3))
def test_a_sweep_encloses_the_weighted_optima(seed):
    generator = np.random.default_rng(seed)
    x, y = generator.standard_normal((5, 2)), generator.standard_normal((4, 2))
    weights = PointWeights(source=generator.uniform(0.2, 3.0, 5), distance=1.0)
    numbers = [4, 2, 3]  # the bounds of 2 hold for more
    found = dcreg.sweep(x, y, numbers, model="similarity2d", weights=weights, rel_gap=0.05)
    for result in found.results:
        optimum = true_optimum(x, y, result.n_inliers, weights, SCALES[2])
        assert result.lower_bound - 1e-9 <= optimum <= result.upper_bound + 1e-9
        assert result.certificate_scope == "similarity pose, weighted points"


def test_a_sweep_suggests_a_number_by_residuals_without_weights():
    """The costs of pairs of low weight are nearly constant, so they show no increase."""
    generator = np.random.default_rng(5)
    x = generator.random((24, 2))
    y = x + 0.01 * generator.standard_normal((24, 2))
    y[16:] = generator.random((8, 2))
    weights = PointWeights(source=generator.uniform(0.2, 1.0, 24), distance=0.05)
    found = dcreg.sweep(
        x, y, [12, 14, 16, 17, 18, 20], model="similarity2d", weights=weights, node_limit=50
    )
    for result, residual in zip(found.results, found.residuals, strict=True):
        rows, columns = result.assignment.T
        moved = apply_pose(result.T_target_source, x[rows])
        assert residual == pytest.approx(np.sqrt(((moved - y[columns]) ** 2).sum(axis=1).mean()))
    assert found.suggested_n_inliers == 16
    assert dcreg.SweepResult(found.results, found.proven_by).suggested_n_inliers != 16


def test_a_sweep_needs_a_distance_for_its_smallest_number():
    weights = PointWeights(np.arange(1.0, 7.0))
    with pytest.raises(InputError, match=r"n_inliers=4 of 6 source .* give distance"):
        dcreg.sweep(POINTS, POINTS, [6, 4], model="similarity2d", weights=weights)


@pytest.mark.parametrize("dim", [2, 3])
def test_certify_judges_by_weighted_costs(dim):
    """The best pose without weights is optimal only without them."""
    generator = np.random.default_rng(dim)
    x = generator.standard_normal((5, dim))
    y = x + 0.1 * generator.standard_normal((5, dim))
    y[[1, 3]] += 0.3  # the light points
    weights = PointWeights(source=np.array([1.0, 0.05, 1.0, 0.05, 1.0]))
    gap = {2: 0.01, 3: 0.3}[dim]
    optimum = true_optimum(x, y, 5, weights, SCALES[dim])
    plain, best = (
        register(x, y, n_inliers=5, model=MODELS[dim], weights=given, rel_gap=gap, prove=True)
        for given in (None, weights)
    )
    for pose, verdict in ((best.T_target_source, "optimal"), (plain.T_target_source, "improvable")):
        found = dcreg.certify(
            x, y, pose, n_inliers=5, model=MODELS[dim], weights=weights, rel_gap=gap,
            options=dcreg.SolveOptions(prove=True),
        )  # fmt: skip
        costs = costs_of(x, y, weights, pose)
        assert found.verdict == verdict
        assert found.objective == pytest.approx(reference.k_assignment(costs, 5))
        assert found.lower_bound <= optimum + 1e-9
    assert "RMS residual" not in str(found)  # the weights change the costs


def test_certify_does_not_prove_a_pose_by_the_constant_part_of_the_costs():
    """The weights alone cost 3.5, so 1 % of the objective is more than the rough pose loses."""
    x = np.random.default_rng(0).random((8, 2))
    weights, rough = PointWeights(source=1.0 + np.arange(8.0), distance=1.0), np.eye(3)
    rough[0, 2] = 0.02
    for pose, y, rel_gap, verdict in (
        (rough, x, 0.01, "open"),
        (rough, x, 1e-4, "improvable"),
        (np.eye(3), x, 0.01, "optimal"),
        (np.eye(3), x + 0.5 * np.eye(8, 2), 1e-4, "improvable"),
    ):
        found = dcreg.certify(
            x, y, pose, n_inliers=8, model="similarity2d", weights=weights, rel_gap=rel_gap
        )
        assert found.verdict == verdict
        assert found.constant_cost == pytest.approx(3.5)
        assert "RMS residual" not in dict(found.entries())["objective"]
        is_about_weights = "about residuals" in dict(found.entries())["lower bound"]
        assert is_about_weights == (pose is rough)


@pytest.mark.parametrize("dim", [2, 3])
def test_weights_and_candidates_hold_together(dim):
    x, y, _, _ = weighted_problem(0, dim)
    generator = np.random.default_rng(3)
    x, y = generator.standard_normal((2, 5, dim))
    weights = PointWeights(source=generator.uniform(0.1, 1.0, 5), distance=2.0)
    mask = generator.random((5, 5)) < 0.5
    np.fill_diagonal(mask, True)
    found = register(
        x, y, n_inliers=4, model=MODELS[dim], weights=weights, candidates=mask, rel_gap=0.5
    )
    assert mask[found.assignment[:, 0], found.assignment[:, 1]].all()
    costs = costs_of(x, y, weights, found.T_target_source)
    allowed = np.where(mask, costs, 1e6)
    assert found.objective == pytest.approx(reference.k_assignment(allowed, 4))


@pytest.mark.parametrize("dim", [2, 3])
def test_equal_weights_change_nothing(dim):
    generator = np.random.default_rng(1)
    x = generator.random((12, dim))
    y = x + 0.01 * generator.standard_normal((12, dim))
    runs = [
        register(x, y, n_inliers=12, model=MODELS[dim], weights=weights)
        for weights in (None, PointWeights(), PointWeights(np.full(12, 3.0), np.ones(12), 0.5))
    ]
    for found in runs:
        values = {k: v for k, v in found.to_dict().items() if "time" not in k and k != "stages"}
        assert values == {k: v for k, v in runs[0].to_dict().items() if k in values}


@pytest.mark.parametrize("dim", [2, 3])
def test_a_light_outlier_does_not_disturb_the_pose(dim):
    generator = np.random.default_rng(0)
    x = generator.random((15, dim))
    y = x + 1.0
    y[0] += 0.3
    weights = PointWeights(source=[1e-4] + 14 * [1.0])
    plain, light = (
        register(x, y, n_inliers=15, model=MODELS[dim], weights=given) for given in (None, weights)
    )
    assert light.status is dcreg.Status.OPTIMAL
    assert np.abs(light.T_target_source @ np.append(x[5], 1.0))[:dim] == pytest.approx(
        y[5], abs=1e-4
    )
    assert np.abs((plain.T_target_source @ np.append(x[5], 1.0))[:dim] - y[5]).max() > 5e-3


@pytest.mark.parametrize("dim", [2, 3])
def test_the_covariance_of_weighted_pairs_is_that_of_samples(dim):
    generator = np.random.default_rng(4)
    x, weights = generator.random((30, dim)), generator.choice([0.05, 1.0], 30)
    sizes = 0.01 / np.sqrt(weights)
    noise = sizes[:, None] * generator.standard_normal((4000, 30, dim))
    poses = fit_pose(np.broadcast_to(x, noise.shape), x + noise, (1.0, 1.0), weights)
    sampled = np.cov(poses[:, :dim, dim], rowvar=False)
    stated = np.mean(
        [
            pose_covariance(T, x, x + one, weights)[-dim:, -dim:] if dim == 3
            else pose_covariance(T, x, x + one, weights)[1:3, 1:3]
            for T, one in zip(poses[:50], noise[:50], strict=True)
        ],
        axis=0,
    )  # fmt: skip
    np.testing.assert_allclose(np.diag(stated), np.diag(sampled), rtol=0.12)


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        (PointWeights([1.0] * 5), r"source has the shape \(5,\), but there are 6 source points"),
        (PointWeights(None, [1.0] * 5), r"target has the shape \(5,\), but there are 6 target"),
        (PointWeights([1, 1, -2, 1, 1, 1]), "source has -2.0 in row 2; give positive numbers"),
        (PointWeights([1, 1, 1, np.nan, 1, 1]), "source has nan in row 3"),
        (PointWeights([0.0] * 6), "source has 0.0 in row 0; .* leave out points"),
        (PointWeights([1, 1, 1, 1, 1, 1e-12]), "ranges from 1e-12 to 1"),
        (PointWeights(["heavy"] * 6), "source is not an array of numbers"),
        (PointWeights([1, 2, 3, 4, 5, 6], distance=0.0), "distance 0.0 is not a positive number"),
        (PointWeights([1, 2, 3, 4, 5, 6]), "n_inliers=4 of 6 source and 6 target .* give distance"),
        ([1.0] * 6, "is not a PointWeights"),
    ],
)
def test_bad_weights_are_refused(weights, message):
    with pytest.raises(InputError, match=f"weights: .*{message}"):
        dcreg.register(POINTS, POINTS, n_inliers=4, model="similarity2d", weights=weights)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            {"model": "rigid3d", "mode": "paper"},
            "weights: not supported by rigid3d in mode 'paper'; use mode 'full'$",
        ),
        (
            {"model": "rigid3d", "bound": "dc"},
            "weights: not supported by rigid3d in mode 'paper'; use mode 'full' and omit bound$",
        ),
        ({"model": "rigid3d", "certificate": True}, "certificate: cannot be combined with weights"),
        ({"model": "rigid3d", "max_rms": 0.1}, "max_rms: cannot be combined with weights"),
        ({"model": "rigid3d", "downsample": 4}, "downsample: weights would not be used"),
        (
            {"model": "rigid3d", "pose_range": dcreg.PoseRange(max_angle=30)},
            "pose_range: cannot be combined with weights; omit pose_range or weights",
        ),
    ],
)
def test_settings_without_weights_refuse_them(settings, message):
    points = np.random.default_rng(0).random((6, 3))
    weights = PointWeights(np.arange(1.0, 7.0))
    with pytest.raises(InputError, match=message):
        register(points, points, n_inliers=6, weights=weights, **settings)


def test_many_weighted_points_are_refused():
    points = np.random.default_rng(0).random((1100, 3))
    weights = PointWeights(np.linspace(1.0, 2.0, 1100))
    with pytest.raises(InputError, match="weights: 1100 x 1100 pairs exceed 1,200,000; downsample"):
        register(points, points, n_inliers=1100, model="rigid3d", weights=weights)


def test_a_light_pair_that_does_not_fit_makes_no_exact_fit(rng):
    points = rng.random((12, 2))
    moved = points + 3.0
    moved[0] += 0.01
    weights = PointWeights(source=[1e-8, *[1.0] * 11])
    found = register(points, moved, n_inliers=12, model="similarity2d", weights=weights)
    assert 0.0 < found.objective < 1e-11
    assert not found.is_exact
    assert register(
        points, points + 3.0, n_inliers=12, model="similarity2d", weights=weights
    ).is_exact
