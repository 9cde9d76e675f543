"""The report without a browser: checks on the tables, the queries, formats, and the file."""

from __future__ import annotations

import dataclasses
import itertools
import json
import re
import shutil
import sys
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from plotly.offline import get_plotlyjs
from scipy.stats import binomtest

from baselines import registry
from dcreg.plot import packing
from reports import page as pages
from reports import paired, standing, templating, theme
from reports.build import build
from reports.figures import attribution, levels, printing, profile, standalone
from reports.figures.figure import Figure
from reports.ledger.judging import ledger
from reports.pairs import pair_rows
from reports.sections import figures, outcome
from reports.sections import levels as levels_section
from reports.sections.parameters import parameters
from reports.tables import (
    PENALTY,
    ReportError,
    Tables,
    counted_time,
    row_names,
    share_intervals,
    thin_trace,
)
from tests.unit import report_fixture
from tests.unit.report_fixture import CARDS
from workflows.attribution import VERDICTS
from workflows.config import CONFIGS, load
from workflows.labels import display_names
from workflows.outcomes import attempted
from workflows.records import SchemaError


@pytest.fixture(scope="module")
def folder(made_report) -> Path:
    return made_report / "tables"


@pytest.fixture(scope="module")
def tables(folder) -> Tables:
    return Tables.load(folder)


@pytest.fixture(scope="module")
def html(made_report) -> str:
    return (made_report / "index.html").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def styles(tables) -> dict[str, theme.Style]:
    return theme.method_styles(tables)


@pytest.fixture(scope="module")
def flat(tables, styles) -> Figure:
    """The figure of levels in 2D."""
    return levels.build(tables, styles, "similarity2d")


@pytest.fixture(scope="module")
def small(tmp_path_factory) -> tuple[Path, str]:
    """Tables of one test of an experiment of the paper, in which two methods hit limits on boxes."""
    root = tmp_path_factory.mktemp("small")
    cases = report_fixture.CASES[:1]
    folder = report_fixture.write_tables(root / "tables", "paper2d", cases)
    path = folder / "provenance.json"
    known = json.loads(path.read_text(encoding="utf-8"))
    boxes = {"dcreg-full": {"nodes": 700}, "dcreg-half": {"nodes": 8}}
    for method, limits in boxes.items():
        known["methods"][method]["limits"] |= limits
    path.write_text(json.dumps(known), encoding="utf-8")
    runs = pd.read_parquet(folder / "runs.parquet")
    late = runs["method"].isin(list(boxes)) & runs["status"].eq("time_limit")
    assert late.any()
    runs.loc[late, "status"] = "node_limit"
    runs.to_parquet(folder / "runs.parquet")
    build(folder, root / "index.html")
    return folder, (root / "index.html").read_text(encoding="utf-8")


