"""Tables of many synthetic runs equal those that pandas makes group by group."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import typer
from pandas.testing import assert_frame_equal
from scipy.stats import bootstrap

from reports import csv_tables, measured
from reports.figures import bounds, levels
from reports.page import pack_json
from reports.tables import Tables, thin_trace
from reports.theme import method_styles
from tests import reference_tables
from workflows import records
from workflows.config import load
from workflows.integrity import SUMS
from workflows.outcomes import OUTCOMES
from workflows.stages import aggregate as stage
from workflows.stages.aggregate import aggregate, join_runs
from workflows.stages.plan import Plan, expand
from workflows.studies import million, synthetic

RULE = Path(__file__).parents[2] / "workflows" / "rules" / "aggregate.smk"
EVENTS = 6  # mean length of a history; the short ones make the test quick


@pytest.fixture(scope="module")
def plan(tmp_path_factory) -> Plan:
    out = tmp_path_factory.mktemp("synthetic")
    config, _ = synthetic.write(out, n_trials=1, events=EVENTS)
    return expand(load(str(config)), None, str(config))


@pytest.fixture(scope="module")
def folder(plan) -> Path:
    place = Path(plan.config).parent / "results" / synthetic.NAME
    aggregate(plan, place)
    return place


@pytest.fixture(scope="module")
def tables(folder) -> Tables:
    return Tables.load(folder / "tables")


def test_synthetic_runs_are_as_varied_as_real_ones(tables):
    runs = tables.runs
    assert len(runs) == synthetic.RUNS_PER_TRIAL == runs["run_id"].nunique()
    assert len(tables.methods) == 100
    assert set(runs["outcome"]) == set(OUTCOMES) - {"not_needed"}
    assert runs[["model", "test"]].drop_duplicates().shape == (10, 2)
    assert 0.1 < runs["upper_bound"].notna().mean() < 0.4
    assert 0.3 < runs["success"].mean() < 0.9


def test_joined_tables_equal_those_of_pandas(plan, folder):
    runs = reference_tables.join_runs(plan, folder)
    assert_frame_equal(pd.read_parquet(folder / "tables" / "runs.parquet"), runs)
    traces = reference_tables.join_traces(plan, folder)
    assert_frame_equal(pd.read_parquet(folder / "tables" / "traces.parquet"), traces)
    assert_frame_equal(pd.read_csv(folder / "tables" / "traces.csv"), traces)
    stored = pd.read_csv(folder / "tables" / "runs.csv", keep_default_na=False, na_values={})
    assert list(stored) == list(records.runs_columns())
    assert (stored["T_target_source"] == runs["T_target_source"]).all()


def test_optima_of_earlier_files_without_a_lower_bound_count_as_converged(plan, folder, tmp_path):
    copied = shutil.copytree(folder, tmp_path / "results")
    method, chunk = next(each for each in plan.jobs() if each[0].baseline == "dcreg_paper")
    path = copied / "runs" / method.name / f"{chunk.name}.parquet"
    raw = records.read(path, records.RAW)
    optimal = raw.index[raw["status"] == "optimal"]
    assert len(optimal) > 1
    raw.loc[optimal[0], ["lower_bound", "bound_ratio"]] = 0.0
    records.write(raw, path)
    found = join_runs(plan, copied).collect().to_pandas().set_index("run_id")
    of_raw = found.loc[raw.loc[optimal, "run_id"]]
    assert list(of_raw["status"]) == ["converged"] + ["optimal"] * (len(optimal) - 1)
    assert set(of_raw["outcome"]) == {"finished"}


@pytest.mark.parametrize("column", ["rmse", "scale_error", "time_solve_s"])
def test_statistics_of_levels_equal_those_of_numpy(tables, column):
    runs = levels.prepare(tables, "rigid3d")
    runs = runs[runs["test"].isin(["noise", "mixed_outliers"])]
    minimum = -np.inf if column == "time_solve_s" else levels.MIN_ERROR
    expected = reference_tables.level_statistics(runs, column, minimum)
    found = levels.statistics(runs, column)
    assert len(found) == len(expected) > 500
    for row in found:
        known = expected[row["test"], row["row"], row["method"], row["level"]]
        for name, value in known.items():
            assert row[name] == (value if isinstance(value, str | int) else pytest.approx(value))


def test_chosen_histories_are_those_of_all_histories_thinned(tables):
    lengths = bounds.lengths(tables.scan_traces())
    expected: dict[str, int] = {}
    for (run_id, _), part in tables.traces.groupby(["run_id", "stage"]):
        expected[run_id] = expected.get(run_id, 0) + len(thin_trace(part))
    assert lengths.to_dict() == expected
    figure = bounds.build(tables, method_styles(tables))
    assert 0 < len(figure.payload["instances"]) <= figure.payload["total"]
    runs = [run for instance in figure.payload["instances"] for run in instance["runs"]]
    drawn = [len(stage["time"]) for run in runs for stage in run["stages"].values()]
    assert sum(drawn) <= bounds.MAX_EVENTS


def test_ends_of_stages_equal_those_of_pandas(tables):
    found = measured.Measured.of_tables(tables)
    attempted = tables.traces[tables.traces["run_id"].isin(found.runs["run_id"])]
    ends = ["n_nodes", "n_assignments", "lower_bound", "upper_bound"]
    expected = attempted.groupby(["run_id", "stage"], sort=False)[ends].last().reset_index()
    assert_frame_equal(found.stages, expected)


@pytest.mark.parametrize("n", [5, 200])
def test_intervals_are_those_of_a_bootstrap(rng, n):
    one, other = (pd.Series(rng.random(n)) for _ in range(2))
    expected = bootstrap(
        (one, other), lambda a, b, axis: a.mean(axis=axis) / b.mean(axis=axis), paired=True,
        n_resamples=measured.DRAWS, method="percentile", confidence_level=measured.COVERAGE,
        rng=np.random.default_rng(measured.SEED),
    ).confidence_interval  # fmt: skip
    found = measured.estimate(np.divide, one, other)
    assert found == pytest.approx((one.mean() / other.mean(), expected.low, expected.high))


def test_every_table_of_the_report_is_written(tables, folder, tmp_path):
    written = {
        path.stem: pd.read_csv(path) for path in csv_tables.write(folder / "tables", tmp_path)
    }
    assert {"outcome", "accounting", "tests", "levels", "claims", "comparisons"} < set(written)
    assert {"failures", "attribution", "attribution-tests", "stages", "noise-bounds"} < set(written)
    runs = tables.runs
    assert written["outcome"]["runs"].sum() == runs["outcome"].isin(OUTCOMES[:3]).sum()
    assert written["accounting"]["planned"].sum() == len(runs)
    assert written["tests"]["planned"].sum() == len(runs)
    assert written["failures"]["count"].sum() == (runs["outcome"] != "finished").sum()
    assert len(written["failures"]) < 5 * len(tables.methods)  # not one for each number of boxes
    assert len(written["noise-bounds"]) == 2 * 25
    assert len(written["claims"]) > 5
    assert written["comparisons"]["runs"].min() > 0


def test_a_table_of_many_runs_is_next_to_the_page(tables, monkeypatch):
    from reports.page import Page
    from reports.sections import downloads

    monkeypatch.setattr(downloads, "MAX_RUNS", len(tables.runs) - 1)
    monkeypatch.setattr(downloads, "MAX_EVENTS", tables.count_events() - 1)
    page = Page(tables, {}, Path())
    left_out = downloads.context(page)["left_out"]
    assert left_out == [
        ("tables/runs.parquet", len(tables.runs)),
        ("tables/traces.parquet", tables.count_events()),
    ]
    assert not {"runs.csv", "traces.csv"} & set(page.downloads)


def test_a_scatter_draws_a_part_of_many_runs(tables, monkeypatch):
    from reports.figures import attribution

    monkeypatch.setattr(attribution, "MAX_POINTS", 1000)
    figure = attribution.build(tables.runs, method_styles(tables))
    drawn = [len(trace["x"]) for trace in figure.payload["views"][""]["data"]]
    assert 500 < sum(drawn) <= 1000
    assert len(pack_json(figure.payload)) < 200_000


def test_runs_of_one_machine_have_times_that_are_compared(tables):
    runs = tables.runs.assign(machine_id=["a", "a", "b"] * (len(tables.runs) // 3) + ["b"])
    mixed = levels.prepare(Tables(tables.directory, runs, *[None] * 3), "rigid3d")
    known = set(mixed.loc[mixed["time_solve_s"].notna(), "run_id"])
    assert known
    assert known <= set(runs.loc[runs["machine_id"] == "a", "run_id"])
    assert mixed["rmse"].notna().sum() > len(known)


def test_all_files_that_the_rule_promises_exist_without_copies_as_csv(plan, folder, monkeypatch):
    promised = re.findall(r"tables/([\w.]+)", RULE.read_text())
    assert len(promised) == 6
    assert [name for name in promised if name.endswith("csv")] == ["accounting.csv"]
    sums = (folder / "tables" / SUMS).read_text().splitlines()
    assert {*promised, "runs.csv", "traces.csv"} == {line.partition("  ")[2] for line in sums}
    kept = {path.name: path.read_bytes() for path in (folder / "tables").iterdir()}
    monkeypatch.setattr(stage, "MOST_CSV_ROWS", 0)
    aggregate(plan, folder)
    try:
        assert all((folder / "tables" / name).is_file() for name in promised)
        assert not (folder / "tables" / "runs.csv").exists()
    finally:
        for name, content in kept.items():
            (folder / "tables" / name).write_bytes(content)


def test_missing_and_double_results_are_refused(plan, folder, tmp_path):
    for name in ("plan", "runs"):
        (tmp_path / name).symlink_to(folder / name)
    path = tmp_path / "metrics" / "metrics.parquet"
    path.parent.mkdir()
    metrics = pd.read_parquet(folder / "metrics" / "metrics.parquet")
    for change, message in (
        (metrics.iloc[1:], "1 planned runs of .* have no result"),
        (pd.concat([metrics, metrics.iloc[:1]]), "1 runs have several results"),
    ):
        change.to_parquet(path)
        with pytest.raises(records.SchemaError, match=message):
            aggregate(plan, tmp_path)
    assert not list(tmp_path.glob("tables/*"))


@pytest.mark.parametrize(
    ("seconds", "peak_gb", "code"), [(59.0, 3.9, 0), (61.0, 1.0, 1), (9.0, 4.1, 1)]
)
def test_more_than_the_stated_time_or_memory_is_a_failure(
    tmp_path, monkeypatch, seconds, peak_gb, code
):
    steps = [("aggregate", 1.0, 1.0), ("tables", seconds - 1.0, peak_gb), ("report", 99.0, 9.0)]
    table = pd.DataFrame(steps, columns=["step", "wall_s", "peak_gb"])
    monkeypatch.setattr(million, "study", lambda *_, **__: table)
    monkeypatch.setattr(million, "costs", pd.DataFrame)
    with pytest.raises(typer.Exit) as ended:
        million.main(tmp_path, synthetic.RUNS_PER_TRIAL)
    assert ended.value.exit_code == code
    assert (tmp_path / "million.csv").is_file()
