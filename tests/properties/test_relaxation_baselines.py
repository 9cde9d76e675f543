"""RPM-HTB, RPM-BP and HBSP: their bounds lie below the objective, and no wrong optimum is certified.

The suite uses a few small problems; ``SMALL_PROBLEMS=1000 pytest`` of this file uses 1,000.
"""

from __future__ import annotations

import os
from operator import itemgetter
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from baselines import registry
from baselines._shared.library_search import solution_of
from baselines.contract import BoxBounding, Instance, Limits
from baselines.hbsp.lifted import LiftedBox
from baselines.hbsp.rotation import SemidefiniteRotationBound, quaternion_form, rotation_range
from baselines.hbsp.similarity import SemidefiniteBound
from baselines.rpm_bp.bound import BilinearBound, best_multipliers, separable
from baselines.rpm_htb.bounds import TermwiseR1
from dcreg.assignment.objective import objective
from dcreg.families.rotation3d.space import Rotation3D
from dcreg.families.translation3d.space import Translation3D
from dcreg.problem import Problem
from dcreg.search import Box, Budget, Tolerance, minimise
from tests.oracles import kernels as reference
from tests.oracles.matchings import optimal_rotation, optimal_similarity
from tests.problems import (
    SEEDS,
    facet_boxes,
    lower_bound,
    minimum_over,
    model_of,
    models_with_boxes,
    thetas_in,
)
from tests.properties.test_bounds import rounding
from tests.searches import is_certified

N_PROBLEMS = int(os.environ.get("SMALL_PROBLEMS", "25"))


@given(models_with_boxes(families=("similarity2d",)))
def test_more_of_the_envelope_never_weakens(model_and_box):
    """RPM-HTB's R1 <= RPM-BP <= HBSP, box by box: each keeps more of the products of parameters."""
    model, box = model_and_box
    if not model.touches(box.lower[None], box.upper[None])[0]:
        return
    r1, bilinear, semidefinite = (
        lower_bound(bound(model), box) for bound in (TermwiseR1, BilinearBound, SemidefiniteBound)
    )
    slack = rounding("rpm_bp", model)
    assert r1 <= bilinear + slack
    # approximate multipliers make both bounds weaker than their exact values
    assert bilinear <= semidefinite + 2.0 * slack


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


@given(SEEDS)
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


@given(SEEDS, st.sampled_from([1, 3, 4]), st.booleans())
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
    for z in thetas_in(Box(-np.ones(dim), np.ones(dim)), 50):
        lift = np.concatenate([[1.0], z])
        assert found <= (lift @ C @ lift) / (lift @ N @ lift) + 1e-9


# --- bounds over boxes of rotations -------------------------------------------------------------


@given(facet_boxes(Rotation3D.roots()), SEEDS)
def test_rotations_of_the_box_lie_in_their_range(box, seed):
    low, high = rotation_range(box)
    generator = np.random.default_rng(seed)
    W = generator.normal(size=(3, 3))
    for theta in box.sample(generator, 20):
        R = Rotation3D.matrix(theta)
        assert (low - 1e-12 <= R).all()
        assert (high + 1e-12 >= R).all()
        unit = theta / np.linalg.norm(theta)
        assert unit @ quaternion_form(W) @ unit == pytest.approx((W * R).sum())


# --- no wrong optimum ---------------------------------------------------------------------------

