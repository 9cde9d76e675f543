"""Every bound over similarities or norms: below the objective in its box, exact at a point.

The bounds of RPM-HTB, RPM-BP and HBSP have to pass the same tests as those of the library.
"""

from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from baselines.hbsp.similarity import SemidefiniteBound
from baselines.rpm_bp.bound import BilinearBound
from baselines.rpm_htb.adapter import BOUNDS as TERMWISE
from dcreg.families.registry import make_bound
from dcreg.families.similarity2d.space import Similarity2D
from dcreg.names import BOUND_NAMES
from dcreg.problem import InputError
from dcreg.search import Box, Boxes, LongestEdge
from tests.oracles import kernels as reference
from tests.problems import (
    SEEDS,
    lower_bound,
    minimum_over,
    model_of,
    models,
    models_with_boxes,
    thetas_in,
)

NAMES = [*BOUND_NAMES, "dc+interval"]
RELAXATIONS = {"rpm_bp": BilinearBound, "hbsp": SemidefiniteBound, **TERMWISE}
MAKERS = {name: partial(make_bound, name) for name in NAMES} | RELAXATIONS
FAMILIES = dict.fromkeys(("rpm_bp", "hbsp", "termwise-r3"), ("similarity2d",))
BOTH = ("similarity2d", "norm3d")


def cases(name):
    return models_with_boxes(families=FAMILIES.get(name, BOTH))


def rounding(name, model):
    """Tolerance for rounding and, in a relaxation, for the precision of its solver."""
    if name in NAMES:
        return 1e-8
    return 1e-7 * model.n_inliers * (1 + (model.source**2).sum() + (model.target**2).sum())


@pytest.mark.parametrize("name", MAKERS)
@given(data=st.data(), tightness=st.sampled_from([0.5, 1.0, 2.0]))
def test_bound_is_below_the_objective_anywhere_in_the_box(name, data, tightness):
    model, box = data.draw(cases(name))
    lowest = minimum_over(model, thetas_in(box))
    found = MAKERS[name](model).evaluate(Boxes.of([box]), np.inf)
    # without a cutoff no bound stops early
    strongest = lower_bound(MAKERS[name](model), box, None)
    assert max(found.lower_bounds[0], strongest) <= lowest + 1e-9
    if np.isfinite(lowest):
        cutoff = tightness * lowest + 1e-3
        plain = lower_bound(MAKERS[name](model), box, cutoff)
        # above the cutoff a search needs no precision
        assert strongest >= min(plain, cutoff) - 1e-3 * (1.0 + abs(strongest))
    if np.isfinite(found.values[0]):
        [theta] = found.thetas
        assert model.admissible(found.thetas)[0]
        expected = reference.objective(model, theta)
        assert found.values[0] >= expected - 1e-9
        if name in RELAXATIONS:
            assert found.values[0] <= expected + 1e-9
            if name != "termwise-r3":  # R3 moves its candidate to an admissible scale
                assert (box.lower <= theta).all()
                assert (theta <= box.upper).all()


@pytest.mark.parametrize("name", MAKERS)
@pytest.mark.parametrize("half", [0.0, 1e-7])
@given(data=st.data())
def test_bound_converges_to_the_objective_at_a_point(name, half, data):
    """Otherwise no search would end; poor multipliers of a solver give a valid but weak bound."""
    model, box = data.draw(cases(name))
    theta = box.centre if model.admissible(box.centre[None])[0] else model.identity
    found = lower_bound(MAKERS[name](model), Box(theta - half, theta + half))
    tolerance = rounding(name, model) + 1e3 * half
    assert found == pytest.approx(reference.objective(model, theta), abs=tolerance)


@pytest.mark.parametrize("family", BOTH)
def test_tight_bound_surpasses_the_shared_one_without_a_cutoff(family):
    """Off the optimum the objective slopes, so that the box centre is not the best place."""
    generator = np.random.default_rng(3)
    source = generator.standard_normal((30, 2 if family == "similarity2d" else 3))
    target = source + 0.02 * generator.standard_normal(source.shape)
    model = model_of(family, source, target, 30)
    for _ in range(5):
        centre = model.identity + generator.uniform(-0.2, 0.2, model.identity.size)
        box = Box(centre - 0.1, centre + 0.1)
        tight, shared = (
            lower_bound(make_bound(name, model), box, None) for name in ("tight", "shared")
        )
        lowest = min(reference.objective(model, theta) for theta in box.vertices())
        assert tight > shared + 0.05 * (lowest - shared)


