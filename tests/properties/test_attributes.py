"""Attributes of points: bounds, optimum, composition with weights and candidates, and errors."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import dcreg
from dcreg.families.registry import make_bound
from dcreg.families.rigid3d.bound import RigidBound
from dcreg.families.rigid3d.space import Rigid3D
from dcreg.families.similarity2d.space import Similarity2D
from dcreg.names import BOUND_NAMES
from dcreg.problem import InputError, PairWeights, PointWeights, apply_pose
from dcreg.problem.attributes import Attributes
from dcreg.problem.geometry import fit_pose
from tests.oracles import kernels as reference
from tests.oracles.matchings import every_matching
from tests.problems import SEEDS, lower_bound, register
from tests.properties.test_rigid_bounds import box_about, centred
from tests.searches import is_certified

SCALES = {2: (0.5, 1.5), 3: (1.0, 1.0)}
MODELS = {2: "similarity2d", 3: "rigid3d"}
POINTS = {dim: np.random.default_rng(2).random((6, dim)) for dim in (2, 3)}
GREY = np.arange(6.0)


def problem(seed, dim, most=6):
    """Random clouds, k, and attributes with one or three numbers, some of them equal."""
    generator = np.random.default_rng(seed)
    n, m = generator.integers(2, most + 1, 2)
    x, y = generator.standard_normal((n, dim)), generator.standard_normal((m, dim))
    k = int(generator.integers(1, min(n, m) + 1))
    shape = () if seed % 2 else (3,)
    a, b = (generator.random((size, *shape)).round(1) for size in (n, m))
    return x, y, k, Attributes(a, b, float(generator.choice([0.1, 1.0, 10.0])))


def attribute_costs(attributes):
    """The costs that attributes add, from the definition."""
    a, b = (
        np.asarray(each).reshape(len(each), -1) for each in (attributes.source, attributes.target)
    )
    return attributes.scale**2 * ((a[:, None] - b[None]) ** 2).sum(axis=-1)


def optimum(x, y, k, extra, factors=None, allowed=None, scale_range=None):
    """Minimum over all matchings, each with its closed-form pose."""
    dim = x.shape[1]
    rows, columns = every_matching(len(x), len(y), k)
    if allowed is not None:
        kept = allowed[rows, columns].all(axis=1)
        rows, columns = rows[kept], columns[kept]
    weights = np.ones(rows.shape) if factors is None else factors[rows, columns]
    poses = fit_pose(x[rows], y[columns], scale_range or SCALES[dim], weights)
    moved = x[rows] @ poses[:, :dim, :dim].swapaxes(1, 2) + poses[:, None, :dim, dim]
    squares = ((moved - y[columns]) ** 2).sum(axis=-1)
    return float((weights * squares + extra[rows, columns]).sum(axis=1).min())


def space_of(x, y, k, attributes):
    """A space with the costs, and what it minimises at a parameter."""
    extra = attribute_costs(attributes)
    space = Similarity2D(x, y, k, SCALES[2]) if x.shape[1] == 2 else Rigid3D.between(x, y, k)

    def value_at(theta):
        squares = ((apply_pose(space.pose(theta), x)[:, None] - y[None]) ** 2).sum(axis=-1)
        return reference.k_assignment(squares + extra, k)

    return space.weighted(PairWeights(np.ones_like(extra), extra)), value_at


@given(SEEDS, st.sampled_from(BOUND_NAMES))
@settings(max_examples=60)
def test_2d_bounds_hold_with_attributes(seed, name):
    space, value_at = space_of(*problem(seed, 2))
    generator = np.random.default_rng(seed + 1)
    (box,) = space.roots()
    bound = lower_bound(make_bound(name, space), box)
    assert bound >= space.floor or space.floor == 0.0
    thetas = box.sample(generator, 20)
    for theta in thetas[space.admissible(thetas)]:
        true = value_at(theta)
        assert bound <= true + 1e-9
        assert space.objective(theta)[0] == pytest.approx(true, abs=1e-9)


@given(SEEDS, st.sampled_from([1.0, 0.3, 0.01]), st.sampled_from([0.5, 1.0, 1.5, 10.0]))
@settings(max_examples=40)
def test_rigid_bound_holds_with_attributes(seed, size, tightness):
    x, y, k, attributes = problem(seed, 3)
    space, value_at = space_of(centred(x), centred(y), k, attributes)
    generator = np.random.default_rng(seed + 1)
    root = space.roots()[generator.integers(4)]
    theta, best, _ = space.refine(generator.uniform(root.lower, root.upper))
    assert best == pytest.approx(value_at(theta), abs=1e-9)
    box = box_about(space.normalised(theta), generator, size)
    bound = lower_bound(RigidBound(space), box, tightness * best + 1e-12)
    assert 0.0 <= bound <= best + 1e-9


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("seed", range(8))
def test_the_optimum_is_that_of_all_matchings(seed, dim):
    x, y, k, attributes = problem(seed, dim, most=5 if dim == 3 else 6)
    best = optimum(x, y, k, attribute_costs(attributes))
    gap = {2: 0.05, 3: 0.5}[dim] * best
    found = register(
        x, y, n_inliers=k, model=MODELS[dim], attributes=attributes, rel_gap=0.0, abs_gap=gap,
        prove=True, time_limit=20,
    )  # fmt: skip
    assert is_certified(found, best, found.gap_tol)
    assert best - 1e-9 <= found.objective <= found.objective_certified + 1e-9
    assert found.certificate_scope.endswith("pose, with attributes")
    rows, columns = found.assignment.T
    assert found.attribute_cost == pytest.approx(attribute_costs(attributes)[rows, columns].sum())
    moved = apply_pose(found.T_target_source, x)
    rms = np.sqrt(((moved[rows] - y[columns]) ** 2).sum(axis=1).mean())
    assert found.rmse_matched == pytest.approx(rms, abs=1e-6)
    assert f"{found.attribute_cost:.6g} of the objective" in str(found)


def test_the_similarity_in_3d_is_that_of_all_matchings():
    """All points match: without attributes, the best matching would not depend on the scale."""
    generator = np.random.default_rng(0)
    x, y = (points - points.mean(axis=0) for points in generator.standard_normal((2, 4, 3)))
    attributes = Attributes(generator.random(4), generator.random(4), 2.0)
    best = optimum(x, y, 4, attribute_costs(attributes), scale_range=(0.8, 1.2))
    found = register(
        x, y, n_inliers=4, model="similarity3d", scale_range=(0.8, 1.2), attributes=attributes,
        rel_gap=0.0, abs_gap=0.4 * best, prove=True, time_limit=20,
    )  # fmt: skip
    assert is_certified(found, best, found.gap_tol)
    assert found.objective == pytest.approx(best)
    judged = dcreg.certify(
        x, y, found.T_target_source, n_inliers=4, model="similarity3d", attributes=attributes,
        scale_range=(0.8, 1.2), abs_gap=0.4 * best,
    )  # fmt: skip
    assert judged.objective == pytest.approx(best)
    assert "RMS residual" not in dict(judged.entries())["objective"]


@pytest.mark.parametrize("dim", [2, 3])
def test_attributes_hold_with_weights_and_candidates(dim):
    generator = np.random.default_rng(3)
    x, y = generator.standard_normal((2, 5, dim))
    v = generator.uniform(0.1, 1.0, 5)
    attributes = Attributes(generator.random(5), generator.random(5), 2.0)
    mask = generator.random((5, 5)) < 0.5
    np.fill_diagonal(mask, True)
    factors = np.repeat(v[:, None] / v.max(), 5, axis=1)
    extra = factors * attribute_costs(attributes) + (1.0 - factors) * 2.0**2
    best = optimum(x, y, 4, extra, factors, mask)
    found = register(
        x, y, n_inliers=4, model=MODELS[dim], weights=PointWeights(source=v, distance=2.0),
        attributes=attributes, candidates=mask, rel_gap=0.5, prove=True, time_limit=20,
    )  # fmt: skip
    assert is_certified(found, best, found.gap_tol)
    assert found.certificate_scope.endswith("pose, weighted points, with attributes")
    rows, columns = found.assignment.T
    assert mask[rows, columns].all()
    own = (factors * attribute_costs(attributes))[rows, columns].sum()
    assert found.attribute_cost == pytest.approx(own)


def vertices(dim):
    """A square or a cube, with a number for each vertex."""
    axes = np.meshgrid(*[[0.0, 1.0]] * dim, indexing="ij")
    return np.stack(axes, axis=-1).reshape(-1, dim), np.arange(2.0**dim)


@pytest.mark.parametrize("dim", [2, 3])
def test_colours_decide_the_pose_of_a_symmetric_shape(dim):
    """Only one of the 4 or 24 turns onto itself agrees with the colours."""
    points, colours = vertices(dim)
    turn = np.eye(dim)
    turn[:2, :2] = [[0.0, -1.0], [1.0, 0.0]]
    target = points @ turn.T + 3.0
    order = np.random.default_rng(0).permutation(len(points))
    target, others = target[order], colours[order] + 0.01
    found = register(
        points, target, n_inliers=len(points), model=MODELS[dim],
        attributes=Attributes(colours, others, 0.1),
    )  # fmt: skip
    assert found.status is dcreg.Status.OPTIMAL
    np.testing.assert_allclose(found.rotation, turn, atol=1e-6)
    assert (others[found.assignment[:, 1]].round() == colours[found.assignment[:, 0]]).all()
    assert found.lower_bound > 0.0
    assert found.objective == pytest.approx(found.attribute_cost)
    assert not found.is_exact
    assert not found.warnings


@pytest.mark.parametrize(("dim", "stage"), [(2, "distances"), (3, "triples")])
def test_excluded_poses_contain_no_optimum_with_attributes(dim, stage):
    """Weights that hardly differ give the same problem, but a search that excludes no poses."""
    generator = np.random.default_rng(5)
    x = generator.random((36, dim))
    y = x + 0.02 * generator.standard_normal((36, dim))
    y[30:] = generator.random((6, dim))
    grey = generator.random(36).round(1)
    attributes = Attributes(grey, grey + 0.1 * generator.random(36), 0.03)
    flat = PointWeights(source=[1.0 - 1e-9, *[1.0] * 35], distance=1e-3)
    found, other = (
        register(
            x, y, n_inliers=30, model=MODELS[dim], attributes=attributes, weights=weights,
            node_limit=100_000,  # so that the clock does not decide whether a stage is tried
        )
        for weights in (None, flat)
    )  # fmt: skip
    assert found.status is other.status is dcreg.Status.OPTIMAL
    assert stage in {each.name for each in found.stages if each.outside is not None}
    assert not [each for each in other.stages if each.outside is not None]
    assert found.objective == pytest.approx(other.objective, rel=1e-6)
    assert found.lower_bound <= other.objective * (1.0 + 1e-6)


@pytest.mark.parametrize("dim", [2, 3])
def test_equal_attributes_change_nothing(dim):
    x = POINTS[dim]
    flat = Attributes(np.full(6, 0.3), np.full(6, 0.3), 0.5)
    runs = [
        register(x, x + 0.1 * x**2, n_inliers=6, model=MODELS[dim], attributes=each)
        for each in (None, flat)
    ]
    first, other = (
        {k: v for k, v in each.to_dict().items() if "time" not in k and k != "stages"}
        for each in runs
    )
    assert first == other
    assert first["attribute_cost"] is None


@pytest.mark.parametrize(
    ("attributes", "message"),
    [
        (Attributes(GREY[:5], GREY, 1.0), r"source has the shape \(5,\), but there are 6 source"),
        (Attributes(GREY, GREY[:5], 1.0), r"target has the shape \(5,\), but there are 6 target"),
        (Attributes(GREY, None, 1.0), r"target has the shape \(\), but"),
        (Attributes(np.empty((6, 0)), GREY, 1.0), r"source has the shape \(6, 0\)"),
        (Attributes(np.ones((6, 3)), GREY, 1.0), "source has 3 numbers per point, target 1"),
        (Attributes(GREY, [0, 1, np.nan, 3, 4, 5], 1.0), r"target has \[nan\] in row 2"),
        (Attributes(["red"] * 6, GREY, 1.0), "source is not an array of real numbers"),
        (Attributes(GREY * 1j, GREY, 1.0), "source is not an array of real numbers"),
        (Attributes(GREY, GREY, 0.0), "scale 0.0 is not a positive number"),
        (Attributes(GREY, GREY, np.nan), "scale nan is not a positive number"),
        (Attributes(GREY, GREY, True), "scale True is not a positive number"),
        (Attributes(GREY, GREY, 1e3), "scale 1000 makes .* residual of 5000, .* smaller scale"),
        (Attributes(GREY * 1e300, GREY, 1e3), "scale 1000 makes .* residual of inf"),
        (GREY, "ndarray is not an Attributes; give one such as"),
    ],
)
def test_bad_attributes_are_refused(attributes, message):
    with pytest.raises(InputError, match=f"^attributes: .*{message}"):
        dcreg.register(
            POINTS[2], POINTS[2], n_inliers=4, model="similarity2d", attributes=attributes
        )


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"mode": "paper"}, "attributes: not supported by rigid3d in mode 'paper'"),
        ({"certificate": True}, "certificate: cannot be combined with attributes; omit"),
        ({"max_rms": 0.1}, "max_rms: cannot be combined with attributes"),
        ({"downsample": 4}, "downsample: attributes would not be used with a sample"),
        ({"n_inliers": "auto"}, "n_inliers: attributes need a number of pairs; run once without"),
        (
            {"pose_range": dcreg.PoseRange(max_angle=30)},
            "pose_range: cannot be combined with attributes; omit pose_range or attributes",
        ),
    ],
)
def test_settings_without_attributes_refuse_them(settings, message):
    given = {"n_inliers": 6, "model": "rigid3d", **settings}
    with pytest.raises(InputError, match=message):
        register(POINTS[3], POINTS[3], attributes=Attributes(GREY, GREY + 1.0, 0.1), **given)


def test_many_points_with_attributes_are_refused_before_they_take_memory():
    points, grey = np.random.default_rng(0).random((200_000, 3)), np.arange(2e5)
    message = "attributes: 200000 x 200000 pairs exceed 1,200,000; downsample both clouds first"
    with pytest.raises(InputError, match=message):
        register(
            points, points, n_inliers=0.5, model="rigid3d", attributes=Attributes(grey, grey, 1e-9)
        )
