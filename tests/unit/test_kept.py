"""What a disturbed experiment lost or repeated is found also if its final table is complete."""

from __future__ import annotations

import shutil

import pandas as pd
import pytest

from workflows.integrity import sealed
from workflows.studies.kept import finished, lost_and_repeated


def append(results, times):
    """Execute runs, each with its time."""
    path = results / "runs" / "icp" / "a.journal.jsonl"
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", encoding="utf-8") as journal:
        for run, time in times.items():
            journal.write(sealed({"run_id": run, "time_solve_s": time}) + "\n")


def tabulate(results, times):
    """Write the final table."""
    path = results / "tables" / "runs.parquet"
    path.parent.mkdir()
    rows = pd.DataFrame(times.items(), columns=["run_id", "time_solve_s"])
    rows.to_parquet(path)


@pytest.fixture
def disturbed(tmp_path):
    """Two of three runs were finished at the disturbance."""
    append(tmp_path, {"a": 0.1, "b": 0.2})
    return finished(tmp_path)


def test_a_continued_experiment_keeps_its_runs(tmp_path, disturbed):
    assert disturbed == {"a": {0.1}, "b": {0.2}}
    append(tmp_path, {"c": 0.3})
    tabulate(tmp_path, {"a": 0.1, "b": 0.2, "c": 0.3})
    assert lost_and_repeated(disturbed, tmp_path) == (0, 0)


@pytest.mark.parametrize("is_complete", [True, False])
def test_results_that_were_deleted_are_repeated(tmp_path, disturbed, is_complete):
    shutil.rmtree(tmp_path / "runs")
    again = {"a": 0.15, "b": 0.25, "c": 0.3}
    append(tmp_path, again)
    if is_complete:
        tabulate(tmp_path, again)
    assert lost_and_repeated(disturbed, tmp_path) == (0, 2)


@pytest.mark.parametrize("is_complete", [True, False])
def test_runs_without_a_result_are_lost(tmp_path, disturbed, is_complete):
    shutil.rmtree(tmp_path / "runs")
    left = {"b": 0.2, "c": 0.3}
    append(tmp_path, left)
    if is_complete:
        tabulate(tmp_path, left)
    assert lost_and_repeated(disturbed, tmp_path) == (1, 0)


def test_runs_are_also_repeated_if_both_results_are_there(tmp_path, disturbed):
    append(tmp_path, {"a": 0.15, "c": 0.3})
    append(tmp_path, {"c": 0.35})  # was not noted, but may not be executed twice either
    tabulate(tmp_path, {"a": 0.15, "b": 0.2, "c": 0.35})
    assert lost_and_repeated(disturbed, tmp_path) == (0, 2)


def test_a_damaged_run_may_be_executed_again(tmp_path, disturbed):
    path = tmp_path / "runs" / "icp" / "a.journal.jsonl"
    path.write_text(path.read_text().replace("0.1", "0.7"))
    noted = finished(tmp_path)
    assert noted == {"b": {0.2}}
    again = {"a": 0.15, "c": 0.3}
    append(tmp_path, again)
    tabulate(tmp_path, {"b": 0.2} | again)
    assert lost_and_repeated(noted, tmp_path) == (0, 0)
