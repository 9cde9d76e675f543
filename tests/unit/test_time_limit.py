"""Past the limit no further descent or polishing step begins."""

import numpy as np
import pytest

from dcreg.local import polish
from dcreg.search import Box, Budget, Evaluation, LongestEdge, branch_and_bound
from dcreg.status import Status


class Parabola:
    """x^2 with the trivial bound."""

    n_assignments = 0
    round_size = 16
    roots = (Box(np.array([1.0]), np.array([3.0])),)

    def evaluate(self, lower, upper, cutoff, *, thorough=False):
        centres = 0.5 * (lower + upper)
        return Evaluation(np.zeros(len(lower)), centres, (centres**2).sum(axis=1))


@pytest.mark.parametrize(("time_s", "descends"), [(0.0, False), (60.0, True)])
def test_no_descent_begins_past_the_limit(time_s, descends):
    calls = []

    def refine(theta):
        calls.append(theta)
        return theta, float((theta**2).sum()), 1

    found = branch_and_bound(
        Parabola(), Budget(time_s, nodes=50), branching=LongestEdge(np.ones(1)), gap_tol=1e-3,
        refine=refine,
    )  # fmt: skip
    assert bool(calls) == descends
    assert found.status is (Status.NODE_LIMIT if descends else Status.TIME_LIMIT)


@pytest.mark.parametrize(("time_s", "moves"), [(0.0, False), (None, True)])
def test_a_late_polish_only_values_the_pose(time_s, moves):
    generator = np.random.default_rng(0)
    source = generator.random((20, 2))
    target = source + np.array([0.02, -0.01])
    T, value, _, spent = polish(source, target, np.eye(3), 20, (0.5, 2.0), budget=Budget(time_s))
    assert np.allclose(T, np.eye(3)) != moves
    assert (spent > 1) == moves
    assert value == pytest.approx(0.0 if moves else 20 * 0.0005, abs=1e-12)
