"""Every bound, found by name: below the objective anywhere in the box, exact at a point."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dcreg.families.registry import make_bound
from dcreg.families.similarity2d.space import Similarity2D
from dcreg.families.translation3d.space import Translation3D
from dcreg.names import BOUND_NAMES
from dcreg.search import Box, Boxes, LongestEdge
from tests.oracles import kernels as reference
from tests.problems import models, models_with_boxes

NAMES = [*BOUND_NAMES, "dc+interval"]


FAMILIES = ("similarity2d", "norm3d")


def evaluate(name, model, *boxes):
    return make_bound(name, model).evaluate(Boxes.of(boxes), np.inf)


@pytest.mark.parametrize("name", NAMES)
@given(data=st.data())
def test_bound_is_below_the_objective_anywhere_in_the_box(name, data):
    model, box = data.draw(models_with_boxes(families=FAMILIES))
    bound = evaluate(name, model, box).lower_bounds[0]
    thetas = np.concatenate([box.sample(np.random.default_rng(0), 40), box.vertices()])
    thetas = thetas[model.admissible(thetas)]
    objectives = [reference.objective(model, theta) for theta in thetas]
    assert bound <= min(objectives, default=np.inf) + 1e-9


def strongest(name, model, box):
    """Without a cutoff no bound stops early."""
    return make_bound(name, model).evaluate(Boxes.of([box]), None).lower_bounds[0]


@pytest.mark.parametrize("name", NAMES)
@given(data=st.data(), tightness=st.sampled_from([0.5, 1.0, 2.0]))
def test_bound_without_a_cutoff_is_below_the_objective_and_no_weaker(name, data, tightness):
    model, box = data.draw(models_with_boxes(families=FAMILIES))
    thetas = np.concatenate([box.sample(np.random.default_rng(0), 40), box.vertices()])
    thetas = thetas[model.admissible(thetas)]
    lowest = min((reference.objective(model, theta) for theta in thetas), default=np.inf)
    bound = strongest(name, model, box)
    assert bound <= lowest + 1e-9
    if np.isfinite(lowest):
        cutoff = tightness * lowest + 1e-3
        # what a search gets of it; above the cutoff precision is of no use
        plain = make_bound(name, model).evaluate(Boxes.of([box]), cutoff)
        assert bound >= min(plain.lower_bounds[0], cutoff) - 1e-3 * (1.0 + abs(bound))


@pytest.mark.parametrize("family", ["similarity2d", "norm3d"])
def test_tight_bound_surpasses_the_shared_one_without_a_cutoff(family):
    """Off the optimum the objective slopes, so that the box centre is not the best place."""
    generator = np.random.default_rng(3)
    source = generator.standard_normal((30, 2 if family == "similarity2d" else 3))
    target = source + 0.02 * generator.standard_normal(source.shape)
    model = (
        Similarity2D(source, target, 30, (0.5, 1.5))
        if family == "similarity2d"
        else Translation3D(source, target, 30)
    )
    for _ in range(5):
        centre = model.identity + generator.uniform(-0.2, 0.2, model.identity.size)
        box = Box(centre - 0.1, centre + 0.1)
        tight, shared = strongest("tight", model, box), strongest("shared", model, box)
        least = min(reference.objective(model, theta) for theta in box.vertices())
        assert tight > shared + 0.05 * (least - shared)


@pytest.mark.parametrize("name", NAMES)
@given(data=st.data())
def test_bound_equals_the_objective_at_a_degenerate_box(name, data):
    model, box = data.draw(models_with_boxes(families=FAMILIES))
    theta = box.centre
    if not model.admissible(theta[None])[0]:
        theta = model.identity
    found = evaluate(name, model, Box(theta, theta))
    assert found.lower_bounds[0] == pytest.approx(reference.objective(model, theta), abs=1e-8)


@pytest.mark.parametrize("name", NAMES)
@given(data=st.data())
def test_candidates_are_upper_bounds_at_their_parameter(name, data):
    model, box = data.draw(models_with_boxes(families=FAMILIES))
    found = evaluate(name, model, box)
    if np.isfinite(found.values[0]):
        assert model.admissible(found.thetas)[0]
        assert found.values[0] >= reference.objective(model, found.thetas[0]) - 1e-9


@pytest.mark.parametrize("name", NAMES)
@given(data=st.data())
def test_halving_boxes_closes_the_bound_on_a_point(name, data):
    """Towards a point every bound converges to the objective there (else no search would end)."""
    model, box = data.draw(models_with_boxes(families=FAMILIES))
    theta = model.identity + 0.1
    half = 1e-7 * np.ones(box.dim)
    found = evaluate(name, model, Box(theta - half, theta + half))
    assert found.lower_bounds[0] == pytest.approx(reference.objective(model, theta), abs=1e-4)


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
    generator = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))
    # below a low cutoff estimates stay estimates, below a high one the binding vertices are solved
    cutoff = data.draw(st.sampled_from([-np.inf, 0.0, 0.3, np.inf]))
    for _ in range(7):
        found = bound.evaluate(boxes, cutoff)
        for at, (lower, upper) in enumerate(zip(boxes.lower, boxes.upper, strict=True)):
            vertex = np.where(generator.random(box.dim) < 0.5, lower, upper)
            thetas = np.vstack([generator.uniform(lower, upper, (3, box.dim)), vertex])
            for theta in thetas[model.admissible(thetas)]:
                assert found.lower_bounds[at] <= reference.objective(model, theta) + 1e-9
            if np.isfinite(found.values[at]):
                expected = reference.objective(model, found.thetas[at])
                assert found.values[at] == pytest.approx(expected, abs=1e-9)
        boxes = branching(boxes[generator.permutation(len(boxes))[:4]])


@pytest.mark.parametrize("name", NAMES)
@given(data=st.data())
def test_bounds_over_several_roots_do_not_mix_them_up(name, data):
    """Roots flat along one axis and apart on it: what holds at one tells nothing of the other."""
    model, box = data.draw(models_with_boxes(families=FAMILIES))
    flat = box.lower.copy()
    flat[-1] = box.upper[-1] = box.lower[-1]
    shift = np.zeros(box.dim)
    shift[-1] = 3.0
    roots = [Box(flat - far, np.maximum(flat, box.upper) - far) for far in (0.0 * shift, shift)]
    together = make_bound(name, model, roots).evaluate(Boxes.of(roots), np.inf).lower_bounds
    alone = [evaluate(name, model, root).lower_bounds[0] for root in roots]
    generator = np.random.default_rng(0)
    for bound, root in zip(together, roots, strict=True):
        thetas = root.sample(generator, 20)
        for theta in thetas[model.admissible(thetas)]:
            assert bound <= reference.objective(model, theta) + 1e-9
    if name in ("dc", "interval"):  # without memory: the same to the last bit
        np.testing.assert_array_equal(together, alone)


@given(models_with_boxes())
def test_paper_bound_equals_its_numpy_twin(model_and_box):
    model, box = model_and_box
    found = evaluate("dc", model, box).lower_bounds[0]
    if np.isfinite(found):
        assert found == pytest.approx(reference.paper_bound(model, box), abs=1e-9)


@given(models_with_boxes(families=("norm3d",)))
def test_paper_bound_in_norm_space_is_vertex_objective_minus_half_diagonal(model_and_box):
    """dcreg.md 2: LB = min_v E(v) - k |h|^2, exactly."""
    model, box = model_and_box
    least = min(reference.objective(model, vertex) for vertex in box.vertices())
    expected = least - model.n_inliers * (box.half_widths**2).sum()
    assert evaluate("dc", model, box).lower_bounds[0] == pytest.approx(expected, abs=1e-9)


@given(models_with_boxes())
def test_combined_bound_is_the_greater_one(model_and_box):
    model, box = model_and_box
    both = evaluate("dc+interval", model, box).lower_bounds[0]
    single = [evaluate(name, model, box).lower_bounds[0] for name in ("dc", "interval")]
    assert both == max(single)


@pytest.mark.parametrize("name", NAMES)
@given(data=st.data())
def test_threads_do_not_change_a_bound(name, data):
    model, box = data.draw(models_with_boxes(families=FAMILIES))
    branching = LongestEdge(model.axis_weights)
    quarters = branching(branching(Boxes.of([box])))
    one, two = (make_bound(name, model, threads=threads) for threads in (1, 2))
    a, b = one.evaluate(quarters, np.inf), two.evaluate(quarters, np.inf)
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
        assert evaluate("dc", model, box).lower_bounds[0] == np.inf


@given(models(max_points=5), st.integers(0, 2**32 - 1))
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


@given(models(), st.integers(0, 2**32 - 1))
def test_refinement_returns_an_admissible_point_with_its_objective(model, seed):
    start = np.random.default_rng(seed).uniform(-2, 2, model.axis_weights.size)
    theta, value, spent = model.refine(start)
    assert model.admissible(theta[None])[0]
    assert value == pytest.approx(reference.objective(model, theta), abs=1e-9)
    assert spent >= 1
    if model.admissible(start[None])[0]:
        assert value <= reference.objective(model, start) + 1e-9


def test_unknown_bound_is_refused_with_the_known_names():
    from dcreg.problem import InputError

    model = Similarity2D(np.eye(2), np.eye(2), 1, (0.5, 1.5))
    with pytest.raises(InputError, match=r"'dcc' is unknown.*dc"):
        make_bound("dcc", model)
