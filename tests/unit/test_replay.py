"""A repeated run is compared with the stored one, and the comparison can fail."""

import json

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from baselines import registry
from baselines.contract import Solution
from dcreg.status import Status
from workflows import UserError, archives, config, records
from workflows.__main__ import app
from workflows.instances import content_digest
from workflows.replay import SAME, replay
from workflows.stages.generate import instance_of
from workflows.stages.plan import expand

CONFIG = """
name: mine
datasets: [{dataset: embedded, shapes: [fish], n_points: 10, tests: {noise: [0.01]}}]
methods: [{name: icp, baseline: icp}]
"""


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Return the config, the id of its run, and what a table of runs would hold of it."""
    monkeypatch.setattr(archives, "ARCHIVES", tmp_path / "none")
    path = tmp_path / "mine.yaml"
    path.write_text(CONFIG)
    plan = expand(config.load(str(path)), None, str(path), None)
    planned = next(plan.runs())
    instance = instance_of(planned.instance, 1.0, plan.experiment.seed, None, None)
    found = replay(planned.run_id, str(path))
    assert found["stored"] == "not compared: no stored run"
    row = {
        "schema_version": records.SCHEMA_VERSION,
        "run_id": planned.run_id,
        "experiment": str(path),
        "status": found["status"],
        "outcome": "finished",
        "T_target_source": json.dumps(found["T_target_source"]),
        "instance_digest": content_digest(instance),
        "fingerprint": registry.fingerprint("icp"),
        **{
            name: found[name] for name in ("lower_bound", "upper_bound", "n_nodes", "n_assignments")
        },
    }
    return tmp_path, planned.run_id, row


def stored(folder, row) -> str:
    tables = folder / "mine" / "tables"
    tables.mkdir(parents=True, exist_ok=True)
    pd.DataFrame([row]).to_parquet(tables / "runs.parquet")
    return str(replay(row["run_id"], results=folder)["stored"])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({}, SAME),
        (
            {"T_target_source": json.dumps([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]])},
            "different: pose",
        ),
        ({"n_assignments": 10_000.0}, "different: n_assignments"),
        (
            {"n_assignments": 10_000.0, "machine_id": "other"},
            "different: n_assignments; the stored run is from another machine",
        ),
        ({"instance_digest": "other"}, "not compared: another instance"),
        ({"fingerprint": "other"}, "not compared: another version of the method"),
        ({"outcome": "failed", "status": "failed"}, "not compared: the stored run has the status"),
        ({"status": "time_limit", "outcome": "limited"}, "not compared: one of the runs hit"),
    ],
)
def test_the_stored_run_decides(run, change, said):
    folder, _, row = run
    assert stored(folder, {**row, **change}).startswith(said)


def test_an_optimum_without_a_bound_is_compared_as_it_is_stated(run, monkeypatch):
    folder, _, row = run
    answer = Solution(Status.OPTIMAL, np.eye(3), lower_bound=-1.0, upper_bound=1.0)
    monkeypatch.setattr(type(registry.load("icp")), "solve", lambda *_: answer)
    row |= {
        "status": "converged", "T_target_source": json.dumps(np.eye(3).tolist()),
        "lower_bound": -1.0, "upper_bound": 1.0, "n_nodes": None, "n_assignments": None,
    }  # fmt: skip
    assert stored(folder, row) == SAME


def test_a_run_that_was_started_comes_before_a_planned_one(run):
    folder, _, row = run
    earlier = folder / "mine" / "evidence" / "tables"
    earlier.mkdir(parents=True)
    planned = {**row, "outcome": "not_needed", "status": "not_run", "fingerprint": ""}
    pd.DataFrame([planned]).to_parquet(earlier / "runs.parquet")
    assert stored(folder, row) == SAME


def test_results_come_before_archives(run, tmp_path, monkeypatch):
    folder, _, row = run
    monkeypatch.setattr(archives, "folders", lambda: [tmp_path / "damaged"])
    assert stored(folder, row) == SAME


def test_the_config_recorded_with_the_run_is_used(run):
    folder, run_id, row = run
    path = folder / "mine" / "tables" / "provenance.json"
    path.parent.mkdir(parents=True)
    settings = config.load(row["experiment"]).model_dump()
    path.write_text(json.dumps({"config": settings}))
    assert stored(folder, {**row, "experiment": "mine"}) == SAME
    path.write_text(json.dumps({"config": {**settings, "limits": {"time_s": 3.0}}}))
    with pytest.raises(UserError, match=f"no run '{run_id}'"):
        stored(folder, row)


def test_a_difference_has_its_own_exit_code(run):
    folder, run_id, row = run
    stored(folder, {**row, "n_assignments": 10_000.0})
    done = CliRunner().invoke(app, ["replay", run_id, "--results", str(folder)])
    assert done.exit_code == 1, done.output
    assert json.loads(done.output)["stored"] == "different: n_assignments"


def test_a_run_that_was_only_planned_is_refused_before_it_is_solved(run):
    folder, run_id, row = run
    with pytest.raises(UserError, match=f"run {run_id} was not started .*not_needed"):
        stored(folder, {**row, "outcome": "not_needed", "status": "not_run", "fingerprint": ""})


def test_an_unknown_run_is_named(run):
    folder, _, _ = run
    with pytest.raises(UserError, match="no run 'x' in the archives or in"):
        replay("x", results=folder)