class Page(HTMLParser):
    """Everything in the page that could cause a request."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.links: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.links += [v for k, v in attrs if k in ("src", "href", "srcset", "data") and v]


def data_of(report: Path, name: str) -> bytes:
    """The content of a file of data next to a page."""
    text = (report / "data" / f"{name}.js").read_text(encoding="ascii")
    stated, packed = re.fullmatch(r'store\("(.*)", "(.*)"\);\n', text).groups()
    assert stated == name
    return packing.unpack(packed)


def broken(folder: Path, tmp_path: Path, edit) -> Path:
    """A copy of the tables with an edited accounting ledger."""
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    ledger = pd.read_csv(tmp_path / "accounting.csv")
    edit(ledger).to_csv(tmp_path / "accounting.csv", index=False)
    return tmp_path


def test_page_is_small_and_asks_for_nothing_but_the_files_next_to_it(html):
    assert len(html) < 2_500_000
    assert all(link.startswith("#") for link in Page(html).links)
    assert "default-src 'none'" in html
    assert not re.search(r"url\(|@import", html.split("<body>")[0])


def test_a_page_of_100_methods_stays_small(made_report, html, tables):
    """The part of the page that grows with the methods; the rest is loaded when it is shown."""
    sections = html.split("<main")[1].split("</main>")[0]
    fixed = len(html.encode()) - len(sections.encode())
    assert fixed + len(sections.encode()) * 100 / len(tables.methods) < 2_000_000
    overlays = json.loads(data_of(made_report, "gallery"))
    assert sorted(overlays["run_id"]) == sorted(item["run_id"] for item in tables.overlays)
    assert 'class="card"' not in html  # cards are made in the browser
    cards = json.loads(data_of(made_report, "parts-provenance"))
    assert len(cards) == html.count('class="method-card"') == len(tables.methods)


def test_every_success_rate_has_its_interval(made_report, tables):
    (table,) = json.loads(data_of(made_report, "parts-overview"))
    text = re.sub(r"<[^>]*>", " ", table)
    tried = attempted(tables.runs)
    for _, part in tried.groupby(["model", "test", "method"]):
        ends = binomtest(int(part["success"].sum()), len(part)).proportion_ci(0.95, "wilson")
        low, high = (round(100 * end) for end in ends)
        assert f"[{low}, {high}]" in text
    shown = re.findall(r"\[\d+, \d+\]", text)
    assert len(shown) == tried.groupby(["model", "test", "method"]).ngroups


@pytest.mark.usefixtures("blank_prints")
def test_a_report_links_to_the_history_next_to_the_results(small, tmp_path):
    folder, html = small
    assert "history-link" not in html
    (tmp_path / "history").mkdir()
    (tmp_path / "history" / "index.html").write_text("")
    for place, address in (("one", "../.."), ("one/parts/noise", "../../../..")):
        build(folder, tmp_path / place / "report" / "index.html")
        page = (tmp_path / place / "report" / "index.html").read_text(encoding="utf-8")
        assert f'href="{address}/history/index.html"' in page
        whole = (tmp_path / place / "report" / "whole.html").read_text(encoding="utf-8")
        assert "history-link" not in whole  # it is sent alone


def test_the_very_tables_are_next_to_the_page(made_report, folder):
    for name in ("runs.csv", "traces.csv", "accounting.csv", "provenance.json"):
        assert data_of(made_report, f"file-{name}") == (folder / name).read_bytes()
    assert data_of(made_report, "plotly") == get_plotlyjs().encode()


def test_the_page_in_one_file_has_the_same_data(made_report):
    whole = (made_report / "whole.html").read_text(encoding="utf-8")
    inside = dict(re.findall(r'<script type="text/plain" data-stored="(.*)">(.*)</script>', whole))
    names = {path.stem for path in (made_report / "data").iterdir()}
    assert set(inside) == names
    assert packing.unpack(inside["runs"]) == data_of(made_report, "runs")


def test_a_new_page_replaces_the_data_of_an_earlier_one(small, tmp_path):
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "old.js").write_text("")
    page = pages.Page(Tables.load(small[0]), {}, tmp_path)
    page.add_download("a.csv", b"1", "one")
    pages.write_data(page.packed(), tmp_path)
    names = {path.stem for path in (tmp_path / "data").iterdir()}
    assert names == {"file-a.csv", "plotly"}


def test_page_shows_the_accounting(html, tables):
    shown = re.sub(r"<[^>]*>|\s+", " ", html.split('class="headline"')[1].split("</p>")[0])
    numbers = [int(n) for n in re.findall(r"\d+", shown)]
    assert numbers[0] == len(tables.runs) == sum(numbers[1:])
    assert len(numbers) == 6


def test_messages_are_escaped(html):
    assert "signal 11 &lt;b&gt;segfault&lt;/b&gt;" in html
    assert "<b>segfault</b>" not in html


def test_print_figures_are_files_and_downloads(made_report):
    for name in ("levels-similarity2d.svg", "levels-rigid3d-mean.pdf"):
        assert data_of(made_report, f"file-{name}") == (made_report / "figures" / name).read_bytes()
    assert b"<svg" in data_of(made_report, "file-levels-similarity2d.svg")


def test_same_tables_give_the_same_page(small, tmp_path):
    folder, html = small
    build(folder, tmp_path / "index.html")
    assert (tmp_path / "index.html").read_text(encoding="utf-8") == html


@pytest.mark.parametrize(
    ("steps", "dropped", "message"),
    [
        ({"finished": -1}, "", r"accounting\.csv.*planned = 63.*sum to 62"),
        ({"finished": -1, "limited": 1}, "", "finished = 55 but runs has 56"),
        ({}, "teaser", "teaser"),
    ],
    ids=["a run less", "another outcome", "a method less"],
)
def test_a_wrong_ledger_is_refused(folder, tmp_path, steps, dropped, message):
    def edit(ledger):
        for column, step in steps.items():
            ledger.loc[0, column] += step
        return ledger[ledger["method"] != dropped]

    with pytest.raises(ReportError, match=message):
        Tables.load(broken(folder, tmp_path, edit))


def test_missing_tables_are_named(tmp_path):
    (tmp_path / "accounting.csv").write_text("method,planned\n")
    with pytest.raises(SchemaError, match=r"runs\.parquet"):
        Tables.load(tmp_path)


def test_thinned_trace_keeps_every_move_and_both_ends():
    lower = [0.0, 0.0, 0.0, 1.0, 1.0, 2.0, 2.0, 2.0]
    events = pd.DataFrame({"time_s": range(8), "lower_bound": lower, "upper_bound": [3.0] * 8})
    assert list(thin_trace(events)["time_s"]) == [0, 3, 5, 7]


def test_long_trace_is_thinned_to_true_events_with_both_ends():
    n = 5000
    events = pd.DataFrame(
        {"time_s": range(n), "lower_bound": np.arange(n) * 1.0, "upper_bound": [1e4] * n}
    )
    kept = thin_trace(events, most=100)
    assert 50 < len(kept) <= 100
    assert kept["time_s"].iloc[[0, -1]].tolist() == [0, n - 1]
    assert (kept["lower_bound"] == kept["time_s"]).all()


def test_rows_of_a_figure_are_shapes_or_data_sets_when_shapes_are_many():
    few = pd.DataFrame({"dataset": ["a"] * 3, "shape": ["x", "y", "x"]})
    assert list(row_names(few)) == ["x", "y", "x"]
    many = pd.DataFrame({"dataset": ["a"] * 6 + ["b"], "shape": [*"pqrstu", "x"]})
    assert list(row_names(many)) == ["a"] * 6 + ["b · x"]


def test_every_started_run_is_counted_under_one_verdict(tables):
    counts = attribution.count(attribution.judged(tables.runs), tables.methods)
    assert (counts[list(VERDICTS)].sum(axis=1) == counts["started"]).all()
    assert counts["started"].sum() == len(attempted(tables.runs))
    assert counts.loc["fgr", "no_pose"] == 1 + 1  # one crash in each model


def test_certified_intervals_reach_methods_without_bounds_and_keep_to_their_scope(tables):
    flat = tables.runs[tables.runs["model"] == "similarity2d"]
    counts = attribution.count(attribution.judged(flat), tables.methods)
    assert counts.loc["icp", "certified"] == counts.loc["icp", "started"]
    assert counts.loc["icp", "proven"] < counts.loc["dcreg-full", "proven"]
    assert (counts["objective_regret"] <= counts["regret_at_most"]).loc[["icp", "dcreg-full"]].all()
    solid = tables.runs[tables.runs["model"] == "rigid3d"]  # bounds are of another scope there
    assert not attribution.count(attribution.judged(solid), tables.methods)["certified"].any()


def test_page_prints_every_parameter(html):
    shown = re.sub(r"<[^>]*>|\s+", " ", html.split('id="parameters"')[1].split("</section>")[0])
    for text in ("made_up_weight", "0.25", "0.5", "2 σ (nobody)"):
        assert text in shown


def medians(figure, method):
    """The first trace of a method's medians."""
    data = figure.payload["views"]["rmse"]["data"]
    return next(t for t in data if t["meta"] == {"role": "median", "method": method})


