"""Planted changes are found, unchanged re-runs are not."""

from __future__ import annotations

import json
from dataclasses import asdict

import numpy as np
import pandas as pd
import pytest
from record_fixture import N_RUNS, about, table, write_record
from typer.testing import CliRunner

from workflows import recording, verdict_text
from workflows.__main__ import app
from workflows.compare import compare, corrected, judge_records
from workflows.records import SCHEMA_VERSION


def judged(base: pd.DataFrame, head: pd.DataFrame, old: object = None, new: object = None):
    """Return the verdicts on two tables, recorded with these settings of the method."""
    cards = ({"methods": {"dcreg": card}} if card else {} for card in (old, new))
    return [*judge_records("e", *map(recording.Record, (base, head), cards))]


def verdicts(base: pd.DataFrame, head: pd.DataFrame) -> dict[str, str]:
    return {v.metric: v.verdict for v in judged(base, head)}


@pytest.fixture
def base(rng) -> pd.DataFrame:
    return table(rng)


def test_an_unchanged_version_has_no_finding(base):
    assert set(verdicts(base, base.copy()).values()) == {"same"}


def test_a_record_with_an_additional_column_is_read(base, tmp_path):
    folder = tmp_path / "old" / "e"
    folder.mkdir(parents=True)
    base.assign(n_bound_evals=base["n_nodes"]).to_parquet(folder / recording.RUNS)
    about(folder)
    old = recording.read("old", tmp_path)["e"].runs
    assert set(verdicts(old, base).values()) == {"same"}


def test_a_record_without_a_later_metric_is_compared_in_all_others(base, tmp_path):
    folder = tmp_path / "old" / "e"
    folder.mkdir(parents=True)
    base.drop(columns=["gap_integral_boxes", "bound_violation"]).to_parquet(folder / recording.RUNS)
    about(folder)
    old = recording.read("old", tmp_path)["e"].runs
    found = verdicts(old, base)
    assert set(found.values()) == {"same"}
    assert "median gap integral" not in found


def test_a_rerun_differs_in_times_and_limits_only(base, rng):
    head = base.copy()
    head["time_solve_s"] *= rng.uniform(0.9, 1.1, N_RUNS)
    clocked = head["status"] == "time_limit"
    for column in ("n_nodes", "n_assignments", "gap", "rmse", "objective"):
        head.loc[clocked, column] *= 2  # a time limit cuts each execution elsewhere
    assert "worse" not in verdicts(base, head).values()
    assert verdicts(base, head)["n_nodes"] == "same"


def test_one_node_more_in_one_run_is_found(base):
    head = base.copy()
    head.loc[3, "n_nodes"] += 1
    found = verdicts(base, head)
    assert found["n_nodes"] == "worse"
    assert {word for metric, word in found.items() if metric != "n_nodes"} == {"same"}
    assert verdicts(head, base)["n_nodes"] == "better"


def test_equal_totals_do_not_hide_a_change(base):
    head = base.copy()
    head.loc[3, "n_nodes"] += 1
    head.loc[4, "n_nodes"] -= 1
    assert verdicts(base, head)["n_nodes"] == "changed"


def test_worse_quality_everywhere_is_found_and_rounding_is_not(base):
    head = base.assign(rmse=base["rmse"] * 1.01)
    assert verdicts(base, head)["median rmse"] == "worse"
    assert verdicts(head, base)["median rmse"] == "better"
    head = base.assign(rmse=base["rmse"] * (1 + 1e-9))
    assert verdicts(base, head)["median rmse"] == "same"


def test_quality_that_goes_both_ways_is_unclear(base):
    head = base.copy()
    head["objective"] *= np.where(np.arange(N_RUNS) % 2, 1.1, 0.9)
    assert verdicts(base, head)["median objective"] == "unclear"


def test_a_pose_that_is_gone_counts_as_worst(base):
    head = base.copy()
    head.loc[:9, ["rmse", "objective"]] = np.nan
    head.loc[:9, "status"] = "failed"
    found = verdicts(base, head)
    assert found["without pose"] == "worse"
    assert found["median rmse"] == "worse"


