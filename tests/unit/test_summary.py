"""What is printed of methods and of plans."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import report_fixture
from rich.console import Console

from baselines import registry
from workflows.config import Experiment, parse_selection
from workflows.integrity import sealed
from workflows.labels import display_names
from workflows.outlook import outlook_of
from workflows.stages.plan import expand
from workflows.summary import print_baselines, print_plan, print_summary

FAULTS = Path(__file__).parents[1] / "workflow" / "baselines"


def test_the_list_of_methods_shows_the_key_that_a_config_needs(monkeypatch):
    monkeypatch.setattr(registry, "roots", lambda: [FAULTS])
    console = Console(record=True, width=160)
    print_baselines(console)
    lines = console.export_text().splitlines()
    (row,) = [line for line in lines if "│ Fault" in line]
    assert row.split("│")[1].strip() == "fault"


def test_a_plan_shows_the_names_of_its_methods_and_their_keys(tmp_path):
    experiment = Experiment(
        name="e",
        datasets=[{"dataset": "embedded", "shapes": ["fish"], "tests": {"noise": [0.1]}}],
        methods=[
            {"name": "one", "baseline": "cpd", "label": "CPD [red]"},
            {"name": "two", "baseline": "cpd", "n_inliers_ratio": 0.5},
        ],
    )
    console = Console(record=True, width=200)
    print_plan(expand(experiment), tmp_path, 2, console)
    rows = [
        line.split("│") for line in console.export_text().splitlines() if "similarity2d" in line
    ]
    shown = {row[2].strip(): row[1].strip() for row in rows}
    assert shown == display_names(experiment.methods)
    assert shown["one"] == "CPD [red]"


def test_methods_with_one_displayed_name_are_distinguished(tmp_path):
    report_fixture.write_tables(tmp_path / "tables")
    path = tmp_path / "tables" / "runs.parquet"
    runs = pd.read_parquet(path)
    alike = list(dict.fromkeys(runs["method"]))[:2]
    runs.loc[runs["method"].isin(alike), "display_name"] = "Twin"
    runs.to_parquet(path)
    console = Console(record=True, width=200)
    print_summary(tmp_path, console)
    shown = console.export_text()
    assert all(f"Twin [{name}]" in shown for name in alike)
    assert shown.count("[") == shown.count("Twin [")


def test_the_outlook_counts_finished_runs_and_takes_their_times(tmp_path):
    experiment = Experiment(
        name="e",
        limits={"time_s": 7},
        datasets=[{"dataset": "embedded", "shapes": ["fish"], "tests": {"noise": [0.0, 0.1, 0.2]}}],
        methods=[{"name": "a", "baseline": "icp"}, {"name": "b", "baseline": "cpd"}],
    )
    plan = expand(experiment)
    first, second, _ = [run.run_id for run in plan.runs() if run.method.name == "a"]
    rows = [
        {"run_id": first, "fingerprint": registry.fingerprint("icp"), "time_solve_s": 2.0},
        {"run_id": second, "fingerprint": "of an older version", "time_solve_s": 4.0},
        {"run_id": "of another config", "fingerprint": "", "time_solve_s": 100.0},
    ]
    folder = tmp_path / "runs" / "a"
    folder.mkdir(parents=True)
    lines = [sealed({**row, "instance_digest": "", "status": "converged"}) for row in rows]
    (folder / "c.journal.jsonl").write_text("\n".join(lines))
    a, b = outlook_of(plan, tmp_path)
    assert (a.runs, a.finished, a.seconds, a.known) == (3, 1, 2 * 3.0, True)
    assert (b.runs, b.finished, b.seconds, b.known) == (3, 0, 3 * 7.0, False)
    (part,) = outlook_of(expand(experiment, parse_selection(["methods=b", "levels=0.1"])), tmp_path)
    assert (part.method, part.runs) == ("b", 1)
    console = Console(record=True, width=200)
    print_plan(plan, tmp_path, 1, console)
    assert "no report yet: " in console.export_text()