def test_level_figure_shows_the_numbers_of_the_table(tables, flat):
    trace = medians(flat, "icp")
    runs = tables.runs
    cell = runs[
        (runs.method == "icp") & (runs.test == "deformation") & (runs["shape"] == "fish-like")
    ]
    expected = cell.groupby("level")["rmse"].median()
    assert trace["x"] == list(expected.index)
    np.testing.assert_allclose(trace["y"], expected)
    assert "n = 3" in trace["text"][0]
    assert cell["run_id"].iloc[0] in "".join(trace["text"])


def test_the_floor_of_a_single_level_is_visible(tables, styles):
    once = tables.runs[
        tables.runs["level"] == tables.runs.groupby("test")["level"].transform("max")
    ]
    found = levels.build(dataclasses.replace(tables, runs=once), styles, "similarity2d")
    floors = [
        trace
        for trace in found.payload["views"]["rmse"]["data"]
        if trace["meta"]["role"] == "floor"
    ]
    assert {trace["mode"] for trace in floors} == {"markers"}
    drawn = printing.draw(floors, found.grid, styles, "", ("floor",))
    assert "_" in {line.get_marker() for axes in drawn.axes for line in axes.lines}


@pytest.mark.parametrize("statistic", ["median", "mean"])
def test_print_figure_cuts_no_data(flat, styles, statistic):
    view = flat.payload["views"]["rmse"]["data"]
    drawn = printing.draw(view, flat.grid, styles, "", (statistic, "floor"))
    lines = [(axes, line) for axes in drawn.axes for line in axes.lines]
    assert len(lines) > 20
    for axes, line in lines:
        low, high = axes.get_ylim()
        assert (line.get_ydata() >= low).all()
        assert (line.get_ydata() <= high).all()


def test_figures_keep_their_room_until_they_are_drawn(html, flat):
    """Or else what lies below moves away from a reader who jumps to it."""
    wide = flat.payload["views"]["rmse"]["layouts"]["wide"]["height"]
    tag = html.split('id="fig-levels-similarity2d"')[1].split(">")[0]
    assert f"--wide: {wide}px" in tag
    assert len(re.findall(r"--narrow: \d{3,}px", html)) == html.count('class="plot"')


def test_levels_with_a_limited_run_have_open_markers(flat):
    symbols = medians(flat, "bilinear")["marker"]["symbol"]
    assert [symbol.endswith("-open") for symbol in symbols] == [False, False, True]


def test_print_shows_what_the_page_shows_and_its_open_markers(flat, styles):
    view = flat.payload["views"]["rmse"]["data"]
    drawn = printing.draw(view, flat.grid, styles, "", ("median",))
    shown = [t for t in view if t["meta"]["role"] == "median"]
    expected = sorted(y for trace in shown for y in trace["y"])
    markers = [line for axis in drawn.axes for line in axis.lines if line.get_linestyle() == "None"]
    full = [line for line in markers if line.get_marker() != "."]
    np.testing.assert_allclose(sorted(y for line in full for y in line.get_ydata()), expected)
    opened = sum(len(m.get_ydata()) for m in full if m.get_markerfacecolor() == "white")
    assert opened == sum("-open" in symbol for t in shown for symbol in t["marker"]["symbol"]) > 0
    texts = [text.get_text() for text in drawn.legends[0].get_texts()]
    assert "open: some runs hit a limit" in texts


def test_levels_with_a_failed_run_are_dotted_on_the_page_and_in_print(tables, styles):
    figure = levels.build(tables, styles, "rigid3d")
    view = figure.payload["views"]["rmse"]["data"]
    trace = medians(figure, "fgr")
    assert trace["marker"]["symbol"][-1].endswith("-open-dot")
    assert "(1 without a pose)" in trace["text"][-1]
    drawn = printing.draw(view, figure.grid, styles, "", ("median",))
    dots = [line for axis in drawn.axes for line in axis.lines if line.get_marker() == "."]
    assert sum(len(line.get_ydata()) for line in dots) > 0


