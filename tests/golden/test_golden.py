"""Results of fixed small problems: work counters exactly, floating results to the last digits.

A differing counter is a changed search, on any machine. If the change is meant:
``python -m tests.golden.regenerate``.
"""

import numpy as np
import pytest

from tests.golden.cases import CASES, Case
from tests.golden.regenerate import COMMAND, stored
from workflows.stages.worker import COUNTERS

VALUES = ("lower_bound", "upper_bound", "objective")
REMEDY = f"if this change is meant: {COMMAND}"


@pytest.fixture(scope="module")
def golden():
    return stored()


def test_every_case_is_stored_and_no_other(golden):
    assert list(golden) == list(CASES), REMEDY


@pytest.mark.usefixtures("thin_slices")
@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("name", CASES)
def test_results_are_those_stored(name, threads, golden):
    expected, found = golden[name], CASES[name].outcome(threads)
    assert found["points"] == expected["points"], "the problem itself changed, not its solution"
    for key in ("status", *COUNTERS):
        assert found[key] == expected[key], f"{key}; {REMEDY}"
    size = expected["upper_bound"]
    for key in VALUES:
        assert found[key] == pytest.approx(expected[key], rel=1e-9, abs=1e-9 * size), REMEDY
    np.testing.assert_allclose(
        found["T_target_source"], expected["T_target_source"], rtol=1e-9, atol=1e-9
    )


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", CASES)
def test_rounding_does_not_decide_the_counters(name, seed, golden):
    """Another processor may round differently: only what survives that is worth storing."""
    result = CASES[name].solve(jitter=1e-13, seed=seed)
    found = {key: getattr(result, key) for key in COUNTERS}
    assert found == {key: golden[name][key] for key in COUNTERS}, "choose another problem"


@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.with_trace])
def test_bound_history_is_that_stored(name, golden):
    expected, found = golden[name]["trace"], CASES[name].outcome()["trace"]
    assert len(found) == len(expected), REMEDY
    for event, known in zip(found, expected, strict=True):
        bounds = ("lower_bound", "upper_bound")
        assert {k: v for k, v in event.items() if k not in bounds} == {
            k: v for k, v in known.items() if k not in bounds
        }, REMEDY
        size = known["upper_bound"]
        for key in bounds:
            assert event[key] == pytest.approx(known[key], rel=1e-9, abs=1e-9 * size), REMEDY


def test_stored_history_closes_in_on_the_optimum(golden):
    """Guards the file itself: what was regenerated is a valid history, with its bounds moving."""
    trace = golden["2d-complete-safe"]["trace"]
    lower = [event["lower_bound"] for event in trace]
    upper = [event["upper_bound"] for event in trace]
    assert lower == sorted(lower)
    assert upper == sorted(upper, reverse=True)
    assert len(set(lower)) > 5
    assert trace[-1]["status"] == "optimal"
    assert upper[-1] - lower[-1] <= CASES["2d-complete-safe"].gap_tol


@pytest.mark.parametrize("cloud", sorted({case.cloud.seed for case in CASES.values()}))
def test_stored_bounds_of_one_problem_agree(cloud, golden):
    """Every lower bound lies below every upper bound of the same problem, whatever the bound."""
    families: dict[tuple, list[dict]] = {}
    for name, case in CASES.items():
        if case.cloud.seed == cloud:
            family = (case.model, case.n_inliers, case.scale_range)
            families.setdefault(family, []).append(golden[name])
    for outcomes in families.values():
        lower = max(outcome["lower_bound"] for outcome in outcomes)
        upper = min(outcome["upper_bound"] for outcome in outcomes)
        assert lower <= upper


def test_a_changed_search_is_found(golden):
    """The comparison can fail: the same problem with another bound has other counters."""
    name = "2d-complete-dc"
    case = CASES[name]
    other = Case(case.model, case.cloud, case.n_inliers, "interval", case.gap_tol).outcome()
    assert other["points"] == golden[name]["points"]
    assert other["n_nodes"] != golden[name]["n_nodes"]
