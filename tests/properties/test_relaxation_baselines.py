"""RPM-HTB, RPM-BP and HBSP: their bounds lie below the objective, and no wrong optimum is certified.

The suite uses a few small problems; ``SMALL_PROBLEMS=1000 pytest`` of this file uses 1,000.
"""

from __future__ import annotations

import itertools
import os
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from baselines import registry
from baselines.contract import BoxBounding, Instance, Limits
from baselines.hbsp.lifted import LiftedBox
from baselines.hbsp.rotation import SemidefiniteRotationBound, quaternion_form, rotation_range
from baselines.hbsp.similarity import SemidefiniteBound
from baselines.rpm_bp.bound import BilinearBound, best_multipliers, separable
from baselines.rpm_htb.bounds import TermwiseR1, TermwiseR2
from baselines.rpm_htb.lp import TermwiseR3
from dcreg.assignment.objective import objective
from dcreg.families.rotation3d.space import Rotation3D
from dcreg.families.similarity2d.space import Similarity2D
from dcreg.families.translation3d.space import Translation3D
from dcreg.problem import rms_radius
from dcreg.search import Box, Boxes, Budget, LongestEdge, minimise
from dcreg.status import Status
from tests.oracles import kernels as reference
from tests.problems import models_with_boxes
from tests.properties.test_rotation_bounds import facet_boxes, problems

N_PROBLEMS = int(os.environ.get("SMALL_PROBLEMS", "25"))
BOUNDS = [BilinearBound, SemidefiniteBound, TermwiseR1, TermwiseR2, TermwiseR3]
BOTH = ("similarity2d", "norm3d")
FAMILIES = {TermwiseR1: BOTH, TermwiseR2: BOTH}  # of a bound; the others are written for 2D only
planar = models_with_boxes(families=("similarity2d",))


def families(bound):
    return models_with_boxes(families=FAMILIES.get(bound, ("similarity2d",)))


def value(bound, box):
    return bound.evaluate(Boxes.of([box]), np.inf).lower_bounds[0]


def slack(model):
    """Tolerance for rounding and the precision of the solver, relative to the terms of the objective."""
    return 1e-7 * model.n_inliers * (1 + (model.source**2).sum() + (model.clouds.target**2).sum())


# --- bounds over boxes of similarities ----------------------------------------------------------


@pytest.mark.parametrize("bound", BOUNDS)
@given(data=st.data())
def test_bound_is_below_the_objective_anywhere_in_the_box(bound, data):
    model, box = data.draw(families(bound))
    found = bound(model).evaluate(Boxes.of([box]), np.inf)
    thetas = np.concatenate([box.sample(np.random.default_rng(0), 40), box.vertices()])
    thetas = thetas[model.admissible(thetas)]
    objectives = [reference.objective(model, theta) for theta in thetas]
    assert found.lower_bounds[0] <= min(objectives, default=np.inf) + 1e-9
    if np.isfinite(found.values[0]):
        if bound is not TermwiseR3:  # its candidate is moved to an admissible scale
            assert (box.lower <= found.thetas[0]).all()
            assert (found.thetas[0] <= box.upper).all()
        expected = reference.objective(model, found.thetas[0])
        assert found.values[0] == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("bound", BOUNDS)
@pytest.mark.parametrize("half", [0.0, 1e-7])
@given(data=st.data())
def test_bound_closes_on_the_objective_at_a_point(bound, half, data):
    """This also checks that the solver's multipliers are good: poor ones give a valid but weak bound."""
    model, box = data.draw(families(bound))
    theta = box.centre if model.admissible(box.centre[None])[0] else model.identity
    found = value(bound(model), Box(theta - half, theta + half))
    tolerance = slack(model) + 1e3 * half
    assert found == pytest.approx(reference.objective(model, theta), abs=tolerance)


@given(planar)
def test_more_of_the_envelope_never_weakens(model_and_box):
    """RPM-HTB's R1 <= RPM-BP <= HBSP, box by box: each keeps more of the products of parameters."""
    model, box = model_and_box
    if not model.touches(box.lower[None], box.upper[None])[0]:
        return
    weakest = value(TermwiseR1(model), box)
    middle, strongest = value(BilinearBound(model), box), value(SemidefiniteBound(model), box)
    assert weakest <= middle + slack(model)
    # approximate multipliers make both bounds weaker than their exact values
    assert middle <= strongest + 2.0 * slack(model)