def test_levels_are_named_with_their_unit(flat):
    titles = {panel.x_title for panel in flat.grid.panels}
    assert titles == {
        "coefficient of the deformation", "noise σ, in longest sides", "outliers per inlier, each set",
    }  # fmt: skip


def test_outcome_states_language_work_and_the_share_of_excluded_truths(tables):
    cards = {name: {**card, "language": "C++"} for name, card in tables.cards.items()}
    runs = tables.runs.assign(n_assignments=7.0, truth_in_cube=np.nan)
    of_icp = runs.index[runs["method"] == "icp"]
    runs.loc[of_icp, "truth_in_cube"] = 1.0
    runs.loc[of_icp[: len(of_icp) // 2], "truth_in_cube"] = 0.0
    changed = dataclasses.replace(tables, runs=runs, provenance={"methods": cards})
    rows = outcome.outcomes(changed)
    assert {(row["language"], row["assignments"]) for row in rows} == {("C++", 7.0)}
    shares = {
        row["method"]: row["truth_excluded"] for row in rows if row["model"] == "similarity2d"
    }
    assert shares["icp"] > 0
    assert np.isnan(shares["dcreg-full"])


def test_methods_that_are_not_deterministic_are_labelled(html):
    rows = re.findall(r'<tr data-method="([^"]*)"><th scope="row">(.*?)</th>', html, re.DOTALL)
    assert {method for method, text in rows if "not deterministic" in text} == {"fgr"}


def test_times_of_runs_without_the_right_pose_count_as_twice_the_longest_limit(tables):
    runs = tables.runs.head(5).assign(
        time_solve_s=3.0, outcome="finished", status="optimal", success=True
    )
    runs["success"] = runs["success"].astype(object)
    runs.loc[1, ["outcome", "status"]] = "limited", "time_limit"
    runs.loc[2, ["outcome", "status", "success"]] = "limited", "assignment_limit", False
    runs.loc[3, ["outcome", "status", "time_solve_s", "success"]] = "failed", "failed", np.nan, None
    runs.loc[4, "success"] = False
    cards = {**tables.cards, "slow": {"limits": {"time_s": 40.0}}, "free": {}}
    assert list(counted_time(runs, cards)) == [3.0, 3.0, *[PENALTY * 40] * 3]
    assert list(counted_time(runs, {})) == [3.0, 3.0, *[PENALTY * 3] * 3]


def test_methods_are_compared_with_the_best_on_common_instances(tables):
    def compared(*patterns: str) -> dict[str, standing.Cell]:
        """Return the cells of methods with one run for each character: 1 right, 0 wrong, - none."""
        runs = pd.DataFrame(
            {
                "instance_id": i, "instance_digest": i, "model": "rigid3d", "test": "noise",
                "method": method, "outcome": "finished", "success": run == "1",
            }
            for method, pattern in zip(CARDS, patterns, strict=False)
            for i, run in enumerate(pattern)
            if run != "-"
        )  # fmt: skip
        (matrix,) = standing.matrices(dataclasses.replace(tables, runs=runs))
        assert matrix.columns == ["noise"]
        return {method: row["noise"] for method, row in matrix.rows.items()}

    cells = compared("1" * 20, "1" * 17 + "000", "1" * 10 + "0" * 10, "-" * 11 + "1" * 9)
    full, half, bilinear, icp = cells.values()
    assert list(cells) == list(CARDS)[:4]
    assert (full.standing, half.standing, bilinear.standing) == ("best", "tied", "worse")
    assert (icp.runs, icp.right, icp.standing) == (9, 9, "")  # fewer than half of the instances
    low, high = half.interval
    assert 0.6 < low < half.share == 0.85 < high < 0.95
    # five lost instances have p = 0.063, six 0.031: significant alone, but not among three methods
    assert compared("1" * 20, "1" * 14 + "0" * 6)["dcreg-half"].standing == "worse"
    assert compared("1" * 20, "1" * 15 + "0" * 5)["dcreg-half"].standing == "tied"
    both = compared("1" * 20, "1" * 14 + "0" * 6, "1" * 14 + "0" * 6)
    assert [cell.standing for cell in both.values()] == ["best", "tied", "tied"]
    # five instances cannot show a difference, not even between 100 % and 0 %; six can
    assert compared("1" * 5, "0" * 5)["dcreg-half"].standing == "few"
    assert compared("1" * 6, "1" * 4 + "00")["dcreg-half"].standing == "tied"
    assert compared("1" * 6, "0" * 6)["dcreg-half"].standing == "worse"
    # of three methods, or with fewer common instances, it takes more
    assert compared("1" * 6, "1" * 5 + "0", "0" * 6)["bilinear"].standing == "few"
    assert compared("1" * 10, "----" + "1" * 5 + "0")["dcreg-half"].standing == "tied"
    assert compared("1" * 10, "-----" + "1" * 4 + "0")["dcreg-half"].standing == "few"
    # one that attempted fewer instances can be better on them
    assert compared("0" * 12 + "1" * 8, "1" * 12 + "-" * 8)["dcreg-half"].standing == "tied"


def test_the_outcome_says_where_too_few_instances_decide_nothing(tables, styles):
    cells = {
        "icp": {"noise": standing.Cell(2, 2, "best")},
        "fgr": {"noise": standing.Cell(1, 2, "few")},
    }
    said = outcome.sentence(standing.Matrix("rigid3d", ["noise"], cells), styles)
    assert said.endswith(
        f"; there are too few instances to say whether {styles['fgr'].name} is worse."
    )
    assert "not significantly" not in said
    assert "highest success rate, 100 %" in said
    cells["fgr"] = {"noise": standing.Cell(1, 1, "tied")}
    said = outcome.sentence(standing.Matrix("rigid3d", ["noise"], cells), styles)
    assert "highest success rate of those with the most runs, 100 %" in said


def test_the_page_repeats_a_run_of_earlier_tables(tables):
    older = dataclasses.replace(tables, provenance={"replay": "python -m workflows replay"})
    assert older.replay_command + "1f" == "make replay RUN=1f"


def test_equal_methods_are_rarely_significantly_worse_than_the_best(tables, rng):
    """The best of several equal methods is best by chance; 5 % of the columns may say more."""
    names, n_runs, wrong = [*CARDS][:5], 60, 0
    for _ in range(100):
        runs = pd.DataFrame(
            {
                "instance_id": np.tile(np.arange(n_runs), len(names)), "model": "rigid3d",
                "instance_digest": np.tile(np.arange(n_runs), len(names)), "test": "noise",
                "method": np.repeat(names, n_runs), "outcome": "finished",
                "success": rng.random(n_runs * len(names)) < 0.5,
            }
        )  # fmt: skip
        (matrix,) = standing.matrices(dataclasses.replace(tables, runs=runs))
        wrong += bool(matrix.standing(standing.WORSE))
    assert wrong <= 7


def test_methods_on_different_instances_are_not_compared_over_all_tests(tables):
    (whole,) = standing.matrices(tables)[:1]
    assert whole.columns[0] == standing.ALL
    runs = tables.runs.copy()
    runs.loc[runs.index[0], "outcome"] = "not_needed"
    chosen = dataclasses.replace(tables, runs=runs)
    (matrix,) = standing.matrices(chosen)[:1]
    assert matrix.columns == whole.columns[1:]
    assert whole.standing(standing.BEST)
    assert not any(cell.standing for row in matrix.rows.values() for cell in row.values())
    for each, has_p in ((tables, True), (chosen, False)):
        counts = [
            c for found in paired.comparisons(each) for c in np.ravel(found["counts"]["right"])
        ]
        assert np.isfinite(counts[3::4]).all() == has_p
    styles = theme.method_styles(tables)
    for each, has_ratio in ((tables, True), (chosen, False)):
        panels = str(profile.build(each, styles, matrix.model).payload)
        assert ("multiple of the fastest method" in panels) == has_ratio


def test_the_first_sentence_says_what_was_run(tables):
    said = (
        "5 of 6 methods were attempted on 63 instances of demo, 3 tests in 2D and 3D: 270 of 378 "
        "planned runs were attempted, 45 unsupported, 63 unavailable."
    )
    assert outcome.what(tables) == said
    runs = tables.runs
    other_model = runs["method"].eq("icp") & runs["model"].eq("rigid3d")
    less = dataclasses.replace(tables, runs=attempted(runs[~other_model]))
    assert outcome.what(less) == (
        "5 methods were attempted on 63 instances of demo, 3 tests in 2D and 3D: all 252 planned runs "
        "were attempted. Not every method is planned for every instance: each is planned for 18 to 63 "
        "of 63."
    )
    one = dataclasses.replace(less, runs=less.runs[less.runs["method"] == "icp"])
    assert outcome.what(one).startswith("1 method was attempted on 45 instances of demo")


def test_the_filter_of_methods_reaches_the_boxes_per_stage(html):
    shown = html.split('id="stages"')[1].split("</section>")[0]
    rows = re.findall(r'<tr data-method="([^"]*)"><th scope="row">', shown)
    assert {"dcreg-full", "dcreg-half"} <= set(rows)
    assert len(rows) == shown.count('<th scope="row">')


def test_columns_of_words_are_aligned_to_the_left(html):
    rows = [("a", "2D", "7\u202f059", "65 % [43, 82]"), ("b", "3D", "–", "-0.1")]
    assert templating.numeric(rows) == [False, False, True, True]
    stages = html.split('id="stages"')[1].split("</table>")[0]
    assert '<th scope="col">stage</th>' in stages
    assert '<th scope="col" class="n">median boxes</th>' in stages


def test_names_of_pairs_are_left_out_only_if_that_is_shorter():
    assert outcome._named(np.array(list("abcde")), "mine") == "a, b, c, d, e of mine"
    assert outcome._named(np.array(list("abcdef")), "mine") == "a, b, c, d and 2 more of mine"


def test_methods_without_an_attempted_run_are_folded(html):
    shown = html.split('id="accounting"')[1].split("</table>")[0]
    folded = html.split('id="idle"')[1].split("</table>")[0]
    assert re.findall(r'<tr data-method="([^"]*)"', folded) == ["teaser"]
    assert 'data-method="teaser"' not in shown
    assert "<summary>1 method without an attempted run</summary>" in html


def test_one_attempted_method_is_not_called_the_best(tables, styles):
    alone = tables.runs[tables.runs["method"].eq("icp") & tables.runs["model"].eq("similarity2d")]
    (matrix,) = standing.matrices(dataclasses.replace(tables, runs=alone))
    said = outcome.sentence(matrix, styles)
    assert "highest" not in said
    assert said.endswith(f"of {len(alone)} runs; no other method was attempted.")
    assert not matrix.is_compared


def test_the_outcome_names_the_best_methods(tables, styles):
    for matrix in standing.matrices(tables):
        text = outcome.sentence(matrix, styles)
        first, second = text.split("; ")
        share = next(iter(matrix.rows.values()))[standing.ALL].share
        assert f" the highest success rate, {100 * share:.0f} %" in first
        assert all(styles[name].name in first for name in matrix.standing("best"))
        assert all(styles[name].name in second for name in matrix.standing("tied"))


def test_two_methods_are_compared_on_the_instances_that_both_attempted(tables):
    both = next(each for each in paired.comparisons(tables) if each["model"] == "rigid3d")
    a, b = (both["methods"].index(name) for name in ("dcreg-full", "fgr"))
    runs = attempted(tables.runs[tables.runs["model"] == "rigid3d"])
    right = runs.pivot(index="instance_id", columns="method", values="success").astype(bool)
    one, other = right["dcreg-full"], right["fgr"]
    won, lost = int((one & ~other).sum()), int((~one & other).sum())
    assert won > lost
    p_value = binomtest(won, won + lost).pvalue
    assert both["counts"]["right"][a][b] == [won, len(right) - won - lost, lost, p_value]
    assert both["counts"]["right"][b][a] == [lost, len(right) - won - lost, won, p_value]
    # a run without a pose has the worst RMSE, and times count where both are right
    failed = int(runs[runs["method"] == "fgr"]["rmse"].isna().sum())
    assert failed
    assert both["counts"]["rmse"][a][b][0] >= failed
    assert sum(both["counts"]["time"][a][b][:3]) == int((one & other).sum())
    assert both["runs"][b]["right"] == list(right["fgr"][pd.unique(runs["instance_id"])])


def test_own_pairs_have_a_row_per_method_the_best_first(tables):
    runs = tables.runs.assign(test="pair")
    stopped = runs.index[runs["outcome"] == "limited"][0]  # at its limit, before it had a pose
    runs.loc[stopped, ["T_target_source", "rmse", "success"]] = ["", np.nan, False]
    own = dataclasses.replace(tables, runs=runs)
    rows = pair_rows(own)
    assert len(rows) == len(attempted(tables.runs))
    assert {row["verdict"] for row in rows} == {"right", "wrong", "no pose"}
    assert all((row["verdict"] == "no pose") == np.isnan(row["rmse"]) for row in rows)
    assert {row["certificate"] for row in rows} >= {"", "optimal: similarity pose"}
    for _, pair in itertools.groupby(rows, lambda row: (row["model"], row["shape"])):
        ranked = [(row["verdict"] != "right", row["rmse"]) for row in pair]
        known = [each for each in ranked if each[1] == each[1]]
        assert known == sorted(known)
    page = pages.Page(own, {}, Path())
    assert levels_section.context(page) is None
    assert pair_rows(tables) == []


def test_curves_over_time_end_at_the_success_rate(tables, styles):
    runs = attempted(tables.runs[tables.runs["model"] == "rigid3d"])
    figure = profile.build(tables, styles, "rigid3d")
    curves = [trace for trace in figure.traces if trace["meta"]["role"] == "profile"]
    for trace in curves:
        part = runs[runs["method"] == trace["meta"]["method"]]
        share = part["rmse"].notna().mean() if trace["xaxis"] == "x" else part["success"].mean()
        assert trace["y"][-1] == pytest.approx(share)
    ratios = [trace for trace in curves if trace["xaxis"] == "x3"]
    assert min(min(trace["x"]) for trace in ratios) == 1.0
    # also those of a method with another number of pairs refer to the fastest of all methods
    assert all(max(trace["x"]) > 1.0 for trace in ratios if trace["meta"]["method"] != "icp")


def test_profiles_over_work_have_the_methods_that_count_it(tables, styles):
    views = profile.build(tables, styles, "rigid3d").payload["views"]
    runs = attempted(tables.runs[tables.runs["model"] == "rigid3d"])
    assert list(views) == list(profile.WORK.values())
    for column, title in profile.WORK.items():
        drawn = {}
        for trace in views[title]["data"]:
            if (trace["xaxis"], trace["meta"]["role"]) == ("x4", "profile"):
                drawn[trace["meta"]["method"]] = max(trace["x"])
        found = runs[runs["success"].astype(bool)].groupby("method")[column].max().dropna()
        assert 1 < len(drawn) < runs["method"].nunique()
        assert drawn == found.to_dict()
    uncounted = dataclasses.replace(tables, runs=tables.runs.drop(columns=list(profile.WORK)))
    assert list(profile.build(uncounted, styles, "rigid3d").payload["views"]) == [""]


def test_every_curve_of_a_profile_is_within_its_band(tables, styles):
    for view in profile.build(tables, styles, "rigid3d").payload["views"].values():
        for band, curve in zip(view["data"][::2], view["data"][1::2], strict=True):
            assert (band["meta"]["role"], curve["meta"]["role"]) == ("band", "profile")
            high, low = np.split(np.array(band["y"]), 2)
            np.testing.assert_array_less(low[::-1][::2], curve["y"])
            assert (high[::2] >= curve["y"]).all()
            assert set(band["x"]) == set(curve["x"])


@pytest.mark.parametrize("runs", [1, 7, 400])
def test_intervals_of_shares_are_those_of_wilson(runs):
    right = np.arange(runs + 1)
    found = np.transpose(share_intervals(right, runs))
    for count, ends in zip(right.tolist(), found, strict=True):
        expected = binomtest(count, runs).proportion_ci(0.95, method="wilson")
        assert ends == pytest.approx([expected.low, expected.high], abs=1e-12)


def test_outcome_counts_limits_and_missing_poses(tables):
    rows = {(row["model"], row["method"]): row for row in outcome.outcomes(tables)}
    runs = tables.runs[(tables.runs["model"] == "rigid3d") & (tables.runs["method"] == "fgr")]
    row = rows["rigid3d", "fgr"]
    assert row["runs"] == len(runs)
    assert row["failed"] == runs["outcome"].eq("failed").sum() == 2
    assert row["success"] == pytest.approx(runs["success"].sum() / len(runs))
    right = runs["success"].astype(bool)
    penalties = PENALTY * 10.0 * (~right).sum()
    assert row["time"] == pytest.approx((runs["time_solve_s"][right].sum() + penalties) / len(runs))
    assert row["certified"] is None
    assert ("similarity2d", "fgr") not in rows  # never attempted
    success = [r["success"] for r in outcome.outcomes(tables) if r["model"] == "similarity2d"]
    assert success == sorted(success, reverse=True)


def test_methods_that_receive_the_true_pairs_come_last(tables):
    best = outcome.outcomes(tables)[0]
    cards = {
        name: {**card, "options": {"front_end": "oracle"}} if name == best["method"] else card
        for name, card in tables.cards.items()
    }
    changed = dataclasses.replace(tables, provenance={**tables.provenance, "methods": cards})
    ranked = [r["method"] for r in outcome.outcomes(changed) if r["model"] == best["model"]]
    assert len(ranked) > 1
    assert ranked[-1] == best["method"]


def test_first_screen_shows_what_was_run(html):
    shown = re.sub(r"<[^>]*>", " ", html.split('class="run"')[1].split("</dl>")[0])
    for text in ("fish-like, glyph-like of demo", "98", "10 s per run", "0.05 of the longest side",
                 "1 and 0.5 × the true pairs"):  # fmt: skip
        assert text in shown
    assert html.index('id="outcomes"') < html.index('id="accounting"')


def test_ledger_is_on_the_first_page_of_its_experiment(small):
    _, page = small
    about = [claim for claim in ledger().claims if claim.experiment == "paper2d"]
    assert all(f"<code>{claim.id}</code>" in page for claim in about)
    assert page.index('class="tally"') < page.index('id="outcomes"')
    assert "<code>low-3d</code>" not in page


def test_a_run_at_its_limit_shows_the_limit_and_leads_to_its_view(html):
    text = html.split('id="unfinished"')[1].split("</table>")[0]
    assert "hit its limit of 10 s (made-up bound)" in text
    assert "–" not in re.findall(r'class="reason">([^<]*)', text)
    assert re.search(r'href="#run=[0-9a-f]{8}"', text)


def test_the_page_shows_the_limit_that_a_run_hit(small):
    """A search that ended by its boxes did not meet the seconds."""
    _, page = small
    first = page.split('class="run"')[1].split("</dl>")[0]
    n_methods = len(report_fixture.CARDS)
    assert f"10 s per run; 8 to 700 boxes per search for 2 of {n_methods} methods" in first
    assert "10 s, 700 boxes or initial poses" in page.split('id="parameters"')[1]

    unfinished = page.split('id="unfinished"')[1].split("</table>")[0]
    for limit in ("700 boxes or initial poses", "8 boxes or initial poses"):
        assert f"hit its limit of {limit} (made-up bound)" in unfinished
    assert unfinished.count("hit its limit of 10 s") == 1  # the third method that bounds


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, "1 × the true pairs"),
        (
            {"n_inliers": [90, 90]},
            "1 × the true pairs (in canny: × the pairs that the dataset prescribes)",
        ),
        (
            {"n_source": [400, 100], "n_inliers": [20, 5]},
            "1 × the true pairs; in proportion for methods that receive fewer points",
        ),
    ],
)
def test_the_given_number_of_pairs_is_described(changes, words):
    made = {"n_inliers_ratio": 1.0, "instance_id": "i", "test": "canny", "n_inliers_true": 20}
    runs = pd.DataFrame({"n_source": [100, 100], "n_inliers": [20, 20], **changes}).assign(**made)
    assert outcome._prior(runs) == words


