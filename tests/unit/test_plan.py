"""The plan is a pure function of config and selection."""

from __future__ import annotations

import subprocess
import sys

import pytest

from workflows import CHECKOUT
from workflows.config import ConfigError, Experiment, load, parse_selection
from workflows.integrity import sealed
from workflows.outlook import outlook_of
from workflows.stages.plan import MAX_NAME, expand


def experiment(**changes) -> Experiment:
    grid = {"dataset": "embedded", "shapes": ["fish", "pony"], "tests": {"noise": [0.0, 0.01]}}
    methods = [
        {"name": "dcreg", "baseline": "dcreg"},
        {"name": "half", "baseline": "dcreg", "n_inliers_ratio": 0.5},
        {"name": "bnb", "baseline": "rpm_htb", "models": ["similarity2d"]},
    ]
    fields = {"name": "small", "chunk_size": 3, "datasets": [{**grid, "trials": 2}]}
    return Experiment(**{**fields, "methods": methods, **changes})


def test_the_grid_is_complete_and_has_no_run_twice():
    runs = list(expand(experiment()).runs())
    assert len(runs) == 8 + 8 + 4  # the last method is asked to treat 2D only
    assert len({run.run_id for run in runs}) == len(runs)
    seen = {
        name: {run.instance.instance_id for run in runs if run.method.name == name}
        for name in ("dcreg", "half")
    }
    assert seen["dcreg"] == seen["half"] == {run.instance.instance_id for run in runs}
    assert len(seen["dcreg"]) == 8


def test_a_stage_of_one_chunk_identifies_no_run(monkeypatch):
    """Every stage expands the plan, and some have half a million runs."""
    monkeypatch.delattr("workflows.stages.plan.run_identity")
    assert len(expand(experiment()).chunks) == 4


def test_chunks_hold_one_model_and_no_more_than_asked():
    plan = expand(experiment())
    assert all(len(chunk.instances) <= 3 for chunk in plan.chunks)
    assert all({i.model for i in chunk.instances} == {chunk.model} for chunk in plan.chunks)
    assert sum(len(chunk.instances) for chunk in plan.chunks) == 8


def test_ids_are_the_same_in_another_process():
    code = (
        "from workflows.config import load; from workflows.stages.plan import expand;"
        "print([run.run_id for run in expand(load('demo')).runs()])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=CHECKOUT, env={"PATH": ""}, capture_output=True, text=True, check=True,
    )  # fmt: skip
    here = [run.run_id for run in expand(load("demo")).runs()]
    assert done.stdout == f"{here}\n"
    assert len(here) > 10


def ids(settings: Experiment, method: str = "dcreg") -> list[str]:
    return [run.run_id for run in expand(settings).runs() if run.method.name == method]


@pytest.mark.parametrize(
    "change", [{"seed": 1}, {"limits": {"time_s": 1}}, {"limits": {"nodes": 5}}]
)
def test_what_can_change_a_result_changes_the_run_id(change):
    assert not set(ids(experiment())) & set(ids(experiment(**change)))


@pytest.mark.parametrize("change", [{"name": "other"}, {"title": "x"}, {"chunk_size": 100}])
def test_what_cannot_change_a_result_keeps_the_run_id(change):
    assert set(ids(experiment())) == set(ids(experiment(**change)))


def test_another_method_or_label_does_not_touch_the_first():
    relabelled = {"name": "dcreg", "baseline": "dcreg", "label": "new words"}
    methods = [relabelled, {"name": "icp", "baseline": "icp"}]
    assert ids(experiment()) == ids(experiment(methods=methods))


def test_a_selection_is_a_part_of_the_whole_in_chunks_of_its_own():
    whole = expand(experiment())
    part = expand(experiment(), parse_selection(["methods=half", "shapes=fish", "levels=0.01"]))
    assert {run.run_id for run in part.runs()} < {run.run_id for run in whole.runs()}
    assert len(list(part.runs())) == 2
    assert not {chunk.name for chunk in part.chunks} & {chunk.name for chunk in whole.chunks}


def test_a_selection_without_a_match_lists_the_known_values():
    with pytest.raises(ConfigError, match="METHODS=ipc matches nothing"):
        expand(experiment(), parse_selection(["methods=ipc"]))
    with pytest.raises(ConfigError, match="contains no run"):
        expand(experiment(), parse_selection(["methods=bnb", "shapes=pony"]))