@pytest.mark.parametrize(
    ("bound", "family"),
    [(bound, family) for bound in BOUNDS for family in FAMILIES.get(bound, BOTH[:1])],
)
def test_threads_do_not_change_a_bound(bound, family, rng):
    if family == "similarity2d":
        model = Similarity2D(rng.normal(size=(8, 2)), rng.normal(size=(7, 2)), 5, (0.5, 1.5))
    else:
        model = Translation3D(rng.normal(size=(8, 3)), rng.normal(size=(7, 3)), 5)
    dim = model.axis_weights.size
    boxes = Boxes(np.full((1, dim), -0.5), np.full((1, dim), 0.5))
    for _ in range(3):
        boxes = LongestEdge(model.axis_weights)(boxes)
    one, two = (bound(model, threads=threads).evaluate(boxes, np.inf) for threads in (1, 2))
    np.testing.assert_array_equal(one.lower_bounds, two.lower_bounds)
    np.testing.assert_array_equal(one.values, two.values)


# --- certified from multipliers -----------------------------------------------------------------


def quadratic_program(generator):
    squares = generator.uniform(0, 2, 4) * (generator.random(4) < 0.7)
    return squares, generator.normal(size=4), generator.normal(size=4)


def envelope_sum(squares, linear, products, z):
    """Return the objective of RPM-BP's QP, with the envelopes of its products."""
    pairs = ((0, 2), (1, 3), (0, 3), (1, 2))
    total = squares @ z**2 + linear @ z
    for c, (a, b) in zip(products, pairs, strict=True):
        total += abs(c) * abs(z[a] + np.sign(c) * z[b])
    return total


@given(st.integers(0, 2**32 - 1))
def test_any_multipliers_give_a_lower_bound_of_the_qp_and_the_solver_the_best(seed):
    import clarabel

    generator = np.random.default_rng(seed)
    squares, linear, products = quadratic_program(generator)
    reach = np.abs(products)
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    best = best_multipliers(squares, linear, products, settings)
    best_value, _ = separable(squares, linear, products, best)
    for _ in range(20):
        omega = generator.uniform(-reach, reach)
        found, _ = separable(squares, linear, products, omega)
        assert found <= best_value + 1e-6
        for z in generator.uniform(-1, 1, (5, 4)):
            assert best_value <= envelope_sum(squares, linear, products, z) + 1e-9


@given(st.integers(0, 2**32 - 1), st.sampled_from([1, 3, 4]), st.booleans())
def test_lifted_bound_holds_for_any_answer_of_the_solver(seed, dim, garbled):
    """Validity rests on eigenvalues, not on the solver: random multipliers only weaken the bound."""
    generator = np.random.default_rng(seed)
    C = generator.normal(size=(dim + 1, dim + 1))
    C = C + C.T
    stretch = np.eye(dim + 1)
    stretch[1:, 0] = generator.normal(size=dim)
    N = stretch.T @ stretch  # |(1, c + z)|^2 >= 1
    lifted = LiftedBox(dim)
    true_value, _ = lifted.minimum(C, N)
    found = true_value
    if garbled:
        n_duals = 1 + len(lifted.products) + (dim + 1) * (dim + 2) // 2
        answer = SimpleNamespace(z=generator.normal(size=n_duals), x=generator.normal(size=20))
        lifted._solver = SimpleNamespace(update=lambda **_: None, solve=lambda: answer)
        found, _ = lifted.minimum(C, N)
        assert found <= true_value + 1e-6
    corners = np.array(list(itertools.product((-1.0, 1.0), repeat=dim)))
    for z in np.vstack([generator.uniform(-1, 1, (50, dim)), corners]):
        lift = np.concatenate([[1.0], z])
        assert found <= (lift @ C @ lift) / (lift @ N @ lift) + 1e-9


# --- bounds over boxes of rotations -------------------------------------------------------------


@given(problems(), facet_boxes())
def test_rotation_bound_is_below_the_objective(problem, box):
    source, target, k = problem
    model = Rotation3D(source, target, k)
    found = value(SemidefiniteRotationBound(model), box)
    thetas = np.vstack([box.sample(np.random.default_rng(0), 30), box.vertices()])
    assert found <= min(model.objective(theta)[0] for theta in thetas) + 1e-9


@given(problems(), facet_boxes(halves=(0.1,)))
def test_rotation_bound_closes_at_a_point(problem, box):
    source, target, k = problem
    model = Rotation3D(source, target, k)
    point = Box(box.centre, box.centre)
    tolerance = 1e-6 * k * (1 + (source**2).sum() + (target**2).sum())
    found = value(SemidefiniteRotationBound(model), point)
    assert found == pytest.approx(model.objective(box.centre)[0], abs=tolerance)