def test_a_method_may_be_called_nan(folder, tmp_path):
    first = str(Tables.load(folder).runs["method"].iloc[0])
    there = broken(folder, tmp_path, lambda table: table.replace({"method": {first: "nan"}}))
    runs = pd.read_parquet(there / "runs.parquet").replace({"method": {first: "nan"}})
    runs.to_parquet(there / "runs.parquet")
    assert "nan" in list(Tables.load(there).accounting["method"])


def test_parameters_that_do_nothing_are_not_printed():
    card = {
        "parameters": {"noise_factor": 1.0, "threshold": "given"},
        "options": {"threshold": "paper"},
    }
    assert "noise_factor" in {name for name, *_ in parameters(card)}
    shown = {name for name, *_ in parameters(card | {"idle_options": ["noise_factor"]})}
    assert shown == {"limits", "n_inliers", "threshold"}


def test_variants_of_one_method_look_different(styles):
    one, other = styles["dcreg-full"], styles["dcreg-half"]
    assert one.light == other.light
    assert one.marker != other.marker
    assert one.dash != other.dash
    assert {one.name, other.name} == {"DC-Reg [dcreg-full]", "DC-Reg [dcreg-half]"}


def test_a_method_looks_the_same_in_every_experiment(tables, styles):
    without = dataclasses.replace(tables, runs=tables.runs[tables.runs["method"] != "dcreg-full"])
    fewer = theme.method_styles(without)
    assert "dcreg-full" not in fewer
    for label, style in fewer.items():
        for look in ("light", "dark", "marker", "dash"):
            assert getattr(style, look) == getattr(styles[label], look), label


