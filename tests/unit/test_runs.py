"""What the browser of runs gets: columns of all runs, details in few files, and clouds."""

import json

import numpy as np
import pandas as pd
import pytest

from dcreg.plot import packing
from reports import theme
from reports.page import Page
from reports.runs import clouds, details, listed
from reports.sections import runs as section
from reports.tables import Tables
from workflows.stages.clouds import CLOUDS, rounded, thinned


@pytest.fixture(scope="module")
def tables(made_report) -> Tables:
    return Tables.load(made_report / "tables")


@pytest.fixture(scope="module")
def made(tables, tmp_path_factory) -> tuple[dict, dict[str, dict]]:
    """The table of runs, and the details of each run with its clouds, as the page reads them."""
    page = Page(tables, theme.method_styles(tables), tmp_path_factory.mktemp("runs"))
    section.context(page)
    files = {name: json.loads(packing.unpack(text)) for name, text in page.data.items()}
    table = files.pop("runs")
    known = {
        run: (name, each) for name, file in files.items() for run, each in file["runs"].items()
    }
    chunks = dict(zip(table["values"]["run"], table["values"]["chunk"], strict=True))
    assert {run: name for run, (name, _) in known.items()} == {
        run: f"runs-{chunk}" for run, chunk in chunks.items()
    }
    return table, {
        run: {**each, "clouds": files[name]["clouds"].get(each["instance"])}
        for run, (name, each) in known.items()
    }


def test_the_columns_are_those_of_the_table(made, tables):
    table, _ = made
    words, values = table["words"], table["values"]
    runs = tables.runs
    assert values["run"] == list(runs["run_id"])
    for name in ("method", "model", "test", "status"):
        assert [words[name][code] for code in values[name]] == list(runs[name])
    known = runs["rmse"].notna()
    np.testing.assert_allclose(
        np.array(values["rmse"], float)[known], runs.loc[known, "rmse"], rtol=1e-3
    )
    assert [value is None for value in values["rmse"]] == list(~known)


def test_every_run_has_one_verdict(tables):
    runs = tables.runs
    found = listed.answers(runs)
    assert set(found) == set(listed.ANSWERS)
    assert (found.eq("right") == runs["success"].astype(bool)).all()
    assert (found.eq("no pose") == runs["status"].eq("failed")).all()
    assert (found.eq("not run") == runs["outcome"].isin(["unavailable", "unsupported"])).all()


def test_details_hold_pose_reason_and_history(made, tables):
    _, known = made
    compared = 0
    for run in tables.runs[tables.runs["upper_bound"].notna()].to_dict("records")[:40]:
        found = known[run["run_id"]]
        np.testing.assert_allclose(found["pose"], json.loads(run["T_target_source"]), rtol=1e-5)
        assert found["lower_bound"] == pytest.approx(run["lower_bound"], rel=1e-5)
        events = tables.traces[tables.traces["run_id"] == run["run_id"]]
        for stage, part in events.groupby("stage"):
            history = found["stages"][stage]
            assert history["upper"] == pytest.approx(list(part["upper_bound"]), rel=1e-5)
            assert history["nodes"] == pytest.approx(list(part["n_nodes"]))
            compared += len(part)
    assert compared >= 40
    late = tables.runs[tables.runs["status"] == "time_limit"].iloc[0]
    assert known[late["run_id"]]["reason"] == "hit its limit of 10 s (made-up bound)"


def test_more_runs_than_a_page_lists_leave_those_with_an_overlay(tables, monkeypatch):
    monkeypatch.setattr(listed, "MAX_RUNS", len(tables.runs) - 1)
    shown = set(listed.listed(tables)["run_id"])
    assert shown == {item["run_id"] for item in tables.overlays}


def test_clouds_come_from_overlays_or_from_their_table(made, tables, tmp_path):
    _, known = made
    item = tables.overlays[0]
    cloud = known[item["run_id"]]["clouds"]
    np.testing.assert_allclose(cloud["source"], item["source"])
    assert (cloud["kind"], len(cloud["pairs"])) == (clouds.TRUE, 98)
    row = {
        "instance_id": "a",
        "dim": 2,
        "source": [0.0, 1, 2, 3],
        "target": [4.0, 5],
        "pairs": [1, 0],
    }
    pd.DataFrame([row]).to_parquet(tmp_path / CLOUDS)
    without = Tables(tmp_path / "none", tables.runs, None, {}, tables.overlays)
    overlaid = clouds.of_instances(without)[known[item["run_id"]]["instance"]]
    np.testing.assert_allclose(overlaid["source"], item["source"], atol=1e-3)
    assert overlaid["kind"] == clouds.NEAREST
    stored = clouds.of_instances(Tables(tmp_path, tables.runs, None, {}, []))
    assert stored == {
        "a": {
            "source": [[0, 1], [2, 3]],
            "target": [[4, 5]],
            "pairs": [[1, 0]],
            "kind": clouds.TRUE,
        }
    }


def test_thinned_clouds_keep_pairs_together(rng):
    source, target = rng.random((900, 3)), rng.random((500, 3))
    pairs = np.column_stack([rng.permutation(900)[:300], rng.permutation(500)[:300]])
    few, others, kept = thinned(source, target, pairs, 90)
    assert (len(few), len(others)) == (90, 90)
    assert len(kept) == 30
    whole = {(tuple(source[i]), tuple(target[j])) for i, j in pairs}
    assert {(tuple(few[i]), tuple(others[j])) for i, j in kept} <= whole
    few, others, kept = thinned(source[:5], target[:5], pairs[:0], 90)
    np.testing.assert_array_equal(few, source[:5])
    np.testing.assert_array_equal(others, target[:5])
    assert kept.shape == (0, 2)
    far = 1e6 + rng.random((20, 2))
    assert np.abs(rounded(far) - far).max() <= 1e-4


def test_the_number_of_files_is_limited(tables, monkeypatch):
    monkeypatch.setattr(details, "FILE_WEIGHT", 1)
    runs = listed.listed(tables)
    chunk_of = details.Details(tables, runs).chunk_of
    assert 20 < chunk_of.nunique() <= details.MAX_FILES
    assert list(chunk_of) == sorted(chunk_of)
