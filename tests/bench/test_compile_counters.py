"""First calls and covers compile little more than stored: a check of compile time without a clock."""

import pytest
from numba import config

from tests.bench.compile_counters import COMMAND, PROCESSES, count, growth, stored


@pytest.mark.slow
@pytest.mark.skipif(bool(config.DISABLE_JIT), reason="nothing is compiled")
@pytest.mark.parametrize("cases", PROCESSES, ids="-".join)
def test_little_more_is_compiled_than_stored(cases):
    accepted, found = stored(), count(*cases)
    grown = [f"{case}: {each}" for case in cases for each in growth(found[case], accepted[case])]
    assert not grown, f"{'; '.join(grown)}; to accept the growth: {COMMAND}"


def test_a_growth_by_more_than_a_tenth_is_found():
    accepted = {"functions": 50, "ir_lines": 1000}
    assert growth({"functions": 55, "ir_lines": 900}, accepted) == []
    assert growth({"functions": 50, "ir_lines": 1101}, accepted) == [
        "ir_lines grew by 10 %: 1101, accepted 1000"
    ]