@given(facet_boxes(), st.integers(0, 2**32 - 1))
def test_rotations_of_the_box_lie_in_their_range(box, seed):
    least, most = rotation_range(box)
    generator = np.random.default_rng(seed)
    W = generator.normal(size=(3, 3))
    for theta in box.sample(generator, 20):
        R = Rotation3D.matrix(theta)
        assert (least - 1e-12 <= R).all()
        assert (most + 1e-12 >= R).all()
        unit = theta / np.linalg.norm(theta)
        assert unit @ quaternion_form(W) @ unit == pytest.approx((W * R).sum())


# --- no wrong optimum ---------------------------------------------------------------------------

SETTINGS = [  # method, options, node limits: for most problems, and for those that can finish
    ("rpm_htb", {"bound": "termwise"}, (1000, 1000)),
    ("rpm_htb", {"bound": "termwise-r1"}, (1000, 1000)),
    ("rpm_htb", {"bound": "termwise-r2"}, (1000, 1000)),
    ("rpm_bp", {}, (40, 600)),
    ("hbsp", {}, (40, 600)),
]


def clouds(seed, dim):
    """Return three to five points: noisy copies, partial copies or unrelated."""
    generator = np.random.default_rng([seed, dim])
    n, m = generator.integers(3, 6, 2)
    source, target = generator.normal(size=(n, dim)), generator.normal(size=(m, dim))
    fewest = int(min(n, m))
    shared = (fewest, 2, 0)[seed % 3]
    target[:shared] = source[:shared] + 0.2 * generator.normal(size=(shared, dim))
    if seed % 2:
        return source[:fewest], target[:fewest], fewest
    return source, generator.permutation(target), int(generator.integers(2, fewest + 1))


def tolerance(seed, least, k):
    """Return a tolerance, mostly below the optimum; otherwise a certificate only says E >= 0."""
    return 0.01 * k if seed % 5 == 0 else max(0.9 * least, 1e-3)


def around(theta, seed):
    """Return a small box that contains `theta`, since the bounds are too weak for a full search."""
    generator = np.random.default_rng(seed)
    half = 0.02 * generator.random(theta.size)
    if theta.size == 4:
        half[np.argmax(theta)] = 0.0  # the component of the quaternion that is 1
    return Box(theta - half, theta + half * generator.random(theta.size))


def matchings(n, m, k):
    """Return all (b, k) rows and columns of k one-to-one pairs."""
    rows = np.array(list(itertools.combinations(range(n), k)))
    columns = np.array(list(itertools.permutations(range(m), k)))
    return np.repeat(rows, len(columns), axis=0), np.tile(columns, (len(rows), 1))


def least_similarity(source, target, k, scale_range):
    """Return the optimum over all matchings, each with its closed-form pose of clipped scale, in 2D."""
    rows, columns = matchings(len(source), len(target), k)
    z, w = source @ [1, 1j], target @ [1, 1j]
    x, y = z[rows], w[columns]
    x, y = x - x.mean(axis=1, keepdims=True), y - y.mean(axis=1, keepdims=True)
    spread, product = (np.abs(x) ** 2).sum(axis=1), np.abs((x.conj() * y).sum(axis=1))
    scale = np.clip(product / spread, *scale_range)
    return ((np.abs(y) ** 2).sum(axis=1) - 2 * scale * product + scale**2 * spread).min()


def least_rotation(source, target, k):
    """Return the optimum over all matchings of the rotation about the origin, by singular values."""
    rows, columns = matchings(len(source), len(target), k)
    x, y = source[rows], target[columns]
    spread = y.transpose(0, 2, 1) @ x
    singular = np.linalg.svd(spread, compute_uv=False)
    singular[:, 2] *= np.where(np.linalg.det(spread) < 0, -1.0, 1.0)
    return ((x**2).sum(axis=(1, 2)) + (y**2).sum(axis=(1, 2)) - 2 * singular.sum(axis=1)).min()


def judge(found, gap_tol, least):
    """Check the bounds and the certificate; return whether one is given above zero."""
    slack = 1e-8 * (1 + least)
    assert found.lower_bound <= least + slack
    assert found.upper_bound >= least - slack
    if found.status is Status.OPTIMAL:
        assert found.upper_bound <= least + gap_tol + slack
        assert found.upper_bound - found.lower_bound <= gap_tol + slack
        return found.upper_bound > gap_tol  # more than that E >= 0
    assert found.status is Status.NODE_LIMIT
    return False


