"""Disturbed sweeps end with the table of an undisturbed one; `make faults` tries all faults."""

from __future__ import annotations

import pytest

from workflows.studies.faults import FAULTS, study

pytestmark = [pytest.mark.workflow, pytest.mark.timeout(1800)]
SHORT = ("restart_machine", "corrupt_files")


def test_a_disturbed_sweep_loses_and_repeats_nothing(tmp_path):
    found = study(tmp_path, 24, SHORT, seed=0).set_index("fault")
    assert list(found.index) == list(SHORT)
    assert set(SHORT) < set(FAULTS)
    assert found["struck"].all()
    assert (found["runs"] == 24).all()
    assert (found["lost"] == 0).all()
    assert (found["repeated"] == 0).all()
    assert found["survived"].all(), found
