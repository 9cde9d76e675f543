"""The figures of the paper: found by themselves, drawn for print and for their page."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from reports import paper_page, theme
from reports.figures import method, printing
from reports.figures.paper import LINES, PaperFigure
from reports.figures.standalone import (
    paper_2d,
    paper_3d,
    paper_alignments_2d,
    paper_examples,
    paper_images,
    paper_scans,
)
from reports.ledger.book import ledger
from reports.tables import ReportError, Tables
from tests.unit import report_fixture
from tests.unit.claim_tables import options_of
from workflows.discovery import modules
from workflows.records import SchemaError

MODULES = paper_page.paper_modules()
# label of the made-up tables -> role of the ledger
KINDS = {
    "dcreg-full": "dcreg_paper",
    "dcreg-half": "dcreg_paper_half",
    "bilinear": "rpm_htb",
    "icp": "dcreg",
    "fgr": "frs",
}


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    return write_results(tmp_path_factory.mktemp("results"))


def write_results(root: Path) -> Path:
    """Write made-up results of all experiments of the paper's figures, with the paper's methods."""
    first = report_fixture.write_tables(root / "made" / "tables", "made")
    for experiment in {module.PAPER.experiment for module in MODULES.values()} - {""}:
        folder = root / f"{experiment}-quick" / "tables"
        shutil.copytree(first, folder)
        _rename(folder, experiment)
    return root


def _rename(folder, experiment: str) -> None:
    """Turn the made-up tables into those of an experiment."""
    runs = pd.read_parquet(folder / "runs.parquet")
    for label, name in KINDS.items():
        role = ledger().roles[name]
        columns = ["baseline", "options_effective", "n_inliers_ratio"]
        values = role.baseline[0], json.dumps(options_of(role)), role.n_inliers_ratio
        runs.loc[runs["method"] == label, columns] = values
    overlays = json.loads((folder / "overlays.json").read_text(encoding="utf-8"))
    poses = {item["run_id"]: json.dumps(item["T_target_source"]) for item in overlays}
    runs["T_target_source"] = runs["run_id"].map(poses).fillna("")
    if experiment == "paper2d_images":
        for item in overlays:
            item |= {"test": "canny", "dataset": "lian_images"}
        overlays = [item for item in overlays if item["model"] == "similarity2d"]
    if experiment == "threedmatch":
        runs["dataset"] = "threedmatch"
        runs["shape"] = runs["shape"].replace("horse-like", "sun3d-home")
    (folder / "overlays.json").write_text(json.dumps(overlays), encoding="utf-8")
    runs.to_parquet(folder / "runs.parquet")


def tables_of(results, name: str) -> Tables:
    folder = MODULES[name].PAPER.find_tables([results])
    assert folder is not None
    return Tables.load(folder)


def test_every_figure_of_the_paper_has_a_module():
    """Two drawings, examples, statistics and alignments in 2D and 3D, photographs, scans."""
    assert list(MODULES) == [
        "method_dc", "method_vertex", "paper_examples", "paper_2d", "paper_alignments_2d",
        "paper_images", "paper_3d", "paper_alignments_3d", "paper_scans",
    ]  # fmt: skip


@pytest.mark.parametrize("name", MODULES)
def test_a_figure_is_drawn_for_print_and_for_the_page(name, results, tmp_path):
    page = paper_page.build(tmp_path, [results], [name])
    text = page.read_text(encoding="utf-8")
    assert (tmp_path / f"{name}.svg").read_text(encoding="utf-8").startswith("<?xml")
    assert (tmp_path / f"{name}.pdf").read_bytes().startswith(b"%PDF")
    assert text.count("<svg ") == 2  # wide, and stacked for a phone
    assert MODULES[name].PAPER.caption in text.replace("&#39;", "'")
    assert "makes them in hours" not in text
    ids = re.findall(r'<clipPath id="([^"]+)"', text)
    assert len(ids) == len(set(ids))


@pytest.mark.parametrize("name", MODULES)
def test_a_figure_says_what_it_shows_and_how_it_differs(name):
    module = MODULES[name]
    assert module.TITLE.startswith("Paper: ")
    assert module.CAPTION.endswith(".")
    assert module.DRAWN
    assert module.PAPER.differs
    assert bool(module.PAPER.experiment) == bool(module.PAPER.command)


def test_the_page_lists_all_figures_and_drops_none(results, tmp_path):
    empty = paper_page.build(tmp_path / "empty", [tmp_path]).read_text(encoding="utf-8")
    full = paper_page.build(tmp_path / "full", [results]).read_text(encoding="utf-8")
    for name, module in MODULES.items():
        for text in (empty, full):
            assert f'<h2 id="{name}">' in text
        if command := module.PAPER.command:
            assert f"<code>{command}</code>" in empty
    assert empty.count('class="note"') == len(MODULES) - 2  # the drawings need no tables
    assert 'class="note"' not in full
    assert "default-src 'none'" in full
    assert not re.search(r'(?:src|href)="(?!#|[\w.]+\.(?:svg|pdf)")', full)
    assert "python -m workflows run made-up" in full  # the command that made the tables


def test_the_page_names_the_lines_of_the_paper_that_did_not_run(results, tmp_path):
    text = paper_page.build(tmp_path, [results], ["paper_2d"]).read_text(encoding="utf-8")
    lacking = text.split("methods of the paper without runs")[1].split("</dd>")[0]
    assert "RPM-PA, RPM-CAV" in lacking
    assert "RPM-HTB" not in lacking


def test_tables_of_another_version_cost_only_their_own_figures(results, tmp_path):
    shutil.copytree(results / "paper2d-quick", tmp_path / "paper2d-quick")
    path = tmp_path / "paper2d-quick" / "tables" / "runs.parquet"
    pd.read_parquet(path).drop(columns="rmse").to_parquet(path)
    text = paper_page.build(tmp_path / "out", [tmp_path]).read_text(encoding="utf-8")
    assert "column &#39;rmse&#39; is missing" in text
    assert text.count("<svg ") == 2 * 2
    with pytest.raises(SchemaError):
        paper_page.build(tmp_path / "out", names=["paper_2d"], tables=path.parent)


def test_an_unknown_figure_is_an_error_that_names_the_others(tmp_path):
    with pytest.raises(ReportError, match="no figure 'nothing'; choose one of method_dc"):
        paper_page.build(tmp_path, names=["nothing"])


def test_colours_of_a_page_follow_the_theme(results):
    tables = tables_of(results, "paper_2d")
    styles = theme.method_styles(tables)
    figure = paper_2d.build(tables, styles)
    drawing = printing.draw(figure.traces, figure.grid, styles, "", paper_2d.DRAWN)
    svg = printing.inline(drawing, styles, "here")
    plain = re.sub(r"light-dark\([^)]*\)", "", svg)
    assert set(re.findall(r"(?:fill|stroke): (#\w+)", plain)) == set()
    style = styles["bilinear"]
    assert f"light-dark({style.light}, {style.dark})" in svg


def test_preferred_tables_come_first(tmp_path):
    figure = PaperFigure("", (), experiment="paper2d")
    for place in ("paper2d-quick", "paper2d-40", "paper2d-quick/parts/some", "other"):
        folder = tmp_path / place / "tables"
        folder.mkdir(parents=True)
        (folder / "accounting.csv").touch()
    assert figure.find_tables([tmp_path]) == tmp_path / "paper2d-40" / "tables"
    shutil.rmtree(tmp_path / "paper2d-40")
    assert figure.find_tables([tmp_path]) == tmp_path / "paper2d-quick" / "tables"
    (tmp_path / "paper2d-quick" / "tables" / "accounting.csv").unlink()
    parts = tmp_path / "paper2d-quick" / "parts" / "some" / "tables"
    assert figure.find_tables([tmp_path]) == parts
    assert PaperFigure("", ()).find_tables([tmp_path]) is None


def test_lines_are_roles_of_the_ledger():
    assert {role for roles in LINES.values() for role in roles} <= set(ledger().roles)
    assert {line for module in MODULES.values() for line in module.PAPER.lines} == set(LINES)


def test_a_method_with_other_options_in_effect_is_no_line_of_the_paper(results):
    tables = tables_of(results, "paper_2d")
    assert paper_2d.PAPER.methods(tables)["RPM-HTB"] == "bilinear"
    other = json.dumps(options_of(ledger().roles["rpm_htb"]) | {"search": "ours"})
    is_other = tables.runs["method"] == "bilinear"
    runs = tables.runs.assign(
        options_effective=tables.runs["options_effective"].mask(is_other, other)
    )
    assert "RPM-HTB" not in paper_2d.PAPER.methods(dataclasses.replace(tables, runs=runs))


def test_statistics_show_both_shares_of_the_pairs_and_a_linear_error(results):
    tables = tables_of(results, "paper_2d")
    styles = theme.method_styles(tables)
    flat = paper_2d.build(tables, styles)
    assert flat.methods == {"dcreg-full", "dcreg-half", "bilinear", "icp"}
    assert {panel.y_type for panel in flat.grid.panels} == {"linear", "log"}
    assert paper_3d.build(tables_of(results, "paper_3d"), styles).methods == {
        "dcreg-full", "dcreg-half", "bilinear", "icp", "fgr",
    }  # fmt: skip
    assert next(iter(flat.payload["views"])) == "rmse"  # the paper's error is printed
    assert any(trace["meta"]["role"] == "floor" for trace in flat.traces)


def test_scans_have_a_panel_per_source(results):
    tables = tables_of(results, "paper_scans")
    found = paper_scans.build(tables, theme.method_styles(tables))
    assert found.grid.column_titles[-1] == "sun3d"
    assert {panel.x_title for panel in found.grid.panels} == {"overlap"}
    assert paper_scans.build(tables_of(results, "paper_3d"), {}) is None


def test_alignments_of_a_row_are_of_one_instance(results):
    tables = tables_of(results, "paper_alignments_2d")
    styles = theme.method_styles(tables)
    figure = paper_alignments_2d.build(tables, styles)
    assert figure.grid.column_titles[0] == "source and target"
    assert len(figure.grid.column_titles) == 1 + 4
    targets = {}
    for trace in figure.traces:
        panel = figure.grid.panels[printing._index(trace["xaxis"])]
        if trace["meta"]["role"] == "target":
            targets.setdefault(panel.row, []).append(trace["y"])
    for row in targets.values():
        assert all(np.array_equal(row[0], other) for other in row)
    titles = [panel.y_title for panel in figure.grid.panels if panel.column == 1]
    assert all(title.startswith("RMSE") for title in titles)


def test_photographs_are_behind_the_alignments(results, monkeypatch):
    tables = tables_of(results, "paper_images")
    styles = theme.method_styles(tables)
    plain = paper_images.build(tables, styles)
    assert plain.photographs == {}  # of made-up instances there are none
    monkeypatch.setattr(paper_images, "photograph", lambda item: np.zeros((4, 6)))
    figure = paper_images.build(tables, styles)
    behind = [panel.column for panel in figure.grid.panels]
    assert sorted(figure.photographs) == [i for i, column in enumerate(behind) if column]
    drawn = printing.draw(figure.traces, figure.grid, styles, "", photographs=figure.photographs)
    assert sum(len(axis.images) for axis in drawn.axes) == len(figure.photographs) > 0


def test_examples_are_brought_back_by_the_reference_pose(results):
    tables = tables_of(results, "paper_examples")
    poses = {item["run_id"]: json.dumps(item["T_target_source"]) for item in tables.overlays}
    runs = tables.runs.assign(T_reference=tables.runs["run_id"].map(poses).fillna("[]"))
    figure = paper_examples.build(dataclasses.replace(tables, runs=runs), {})
    assert figure.grid.column_titles == ["deformation", "noise", "mixed outliers"]
    by_axis = {}
    for trace in figure.traces:
        by_axis.setdefault(trace["xaxis"], []).append(trace)
    for source, target in by_axis.values():
        assert np.abs(source["x"] - target["x"]).max() < 0.5  # deformed, no longer turned


# --- the drawings of the method -----------------------------------------------------------------


def test_the_drawn_bound_is_that_of_the_method():
    found = method.section()
    at_vertices = found.at_vertices()
    assert at_vertices.min() == pytest.approx(found.bounded.lower_bound, rel=1e-9)
    assert found.relaxed()[0] == pytest.approx(found.bounded.lower_bound, rel=1e-9)
    assert found.objective()[0] == pytest.approx(found.bounded.value, rel=1e-9)


def test_the_relaxed_objective_is_concave_below_the_objective_and_equal_at_the_centre():
    found = method.section()
    relaxed, objective = found.relaxed(), found.objective()
    assert (relaxed <= objective + 1e-9).all()
    centre = len(found.at) // 2
    assert relaxed[centre] == pytest.approx(objective[centre], rel=1e-9)
    assert (np.diff(relaxed, 2) <= 1e-9).all()


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_a_fixed_matching_is_concave_and_touches_the_minimum_where_it_is_optimal(share):
    found = method.section()
    position = round(share * (len(found.at) - 1))
    values = found.with_matching(found.matching(position))
    assert (np.diff(values, 2) <= 1e-9).all()
    assert (values >= found.relaxed() - 1e-9).all()
    assert values[position] == pytest.approx(found.relaxed()[position], rel=1e-9)


def test_no_drawing_of_the_method_is_in_a_report():
    from reports.figures import standalone

    alone = [m for m in modules(standalone) if hasattr(m, "PAPER") and not m.PAPER.experiment]
    assert {m.__name__.rpartition(".")[2] for m in alone} == {"method_dc", "method_vertex"}