@pytest.mark.parametrize(("name", "options", "nodes"), SETTINGS)
def test_no_wrong_optimum_in_2d(name, options, nodes):
    n_telling = 0
    for seed in range(N_PROBLEMS):
        source, target, k = clouds(seed, 2)
        least = least_similarity(source, target, k, (0.5, 1.5))
        gap_tol = tolerance(seed, least, k)
        factor = float(np.sqrt(gap_tol / k) / rms_radius(target))
        method = registry.load(name, gap_tol_factor=factor, polish=False, **options)
        instance = Instance("small", source, target, "similarity2d", k, (0.5, 1.5), 0.1, seed)
        solution = method.solve(instance, Limits(60.0, nodes[seed % 6 == 5]))
        n_telling += judge(solution, gap_tol, least)
        reached, _ = objective(source, target, solution.T_target_source, k)
        assert reached == pytest.approx(solution.upper_bound, abs=1e-8)
    print(f"{name} {options}: {n_telling} of {N_PROBLEMS} certified above zero")
    assert n_telling > 0


@pytest.mark.parametrize("bound", ["termwise", "termwise-r1", "termwise-r2"])
def test_no_wrong_optimum_in_norm_space(bound):
    """The reference, from many initial poses, can only be too large; that hides no wrong bound."""
    n_telling = 0
    for seed in range(N_PROBLEMS):
        source, target, k = clouds(seed, 3)
        model = Translation3D(source, target, k)
        [root] = model.roots()
        starts = [*root.sample(np.random.default_rng(seed), 30), *model.seeds()]
        best, least = min((model.refine(start)[:2] for start in starts), key=lambda fit: fit[1])
        gap_tol = tolerance(seed, least, k)
        roots = [around(best, seed)] if seed % 2 else None
        found = minimise(
            model, registry.load("rpm_htb", bound=bound).make_bound(model, roots), Budget(nodes=1000),
            gap_tol=gap_tol, start=(best, np.inf),
        )  # fmt: skip
        least = min(least, found.upper_bound)
        n_telling += judge(found, gap_tol, least)
    print(f"{bound}: {n_telling} of {N_PROBLEMS} certified above zero")
    assert n_telling > 0


def test_no_wrong_rotation():
    n_telling = 0
    for seed in range(N_PROBLEMS):
        source, target, k = clouds(seed, 3)
        model = Rotation3D(source, target, k)
        least = least_rotation(source, target, k)
        gap_tol = tolerance(seed, least, k)
        starts = [model.refine(theta) for theta in np.vstack([np.eye(4), 2 * np.eye(4) - 1])]
        best, reached, _ = min(starts, key=lambda start: start[1])
        known = reached <= least + 1e-9 and seed % 2
        roots = [around(best, seed)] if known else None
        found = minimise(
            model, SemidefiniteRotationBound(model, roots), Budget(nodes=60), gap_tol=gap_tol,
            start=(best, np.inf),
        )  # fmt: skip
        n_telling += judge(found, gap_tol, least)
    print(f"rotation: {n_telling} of {N_PROBLEMS} certified above zero")
    assert n_telling > 0


# --- the adapters -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "model", "options"),
    [
        *(("rpm_htb", model, {}) for model in ("similarity2d", "rigid3d")),
        ("rpm_bp", "similarity2d", {}),
        ("hbsp", "similarity2d", {}),
    ],
)  # fmt: skip
def test_box_bound_is_below_the_objective_in_the_instances_own_units(name, model, options, rng):
    """Clouds are far from the origin and of another size: the bound must not centre them."""
    dim = 2 if model == "similarity2d" else 3
    source = 3.0 * rng.normal(size=(6, dim)) + 1.0
    instance = Instance("box", source, source + 0.5, model, 5, (0.5, 1.5), 0.1, 0)
    method = registry.load(name, **options)
    assert isinstance(method, BoxBounding)
    if dim == 2:
        space = Similarity2D(source, instance.target, 5, (0.5, 1.5))
        centre = np.array([1.0, 0.1, 0.4, 0.5])
    else:
        space, centre = Translation3D(source, instance.target, 5), np.full(3, 0.4)
    for half in (0.3, 0.01, 1e-6):
        found = method.box_bound(instance, centre - half, centre + half)
        samples = Box(centre - half, centre + half).sample(rng, 50)
        assert found <= min(reference.objective(space, theta) for theta in samples) + 1e-8
    assert found == pytest.approx(reference.objective(space, centre), abs=1e-2)


def test_hbsp_bounds_no_translations():
    instance = Instance("box", np.eye(3), np.eye(3), "rigid3d", 3, (1.0, 1.0), 0.1, 0)
    assert np.isnan(registry.load("hbsp").box_bound(instance, -np.ones(3), np.ones(3)))


def test_the_joint_programme_is_for_2d_only():
    method = registry.load("rpm_htb", bound="termwise-r3")
    instance = Instance("rigid", np.eye(3), np.eye(3), "rigid3d", 3, (1.0, 1.0), 0.1, 0)
    assert "rigid3d" in method.supports(instance)
