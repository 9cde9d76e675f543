"""A first call compiles little more than stored: the regression signal of start-up, without a clock."""

import pytest
from numba import config

from tests.bench.compile_counters import CALLS, COMMAND, count, growth, stored


@pytest.mark.slow
@pytest.mark.skipif(bool(config.DISABLE_JIT), reason="nothing is compiled")
@pytest.mark.parametrize("dimension", CALLS)
def test_a_first_call_compiles_what_is_stored(dimension):
    grown = growth(count(dimension), stored()[dimension])
    assert not grown, f"{dimension}: {'; '.join(grown)}; to accept the growth: {COMMAND}"


def test_a_growth_by_more_than_a_tenth_is_found():
    accepted = {"functions": 50, "ir_lines": 1000}
    assert growth({"functions": 55, "ir_lines": 900}, accepted) == []
    assert growth({"functions": 50, "ir_lines": 1101}, accepted) == [
        "ir_lines grew by 10 %: 1101, accepted 1000"
    ]