@pytest.mark.parametrize("status", ["failed", "time_limit", "memory_limit", "unsupported"])
def test_one_lost_pose_is_a_regression_whatever_ended_the_run(base, status):
    head = base.copy()
    lost = {"status": status, "rmse": np.nan, "objective": np.nan, "n_nodes": np.nan}
    head.loc[0, list(lost)] = list(lost.values())
    found = verdicts(base, head)
    assert found["without pose"] == "worse"
    assert found["n_nodes"] == "same"  # less work on the way to no pose is not better
    assert verdicts(head, base)["without pose"] == "better"


def test_success_lost_to_the_time_limit_is_a_regression(base):
    """12 of 12 in one version, 6 of 12 in the next, the other 6 at the time limit."""
    base = base.iloc[:12].assign(status="optimal")
    head = base.copy()
    head.loc[:5, ["status", "success"]] = ["time_limit", False]
    (found,) = [v for v in judged(base, head) if v.metric == "success"]
    assert (found.base, found.head, found.verdict) == (12, 6, "worse")


def test_a_slower_machine_is_not_a_regression(base):
    """Runs that another machine does not finish in the same time say nothing about the version."""
    head = base.assign(machine_id="other")
    head.loc[:9, ["status", "success"]] = ["time_limit", False]
    head.loc[0, ["rmse", "objective"]] = np.nan
    assert "worse" not in verdicts(base, head).values()
    (found,) = [v for v in judged(base, head) if v.metric == "success"]
    assert found.detail == "12 runs at a limit excluded, from two machines"
    for status, word in (("node_limit", "unclear"), ("converged", "worse")):
        head.loc[10, "status"] = status  # rounding may cost a box, but not more
        assert verdicts(base, head)["certified"] == word
    assert verdicts(base, head.assign(status="time_limit"))["success"] == "not compared"


def test_a_method_with_other_settings_is_not_compared(base):
    old = {"options": {}, "n_inliers_ratio": 1.0, "limits": {"time_s": 60.0}}
    head = base.assign(success=False)
    later = {**old, "limits": {"time_s": 60.0, "nodes": None}}
    assert any(v.verdict == "worse" for v in judged(base, head, old, later))
    for name, value in (
        ("options", {"a": 1}),
        ("n_inliers_ratio", 0.5),
        ("limits", {"time_s": 9.0}),
    ):
        (found,) = judged(base, head, old, {**old, name: value})
        assert found.verdict == "not compared"
        assert found.detail.startswith(f"{name} differ: ")
        shown = verdict_text.outcome(pd.DataFrame([asdict(found)]))
        assert shown == f"no regression, 1 not compared; left out: {N_RUNS} runs of dcreg"


def test_a_method_that_is_not_installed_on_one_side_is_not_compared(base):
    lost = {"status": "unavailable", "rmse": np.nan, "success": False}
    head = base.copy()
    head.loc[0, list(lost)] = list(lost.values())
    for count, new, word, outcome in (
        (N_RUNS, base.assign(**lost), "not compared", "no regression, 1 not compared"),
        (1, head, "worse", "1 regression"),  # the method is installed
    ):
        (found,) = [v for v in judged(base, new) if v.verdict != "same"]
        assert (found.metric, found.verdict, found.skipped) == ("runs", word, count)
        assert found.detail == f"{count} runs are unavailable in the head"
        shown = verdict_text.outcome(pd.DataFrame([asdict(found)]))
        assert shown == f"{outcome}; left out: {count} runs of dcreg"
        (found,) = [v for v in judged(new, base) if v.verdict != "same"]
        assert (found.skipped, found.detail) == (0, f"{count} runs are unavailable in the base")


def test_a_bound_above_the_truth_is_a_regression(base):
    head = base.copy()
    head.loc[0, "bound_violation"] = 1e-3
    assert verdicts(base, head)["wrong bounds"] == "worse"


@pytest.mark.parametrize(
    ("status", "slower", "expected"),
    [("node_limit", 1.0, "worse"), ("time_limit", 1.1, "unclear"), ("time_limit", 3.0, "unclear")],
)
def test_a_lost_certificate_is_a_regression_unless_the_time_limit_may_explain_it(
    base, status, slower, expected
):
    head = base.copy()
    head.loc[0, "status"] = status
    head.loc[0, "time_solve_s"] *= slower
    assert verdicts(base, head)["certified"] == expected


