"""DC-Reg as published: its bound is the formula, and every incumbent is the objective at a vertex."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given

from baselines._shared.algorithm1 import Bounded, algorithm_1, bisected
from baselines._shared.published import published_bound
from dcreg.search import Box, Budget
from dcreg.status import Status
from tests.oracles import kernels as reference
from tests.problems import model_of, models_with_boxes


@given(case=models_with_boxes())
def test_bound_is_the_published_formula(case):
    space, box = case
    (found,) = published_bound(space).evaluate([box])
    assert found.lower_bound == pytest.approx(reference.paper_bound(space, box), abs=1e-9)
    assert found.value == pytest.approx(reference.objective(space, found.theta), abs=1e-9)
    assert ((found.theta == box.lower) | (found.theta == box.upper)).all()


@pytest.mark.parametrize("family", ["similarity2d", "norm3d"])
def test_incumbents_are_objectives_at_visited_vertices(family):
    generator = np.random.default_rng(0)
    dim = 2 if family == "similarity2d" else 3
    space = model_of(family, *generator.standard_normal((2, 7, dim)), 5)
    bound, visited = published_bound(space), []
    evaluate = bound.evaluate

    def recorded(boxes: list[Box]) -> list[Bounded]:
        visited.extend(
            np.array(vertex)
            for box in boxes
            for vertex in itertools.product(*zip(box.lower, box.upper, strict=True))
        )
        return evaluate(boxes)

    bound.evaluate = recorded
    found = algorithm_1(bound, space.roots(), 1e-9, Budget(nodes=60))
    values = [reference.objective(space, vertex) for vertex in visited]
    incumbents = {event.upper_bound for event in found.events}
    assert len(incumbents) > 1
    for value in incumbents:
        assert np.abs(np.array(values) - value).min() < 1e-9
    assert any(np.array_equal(found.theta, vertex) for vertex in visited)


class _Line:
    """Bounds of ``(x - 0.3)^2`` over intervals, lower by the squared width."""

    n_assignments = 0

    def evaluate(self, boxes: list[Box]) -> list[Bounded]:
        return [self._bounded(box) for box in boxes]

    def _bounded(self, box: Box) -> Bounded:
        ends = [float((end[0] - 0.3) ** 2) for end in (box.lower, box.upper)]
        best = int(np.argmin(ends))
        theta = (box.lower, box.upper)[best]
        width = float(box.upper[0] - box.lower[0])
        return Bounded(ends[best] - width**2, theta, ends[best])


@pytest.mark.parametrize("raise_children", [False, True])
def test_search_ends_at_the_minimum(raise_children):
    roots = [Box(np.array([-1.0]), np.array([1.0]))]
    found = algorithm_1(_Line(), roots, 1e-4, Budget(), raise_children=raise_children)
    assert found.status is Status.OPTIMAL
    assert found.lower_bound <= 0.0 <= found.upper_bound <= found.lower_bound + 1e-4
    bounds = [event.lower_bound for event in found.events]
    assert bounds == sorted(bounds)


def test_longest_edge_is_bisected():
    first, second = bisected(Box(np.array([0.0, 0.0]), np.array([1.0, 4.0])))
    assert first.upper.tolist() == [1.0, 2.0]
    assert second.lower.tolist() == [0.0, 2.0]


def test_limits_end_the_search_with_valid_bounds():
    roots = [Box(np.array([-1.0]), np.array([1.0]))]
    found = algorithm_1(_Line(), roots, 1e-12, Budget(nodes=9))
    assert found.status is Status.NODE_LIMIT
    assert found.n_nodes == 9
    assert found.lower_bound < 0.0 <= found.upper_bound
    found = algorithm_1(_Line(), roots, 1e-12, Budget(memory_mb=1e-3))
    assert found.status is Status.MEMORY_LIMIT
