"""The benchmark's problems cost the work stored: the regression signal without a clock."""

import json

import pytest

from tests.golden.bench_counters import COUNTED, COUNTERS, STORED, agrees, counters, digest
from tests.golden.regenerate import COMMAND


@pytest.fixture(scope="module")
def stored():
    return json.loads(STORED.read_text(encoding="utf-8"))


def test_every_counted_problem_is_stored_and_no_other(stored):
    assert list(stored) == list(COUNTED), f"run {COMMAND}"


@pytest.mark.parametrize("name", COUNTED)
def test_work_is_that_stored(name, stored):
    case, subject = COUNTED[name]
    if not subject.is_here:
        pytest.skip("DCREG_DATA_MIRROR names no folder: the public files are not here")
    expected, found = stored[name], counters(case, subject)
    assert digest(subject) == expected["points"], "the problem itself changed, not its solution"
    assert found["status"] == expected["status"]
    for counter in COUNTERS:
        assert agrees(found[counter], expected[counter]), (
            f"{counter}: {found[counter]}, stored {expected[counter]}; if this is meant: {COMMAND}"
        )


@pytest.mark.usefixtures("thin_slices")
@pytest.mark.parametrize("name", [name for name in COUNTED if name.startswith("embedded")])
def test_work_is_the_same_in_every_run(name):
    """On one machine the counters are exact, whatever the bound, and do not depend on threads."""
    case, subject = COUNTED[name]
    first, threaded = case.solve(subject), case.solve(subject, threads=2)
    assert [getattr(first, c) for c in COUNTERS] == [getattr(threaded, c) for c in COUNTERS]


def test_some_counters_are_asserted_exactly(stored):
    exact = [name for name, kept in stored.items() if all(len(set(kept[c])) == 1 for c in COUNTERS)]
    assert any("/dc:" in name for name in exact)


def test_a_changed_search_is_found():
    assert agrees(100, [100, 100])
    assert not agrees(101, [100, 100])
    assert agrees(108, [90, 100])
    assert not agrees(115, [90, 100])