def test_times_compare_within_one_machine_and_never_fail(base):
    head = base.assign(time_solve_s=base["time_solve_s"] * 3)
    assert verdicts(base, head)["time_solve_s"] == "slower"
    assert "worse" not in verdicts(base, head).values()
    shown = verdict_text.outcome(pd.DataFrame([asdict(found) for found in judged(base, head)]))
    assert shown == "no regression, 1 slower"
    elsewhere = head.assign(machine_id="other")
    assert verdicts(base, elsewhere)["time_solve_s"] == "not compared"


def test_a_busy_machine_is_not_a_slower_version(base, rng):
    head = base.assign(time_solve_s=base["time_solve_s"] * rng.uniform(1.1, 1.7, N_RUNS))
    assert verdicts(base, head)["time_solve_s"] == "unclear"


@pytest.mark.parametrize(
    ("factor", "version", "word"),
    [
        (3.0, 1, "unclear"),  # an unchanged method takes longer too
        (1.0, 1, "slower"),
        (1 / 3, 1, "slower"),  # an unchanged method that is faster explains nothing
        (3.0, 2, "slower"),  # the other method may be slower for its own reasons
    ],
)
def test_a_time_is_unclear_if_that_of_an_unchanged_method_differs(base, factor, version, word):
    other = base.assign(method="icp")
    head = base.assign(time_solve_s=base["time_solve_s"] * 3)
    head = pd.concat([head, other.assign(time_solve_s=other["time_solve_s"] * factor)])
    cards = [
        {"dcreg": {"baseline": "dcreg", "version": 4 + late},
         "icp": {"baseline": "icp", "version": version if late else 1}}
        for late in (0, 1)
    ]  # fmt: skip
    records = [
        recording.Record(runs, {"methods": methods})
        for runs, methods in zip((pd.concat([base, other]), head), cards, strict=True)
    ]
    found = {(v.method, v.metric): v for v in judge_records("e", *records)}
    assert found["dcreg", "time_solve_s"].verdict == word
    assert ("icp, which did not change, is slower" in found["dcreg", "time_solve_s"].detail) == (
        word == "unclear"
    )


def test_integrals_over_boxes_are_judged_as_quality(base):
    head = base.assign(gap_integral_boxes=base["gap_integral_boxes"] * 1.1)
    assert verdicts(base, head)["median gap integral"] == "worse"


def test_other_content_of_an_instance_is_no_evidence_of_any_metric(base):
    head = base.assign(instance_digest="new", rmse=99.0)
    assert verdicts(base, head) == {"runs": "worse"}


def test_tests_of_several_metrics_are_corrected(base):
    """Six losses without a win are significant alone (p = 0.03), and not as one of two such tests."""
    head = base.assign(machine_id="other")
    head.loc[:5, "success"] = False
    found = judged(base, head)
    assert corrected(found) == found
    head.loc[:5, "objective"] *= 1.1
    words = {v.metric: (v.verdict, v.detail) for v in corrected(judged(base, head))}
    assert words["success"][0] == words["median objective"][0] == "unclear"
    assert words["success"][1].endswith("p of at most 0.025 needed, as one of 2 tests")
    head.loc[:6, "success"] = False  # 7 of 7: p = 0.016; the other one is then tested alone
    words = {v.metric: v.verdict for v in corrected(judged(base, head))}
    assert words["success"] == words["median objective"] == "worse"


def test_tests_that_can_find_nothing_cost_the_others_nothing(base):
    """A method loses everything while others differ in one run."""
    old = pd.concat([base.assign(method=f"m{number}") for number in range(9)], ignore_index=True)
    head = old.assign(machine_id="other")
    first = (old["method"] == "m0") & (old["trial"] < 6)
    head.loc[first, "success"] = False
    head.loc[(old["method"] != "m0") & (old["trial"] == 0), "rmse"] *= 1.001
    found = {(v.method, v.metric): v.verdict for v in corrected(judged(old, head))}
    assert found["m0", "success"] == "worse"
    assert found["m1", "median rmse"] == "unclear"


@pytest.mark.parametrize("kept", [1, 19])
def test_missing_runs_are_a_regression(base, kept):
    (found,) = [v for v in judged(base, base.iloc[:kept]) if v.metric == "runs"]
    assert (found.verdict, found.detail) == ("worse", f"{N_RUNS - kept} runs are missing")
    assert "worse" not in verdicts(base.iloc[:kept], base).values()


