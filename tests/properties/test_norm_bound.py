"""The curvature of the norm objective within a box, and the bound that rests on it."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from dcreg.families.dc.kernels import best_linearisation
from dcreg.families.registry import make_bound
from dcreg.families.translation3d.kernels.curvature import norm_curvature
from dcreg.families.translation3d.space import Translation3D
from dcreg.search import Box, Boxes, LongestEdge
from tests.oracles import kernels as reference
from tests.problems import SEEDS, lower_bound, minimum_over


def in_ball(generator, centre, radius):
    step = generator.standard_normal(3)
    return centre + radius * generator.random() ** (1 / 3) * step / np.linalg.norm(step)


def half_hessian(points, lengths):
    norms = np.linalg.norm(points, axis=1)
    u = points / norms[:, None]
    across = np.eye(3) - u[:, :, None] * u[:, None, :]
    return (np.eye(3) - (lengths / norms)[:, None, None] * across).sum(axis=0)


@example(262142, 0.0, 0.001)  # not the axis-by-axis minimum of two valid matrices
@given(SEEDS, st.sampled_from([0.0, 0.02, 0.3]), st.sampled_from([0.001, 0.02, 0.1, 0.5]))
def test_curvature_is_at_least_that_of_any_matching_that_matters(seed, noise, radius):
    generator = np.random.default_rng(seed)
    n = int(generator.integers(1, 40))
    k = int(generator.integers(max(1, n - 3), n + 1))
    source = generator.standard_normal((n, 3)) * generator.uniform(0.2, 1.5, 3)
    centre = 0.3 * generator.standard_normal(3)
    rows = generator.permutation(n)[:k]
    optimum = in_ball(generator, centre, radius)
    fitting = np.linalg.norm(source[rows] + optimum, axis=1)
    lengths = np.abs(fitting + noise * generator.standard_normal(k))
    misfit = np.linalg.norm(fitting - lengths)
    weights = np.empty(3)
    norm_curvature(source.T.copy(), k, centre, radius, misfit, weights)
    assert (weights >= 0.0).all()
    for _ in range(20):
        t = in_ball(generator, centre, radius)
        hessian = half_hessian(source[rows] + t, lengths)
        assert np.linalg.eigvalsh(np.diag(weights) - hessian).min() >= -1e-9 * k


@pytest.mark.parametrize("side", [np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])])
def test_curvature_allows_for_rotation_and_stretch_across_the_ball(side):
    """Points on one axis, the optimum at one end of the ball, the Hessian at the other."""
    axis, radius = np.array([1.0, 0.0, 0.0]), 0.1
    source = np.outer(np.linspace(1.0, 2.0, 5), axis)
    lengths = np.linalg.norm(source - radius * axis, axis=1)
    weights = np.empty(3)
    norm_curvature(source.T.copy(), 5, np.zeros(3), radius, 0.0, weights)
    hessian = half_hessian(source + radius * side, lengths)
    margin = np.linalg.eigvalsh(np.diag(weights) - hessian).min()
    assert 0.0 <= margin < 6.0 * radius  # valid, and not by much


def planted(generator, n, k, noise):
    """Source and target whose optimum lies near -shift."""
    source = generator.standard_normal((n, 3)) * np.array([1.0, 0.7, 0.4])
    shift = 0.3 * generator.standard_normal(3)
    target = source + noise * generator.standard_normal((n, 3))
    return Translation3D(source + shift, target, k), -shift


@given(SEEDS, st.sampled_from([0.0, 0.03]), st.sampled_from([0.3, 0.1, 0.03]), st.booleans())
def test_bound_below_a_finite_cutoff_holds_in_every_descendant(seed, noise, half, partial):
    generator = np.random.default_rng(seed)
    n = int(generator.integers(8, 30))
    model, optimum = planted(generator, n, n - 2 * partial, noise)
    centre, minimum, _ = model.refine(optimum)
    centre = centre + half * generator.uniform(-1.5, 1.5, 3)
    box = Box(centre - half, centre + half)
    bound = make_bound("tight", model, [box])
    boxes = Boxes.of([box])
    for factor in (1.0, 1.3, 3.0):
        cutoff = factor * minimum + 1e-4
        found = bound.evaluate(boxes, cutoff)
        for at, (lower, upper) in enumerate(zip(boxes.lower, boxes.upper, strict=True)):
            thetas = generator.uniform(lower, upper, (10, 3))
            inside = np.clip(model.refine(0.5 * (lower + upper))[0], lower, upper)
            lowest = minimum_over(model, np.vstack([thetas, inside]))
            assert found.lower_bounds[at] <= lowest + 1e-9
        boxes = LongestEdge(model.axis_weights)(boxes)


def test_curvature_raises_the_bound_near_an_optimum_that_fits():
    """A box next to the optimum is pruned at a cutoff near the minimum; the plain bound fails."""
    model, optimum = planted(np.random.default_rng(1), 200, 200, 0.005)
    centre, minimum, _ = model.refine(optimum)
    box = Box(centre + 0.08, centre + 0.13)
    cutoff = 1.2 * minimum
    vertices = box.vertices()
    values = np.array([reference.objective(model, vertex) for vertex in vertices])
    plain = best_linearisation(vertices, values, np.full(3, 200.0), -np.inf, np.inf, np.empty(3))
    found = lower_bound(make_bound("tight", model), box, cutoff)
    assert plain < cutoff < found <= reference.objective(model, box.lower)
