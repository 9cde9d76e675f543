"""Shared fixtures, the fixed Hypothesis profile, and which tests share a worker, the longest first."""

# Blocks the network, before NumPy starts threads.
import tests.offline  # noqa: F401  # isort: skip

import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hypothesis
import numpy as np
import pytest

from tests import browsing, clocks

hypothesis.settings.register_profile(
    "fixed", derandomize=True, deadline=None, max_examples=int(os.environ.get("EXAMPLES", "30"))
)
hypothesis.settings.load_profile("fixed")

HERE = Path(__file__).parent

# Files that start first, because they run longest: both cores then finish together.
LONGEST = (
    "workflow/test_dag.py", "workflow/test_report_browser.py", "workflow/test_reproducibility.py",
    "workflow/test_profiles.py", "workflow/test_faults.py", "properties/test_cover.py",
    "properties/test_nearest_cover.py", "questions/test_questions.py", "unit/test_claims.py",
    "workflow/test_merge.py", "golden/test_goicp_baseline.py", "bench/test_compile_counters.py",
    "bad_input/test_bad_input.py", "fuzz/test_fuzz.py",
)  # fmt: skip
# Files whose tests share nothing that is expensive to make: any worker may take a part of them.
SPREAD = ("unit/test_compiling.py",)
# A file shares the worker of another one whose fixtures it uses.
WITH = dict.fromkeys(
    (
        "unit/test_report.py",
        "unit/test_findings.py",
        "unit/test_runs.py",
        "workflow/test_runs_browser.py",
        "workflow/test_library_browser.py",
        "workflow/test_accessibility.py",
    ),
    "workflow/test_report_browser.py",
)


def share(nodeid: str) -> str:
    """Return the share of the work that a test belongs to, which one worker does.

    Tests of a file share fixtures and loaded kernels. Where a file runs every method, only the tests of
    one method stay together.
    """
    file = nodeid.split("::")[0].removeprefix("tests/")
    if file in SPREAD:
        return nodeid
    method = nodeid.partition("[")[2].partition("-")[0] if file.startswith("contract/") else ""
    return WITH.get(file, file) + method.rstrip("]")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Distribute shares; the scheduler `loadgroup` of pytest-xdist 3.8 groups nothing with pytest 9.2."""
    from xdist.scheduler import LoadScopeScheduling

    class ByShare(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return share(nodeid)

    return ByShare(config, log)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the tests that run longest."""
    first = (*LONGEST, *SPREAD)
    order = {file: place for place, file in enumerate(first)}
    items.sort(key=lambda item: order.get(item.path.relative_to(HERE).as_posix(), len(first)))


@pytest.fixture(scope="module", autouse=True)
def quick_compilation() -> Iterator[None]:
    """Compile as searches and warm-ups do, also what tests call without them."""
    from dcreg.jit.lean import lean_numba

    with lean_numba():
        yield


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20260326)


@pytest.fixture(scope="session")
def made_report(tmp_path_factory) -> Path:
    """The folder of a report, with its made-up tables."""
    from reports.build import build
    from tests.unit.report_fixture import write_tables

    folder = tmp_path_factory.mktemp("report")
    build(write_tables(folder / "tables"), folder / "index.html")
    return folder


@pytest.fixture
def blank_prints(monkeypatch: pytest.MonkeyPatch) -> None:
    """Blank printed figures, for tests of other parts of a page: drawing takes most of the time."""
    monkeypatch.setattr("reports.figures.printing.rendered", lambda *_, **__: b"<svg ></svg>")


@pytest.fixture(scope="session")
def browser(tmp_path_factory):
    """One headless browser for all tests of pages."""
    driver = browsing.start(tmp_path_factory.mktemp("profile"))
    yield driver
    driver.quit()


@pytest.fixture
def set_clock(monkeypatch: pytest.MonkeyPatch) -> clocks.SetClock:
    """The clock of all budgets, which only the test moves."""
    clock = clocks.SetClock()
    clocks.use(monkeypatch, clock)
    return clock


@pytest.fixture
def thin_slices(monkeypatch: pytest.MonkeyPatch) -> None:
    """Threads share the work of a bound however little it is, which takes longer than it saves."""
    monkeypatch.setattr("dcreg.families.protocol.SpaceBound.slice_pairs", 1)


@pytest.fixture
def processor_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """Budgets count processor time, which other work on the machine does not prolong.

    It is the time of all threads together, so a search has only one by default.
    """
    monkeypatch.setattr("dcreg.driver.options.usable_processors", lambda: 1)
    clocks.use(monkeypatch, time.process_time)