@pytest.mark.parametrize(
    ("changed", "word"), [(3, "not compared"), (10, "not compared"), (11, "worse")]
)
def test_runs_with_another_input_are_a_regression_if_they_are_most(base, changed, word):
    head = base.copy()
    head.loc[: changed - 1, "instance_digest"] = "new"
    (found,) = [v for v in judged(base, head) if v.verdict != "same"]
    assert (found.metric, found.verdict, found.skipped) == ("runs", word, changed)
    assert found.detail == f"{changed} runs have another input"


def test_an_experiment_that_is_missing_is_a_regression(base, tmp_path):
    for version, names in (("v1", ("kept", "gone")), ("v2", ("kept",))):
        for name in names:
            write_record(tmp_path / version / name, base)
    found = compare("v1", "v2", tmp_path)
    assert found.loc[found["experiment"] == "gone", "verdict"].tolist() == ["worse"]
    assert set(found.loc[found["experiment"] == "kept", "verdict"]) == {"same"}


def test_more_work_in_most_runs_is_worse_whatever_the_sum(base):
    head = base.assign(n_nodes=base["n_nodes"] + 1)
    head.loc[5, "n_nodes"] = 0
    assert head["n_nodes"].sum() < base["n_nodes"].sum()
    (found,) = [v for v in judged(base, head) if v.verdict != "same"]
    assert (found.metric, found.verdict) == ("n_nodes", "worse")
    assert ": 17 with more work, 1 with less; 2 runs at a " in found.detail


@pytest.mark.parametrize(
    ("name", "metric"),
    [("n_assignments", "n_assignments"), ("gap_integral_boxes", "median gap integral")],
)
def test_a_number_that_is_no_longer_stated_is_a_regression(base, name, metric):
    assert verdicts(base, base.assign(**{name: np.nan}))[metric] == "worse"
    assert "worse" not in verdicts(base.assign(**{name: np.nan}), base).values()


@pytest.mark.parametrize(
    ("name", "metric"),
    [
        ("gap", "with gap"),
        ("n_nodes", "n_nodes"),
        ("gap_integral_boxes", "median gap integral"),
    ],
)
@pytest.mark.parametrize("status", ["optimal", "node_limit"])
def test_a_number_that_one_run_no_longer_states_is_a_regression(base, name, metric, status):
    base = base.assign(status=status)
    head = base.copy()
    head[name] = head[name].where(head["trial"] > 0)
    (found,) = [v for v in judged(base, head) if v.verdict != "same"]
    assert (found.metric, found.verdict, len(found.lost)) == (metric, "worse", 1)
    assert "worse" not in verdicts(head, base).values()
    head.loc[0, "status"] = "failed"  # without a result there is nothing to state
    assert verdicts(base, head)[metric] == "same"


def test_a_lost_success_is_a_regression_unless_chance_or_time_may_explain_it(base):
    head = base.copy()
    head.loc[0, "success"] = False
    assert verdicts(base, head)["success"] == "worse"
    assert verdicts(base, head.assign(machine_id="other"))["success"] == "unclear"
    old = base.copy()
    old.loc[0, "status"] = "time_limit"
    assert verdicts(old, head)["success"] == "unclear"
    for cards in (({"deterministic": False}, {}), ({}, {"deterministic": False})):
        words = {v.metric: v.verdict for v in judged(base, head, *cards)}
        assert words["success"] == "unclear"
    won = base.copy()
    won.loc[1:12, "success"] = False
    assert verdicts(won, head)["success"] == "worse"  # whatever was won


def test_what_a_rule_decides_needs_no_test(base):
    head = base.copy()
    head.loc[0, "bound_violation"] = 1e-3
    head.loc[:5, "objective"] *= 1.1
    words = {v.metric: v.verdict for v in corrected(judged(base, head))}
    assert words["wrong bounds"] == words["median objective"] == "worse"


def test_a_method_without_a_run_in_the_head_is_a_regression(base):
    both = pd.concat([base, base.assign(method="gone")])
    (found,) = [v for v in judged(both, base) if v.method == "gone"]
    assert (found.verdict, found.detail) == ("worse", "the method is missing")
    assert all(v.method != "gone" or v.verdict == "not compared" for v in judged(base, both))


