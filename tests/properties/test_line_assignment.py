"""The assignment on a line against the general solver, for every cardinality and with ties."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from dcreg.assignment.kernels.dense import k_assignment
from dcreg.assignment.kernels.line import line_assignment, line_matching, line_value
from dcreg.jit import NEVER

KINDS = ["uniform", "few values", "clusters", "duplicates", "apart", "nested"]


def points(generator, kind, n, m):
    a, b = generator.random(n), generator.random(m)
    if kind == "few values":
        a, b = np.round(4 * a) / 4, np.round(4 * b) / 4
    elif kind == "clusters":
        a = generator.choice([0.0, 1.0], n) + 0.1 * a
    elif kind == "duplicates":
        a = np.full(n, a[0])
    elif kind == "apart":  # all on one side: every gap encloses the one before
        b += 2.0
    elif kind == "nested":  # one side around the other
        b += generator.choice([-2.0, 2.0], m)
    return np.sort(a), np.sort(b)


def check_every_cardinality(a, b):
    cost = (a[:, None] - b[None]) ** 2
    most = min(cost.shape)
    values = np.empty(most)
    assert line_assignment(a, b, most, values) == values[-1]
    for k in range(1, most + 1):
        best, _ = k_assignment(cost, k, NEVER)
        assert values[k - 1] == pytest.approx(best, rel=1e-10, abs=1e-11)
        assert line_value(a, b, k) == pytest.approx(best, rel=1e-10, abs=1e-11)
        col_of = line_matching(a, b, k)
        rows = np.flatnonzero(col_of >= 0)
        assert len(rows) == k == len(set(col_of[rows]))
        assert cost[rows, col_of[rows]].sum() == pytest.approx(best, rel=1e-10, abs=1e-11)


@pytest.mark.parametrize("kind", KINDS)
def test_equals_the_general_solver(kind):
    generator = np.random.default_rng(KINDS.index(kind))
    for _ in range(600):  # with every cardinality: about 20,000 problems over all kinds
        check_every_cardinality(*points(generator, kind, *generator.integers(1, 13, 2)))


@settings(max_examples=30)
@given(st.sampled_from(KINDS), st.integers(1, 60), st.integers(1, 60), st.integers(0, 2**32 - 1))
@example("uniform", 60, 60, 0)
def test_equals_the_general_solver_on_larger_problems(kind, n, m, seed):
    check_every_cardinality(*points(np.random.default_rng(seed), kind, n, m))


def test_each_further_pair_costs_at_least_as_much(rng):
    for kind in KINDS:
        a, b = points(rng, kind, 400, 300)
        values = np.empty(300)
        line_assignment(a, b, 300, values)
        assert (np.diff(values, n=2, prepend=0.0) >= -1e-10).all()


def test_thousands_of_points_keep_precision(rng):
    """All matched: the greedy's last value is the sorted order's, after thousands of updates."""
    for kind in KINDS:
        a, b = points(rng, kind, 5000, 5000)
        values = np.empty(5000)
        line_assignment(a, b, 5000, values)
        assert values[-1] == pytest.approx(((a - b) ** 2).sum(), rel=1e-10, abs=1e-10)
