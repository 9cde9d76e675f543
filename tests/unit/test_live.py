"""The state of a running experiment, from the journals and progress files of its jobs."""

from __future__ import annotations

import io
import os
import time

import pandas as pd
import pytest
from rich.console import Console

from baselines import registry
from workflows.config import Experiment
from workflows.integrity import sealed
from workflows.live import LINE_S, View
from workflows.stages import progress
from workflows.stages.plan import expand
from workflows.stages.progress import STALE_S, Reporter, running


@pytest.fixture
def plan():
    return expand(
        Experiment(
            name="e",
            limits={"time_s": 7},
            datasets=[
                {"dataset": "embedded", "shapes": ["fish"], "tests": {"noise": [0.0, 0.1, 0.2]}}
            ],
            methods=[
                {"name": "a", "baseline": "cpd"},
                {"name": "b", "baseline": "cpd", "options": {"starts": "multi"}},
            ],
        )
    )


@pytest.fixture
def write(plan, tmp_path):
    """A function that writes a run into the journal of its job."""

    def written(run, status: str, seconds: float, part: slice = slice(None)) -> None:
        folder = tmp_path / "runs" / run.method.name
        folder.mkdir(parents=True, exist_ok=True)
        row = {
            "run_id": run.run_id, "status": status, "time_solve_s": seconds, "instance_digest": "",
            "fingerprint": registry.fingerprint("cpd"),
        }  # fmt: skip
        with (folder / f"{run.chunk.name}.journal.jsonl").open("a") as journal:
            journal.write(f"{sealed(row)}\n"[part])

    return written


def view_of(plan, folder, console: Console, monkeypatch) -> View:
    monkeypatch.setattr("workflows.live.GLANCE_S", 0.0)
    return View(plan, folder, 2, console)


def lines_of(console: Console) -> list[str]:
    return console.export_text().splitlines()


def test_lines_count_outcomes_and_estimate_the_rest(plan, write, tmp_path, monkeypatch):
    runs = list(plan.runs())
    first, second, third = (run for run in runs if run.method.name == "a")
    write(first, "converged", 2.0)  # before the run
    console = Console(record=True, width=200, force_terminal=False)
    view = view_of(plan, tmp_path, console, monkeypatch)
    with view:
        view.update()
        assert lines_of(console) == []  # nothing new
        write(second, "time_limit", 4.0)
        write(third, "failed", 1.0, slice(0, 40))  # half a line
        Reporter("b", tmp_path / "runs/a" / "c.parquet").alive(0.75)
        view.update()
        (line,) = lines_of(console)
        assert line.startswith(
            "progress  2 of 6 runs ended (1 finished, 1 limited); running: CPD (s"
        )
        assert ", gap 25 %; at most 12 s left" in line  # (median 3 s + 3 x 7 s) / 2 cores
        monkeypatch.setattr("workflows.live.LINE_SHARE", 0.5)
        write(third, "failed", 1.0, slice(40, None))
        view.update()
        assert lines_of(console) == []  # too soon
        view._line_at -= LINE_S
        view.update()
        assert "3 of 6 runs ended (1 finished, 1 limited, 1 failed)" in lines_of(console)[0]


def test_a_terminal_shows_a_row_per_method_in_place(plan, write, tmp_path, monkeypatch):
    console = Console(record=True, width=100, height=24, force_terminal=True, file=io.StringIO())
    with view_of(plan, tmp_path, console, monkeypatch) as view:
        for run in plan.runs():
            if run.method.name == "a":
                write(run, "converged", 2.0)
        Reporter("b", tmp_path / "runs/a" / "c.parquet").alive()
        view.update()
        shown = console.export_text()
    rows = [line.split() for line in shown.splitlines() if line.startswith("CPD")]
    assert ["CPD", "(starts", "multi)", "0/3", "1", "21", "s"] in rows
    assert ["CPD", "3/3", "3"] in rows
    assert rows[-1][0] == "CPD"


def test_runs_of_methods_that_are_not_installed_have_no_journal(plan, tmp_path, monkeypatch):
    console = Console(record=True, width=200, force_terminal=False)
    view = view_of(plan, tmp_path, console, monkeypatch)
    rows = [
        {"run_id": run.run_id, "status": "unavailable", "fingerprint": registry.fingerprint("cpd")}
        for run in plan.runs()
        if run.method.name == "a"
    ]
    chunk = next(iter(plan.runs())).chunk.name
    (tmp_path / "runs/a").mkdir(parents=True)
    pd.DataFrame(rows).to_parquet(tmp_path / "runs/a" / f"{chunk}.parquet")
    view.update()
    assert "3 of 6 runs ended (3 unavailable)" in lines_of(console)[0]


def test_a_job_writes_once_a_second_and_leaves_nothing(tmp_path, monkeypatch):
    folder = tmp_path / "runs" / "a"
    folder.mkdir(parents=True)
    with Reporter("a", folder / "c.parquet") as reporter:
        reporter.begin("one")
        (solve,) = running(tmp_path / "runs")
        assert (solve.method, solve.chunk, solve.instance_id, solve.proven) == (
            "a",
            "c",
            "one",
            None,
        )
        reporter.alive(0.5)
        assert next(running(tmp_path / "runs")).proven is None  # within the second
        monkeypatch.setattr(progress, "WRITE_S", 0.0)
        reporter.alive()
        assert next(running(tmp_path / "runs")).proven == 0.5
        long_ago = time.time() - 2 * STALE_S
        os.utime(reporter.path, (long_ago, long_ago))
        assert list(running(tmp_path / "runs")) == []  # of a job that was killed
    assert list(folder.iterdir()) == []