def test_an_instance_planned_twice_is_refused():
    entry = {"dataset": "embedded", "shapes": ["fish"], "tests": {"noise": [0.0]}}
    with pytest.raises(ConfigError, match="planned twice"):
        expand(experiment(datasets=[entry, entry]))


@pytest.mark.parametrize("target", ["run", "plan"])
def test_make_passes_the_selection_on(target):
    selection = ["METHODS=icp,cpd", "TESTS=noise", "DATASETS=embedded"]
    words = ["make", "--no-print-directory", "-n", target, "CONFIG=demo", *selection]
    done = subprocess.run(words, cwd=CHECKOUT, capture_output=True, text=True, check=True)
    command = done.stdout.splitlines()[-1]
    assert "--methods icp,cpd --datasets embedded --tests noise" in " ".join(command.split())
    assert ("--dry-run" in command) == (target == "plan")


def test_make_refuses_a_selection_that_evidence_would_ignore():
    words = ["make", "--no-print-directory", "evidence", "METHODS=icp"]
    done = subprocess.run(words, cwd=CHECKOUT, capture_output=True, text=True)
    assert done.returncode == 2
    assert "choose EXPERIMENTS instead" in done.stderr
    assert not done.stdout  # nothing was set up


def test_a_part_has_a_folder_of_its_own():
    def view(*texts: str) -> str:
        return str(expand(experiment(), parse_selection(texts)).view)

    assert view() == "."
    assert view("methods=half,dcreg", "levels=0.01") == "parts/methods-dcreg+half_levels-0.01"
    assert view("methods=dcreg,half", "levels=0.01") == view("methods=half,dcreg", "levels=0.01")


def test_parts_with_long_names_have_different_folders():
    grid = {"dataset": "embedded", "shapes": ["fish"], "tests": {"noise": [0.0]}, "trials": 100}
    many = experiment(datasets=[grid])
    trials = [",".join(map(str, range(start, 99))) for start in (0, 1)]
    names = [expand(many, parse_selection([f"trials={each}"])).view.name for each in trials]
    assert len(set(names)) == 2
    assert max(map(len, names)) <= MAX_NAME


@pytest.mark.parametrize(
    ("method", "limited"), [("icp", "time_limit"), ("dcreg", "time_limit"), ("dcreg", "node_limit")]
)
def test_expected_times_are_medians_of_the_quick_part_with_limited_runs_at_the_limit(
    tmp_path, method, limited
):
    whole = expand(
        load("paper2d_images"), parse_selection([f"methods={method}", "shapes=car"]),
        "paper2d_images",
    )  # fmt: skip
    folder = tmp_path / "paper2d_images"
    (before,) = outlook_of(whole, folder)
    assert (before.seconds, before.known) == (10 * 100.0, False)

    part = expand(load("paper2d_images-quick"), parse_selection([f"methods={method}"]))
    times = {"canny": iter([0.5, 9, 0.5, 0.5, 9, 0.5, 0.5, 0.5]), "marked": iter([4.0] * 4)}
    rows = [
        {
            "run_id": run.run_id, "instance_digest": "", "fingerprint": "",
            "status": limited if run.instance.test == "marked" else "converged",
            "time_solve_s": next(times[run.instance.test]),
        }
        for run in part.runs()
    ]  # fmt: skip
    journal = tmp_path / "paper2d_images-quick" / "runs" / method / "x.journal.jsonl"
    journal.parent.mkdir(parents=True)
    journal.write_text("".join(f"{sealed(row)}\n" for row in rows))
    (after,) = outlook_of(whole, folder)
    assert (after.runs, after.finished, after.known) == (10, 0, True)
    assert after.seconds == 5 * 0.5 + 5 * 100.0


def test_methods_that_cannot_run_here_are_expected_to_take_no_time(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pygcransac", None)
    absent = {"name": "absent", "baseline": "pygcransac", "options": {"front_end": "oracle"}}
    plan = expand(experiment(methods=[absent]), parse_selection(["shapes=pony"]))
    (outlook,) = outlook_of(plan, tmp_path)
    assert (outlook.seconds, outlook.known) == (0.0, True)
