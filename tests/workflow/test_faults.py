"""Disturbed sweeps end with the table of an undisturbed one; `make faults` tries all faults."""

from __future__ import annotations

import shutil

import pytest

from workflows.studies.faults import FAULTS, interrupt, study

pytestmark = [pytest.mark.workflow, pytest.mark.timeout(1800)]
SHORT = ("restart_machine",)  # damaged files: `test_dag`, and all kinds in `make faults`


def forget(sweep):
    """What a harness does that deletes its results when it is started again."""
    struck = interrupt(sweep)
    shutil.rmtree(sweep.results)
    return struck


def test_a_disturbed_sweep_loses_and_repeats_nothing(tmp_path, monkeypatch):
    assert set(SHORT) < set(FAULTS)
    monkeypatch.setitem(FAULTS, "forget", forget)
    found = study(tmp_path, 24, [*SHORT, "forget"], seed=0).set_index("fault")
    assert list(found.index) == [*SHORT, "forget"]
    assert found["struck"].all()
    assert (found["runs"] == 24).all()
    assert (found["intact_at_fault"] > 0).all()

    survived = found.loc[list(SHORT)]
    assert (survived["lost"] == 0).all()
    assert (survived["repeated"] == 0).all()
    assert survived["survived"].all(), found
    # its table is complete and right, so only the noted runs show that they were executed again
    forgotten = found.loc["forget"]
    assert not forgotten["survived"]
    assert forgotten["different"] == 0
    assert forgotten["repeated"] == forgotten["intact_at_fault"]