TERMWISE = ("termwise", "termwise-r1", "termwise-r2")
SETTINGS = [  # method, options, node limits: for most problems, and for those that can finish
    *(("rpm_htb", {"bound": name}, (1000, 1000)) for name in TERMWISE),
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


def tolerance(seed, optimum, k):
    """Return a tolerance, usually below the optimum: above it, a certificate only says E >= 0."""
    return 0.01 * k if seed % 5 == 0 else max(0.9 * optimum, 1e-3)


def around(theta, seed):
    """Return a small box that contains `theta`, since the bounds are too weak for a full search."""
    generator = np.random.default_rng(seed)
    half = 0.02 * generator.random(theta.size)
    if theta.size == 4:
        half[np.argmax(theta)] = 0.0  # the component of the quaternion that is 1
    return Box(theta - half, theta + half * generator.random(theta.size))


@pytest.mark.parametrize(("name", "options", "nodes"), SETTINGS)
def test_no_wrong_optimum_in_2d(name, options, nodes):
    n_positive = 0
    for seed in range(N_PROBLEMS):
        source, target, k = clouds(seed, 2)
        optimum = optimal_similarity(source, target, k, (0.5, 1.5))
        gap_tol = tolerance(seed, optimum, k)
        method = registry.load(name, search="ours", polish=False, **options)
        problem = Problem(source, target, k, "similarity2d", (0.5, 1.5))
        limits = Limits(60.0, nodes[seed % 6 == 5])
        solution = solution_of(method.result(problem, limits, 0.0, gap_tol))
        n_positive += is_certified(solution, optimum, gap_tol) and solution.upper_bound > gap_tol
        reached, _ = objective(source, target, solution.T_target_source, k)
        assert reached == pytest.approx(solution.upper_bound, abs=1e-8)
    print(f"{name} {options}: {n_positive} of {N_PROBLEMS} certified above zero")
    assert n_positive > 0


def termwise(name):
    return registry.load("rpm_htb", bound=name).make_bound


@pytest.mark.parametrize(
    ("space", "make", "nodes"),
    [
        *((Translation3D, termwise(name), 1000) for name in TERMWISE),
        (Rotation3D, SemidefiniteRotationBound, 60),
    ],
)
def test_no_wrong_optimum_in_3d(space, make, nodes):
    """Over norms the reference can only be too large, which hides no wrong bound."""
    n_positive = 0
    for seed in range(N_PROBLEMS):
        source, target, k = clouds(seed, 3)
        model = space(source, target, k)
        starts = [*model.roots()[0].sample(np.random.default_rng(seed), 30), *model.seeds()]
        best, reached = min((model.refine(start)[:2] for start in starts), key=itemgetter(1))
        optimum = optimal_rotation(source, target, k) if space is Rotation3D else reached
        gap_tol = tolerance(seed, optimum, k)
        roots = [around(best, seed)] if seed % 2 and reached <= optimum + 1e-9 else None
        start = best, np.inf
        found = minimise(
            model,
            make(model, roots),
            Budget(nodes=nodes),
            tolerance=Tolerance(abs=gap_tol),
            start=start,
        )
        if space is Translation3D:
            optimum = min(optimum, found.upper_bound)
        n_positive += is_certified(found, optimum, gap_tol) and found.upper_bound > gap_tol
    print(f"{space.__name__}: {n_positive} of {N_PROBLEMS} certified above zero")
    assert n_positive > 0


# --- the adapters -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "model"),
    [
        ("rpm_htb", "similarity2d"),
        ("rpm_htb", "rigid3d"),
        ("rpm_bp", "similarity2d"),
        ("hbsp", "similarity2d"),
    ],
)
def test_box_bound_is_below_the_objective_in_the_instances_own_units(name, model, rng):
    """Clouds are far from the origin and of another size: the bound must not centre them."""
    dim = 2 if model == "similarity2d" else 3
    source = 3.0 * rng.normal(size=(6, dim)) + 1.0
    instance = Instance("box", source, source + 0.5, model, 5, (0.5, 1.5), 0.1, 0)
    method = registry.load(name)
    assert isinstance(method, BoxBounding)
    space = model_of(model, source, instance.target, 5)
    centre = np.array([1.0, 0.1, 0.4, 0.5] if dim == 2 else [0.4, 0.4, 0.4])
    for half in (0.3, 0.01, 1e-6):
        found = method.box_bound(instance, centre - half, centre + half)
        samples = Box(centre - half, centre + half).sample(rng, 50)
        assert found <= minimum_over(space, samples) + 1e-8
    assert found == pytest.approx(reference.objective(space, centre), abs=1e-2)


def test_hbsp_bounds_no_translations_and_the_joint_programme_no_rigid_poses():
    instance = Instance("rigid", np.eye(3), np.eye(3), "rigid3d", 3, (1.0, 1.0), 0.1, 0)
    assert np.isnan(registry.load("hbsp").box_bound(instance, -np.ones(3), np.ones(3)))
    joint_programme = registry.load("rpm_htb", bound="termwise-r3")
    assert "rigid3d" in joint_programme.supports(instance)
