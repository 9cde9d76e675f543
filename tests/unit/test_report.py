"""The report without a browser: checks on the tables, the queries, formats, and the file."""

from __future__ import annotations

import base64
import gzip
import json
import re
import sys
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

sys.path.insert(0, str(Path(__file__).parent))
import report_fixture

from reports import theme
from reports.build import build
from reports.figures import attribution, levels
from reports.page import pack_json
from reports.tables import ReportError, Tables, attempted, row_names, thin_trace
from workflows.attribution import VERDICTS
from workflows.records import SchemaError


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return report_fixture.write_tables(tmp_path_factory.mktemp("made-up") / "tables")


@pytest.fixture(scope="module")
def tables(folder) -> Tables:
    return Tables.load(folder)


@pytest.fixture(scope="module")
def html(folder) -> str:
    out = folder.parent / "report" / "index.html"
    build(folder, out)
    return out.read_text(encoding="utf-8")


class Page(HTMLParser):
    """Everything in the page that could cause a request, and its packed files."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.links: list[str] = []
        self.files: dict[str, bytes] = {}
        self._file: str | None = None
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        self.links += [v for k, v in attrs if k in ("src", "href", "srcset", "data") and v]
        self._file = values.get("data-file")

    def handle_data(self, data):
        if self._file:
            self.files[self._file] = gzip.decompress(base64.b64decode(data))
            self._file = None


def broken(folder: Path, tmp_path: Path, edit) -> Path:
    """A copy of the tables with an edited accounting ledger."""
    for path in folder.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    ledger = pd.read_csv(tmp_path / "accounting.csv")
    edit(ledger).to_csv(tmp_path / "accounting.csv", index=False)
    return tmp_path


def test_page_is_one_small_file_that_asks_for_nothing(html):
    assert len(html) < 4_000_000
    assert all(link.startswith("#") for link in Page(html).links)
    assert "default-src 'none'" in html
    assert not re.search(r"url\(|@import", html.split("<body>")[0])


def test_page_holds_the_very_tables(html, folder):
    files = Page(html).files
    for name in ("runs.csv", "traces.csv", "accounting.csv", "provenance.json"):
        assert files[name] == (folder / name).read_bytes()


def test_page_shows_the_accounting(html, tables):
    shown = re.sub(r"<[^>]*>|\s+", " ", html.split('class="headline"')[1].split("</p>")[0])
    numbers = [int(n) for n in re.findall(r"\d+", shown)]
    assert numbers[0] == len(tables.runs) == sum(numbers[1:])
    assert len(numbers) == 6


def test_messages_are_escaped(html):
    assert "signal 11 &lt;b&gt;segfault&lt;/b&gt;" in html
    assert "<b>segfault</b>" not in html


def test_print_figures_are_beside_the_page_and_in_it(html, folder):
    for name in ("levels-similarity2d.svg", "levels-rigid3d-mean.pdf"):
        content = (folder.parent / "report" / "figures" / name).read_bytes()
        assert Page(html).files[name] == content
    assert (
        b"<svg" in (folder.parent / "report" / "figures" / "levels-similarity2d.svg").read_bytes()
    )


def test_same_tables_give_the_same_page(html, folder, tmp_path):
    build(folder, tmp_path / "index.html")
    assert (tmp_path / "index.html").read_text(encoding="utf-8") == html


def test_dropped_run_in_the_ledger_is_refused(folder, tmp_path):
    def drop(ledger):
        ledger.loc[0, "finished"] -= 1
        return ledger

    with pytest.raises(ReportError, match=r"accounting\.csv.*planned = 63.*sum to 62"):
        Tables.load(broken(folder, tmp_path, drop))


def test_ledger_that_disagrees_with_the_runs_is_refused(folder, tmp_path):
    def shift(ledger):
        ledger.loc[0, ["finished", "limited"]] += [-1, 1]
        return ledger

    with pytest.raises(ReportError, match="finished = 55 but runs has 56"):
        Tables.load(broken(folder, tmp_path, shift))


def test_missing_method_in_the_ledger_is_refused(folder, tmp_path):
    with pytest.raises(ReportError, match="teaser"):
        Tables.load(broken(folder, tmp_path, lambda table: table[table["method"] != "teaser"]))


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
    counts = attribution.count(tables.runs, tables.methods)
    assert (counts[list(VERDICTS)].sum(axis=1) == counts["started"]).all()
    assert counts["started"].sum() == len(attempted(tables.runs))
    assert counts.loc["fgr", "no_pose"] == 1 + 1  # one crash in each model


def test_certified_intervals_reach_methods_without_bounds_and_keep_to_their_scope(tables):
    flat = tables.runs[tables.runs["model"] == "similarity2d"]
    counts = attribution.count(flat, tables.methods)
    assert counts.loc["icp", "certified"] == counts.loc["icp", "started"]
    assert counts.loc["icp", "proven"] < counts.loc["dcreg-full", "proven"]
    assert (counts["objective_regret"] <= counts["regret_at_most"]).loc[["icp", "dcreg-full"]].all()
    solid = tables.runs[tables.runs["model"] == "rigid3d"]  # bounds are of another scope there
    assert not attribution.count(solid, tables.methods)["certified"].any()


def test_page_prints_every_parameter(html):
    shown = re.sub(r"<[^>]*>|\s+", " ", html.split('id="parameters"')[1].split("</section>")[0])
    for text in ("made_up_weight", "0.25", "0.5", "2 σ (nobody)"):
        assert text in shown


def test_level_figure_shows_the_numbers_of_the_table(tables):
    styles = theme.method_styles(tables)
    view = levels.build(tables, styles, "similarity2d").payload["views"]["rmse"]
    trace = next(
        t for t in view["data"] if t["meta"] == {"role": "median", "method": "icp"}
    )  # fmt: skip
    runs = tables.runs
    cell = runs[
        (runs.method == "icp") & (runs.test == "deformation") & (runs["shape"] == "fish-like")
    ]
    expected = cell.groupby("level")["rmse"].median()
    assert trace["x"] == list(expected.index)
    np.testing.assert_allclose(trace["y"], expected)
    assert "n = 3" in trace["text"][0]
    assert cell["run_id"].iloc[0] in "".join(trace["text"])


@pytest.mark.parametrize("statistic", ["median", "mean"])
def test_print_figure_cuts_no_data(tables, statistic):
    styles = theme.method_styles(tables)
    figure = levels.draw_static(tables, styles, "similarity2d", statistic)
    lines = [(axes, line) for axes in figure.axes for line in axes.lines]
    assert len(lines) > 20
    for axes, line in lines:
        low, high = axes.get_ylim()
        assert (line.get_ydata() >= low).all()
        assert (line.get_ydata() <= high).all()


def test_levels_with_a_limited_run_have_open_markers(tables):
    styles = theme.method_styles(tables)
    view = levels.build(tables, styles, "similarity2d").payload["views"]["rmse"]
    trace = next(t for t in view["data"] if t["meta"] == {"role": "median", "method": "bilinear"})
    assert [symbol.endswith("-open") for symbol in trace["marker"]["symbol"]] == [
        False,
        False,
        True,
    ]


def test_variants_of_one_method_look_different(tables):
    styles = theme.method_styles(tables)
    one, other = styles["dcreg-full"], styles["dcreg-half"]
    assert (one.light, one.dash) != (other.light, other.dash)
    assert {one.name, other.name} == {"dcreg-full", "dcreg-half"}  # shared display name


def test_method_colours_are_legible_in_both_themes(tables):
    for style in theme.method_styles(tables).values():
        assert theme.contrast(style.light, theme.SURFACE["light"]) >= 3
        assert theme.contrast(style.dark, theme.SURFACE["dark"]) >= 3


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (theme.number(0.012345), "0.0123"),
        (theme.number(123456.0), "123456"),
        (theme.number(0.0), "0"),
        (theme.number(float("inf")), "∞"),
        (theme.number(float("nan")), "–"),
        (theme.number(1.5e-7), "1.50e-07"),
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
    packed = pack_json({"a": [float("nan"), float("inf"), np.float64(1 / 3), np.int64(2)]})
    assert json.loads(gzip.decompress(base64.b64decode(packed))) == {"a": [None, None, 0.333333, 2]}
