"""Records hold what another person needs, stay small, and are refused with a remedy."""

import json
import platform
import re
import shutil

import numpy as np
import pandas as pd
import pytest

from baselines.registry import SEARCH_PATH
from tests.unit.report_fixture import CASES, write_tables
from workflows import CHECKOUT, provenance, recording
from workflows.config import Experiment
from workflows.integrals import COLUMNS, integral, integrals
from workflows.records import SCHEMA_VERSION


@pytest.fixture
def results(tmp_path):
    """A folder of made-up results."""
    write_tables(tmp_path / "results" / "tables", cases=CASES[:1])
    path = tmp_path / "results" / "tables" / "provenance.json"
    known = {"selection": {}, "git": {"commit": "c", "dirty": False}, "created": "2026-01-01"}
    known |= {"schema_version": SCHEMA_VERSION, "experiment": "made-up"}
    path.write_text(json.dumps(json.loads(path.read_text()) | known | {"methods": {}}))
    return tmp_path / "results"


def test_a_record_comes_back_with_integrals_and_identity(results, tmp_path):
    out = recording.record(results, tmp_path / "history", "v1")
    assert sorted(path.name for path in out.iterdir()) == [recording.ABOUT, recording.RUNS]
    found = recording.read("v1", tmp_path / "history")
    assert list(found) == [out.name]
    record = found[out.name]
    runs = pd.read_parquet(results / "tables" / "runs.parquet")
    pd.testing.assert_series_equal(record.runs["run_id"], runs["run_id"])
    bounded = runs["gap"].notna()
    assert record.runs.loc[bounded, list(COLUMNS)].notna().all(axis=None)
    assert record.runs.loc[runs["method"] == "icp", list(COLUMNS)].isna().all(axis=None)
    assert platform.node() not in (out / recording.ABOUT).read_text()
    direct = recording.read(str(results))[out.name]  # a folder of results needs no record
    pd.testing.assert_frame_equal(direct.runs, record.runs)


def test_methods_next_to_the_config_are_found(results, tmp_path, monkeypatch):
    monkeypatch.setenv(SEARCH_PATH, "")
    shutil.copytree(CHECKOUT / "baselines" / "_template", tmp_path / "baselines" / "next_to")
    path = results / "tables" / "provenance.json"
    known = json.loads(path.read_text()) | {"config_file": str(tmp_path / "mine.yaml")}
    known |= {"git": provenance.git_state(), "methods": {"next_to": {"baseline": "next_to"}}}
    path.write_text(json.dumps(known))
    assert recording.of_results(results).about["methods"]["next_to"]["code"]


def test_a_committed_record_has_a_maximum_size(results, tmp_path, monkeypatch):
    monkeypatch.setattr(recording, "HISTORY", tmp_path / "history")
    monkeypatch.setattr(recording, "MOST_BYTES", 1000)
    with pytest.raises(recording.RecordError, match="have at most 1 kB; record it with --history"):
        recording.record(results, tmp_path / "history", "v1")
    assert not list(tmp_path.glob("history/**/*.parquet"))


def test_a_part_of_an_experiment_is_not_recorded(results, tmp_path):
    path = results / "tables" / "provenance.json"
    known = json.loads(path.read_text())
    path.write_text(json.dumps(known | {"selection": {"tests": ["noise"]}}))
    with pytest.raises(recording.RecordError, match="run and record the whole experiment"):
        recording.record(results, tmp_path, "v1")


def test_unknown_results_are_answered_by_the_known_ones(results):
    with pytest.raises(recording.RecordError, match="no results of 'res'; available: results"):
        recording.find("res", results.parent)
    assert recording.find("results", results.parent) == results
    assert recording.find(str(results)) == results


def test_integrals_of_a_search_by_hand():
    runs = pd.DataFrame(
        {"run_id": ["a", "b"], "instance_id": "i", "n_inliers": 5, "certificate_scope": "s"}
        | {"upper_bound": [4.0, np.nan]}
    )
    events = [
        ("start", 1.0, 0, 0.0, 8.0),
        ("search", 2.0, 10, 2.0, 4.0),
        ("search", 4.0, 30, 4.0, 4.0),
    ]
    names = ["stage", "time_s", "n_nodes", "lower_bound", "upper_bound"]
    traces = pd.DataFrame(events, columns=names).assign(run_id="a")
    found = integrals(runs, traces)
    a = found.iloc[0]
    # seconds 0-1: nothing known; 1-2: bounds 0 and 8; 2-4: bounds 2 and 4; optimum 4
    assert a["primal_integral_s"] == pytest.approx(1 + 0.5)
    assert a["dual_integral_s"] == pytest.approx(1 + 1 + 2 * 0.5)
    assert a["gap_integral_s"] == pytest.approx(1 + 1 + 2 * 0.5)
    assert a["primal_integral_boxes"] == pytest.approx(10 * 0.5)
    assert a["gap_integral_boxes"] == pytest.approx(10 + 20 * 0.5)
    assert found.iloc[1].isna().all()
    assert integral(np.array([]), np.array([])) == 0.0


def test_every_committed_record_is_readable_small_and_runnable_again():
    versions = recording.versions()
    assert versions, "reports/history holds no record: make record"
    for version in versions:
        for name, record in recording.read(version).items():
            folder = recording.HISTORY / version / name
            assert (folder / recording.RUNS).stat().st_size <= recording.MOST_BYTES
            assert Experiment.model_validate(record.about["config"]).name == name
            assert not record.about["git"]["dirty"]
            assert set(record.runs["method"]) == set(record.about["methods"])
            assert re.fullmatch("[0-9a-f]{40}", record.about["git"]["commit"])
