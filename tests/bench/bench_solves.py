"""Solve all cases under pytest-benchmark: ``make bench``. Not collected by the tests: it takes minutes.

Every solve leaves a row (times, counters, status, memory) in the benchmark's ``extra_info``;
`tests.bench.tables` turns the rows into tables.
"""

from __future__ import annotations

import pytest

import dcreg
from tests.bench.cases import CASES
from tests.bench.measure import measure


@pytest.fixture(scope="module", autouse=True)
def _compiled():
    dcreg.warm_up()


@pytest.mark.parametrize("name", CASES)
def test_solve(name, benchmark, request):
    case = CASES[name]
    if request.config.getoption("--quick") and not case.quick:
        pytest.skip("not of the quick selection")
    missing = [str(subject) for subject in case.subjects if not subject.is_here]
    if missing:
        pytest.skip(f"DCREG_DATA_MIRROR names no folder: no {missing[0]}")
    rows = benchmark.pedantic(
        lambda: [measure(case, subject) for subject in case.subjects], rounds=1, iterations=1
    )
    benchmark.extra_info["solves"] = rows
    for row in rows:  # certificates must be valid whatever the time
        assert row["lower_bound"] <= row["upper_bound"] * (1 + 1e-12)
        assert row["status"] != "optimal" or row["gap"] <= row["gap_tol"] * (1 + 1e-9)