# Colours in linear RGB as people without red, green or blue cones see them: Machado, Oliveira, Fernandes,
# "A Physiologically-based Model for Simulation of Color Vision Deficiency", IEEE TVCG 15(6), 2009,
# severity 1.0.
VISION = {
    "normal": np.eye(3),
    "protanopia": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216],
         [-0.003882, -0.048116, 1.051998]]
    ),
    "deuteranopia": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413],
         [-0.011820, 0.042940, 0.968881]]
    ),
    "tritanopia": np.array(
        [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602],
         [0.004733, 0.691367, 0.303900]]
    ),
}  # fmt: skip


@pytest.mark.parametrize("vision", VISION)
def test_colours_of_families_differ_for_everybody_and_are_legible(vision):
    cards = [registry.read_card(name) for name in registry.names()]
    families = sorted({card.color for card in cards})
    assert 6 < len(families) < 12
    assert {card.marker for card in cards} <= set(theme.MARKERS)
    assert len({(card.color, card.marker) for card in cards}) == len(cards)
    for surface, background in theme.SURFACE.items():
        shown = [theme.on_surface(color, surface) for color in families]
        assert all(theme.contrast(color, background) >= 3 for color in shown)
        seen = [theme.hex_of(VISION[vision] @ theme.linear_rgb(color)) for color in shown]
        for one, other in itertools.combinations(seen, 2):
            assert theme.difference(one, other) > 0.08, (surface, one, other)


