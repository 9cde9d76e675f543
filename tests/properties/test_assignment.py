"""Exact k-cardinality assignment against brute force, a second solver and LP duality."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dcreg.assignment.kernels import dense as kernels
from dcreg.assignment.kernels.selection import (
    kth_smallest,
    least,
    place_of_least,
    smallest_sum,
    sum_of_smallest,
)
from dcreg.assignment.objective import k_assignment, pairs_of
from dcreg.jit import NEVER
from tests.oracles import kernels as reference
from tests.problems import SEEDS


@st.composite
def costs(draw, most):
    n, m = draw(st.integers(1, most)), draw(st.integers(1, most))
    k = draw(st.integers(1, min(n, m)))
    generator = np.random.default_rng(draw(SEEDS))
    kind = draw(st.sampled_from(["normal", "integer ties", "constant", "distances"]))
    if kind == "normal":
        cost = generator.standard_normal((n, m))
    elif kind == "integer ties":
        cost = generator.integers(-2, 3, (n, m)).astype(float)
    elif kind == "constant":
        cost = np.full((n, m), generator.standard_normal())
    else:
        x, y = generator.random((n, 2)), generator.random((m, 2))
        cost = ((x[:, None] - y[None]) ** 2).sum(-1) - 0.3
    return cost, k


@given(costs(most=4))
def test_equals_brute_force(case):
    cost, k = case
    value, col_of = k_assignment(cost, k)
    assert value == pytest.approx(reference.k_assignment_brute_force(cost, k), abs=1e-12)
    pairs = pairs_of(col_of)
    assert len(pairs) == k
    assert cost[pairs[:, 0], pairs[:, 1]].sum() == pytest.approx(value, abs=1e-9)


def proven_by(duals, cost, k):
    return np.sort((cost + duals).min(axis=1))[:k].sum() - duals.sum()


def check_optimal(value, col_of, duals, cost, k):
    """A matching of k pairs with this value, which a second solver finds and the duals prove."""
    matched = np.flatnonzero(col_of >= 0)
    assert len(matched) == len(set(col_of[matched])) == k
    assert cost[matched, col_of[matched]].sum() == pytest.approx(value, abs=1e-9)
    assert value == pytest.approx(reference.k_assignment(cost, k), abs=1e-8)
    assert (duals >= 0).all()
    assert proven_by(duals, cost, k) == pytest.approx(value, abs=1e-8)


@given(costs(most=25), SEEDS, st.sampled_from([0.0, 0.1, 3.0]))
def test_is_optimal_from_any_dual_variables_and_any_of_them_bound_it(case, seed, spread):
    cost, k = case
    value, col_of, duals = kernels.cheapest_pairs(cost, k)
    check_optimal(value, col_of, duals, cost, k)
    duals = spread * np.random.default_rng(seed).random(cost.shape[1])
    assert proven_by(duals, cost, k) <= value + 1e-9
    value, col_of = kernels.improve_assignment(cost, k, duals, NEVER)
    check_optimal(value, col_of, duals, cost, k)


@given(arrays(np.float64, st.integers(1, 40), elements=st.floats(allow_nan=False)))
def test_minimum_of_any_numbers(values):
    assert least(values) == values.min()
    assert place_of_least(values) == values.argmin()


@given(st.integers(1, 40), SEEDS, st.booleans())
def test_smallest_sum_equals_sorting(n, seed, ties):
    generator = np.random.default_rng(seed)
    values = generator.integers(0, 4, n) * 1.0 if ties else generator.standard_normal(n)
    k = int(generator.integers(1, n + 1))
    level, spacing = generator.normal(0.0, 5.0), generator.choice([0.0, 1e-6, 1.0])
    found, _ = smallest_sum(values, k, level, spacing)
    assert found == pytest.approx(np.sort(values)[:k].sum(), abs=1e-9)
    assert sum_of_smallest(values, k) == pytest.approx(np.sort(values)[:k].sum(), abs=1e-9)
    assert kth_smallest(values, k - 1) == np.sort(values)[k - 1]


@pytest.mark.parametrize("k", [0, 4])
def test_impossible_cardinality_is_refused(k):
    with pytest.raises(ValueError, match="pairs asked of a 3 x 5"):
        k_assignment(np.zeros((3, 5)), k)


def test_not_finite_costs_are_refused():
    with pytest.raises(ValueError, match="finite"):
        k_assignment(np.array([[np.nan, 1.0]]), 1)
