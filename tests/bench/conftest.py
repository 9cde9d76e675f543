"""The option of the benchmark; `tests/bench/bench_*.py` are run by ``make bench`` only."""


def pytest_addoption(parser):
    parser.addoption("--quick", action="store_true", help="only the cases that take seconds")
