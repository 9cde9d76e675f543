"""Two executions of a config: every difference is found and gets a reason."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest
import report_fixture
from typer.testing import CliRunner

from workflows.__main__ import app
from workflows.compare import CompareError
from workflows.exact import TIMES, differences, read


@pytest.fixture
def folder(tmp_path):
    report_fixture.write_tables(tmp_path / "a" / "tables")
    return tmp_path


@pytest.fixture
def runs(folder) -> pd.DataFrame:
    return read(folder / "a").assign(is_timed=False)


def reasons(one, other) -> dict[str, set[str]]:
    cells = differences(one, other).cells
    return {reason: set(part["run_id"]) for reason, part in cells.groupby("reason")}


def changed(runs, row, **values):
    other = runs.copy()
    for column, value in values.items():
        other.iloc[row, other.columns.get_loc(column)] = value
    return other


def test_times_may_differ_and_missing_numbers_are_equal(runs):
    values = {"machine_id": "elsewhere", "is_timed": True, "is_random": True}
    other = runs.assign(**{column: values.get(column, 7.0) for column in TIMES})
    found = differences(runs, other)
    assert runs.isna().any(axis=None)
    assert found.cells.empty
    assert not found.unexplained
    assert found.n_runs == len(runs)


def test_times_among_the_extra_facts_may_differ(folder):
    path = folder / "a" / "tables" / "runs.parquet"
    table = pd.read_parquet(path)
    found = []
    for time_s, objective in ((1.0, 5.0), (2.0, 5.0), (2.0, 6.0)):
        extra = json.dumps({"time_s_search": time_s, "objective_searched": objective})
        table.assign(extra=extra).to_parquet(path)
        found.append(read(folder / "a"))
    assert differences(*found[:2]).cells.empty
    assert set(differences(*found[1:]).cells["column"]) == {"extra"}


def test_the_last_digit_of_one_run_is_found(runs):
    other = changed(runs, 3, objective=runs["objective"].iloc[3] * (1 + 1e-15))
    found = differences(runs, other)
    assert list(found.cells["column"]) == ["objective"]
    assert reasons(runs, other) == {"unexplained": {runs.index[3]}}
    assert found.unexplained


def test_a_run_at_its_limit_explains_itself_and_what_is_compared_with_it(runs):
    late = changed(runs, 3, is_timed=True, objective=0.5)
    same_instance = np.flatnonzero(runs["instance_id"] == runs["instance_id"].iloc[3])
    other = next(row for row in same_instance if row != 3)
    late = changed(late, other, objective_best=0.5)
    assert reasons(runs, late) == {"limit": {runs.index[3]}, "others": {runs.index[other]}}
    assert not differences(runs, late).unexplained
    # Without a run that differs by itself nothing explains a different best value.
    unexplained = reasons(runs, changed(runs, other, objective_best=0.5))
    assert unexplained == {"unexplained": {runs.index[other]}}


def test_changed_code_is_the_first_reason_and_no_excuse(runs):
    other = changed(runs, 3, fingerprint="another", is_timed=True, objective=0.5)
    assert reasons(runs, other) == {"code": {runs.index[3]}}
    assert differences(runs, other).unexplained


def test_unmatched_runs_and_another_order_are_found(runs):
    fewer = runs[runs["method"] != runs["method"].iloc[0]]
    found = differences(runs, fewer)
    assert found.unmatched == [runs["method"].iloc[0]]
    assert found.unexplained
    assert not differences(runs, runs.iloc[::-1]).same_order
    with pytest.raises(CompareError, match="no run in common; run the same config twice"):
        differences(runs[:1], runs[1:2])


def test_a_run_that_took_its_time_limit_counts_as_limited_whatever_its_status(folder):
    path = folder / "a" / "tables" / "provenance.json"
    known = json.loads(path.read_text())
    runs = pd.read_parquet(folder / "a" / "tables" / "runs.parquet")
    limit = {method: {"limits": {"time_s": 0.5}} for method in runs["method"].unique()}
    path.write_text(json.dumps({**known, "methods": limit}))
    assert (read(folder / "a")["is_timed"].to_numpy() == expected(runs)).all()
    assert 0 < expected(runs).sum() < len(runs)


def test_a_random_method_is_recognised_by_its_card(folder, runs):
    path = folder / "a" / "tables" / "provenance.json"
    known = json.loads(path.read_text())
    method, other = runs["method"].unique()[:2]
    known["methods"][method]["deterministic"] = False
    known["methods"][other]["deterministic"] = True
    path.write_text(json.dumps(known))
    marked = read(folder / "a").assign(is_timed=False)
    of = [list(marked["method"]).index(name) for name in (method, other)]
    differ = changed(changed(marked, of[0], objective=0.5), of[1], objective=0.5)
    assert reasons(marked, differ) == {
        "random": {marked.index[of[0]]}, "unexplained": {marked.index[of[1]]},
    }  # fmt: skip


def expected(runs) -> np.ndarray:
    late = runs["time_solve_s"].fillna(0) >= 0.5
    return (late | runs["status"].isin(["time_limit", "memory_limit"])).to_numpy()


def test_command_prints_methods_columns_and_reasons(folder):
    report_fixture.write_tables(folder / "b" / "tables")
    path = folder / "b" / "tables" / "runs.parquet"

    def invoke():
        return CliRunner().invoke(app, ["compare", "--exact", str(folder / "a"), str(folder / "b")])

    answer = invoke()
    assert (answer.exit_code, "0 differ" in answer.output) == (0, True), answer.output
    table = pd.read_parquet(path)
    finished = table.index[table["status"] == "optimal"][0]
    table.loc[finished, "n_nodes"] += 1
    table.to_parquet(path)
    answer = invoke()
    assert answer.exit_code == 1
    assert "1 differ, times aside: 1 unexplained" in answer.output
    assert all(t in answer.output for t in ("n_nodes", str(table.loc[finished, "method"])))
    missing = CliRunner().invoke(app, ["compare", "--exact", str(folder), str(folder / "b")])
    assert (missing.exit_code, "no such table" in missing.output) == (2, True)