def test_variants_differ_in_every_experiment_and_look_the_same_in_all(tables):
    seen = {}
    for path in sorted(CONFIGS.glob("*.yaml")):
        methods = load(path.stem).methods
        cards = {
            method.name: registry.read_card(method.baseline).model_dump()
            | {"baseline": method.baseline, "options": method.options}
            | {"n_inliers_ratio": method.n_inliers_ratio}
            for method in methods
        }
        names = display_names(methods)
        runs = pd.DataFrame({"method": list(cards), "display_name": [names[key] for key in cards]})
        many = dataclasses.replace(tables, runs=runs, provenance={"methods": cards})
        styles = theme.method_styles(many)
        looks = {key: (style.light, style.marker, style.dash) for key, style in styles.items()}
        assert len(set(looks.values())) == len(cards), path.stem
        assert {key: style.name for key, style in styles.items()} == names
        assert not any(key in name for key, name in names.items() if "-" in key), path.stem
        for name, look in looks.items():
            # the list of scans sets options of methods that keep their names
            plain = not cards[name]["options"]
            assert seen.setdefault((name, plain), look) == look, (path.stem, name)
    assert len(seen) > 200


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (theme.number(0.012345), "0.0123"),
        (theme.number(123456.0), "123456"),
        (theme.number(0.0), "0"),
        (theme.number(float("inf")), "∞"),
        (theme.number(float("nan")), "–"),
        (theme.number(1.5e-7), "1.50e-07"),
        (theme.integer(float("nan")), "–"),
        (theme.seconds(0.0000123), "12.3 µs"),
        (theme.seconds(0.25), "250 ms"),
        (theme.seconds(90.0), "90.0 s"),
        (theme.seconds(600.0), "10.0 min"),
        (theme.percent(0.891), "89 %"),
        (theme.integer(12345), "12\u202f345"),
        (theme.sortable(float("inf")), "Infinity"),
        (theme.sortable(None), ""),
    ],
)
def test_formats(text, expected):
    assert text == expected


def test_packed_numbers_are_valid_json():
    packed = pages.pack_json({"a": [float("nan"), float("inf"), np.float64(1 / 3), np.int64(2)]})
    assert json.loads(packing.unpack(packed)) == {"a": [None, None, 0.333333, 2]}


def test_a_figure_is_one_file_that_is_found(small, tmp_path, monkeypatch):
    (tmp_path / "mine.py").write_text(
        "from reports.figures import levels\n\n"
        "POSITION, CAPTION, DRAWN = 1, 'My caption.', ('median',)\n\n"
        "def build(tables, styles):\n"
        "    runs = levels.prepare(tables, 'similarity2d')\n"
        "    return levels.assemble('mine', 'My figure', runs, styles)\n"
    )
    monkeypatch.setattr(standalone, "__path__", [*standalone.__path__, str(tmp_path)])
    tables = Tables.load(small[0])
    page = pages.Page(tables, theme.method_styles(tables), tmp_path / "figures")
    try:
        first = figures.context(page)["figures"][0]
    finally:
        sys.modules.pop("reports.figures.standalone.mine", None)
    assert (first["figure"].title, first["caption"]) == ("My figure", "My caption.")
    assert (tmp_path / "figures" / "mine.svg").is_file()
