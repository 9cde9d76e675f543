"""Pages and images of registrations and sweeps; pages need no network."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from plotly.offline import get_plotlyjs

from dcreg import (
    Event,
    InputError,
    Status,
    SweepResult,
    Trace,
    plot_registration,
    plot_sweep,
)
from dcreg.plot import registration as plot
from dcreg.plot.packing import unpack
from dcreg.plot.page import write_page
from dcreg.plot.sweep import sweep_figures
from tests.results import made_result


def result(dim, lower=0.5, **changes):
    """A hypothetical result: a shift by one along x, two matched pairs, four events."""
    T = np.eye(dim + 1)
    T[0, dim] = 1.0
    events = [
        Event("start", "search", 0.0, 1, 4, 1, -np.inf, np.inf),
        Event("bound", "search", 0.5, 20, 80, 9, 0.25, 2.0),
        Event("end", "search", 1.0, 40, 160, 0, lower, 1.0, "time_limit"),
        Event("end", "rotation", 2.0, 7, 7, 0, 30.0, 50.0, "optimal"),
    ]
    values = {
        "status": Status.TIME_LIMIT,
        "model": "rigid3d" if dim == 3 else "similarity2d",
        "T_target_source": T,
        "T_certified": T,
        "assignment": np.array([[0, 1], [2, 0]]),
        "n_inliers": 2,
        "lower_bound": lower,
        "gap_tol": 0.25,
        "certificate_scope": "translation in norm space",
        "trace": Trace(events),
    }
    return made_result(**values | changes)


@pytest.fixture(params=[2, 3])
def case(request):
    generator = np.random.default_rng(0)
    source, target = generator.random((4, request.param)), generator.random((3, request.param))
    return source, target, result(request.param)


def coordinates(trace):
    axes = [trace.x, trace.y] + ([trace.z] if trace.type == "scatter3d" else [])
    return np.column_stack([np.asarray(axis, dtype=float) for axis in axes])


def traces(figure, name):
    return [trace for trace in figure.data if trace.name == name]


def kept(values):
    return [value for value in values if value is not None]


def test_clouds_before_and_after(case):
    source, target, outcome = case
    figures = plot.figures(source, target, outcome)
    shift = np.eye(source.shape[1])[0]
    for caption, cloud in (("before", source), ("after", source + shift)):
        (drawn,) = traces(figures[caption], "source")
        np.testing.assert_allclose(coordinates(drawn), cloud, atol=1e-4)
        (drawn,) = traces(figures[caption], "target")
        np.testing.assert_allclose(coordinates(drawn), target, atol=1e-4)


def test_pair_lines_join_the_matched_points(case):
    source, target, outcome = case
    (lines,) = traces(plot.figures(source, target, outcome)["after"], "matched pairs")
    drawn = coordinates(lines).reshape(2, 3, -1)
    shift = np.eye(source.shape[1])[0]
    np.testing.assert_allclose(drawn[:, 0], source[[0, 2]] + shift, atol=1e-4)
    np.testing.assert_allclose(drawn[:, 1], target[[1, 0]], atol=1e-4)
    assert np.isnan(drawn[:, 2]).all()  # a break between pairs


def test_history_shows_the_finite_bounds_of_all_stages_in_order(case):
    figures = plot.figures(*case)
    for caption, x in (
        ("bounds against time", [0.5, 1.0, None, 2.0, None]),
        ("bounds against nodes", [20, 40, None, 47, None]),
    ):
        figure = figures[caption]
        (lower,), (upper,) = traces(figure, "lower bound"), traces(figure, "upper bound")
        assert (list(lower.x), list(lower.y)) == (x, [0.25, 0.5, None, 30.0, None])
        assert (list(upper.x), list(upper.y)) == (x, [2.0, 1.0, None, 50.0, None])
        assert kept(upper.text) == ["search", "search", "", "rotation", ""]
        *bands, line = figure.layout.shapes
        assert [(band.name, band.x0, band.x1) for band in bands] == [
            ("search", 0.0, x[1]),
            ("rotation", x[1], x[3]),
        ]
        assert line.y0 == 0.75  # the upper bound less the tolerance
        words = {annotation.text for annotation in figure.layout.annotations}
        assert words == {"search", "rotation"}


def test_a_narrow_stage_is_named_only_by_its_points(case):
    source, target, outcome = case
    first = Event("bound", "start", 0.01, 0, 3, 0, 0.0, 5.0)
    outcome = replace(outcome, trace=Trace([first, *outcome.trace]))
    figure = plot.figures(source, target, outcome)["bounds against time"]
    assert "start" not in {annotation.text for annotation in figure.layout.annotations}
    (upper,) = traces(figure, "upper bound")
    assert (upper.text[0], upper.y[0]) == ("start", 5.0)


def test_page_states_the_result_once(case, tmp_path):
    source, target, outcome = case
    covariance = 1e-4 * np.eye(4 if source.shape[1] == 2 else 6)
    outcome = replace(outcome, warnings=["too <far>; take more"], covariance=covariance)
    path = tmp_path / "page.html"
    plot_registration(source, target, outcome, path, names=("a/scan & model.ply", "b.txt"))
    html = path.read_text(encoding="utf-8")
    html = re.sub(r"(?s)<(script|style).*?</\1>", "", html)
    for words in (
        "<title>registration of scan &amp; model.ply to b.txt</title>",
        '<meta name="viewport" content="width=device-width',
        "time_limit: best pose so far, not certified",
        "<li>too &lt;far&gt;; take more</li>",
        "<dt>uncertainty</dt><dd>standard deviations if the pairs are right: rotation 0.573 ",
        "<dt>gap</dt><dd>0.5 (tolerance 0.25); the lower bound is 50.0 % of the upper bound</dd>",
        "<dt>scope of bounds</dt><dd>translation in norm space</dd>",
    ):
        assert html.count(words) == 1


def test_lines_of_words_wrap_and_a_matrix_keeps_its_columns(tmp_path):
    path = tmp_path / "page.html"
    facts = [("pose", "  1 -2e-3\n  0   nan"), ("pairs", "3, chosen\nresiduals: 1: 0.1, 2: 0.2")]
    write_page(path, "title", "status", {}, facts=facts)
    html = path.read_text(encoding="utf-8")
    assert '<div class="matrix"><dt>pose</dt><dd tabindex="0">1 -2e-3\n0   nan</dd>' in html
    assert '<div class="lines"><dt>pairs</dt><dd>3, chosen\nresiduals: 1: 0.1, 2: 0.2</dd>' in html


def test_page_is_one_file_for_both_themes_and_always_the_same(case, tmp_path):
    pages = [tmp_path / name for name in ("a.html", "b.html")]
    for path in pages:
        plot_registration(*case, path)
    html, again = (path.read_text(encoding="utf-8") for path in pages)
    assert html == again
    assert "prefers-color-scheme: dark" in html
    for figure in plot.figures(*case).values():  # the page sets the background
        assert figure.layout.paper_bgcolor == figure.layout.plot_bgcolor == "rgba(0, 0, 0, 0)"
    packed = dict(re.findall(r'<script type="text/plain" id="(\w+)">([^\n]*)</script>', html))
    assert unpack(packed["plotly"]) == get_plotlyjs().encode()
    assert len(json.loads(unpack(packed["data"]))) == 4
    assert not re.search(r"<(script|link)[^>]+(src|href)=", html)


def test_page_of_large_clouds_and_long_histories_has_at_most_two_megabytes(tmp_path):
    cloud = np.random.default_rng(0).normal(1e6, 1.0, (20_000, 3))  # far from the origin
    pairs = np.repeat(np.arange(len(cloud)), 2).reshape(-1, 2)
    values = np.random.default_rng(1).random(5000)
    trace = Trace(
        [Event("bound", "rigid", v, at, at, 1, v, 1 + v) for at, v in enumerate(values.tolist())]
    )
    plot_registration(cloud, cloud, result(3, assignment=pairs, trace=trace), tmp_path / "a.html")
    assert (tmp_path / "a.html").stat().st_size < 2_000_000


def test_large_clouds_are_thinned_and_say_so(monkeypatch):
    monkeypatch.setattr(plot, "_MAX_POINTS", 10)
    cloud = np.random.default_rng(0).random((35, 2))
    figure = plot.figures(cloud, cloud, result(2))["before, at most 10 points and pairs shown"]
    (before,) = traces(figure, "source (1 of 4 points)")
    np.testing.assert_allclose(coordinates(before), cloud[::4], atol=1e-4)
    assert list(before.customdata) == list(range(0, 35, 4))


def test_without_history_and_pairs(tmp_path):
    cloud = np.zeros((1, 2))
    empty = result(2, trace=Trace(), assignment=np.empty((0, 2), dtype=int))
    plot_registration(cloud, cloud, empty, tmp_path / "a.html")
    assert (tmp_path / "a.html").stat().st_size > 0


# --- sweep ----------------------------------------------------------------------------------------


def sweep(dim=2, lower=(0.0, 0.8, 15.0, 150.0), upper=(0.5, 1.0, 20.0, 160.0)):
    """A hypothetical sweep over 2, 4, 6 and 8 pairs, of which 4 fit."""
    results = [
        result(dim, low, upper_bound=high, n_inliers=k, objective=high, status=Status.OPTIMAL)
        for k, low, high in zip((2, 4, 6, 8), lower, upper, strict=True)
    ]
    return SweepResult(results, [None, 4, 6, 8])


def test_sweep_draws_residuals_with_their_bands():
    drawn = [trace for figure in sweep_figures(sweep()).values() for trace in figure.data]
    bands = [trace for trace in drawn if trace.fill == "toself"]
    residual, following = [trace for trace in drawn if trace.fill != "toself"]
    k = np.array([2, 4, 6, 8])
    np.testing.assert_allclose(residual.x, k)
    np.testing.assert_allclose(residual.y, np.sqrt(np.array([0.5, 1.0, 20.0, 160.0]) / k))
    np.testing.assert_allclose(bands[0].y[4:], np.sqrt(np.array([0.0, 0.8, 15.0, 150.0]) / k)[::-1])
    np.testing.assert_allclose(following.x, [3, 5, 7])
    np.testing.assert_allclose(following.y, np.sqrt([0.25, 9.5, 70.0]))
    np.testing.assert_allclose(bands[1].y[:3], np.sqrt([0.5, 9.6, 72.5]))
    np.testing.assert_allclose(bands[1].y[3:], np.sqrt([65.0, 7.0, 0.15]))


def test_sweep_calls_its_choice_a_suggestion():
    for figure in sweep_figures(sweep()).values():
        (line,) = figure.layout.shapes
        assert (line.x0, line.name) == (4, "suggestion: 4 pairs")
    for figure in sweep_figures(sweep(upper=(2.0, 16.0, 54.0, 128.0))).values():
        assert not figure.layout.shapes


def test_sweep_in_3d_shows_the_poses_next_to_the_norms():
    for dim, expected in ((2, [0, 0]), (3, [1, 0])):
        figures = sweep_figures(sweep(dim)).values()
        assert [len(traces(figure, "RMSE of the final pose")) for figure in figures] == expected


def test_sweep_page_contains_the_printed_table(tmp_path):
    found = sweep(dim=3)
    plot_sweep(found, tmp_path / "a.html", names=("a.ply", "b.ply"))
    html = (tmp_path / "a.html").read_text(encoding="utf-8")
    html = re.sub(r"(?s)<(script|style).*?</\1>", "", html)
    assert "<title>sweep of a.ply to b.ply</title>" in html
    assert "4 of 4 numbers of pairs certified (bounds on: translation in norm space)" in html
    headings, rows = found.table()
    for cell in [*headings, *rows[1]]:
        assert f">{cell}</t" in html
    for note in found.notes():
        assert note in html


@pytest.mark.parametrize(("suffix", "start"), [(".html", b"<!doctype html>"), (".png", b"\x89PNG")])
def test_sweep_files_by_suffix(tmp_path, suffix, start):
    for name in ("a", "b"):
        plot_sweep(sweep(), tmp_path / (name + suffix))
    content = (tmp_path / f"a{suffix}").read_bytes()
    assert content.startswith(start)
    assert content == (tmp_path / f"b{suffix}").read_bytes()


def test_sweep_as_svg_keeps_its_words(tmp_path):
    for name in ("a.svg", "b.svg"):
        plot_sweep(sweep(dim=3), tmp_path / name)
    text = (tmp_path / "a.svg").read_text(encoding="utf-8")
    for words in ("pairs to match", "suggestion: 4 pairs", "RMSE of the final pose"):
        assert words in text
    assert text == (tmp_path / "b.svg").read_text(encoding="utf-8")


def test_sweep_of_one_cardinality_can_be_drawn(tmp_path):
    only = SweepResult(sweep().results[:1], [None])
    for name in ("a.html", "a.png"):
        plot_sweep(only, tmp_path / name)
        assert (tmp_path / name).stat().st_size > 0


def test_sweep_refuses_other_kinds(tmp_path):
    with pytest.raises(
        InputError, match=r"a\.gif: the suffix '.gif' is not supported; use .html or"
    ):
        plot_sweep(sweep(), tmp_path / "a.gif")