@pytest.fixture
def history(base, tmp_path):
    versions = {
        "v1": base, "same": base, "old": base, "broken": pd.DataFrame({"a": [1], "b": [2]}),
        "worse": base.assign(n_nodes=base["n_nodes"] + 1),
        "elsewhere": base.assign(instance_digest="new"), "fewer": base.iloc[1:],
        "other": base.assign(method="new"),
    }  # fmt: skip
    for version, runs in versions.items():
        folder = tmp_path / version / "demo"
        folder.mkdir(parents=True)
        runs.to_parquet(folder / recording.RUNS)
        about(folder, 3 if version == "old" else SCHEMA_VERSION)
    return tmp_path


@pytest.mark.parametrize(
    ("head", "code", "says"),
    [
        ("same", 0, "no regression"),
        ("worse", 1, "1 regression"),
        ("", 2, "HEAD not given; use `make compare BASE=… HEAD=…`"),
        ("none", 2, "known: broken, elsewhere, fewer, old, other, same, v1, worse"),
        ("broken", 2, "column 'run_id' is missing"),
        ("elsewhere", 2, "share no instance"),
        ("fewer", 1, "1 regression"),
        ("other", 1, "1 regression"),
        ("old", 2, "run and record the experiment again at commit abc123"),
    ],
)
def test_exit_codes_for_ci(history, capfd, head, code, says):
    result = CliRunner().invoke(app, ["compare", "v1", head, "--history", str(history)])
    assert result.exit_code == code
    assert says in result.output + capfd.readouterr().err


def test_lost_and_won_instances_are_named_everywhere(history, base, tmp_path, capfd):
    head = base.copy()
    head.loc[:7, "success"] = False
    (tmp_path / "lost" / "demo").mkdir(parents=True)
    head.to_parquet(tmp_path / "lost" / "demo" / recording.RUNS)
    about(tmp_path / "lost" / "demo")
    files = {"--json": tmp_path / "v.json", "--text": tmp_path / "v.md"}
    options = [str(part) for option in files.items() for part in option]
    arguments = ["compare", "v1", "lost", "--history", str(history), *options]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 1
    names = [f"embedded fish noise 0.1 {trial}" for trial in range(8)]
    shown = result.output + capfd.readouterr().out
    assert ", ".join([*names[:5], "and 3 more"]) in " ".join(shown.replace("│", "").split())
    found = json.loads(files["--json"].read_text())
    (success,) = [row for row in found["verdicts"] if row["metric"] == "success"]
    assert found["outcome"] == "regression"
    assert (success["lost"], success["won"], success["verdict"]) == (names, [], "worse")
    assert (success["unit"], success["better"]) == ("runs", "higher")
    assert success["p_value"] is None  # a rule decides, not the sign test
    text = files["--text"].read_text()
    assert text.startswith("### ❌ v1 → lost: 1 regression\n")
    assert f"- lost: {', '.join(names)}" in text


@pytest.mark.parametrize(
    ("factor", "status", "code"),
    [(1.0, "optimal", 0), (1.3, "optimal", 1), (1.0, "node_limit", 1)],
)
def test_solves_in_turn_decide_the_exit_code(history, tmp_path, rng, factor, status, code):
    rows = [
        {
            "group": "rigid3d", "problem": "p", "repetition": repetition, "cpu_s_base": 1.0,
            "cpu_s_head": factor * rng.uniform(0.98, 1.02), "n_nodes_base": 5, "n_nodes_head": 5,
            "n_assignments_base": 7, "n_assignments_head": 7, "status_base": "optimal",
            "status_head": status,
        }
        for repetition in range(10)
    ]  # fmt: skip
    pd.DataFrame(rows).to_csv(tmp_path / "times.csv", index=False)
    times = ["--times", str(tmp_path / "times.csv")]
    arguments = ["compare", "v1", "same", "--history", str(history), *times]
    assert CliRunner().invoke(app, arguments).exit_code == code


@pytest.mark.parametrize("option", ["--times", "--text"])
def test_an_option_that_exact_would_ignore_is_refused(option, tmp_path, capfd):
    arguments = ["compare", "a", "b", "--exact", option, str(tmp_path / "none")]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 2
    assert f"error: {option}: needs verdicts" in result.output + capfd.readouterr().err


def test_an_empty_history_names_the_command_to_record(tmp_path):
    with pytest.raises(recording.RecordError, match="make record VERSION=v1"):
        compare("v1", "v2", tmp_path)