@pytest.mark.parametrize("name", ["tight", "shared"])
@given(data=st.data())
def test_shared_vertices_keep_every_descendant_valid(name, data):
    """Children rest on what was cached for their ancestors, solved or only estimated from duals."""
    model = data.draw(models())
    branching = LongestEdge(model.axis_weights)
    # a small start box: there the bounds are close to the objective, and an error of theirs shows
    half = data.draw(st.sampled_from([0.3, 0.05, 0.01]))
    centre, _, _ = model.refine(model.identity + 0.2)
    box = Box(centre - half, centre + half)
    bound = make_bound(name, model, [box])
    boxes = Boxes.of([box])
    generator = np.random.default_rng(data.draw(SEEDS))
    # below a low cutoff estimates stay estimates, below a high one the binding vertices are solved
    cutoff = data.draw(st.sampled_from([-np.inf, 0.0, 0.3, np.inf]))
    for _ in range(7):
        found = bound.evaluate(boxes, cutoff)
        for at, (lower, upper) in enumerate(zip(boxes.lower, boxes.upper, strict=True)):
            vertex = np.where(generator.random(box.dim) < 0.5, lower, upper)
            thetas = np.vstack([generator.uniform(lower, upper, (3, box.dim)), vertex])
            assert found.lower_bounds[at] <= minimum_over(model, thetas) + 1e-9
            if np.isfinite(found.values[at]):
                expected = reference.objective(model, found.thetas[at])
                assert found.values[at] == pytest.approx(expected, abs=1e-9)
        boxes = branching(boxes[generator.permutation(len(boxes))[:4]])


@pytest.mark.parametrize("name", NAMES)
@given(data=st.data())
def test_bounds_over_several_roots_do_not_mix_them_up(name, data):
    """The roots have zero width on one axis, on which they are far from each other."""
    model, box = data.draw(models_with_boxes(families=BOTH))
    flat = box.lower.copy()
    flat[-1] = box.upper[-1] = box.lower[-1]
    shift = np.zeros(box.dim)
    shift[-1] = 3.0
    roots = [Box(flat - far, np.maximum(flat, box.upper) - far) for far in (0.0 * shift, shift)]
    together = make_bound(name, model, roots).evaluate(Boxes.of(roots), np.inf).lower_bounds
    for bound, root in zip(together, roots, strict=True):
        assert bound <= minimum_over(model, thetas_in(root, 20)) + 1e-9
    if name in ("dc", "interval"):  # without memory: the same to the last bit
        alone = [lower_bound(make_bound(name, model), root) for root in roots]
        np.testing.assert_array_equal(together, alone)


@given(models_with_boxes())
def test_paper_bound_equals_its_numpy_twin(model_and_box):
    model, box = model_and_box
    found = lower_bound(make_bound("dc", model), box)
    if np.isfinite(found):
        assert found == pytest.approx(reference.paper_bound(model, box), abs=1e-9)


@given(models_with_boxes())
def test_combined_bound_is_the_maximum(model_and_box):
    model, box = model_and_box
    names = ("dc", "interval", "dc+interval")
    *single, both = (lower_bound(make_bound(name, model), box) for name in names)
    assert both == max(single)


@pytest.mark.usefixtures("thin_slices")
@pytest.mark.parametrize(
    ("name", "family"), [(name, family) for name in MAKERS for family in FAMILIES.get(name, BOTH)]
)
def test_threads_do_not_change_a_bound(name, family, rng):
    dim = 2 if family == "similarity2d" else 3
    model = model_of(family, rng.normal(size=(8, dim)), rng.normal(size=(7, dim)), 5)
    dim = model.axis_weights.size
    root = Box(np.full(dim, -0.5), np.full(dim, 0.5))
    boxes = Boxes.of([root])
    for _ in range(4):
        boxes = LongestEdge(model.axis_weights)(boxes)
    one, two = (MAKERS[name](model, [root], threads=threads) for threads in (1, 2))
    a, b = one.evaluate(boxes, np.inf), two.evaluate(boxes, np.inf)
    np.testing.assert_array_equal(a.lower_bounds, b.lower_bounds)
    np.testing.assert_array_equal(a.values, b.values)
    assert one.n_assignments == two.n_assignments


@given(models_with_boxes(families=("similarity2d",)))
def test_boxes_without_an_admissible_scale_are_recognised(model_and_box):
    model, box = model_and_box
    touches = model.touches(box.lower[None], box.upper[None])[0]
    samples = box.sample(np.random.default_rng(1), 200)
    assert touches or not model.admissible(samples).any()
    if not touches:
        assert lower_bound(make_bound("dc", model), box) == np.inf


@given(models(max_points=5), SEEDS)
def test_start_box_holds_every_refined_minimum(model, seed):
    """No local minimum found from anywhere lies below what the start box contains."""
    generator = np.random.default_rng(seed)
    (box,) = model.roots()
    best_inside, best_anywhere = np.inf, np.inf
    for _ in range(20):
        theta, value, _ = model.refine(generator.uniform(-3, 3, box.dim))
        best_anywhere = min(best_anywhere, value)
        if (theta >= box.lower - 1e-7).all() and (theta <= box.upper + 1e-7).all():
            best_inside = min(best_inside, value)
    assert best_inside <= best_anywhere + 1e-6


@given(models(), SEEDS)
def test_refinement_returns_an_admissible_point_with_its_objective(model, seed):
    start = np.random.default_rng(seed).uniform(-2, 2, model.axis_weights.size)
    theta, value, spent = model.refine(start)
    assert model.admissible(theta[None])[0]
    assert value == pytest.approx(reference.objective(model, theta), abs=1e-9)
    assert spent >= 1
    if model.admissible(start[None])[0]:
        assert value <= reference.objective(model, start) + 1e-9


def test_unknown_bound_is_refused_with_the_known_names():
    model = Similarity2D(np.eye(2), np.eye(2), 1, (0.5, 1.5))
    with pytest.raises(InputError, match=r"'dcc' is unknown.*dc"):
        make_bound("dcc", model)
