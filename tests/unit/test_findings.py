"""`docs/findings.md` and the tables behind it: every number on the page comes from stored runs."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pandas as pd
import pytest

from reports import findings, measured
from reports.archive import write as writing
from reports.measured import (
    OURS,
    PUBLISHED,
    RECONSTRUCTED,
    STATED,
    WITH_DISTANCES,
    Measured,
    Shown,
)
from reports.page import Page
from reports.sections import separation, stages
from reports.tables import ReportError, Tables
from tests.unit import report_fixture

TEMPLATE = findings.HERE / "templates" / "findings.md"


@pytest.fixture(scope="module")
def archived():
    return findings.load(findings.archive_of_findings())


def test_the_page_is_what_the_archive_gives(archived):
    """After a change of the archive or of the template: `python -m reports findings`."""
    assert findings.PAGE.read_text(encoding="utf-8") == findings.render(*archived)


def test_the_page_says_where_its_runs_come_from(archived):
    _, origin = archived
    page = findings.PAGE.read_text(encoding="utf-8")
    for fact in (
        origin["machine"]["cpu"],
        origin["commit"][:10],
        origin["archive"],
        *origin["commands"],
    ):
        assert fact in page


def test_the_template_has_no_number():
    text = re.sub(r"\{\{.*?\}\}|\{%.*?%\}", "", TEMPLATE.read_text(encoding="utf-8"), flags=re.S)
    assert not re.findall(r"\d+", re.sub(r"\b[23]D\b", "", text))


def test_every_number_of_the_page_follows_the_runs(archived):
    """Other runs give other numbers: nothing on the page is constant but its words and settings."""
    table, origin = archived
    runs = table.runs.assign(
        success=lambda t: np.arange(len(t)) % 3 == 0,
        rmse_over_scale=lambda t: t["rmse_over_scale"] * 1.7 + 0.011,
        n_nodes=lambda t: t["n_nodes"] * 3 + 1,
        n_assignments=lambda t: t["n_assignments"] * 5 + 2,
    )
    before = findings.render(table, origin).splitlines()
    after = findings.render(Measured(runs, table.stages), origin).splitlines()
    changed = [line for line in after if line.startswith("|") and line not in before]
    assert len([line for line in changed if "%" in line]) > 10
    assert [line for line in before if not line.startswith("|")] == [
        line for line in after if not line.startswith("|")
    ]


def test_an_archive_loses_nothing_that_the_page_shows(tmp_path, monkeypatch):
    monkeypatch.setattr(findings, "EXPERIMENT", "made-up")
    tables = report_fixture.write_tables(tmp_path / "results" / "made-up" / "tables")
    archive = writing.write([tmp_path / "results"], tmp_path / "1.0", "1.0")
    found, origin = findings.load(archive)
    direct = Measured.of_tables(Tables.load(tables))
    shows = (
        measured.effect_of_n_inliers, measured.certified_wrong, measured.norm_stage,
        measured.boxes_per_stage,
    )  # fmt: skip
    for show in shows:
        assert show(found) == show(direct)
    text = findings.render(found, origin)
    assert "no bound in two searches" in text
    assert "made-up CPU" in text


def test_no_archive_is_an_error(tmp_path, monkeypatch):
    monkeypatch.setenv("DCREG_ARCHIVES", str(tmp_path))
    with pytest.raises(ReportError, match="make them with `make findings`"):
        findings.archive_of_findings()


@pytest.mark.parametrize(
    ("card", "model", "expected"),
    [
        ({"baseline": "dcreg_paper"}, "similarity2d", (PUBLISHED, STATED)),
        ({"baseline": "dcreg", "options": {"bound": "dc"}}, "similarity2d", (PUBLISHED, OURS)),
        ({"baseline": "dcreg", "parameters": {"bound": None}}, "similarity2d",
         ("DC, tight", WITH_DISTANCES)),
        ({"baseline": "dcreg", "options": {"bound": "tight"}}, "similarity2d", ("DC, tight", OURS)),
        ({"baseline": "dcreg", "options": {"bound": "dc"}}, "rigid3d", ("", "")),
        ({"baseline": "dcreg", "options": {"mode": "paper"}}, "rigid3d", ("DC, tight", OURS)),
        ({"baseline": "x", "parameters": {"search": "own"}, "display_name": "X (reconstructed)"},
         "similarity2d", ("X", RECONSTRUCTED)),
        ({"baseline": "x", "parameters": {"search": "own"}, "options": {"search": "ours"},
          "display_name": "X"}, "similarity2d", ("X", OURS)),
        ({"baseline": "icp"}, "similarity2d", ("", "")),
    ],
)  # fmt: skip
def test_bound_and_search_are_recognised_by_the_options_in_effect(card, model, expected):
    assert measured.kind(card, model) == expected


def made(**columns) -> Measured:
    """Eight instances, each solved by the published bound in both searches."""
    rows = [
        {"run_id": f"{search}{i}", "instance_id": str(i), "method": search, "search": search,
         "success": search == OURS or i < 2, "n_assignments": 10.0 if search == OURS else 40.0,
         "rmse_over_scale": 0.1 if search == OURS else 0.2 + 0.01 * i}
        for search in (OURS, STATED)
        for i in range(8)
    ]  # fmt: skip
    same = {
        "model": "similarity2d", "bound": PUBLISHED, "n_inliers_ratio": 1.0, "status": "optimal",
        "certificate_scope": "similarity pose", "lower_bound": 0.5, "upper_bound": 1.0, "gap_tol": 0.6,
        "bound_ratio": 0.5, "n_nodes": 3.0, "time_solve_s": 0.1, "display_name": "DC",
        "test": "noise", "level": 0.1, "outcome": "finished",
        "objective": 1.0, "objective_true": 2.0, "family": "f", "norm_translation_error": 0.2,
    }  # fmt: skip
    runs = pd.DataFrame(rows).assign(**same).assign(**columns)
    first = {"stage": "start", "n_nodes": 0, "n_assignments": 0, "lower_bound": 0.0}
    ends = runs[["run_id", "lower_bound", "upper_bound", "n_nodes", "n_assignments"]]
    parts = [ends.assign(**first), ends.assign(stage="search")]
    return Measured(runs, pd.concat(parts, ignore_index=True))


def test_separation_compares_on_the_same_instances():
    found = made()
    shown = measured.separation(found, "similarity2d")
    assert [row[:3] for row in shown.rows] == [
        [PUBLISHED, STATED, "8"],
        [PUBLISHED, OURS, "8"],
    ]
    (row,) = measured.effects(found, "similarity2d").rows
    assert row[0] == f"search {OURS} / {STATED}; bound {PUBLISHED}"
    assert row[2].startswith("+75 % [")
    assert row[4] == "0.25 [0.25, 0.25]"
    assert row[-2:] == ["lower", "lower"]
    fewer = found.runs[~(found.runs["method"].eq(OURS) & found.runs["instance_id"].eq("3"))]
    shown = measured.separation(dataclasses.replace(found, runs=fewer), "similarity2d")
    assert {row[2] for row in shown.rows} == {"7"}


def test_fewer_assignments_of_runs_at_a_limit_decide_nothing():
    found = made()
    for cut, last in ((OURS, "open (limit; counts lower)"), (STATED, "lower")):
        runs = found.runs.copy()
        runs.loc[runs["method"].eq(cut) & runs["instance_id"].eq("3"), "outcome"] = "limited"
        (row,) = measured.effects(dataclasses.replace(found, runs=runs), "similarity2d").rows
        assert row[-1] == last


def test_bounds_are_not_compared_across_searches_that_differ():
    """Algorithm 1 and a reconstructed search differ in more than their bound."""
    found = made()
    rival = found.runs[found.runs["method"].eq(STATED)]
    rival = rival.assign(bound="X", search=RECONSTRUCTED, method="x", run_id="x" + rival["run_id"])
    both = pd.concat([found.runs, rival, rival.assign(search=OURS, method="x-ours")])
    rows = measured.effects(dataclasses.replace(found, runs=both), "similarity2d").rows
    assert [row[0] for row in rows] == [
        f"bound {PUBLISHED} / X; search {OURS}",
        f"search {OURS} / {STATED}; bound {PUBLISHED}",
        f"search {OURS} / {RECONSTRUCTED}; bound X",
    ]


def test_an_interval_that_contains_equality_decides_nothing():
    noisy = made(rmse_over_scale=[0.1, 0.3] * 8)
    (row,) = measured.effects(noisy, "similarity2d").rows
    assert row[-2] == "open"


def test_one_bound_in_one_search_is_no_separation():
    assert measured.separation(made(search=OURS), "similarity2d") is None


def test_an_instance_counts_once_among_wrong_certified_optima():
    assert measured.certified_wrong(made(success=False)) is None  # the tolerance was large
    (row,) = measured.certified_wrong(made(success=False, bound_ratio=0.99)).rows
    assert row[-3:] == ["8", "100 % [68, 100]", "8 of 8"]


def test_the_norm_stage_needs_a_bound_above_zero():
    norm = {"certificate_scope": "translation in norm space", "model": "rigid3d", "success": False}
    (row,) = measured.norm_stage(made(**norm)).rows
    assert row[3:7] == ["16", "16", "100 % [81, 100]", "100 % [81, 100]"]
    assert measured.norm_stage(made(**norm, lower_bound=0.0)) is None
    assert measured.norm_stage(made(**norm, gap_tol=0.4)) is None


def test_stages_that_find_initial_poses_are_not_counted():
    rows = measured.boxes_per_stage(made()).rows
    assert [row[2] for row in rows] == ["search"]


def test_sections_are_left_out_without_runs_for_them(made_report):
    page = Page(Tables.load(made_report / "tables"), {}, made_report)
    assert separation.context(page) is None
    assert isinstance(stages.context(page)["shown"], Shown)
    html = (made_report / "index.html").read_text(encoding="utf-8")
    assert 'id="stages-title"' in html
    assert 'id="separation-title"' not in html
