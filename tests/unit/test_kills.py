"""A run during which its whole job was killed is tried again once, then it has failed."""

from __future__ import annotations

import json

import pandas as pd
import pytest

from workflows.config import Experiment
from workflows.instances import write_problems
from workflows.stages.generate import problem_of, raw_instance
from workflows.stages.kills import Kills
from workflows.stages.plan import expand
from workflows.stages.progress import SUFFIX, Reporter
from workflows.stages.solve import forget, solve

CONFIG = {
    "name": "killed",
    "datasets": [
        {"dataset": "embedded", "shapes": ["fish"], "n_points": 10, "tests": {"noise": [0.01, 0.02]}}
    ],
    "methods": [{"name": "icp", "baseline": "icp"}],
}  # fmt: skip


@pytest.fixture
def job(tmp_path):
    """Return a solve job over two instances as a function, their ids, and the path of its runs."""
    experiment = Experiment.model_validate(CONFIG)
    (chunk,) = expand(experiment).chunks
    problems = [problem_of(spec, raw_instance(spec)) for spec in chunk.instances]
    write_problems(tmp_path / "i.npz", problems)
    runs = tmp_path / "runs" / "icp" / "chunk.parquet"
    runs.parent.mkdir(parents=True)

    def run() -> dict[str, str]:
        solve(experiment, experiment.methods[0], tmp_path / "i.npz", runs, lambda text: None)
        rows = pd.read_parquet(runs).set_index("instance_id")
        return (rows["status"] + ": " + rows["message"]).to_dict()

    return run, [each.instance_id for each in problems], runs


def kill(runs, instance_id: str) -> None:
    """Leave what a job leaves that is killed while it solves an instance."""
    Reporter("icp", runs).begin(instance_id)
    Kills(runs)  # of the job that is started next and killed before its first solve


def test_a_run_is_tried_again_once(job):
    run, (first, second), runs = job
    kill(runs, first)
    found = run()
    assert found[first] == found[second] == "converged: "
    assert [path.name for path in runs.parent.glob("*.json")] == []


def test_every_finished_run_is_on_the_disk_before_the_next_one(job, monkeypatch):
    run, instances, runs = job
    lines = []
    journal = runs.with_suffix(".journal.jsonl")
    monkeypatch.setattr(
        "workflows.stages.solve.os.fsync",
        lambda _: lines.append(journal.read_text().count("\n")),
    )
    run()
    assert lines == list(range(1, len(instances) + 1))


def test_a_run_that_was_killed_twice_has_failed_with_its_reason(job):
    run, (first, second), runs = job
    kill(runs, first)
    kill(runs, first)
    kill(runs, second)
    found = run()
    assert found[first].startswith("failed: the job was killed 2 times during this run")
    assert found[second] == "converged: "
    assert forget(runs.parents[1], {"failed"}) == 1
    assert run()[first] == "converged: "


def test_a_job_that_ends_by_itself_does_not_count(job):
    run, (first, _), runs = job
    for _ in range(3):
        Kills(runs)
        with Reporter("icp", runs) as reporter:  # SIGTERM raises SystemExit
            reporter.begin(first)
    assert run()[first] == "converged: "


@pytest.mark.parametrize("content", ["", "{", "[]", json.dumps({"method": "icp"})])
def test_a_damaged_file_of_progress_counts_nothing(job, content):
    run, (first, _), runs = job
    for _ in range(3):
        runs.with_suffix(SUFFIX).write_text(content)
        Kills(runs)
    assert run()[first] == "converged: "
