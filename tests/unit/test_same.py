"""Two executions of a config: what differs is found, and told apart by whose fault it is."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest
import report_fixture
from typer.testing import CliRunner

from workflows.__main__ import app
from workflows.compare import CompareError
from workflows.same import TIMES, differences, read


@pytest.fixture
def folder(tmp_path):
    report_fixture.write_tables(tmp_path / "a" / "tables")
    return tmp_path


@pytest.fixture
def runs(folder) -> pd.DataFrame:
    return read(folder / "a").assign(clocked=False)


def kinds(one, other) -> dict[str, set[str]]:
    cells = differences(one, other).cells
    return {kind: set(part["run_id"]) for kind, part in cells.groupby("kind")}


def changed(runs, row, **values):
    other = runs.copy()
    for column, value in values.items():
        other.iloc[row, other.columns.get_loc(column)] = value
    return other


def test_times_may_differ_and_missing_numbers_are_equal(runs):
    other = runs.copy()
    for column in TIMES:
        other[column] = {"machine_id": "elsewhere", "clocked": True, "random": True}.get(
            column, 7.0
        )
    found = differences(runs, other)
    assert runs.isna().any(axis=None)
    assert found.cells.empty
    assert not found.unexplained
    assert found.n_runs == len(runs)


def test_the_last_digit_of_one_run_is_found(runs):
    other = changed(runs, 3, objective=runs["objective"].iloc[3] * (1 + 1e-15))
    found = differences(runs, other)
    assert list(found.cells["column"]) == ["objective"]
    assert kinds(runs, other) == {"unexplained": {runs.index[3]}}
    assert found.unexplained


def test_what_the_clock_ended_is_told_apart_and_so_is_what_is_measured_by_it(runs):
    late = changed(runs, 3, clocked=True, objective=0.5)
    instance = runs["instance_id"].iloc[3]
    beside = next(i for i in range(len(runs)) if runs["instance_id"].iloc[i] == instance and i != 3)
    late = changed(late, beside, objective_best=0.5)
    assert kinds(runs, late) == {"clock": {runs.index[3]}, "others": {runs.index[beside]}}
    assert not differences(runs, late).unexplained
    # Without a run that differs by itself nothing explains another best.
    assert kinds(runs, changed(runs, beside, objective_best=0.5)) == {
        "unexplained": {runs.index[beside]}
    }


def test_other_code_is_told_first_and_is_no_excuse(runs):
    other = changed(runs, 3, fingerprint="another", clocked=True, objective=0.5)
    assert kinds(runs, other) == {"code": {runs.index[3]}}
    assert differences(runs, other).unexplained


def test_runs_of_one_alone_and_another_order_are_found(runs):
    fewer = runs[runs["method"] != runs["method"].iloc[0]]
    found = differences(runs, fewer)
    assert found.alone == [runs["method"].iloc[0]]
    assert found.unexplained
    assert not differences(runs, runs.iloc[::-1]).same_order
    with pytest.raises(CompareError, match="no run in common; run one config twice"):
        differences(runs[:1], runs[1:2])


def test_a_run_is_ended_by_the_clock_whatever_it_says_of_itself(folder):
    path = folder / "a" / "tables" / "provenance.json"
    known = json.loads(path.read_text())
    runs = pd.read_parquet(folder / "a" / "tables" / "runs.parquet")
    limit = {method: {"limits": {"time_s": 0.5}} for method in runs["method"].unique()}
    path.write_text(json.dumps({**known, "methods": limit}))
    assert (read(folder / "a")["clocked"].to_numpy() == expected(runs)).all()
    assert 0 < expected(runs).sum() < len(runs)


def test_a_method_that_does_not_repeat_itself_says_so_on_its_card(folder, runs):
    path = folder / "a" / "tables" / "provenance.json"
    known = json.loads(path.read_text())
    method, other = runs["method"].unique()[:2]
    known["methods"][method]["deterministic"] = False
    known["methods"][other]["deterministic"] = True
    path.write_text(json.dumps(known))
    told = read(folder / "a").assign(clocked=False)
    of = [list(told["method"]).index(name) for name in (method, other)]
    differ = changed(changed(told, of[0], objective=0.5), of[1], objective=0.5)
    assert kinds(told, differ) == {
        "random": {told.index[of[0]]}, "unexplained": {told.index[of[1]]},
    }  # fmt: skip


def expected(runs) -> np.ndarray:
    late = runs["time_solve_s"].fillna(0) >= 0.5
    return (late | runs["status"].isin(["time_limit", "memory_limit"])).to_numpy()


def test_command_prints_who_differs_in_what(folder):
    report_fixture.write_tables(folder / "b" / "tables")
    path = folder / "b" / "tables" / "runs.parquet"
    invoke = lambda: CliRunner().invoke(app, ["same", str(folder / "a"), str(folder / "b")])  # noqa: E731
    answer = invoke()
    assert (answer.exit_code, "0 differ" in answer.output) == (0, True), answer.output
    table = pd.read_parquet(path)
    finished = table.index[table["status"] == "optimal"][0]
    table.loc[finished, "n_nodes"] += 1
    table.to_parquet(path)
    answer = invoke()
    assert answer.exit_code == 1
    assert "1 differ, times apart: 1 for no reason known" in answer.output
    assert all(t in answer.output for t in ("n_nodes", str(table.loc[finished, "method"])))
    missing = CliRunner().invoke(app, ["same", str(folder), str(folder / "b")])
    assert (missing.exit_code, "no such table" in missing.output) == (2, True)
