"""Tolerances on the gap: when a search stops, and what its bounds then prove."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dcreg.search import Budget, LongestEdge, Tolerance, branch_and_bound, proven_share
from dcreg.status import Status
from tests.problems import register
from tests.unit.test_search import Ripples

VALUES = st.floats(0.0, 1e6)
TOLERANCES = st.builds(
    Tolerance, st.floats(0.0, 0.99), VALUES, st.one_of(st.none(), st.floats(0.0, 1.0))
)


def test_the_larger_of_both_gaps_is_allowed():
    tolerance = Tolerance(0.1, 0.5)
    assert tolerance.allowed(20.0) == 2.0
    assert tolerance.allowed(2.0) == 0.5
    assert tolerance.allowed(math.inf) == 0.5


@given(TOLERANCES, VALUES, VALUES)
def test_a_pruned_box_stays_pruned_while_the_upper_bound_falls(tolerance, a, b):
    low, high = sorted((a, b))
    assert tolerance.cutoff(low) <= tolerance.cutoff(high) + 1e-9 * high


def test_a_target_is_refuted_only_beyond_the_rounding_error():
    tolerance = Tolerance(target=2.0, margin=0.5).scaled(4.0)
    assert tolerance.status(10.0, 20.0) is None
    assert tolerance.status(10.1, 20.0) is Status.REFUTED
    assert tolerance.status(tolerance.cutoff(20.0), 20.0) is Status.REFUTED
    assert tolerance.status(0.0, 8.0) is not None


@given(TOLERANCES, VALUES, VALUES)
def test_optimal_needs_a_closed_gap_and_a_proof(tolerance, a, b):
    lower, upper = sorted((a, b))
    status = tolerance.status(lower, upper)
    is_closed = upper - lower <= tolerance.allowed(upper) * (1.0 + 1e-9)
    assert (status is None) or is_closed
    if status is Status.OPTIMAL and tolerance.exact is not None:
        assert lower > 0.0 or upper <= tolerance.exact
    if status is Status.CONVERGED:
        assert lower == 0.0 < tolerance.exact < upper or lower == 0.0 == tolerance.exact < upper


@pytest.mark.parametrize(
    ("lower", "upper", "status"),
    [
        (0.0, 0.9, Status.CONVERGED),
        (0.1, 0.9, Status.OPTIMAL),
        (0.0, 1e-9, Status.OPTIMAL),
        (0.0, 1.1, None),
        (99.0, 100.0, Status.OPTIMAL),
        (98.9, 100.0, None),
    ],
)
def test_a_bound_of_zero_proves_exact_fits_only(lower, upper, status):
    assert Tolerance(0.01, 1.0, 1e-8).status(lower, upper) is status


def test_no_gap_ends_a_search_before_its_target_is_decided():
    tolerance = Tolerance(0.01, abs=1.0, exact=1e-8, target=0.5)
    assert tolerance.enough == 0.5
    assert tolerance.status(0.4, 0.6) is None
    assert Tolerance(0.01, abs=1.0, exact=1e-8).enough == 1.0


@given(TOLERANCES, st.floats(1e-3, 1e6), VALUES, VALUES)
def test_a_target_is_refuted_only_by_a_bound_above_it(tolerance, target, a, b):
    tolerance, (lower, upper) = replace(tolerance, target=target), sorted((a, b))
    status = tolerance.status(lower, upper)
    assert (status is Status.REFUTED) == (lower > target)
    if upper <= target:
        assert status in (Status.CONVERGED, Status.OPTIMAL)
    elif lower <= target:
        assert status is None
        # the search goes on until its lower bound refutes the target
        assert tolerance.status(tolerance.cutoff(upper), upper) is Status.REFUTED


def test_without_a_value_for_exact_fits_the_gap_alone_decides():
    assert Tolerance(abs=1.0).status(0.0, 0.9) is Status.OPTIMAL


def test_other_units_and_shares():
    tolerance = Tolerance(0.01, 2.0, 1e-3)
    assert tolerance.scaled(4.0).allowed(4.0 * 500.0) == 4.0 * tolerance.allowed(500.0)
    assert tolerance.scaled(4.0).is_exact(4e-3)
    assert tolerance.tightened(0.5).allowed(7.0) == 0.5 * tolerance.allowed(7.0)
    assert tolerance.enough == 2.0


@pytest.mark.parametrize(
    ("bounds", "share"),
    [((1.0, 4.0), 0.25), ((0.0, 0.0), 1.0), ((-1.0, 2.0), 0.0), ((0.0, math.inf), 0.0)],
)
def test_proven_share(bounds, share):
    assert proven_share(*bounds) == share


@pytest.mark.parametrize("rel", [0.3, 0.1, 0.01])
def test_a_search_stops_at_the_share_and_its_leaves_prove_it(rel):
    """The incumbent improves during the search, and with it the gap that is allowed."""

    class Raised(Ripples):
        def value(self, thetas):
            return 1.0 + super().value(thetas)

    found = branch_and_bound(
        Raised(), Budget(), tolerance=Tolerance(rel), branching=LongestEdge(np.ones(2)),
        keep_leaves=True,
    )  # fmt: skip
    assert found.status is Status.OPTIMAL
    values = [event.upper_bound for event in found.events]
    assert len(set(values)) > 1
    assert found.lower_bound >= (1.0 - rel) * found.upper_bound
    assert found.lower_bound <= 1.0 + 0.3 < 2.0
    assert found.lower_bound == min(found.leaves.boxes.bounds.min(), found.upper_bound)
    assert not found.leaves.is_open.any()


def test_a_sample_gets_its_share_of_the_absolute_gap(rng):
    source = rng.random((60, 2))
    target = source + 0.01 * rng.standard_normal(source.shape)
    given = {"n_inliers": 60, "model": "similarity2d", "downsample": 20, "rel_gap": 0.0}
    whole = register(source, target, **given, abs_gap=60 * 0.005**2)
    per_pair = register(source, target, **given, tol=0.005)
    assert whole.downsampled.n_inliers == 20
    assert whole.gap_tol == pytest.approx(20 * 0.005**2)
    assert per_pair.gap_tol == pytest.approx(whole.gap_tol)
