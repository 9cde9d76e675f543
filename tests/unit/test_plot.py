"""The page of one registration: what it draws, and that it needs no network."""

import re

import numpy as np
import pytest

from dcreg import Event, InputError, Result, Status, SweepResult, Trace, plot


def result(dim, lower=0.5, **changes):
    """A made-up result: a shift by one along x, two matched pairs, three events."""
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
        "mode": "paper",
        "bound": "paper",
        "T_target_source": T,
        "T_certified": T,
        "assignment": np.array([[0, 1], [2, 0]]),
        "n_inliers": 2,
        "lower_bound": lower,
        "upper_bound": 1.0,
        "gap_tol": 0.25,
        "certificate_scope": "translation in norm space",
        "objective": 1.0,
        "objective_certified": 1.0,
        "n_nodes": 40,
        "n_assignments": 160,
        "time_setup_s": 0.1,
        "time_solve_s": 2.0,
        "trace": Trace(events),
    }
    return Result(**values | changes)


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


def test_clouds_before_and_after(case):
    source, target, outcome = case
    figure = plot.figure(source, target, outcome)
    before, after = traces(figure, "source")
    np.testing.assert_allclose(coordinates(before), source)
    shift = np.eye(source.shape[1])[0]
    np.testing.assert_allclose(coordinates(after), source + shift)
    for drawn in traces(figure, "target"):
        np.testing.assert_allclose(coordinates(drawn), target)


def test_pair_lines_join_the_matched_points(case):
    source, target, outcome = case
    (lines,) = traces(plot.figure(source, target, outcome), "matched pairs")
    drawn = coordinates(lines).reshape(2, 3, -1)
    shift = np.eye(source.shape[1])[0]
    np.testing.assert_allclose(drawn[:, 0], source[[0, 2]] + shift)
    np.testing.assert_allclose(drawn[:, 1], target[[1, 0]])
    assert np.isnan(drawn[:, 2]).all()  # a break between pairs


def test_history_holds_the_finite_bounds_of_the_search(case):
    figure = plot.figure(*case)
    by_time, by_nodes = traces(figure, "lower bound")
    assert (list(by_time.x), list(by_time.y)) == ([0.5, 1.0], [0.25, 0.5])
    assert (list(by_nodes.x), list(by_nodes.y)) == ([20, 40], [0.25, 0.5])
    for drawn in traces(figure, "upper bound"):
        assert list(drawn.y) == [2.0, 1.0]  # neither infinity nor the rotation's bounds
    heights = {shape.y0 for shape in figure.layout.shapes}
    assert heights == {0.75}  # the upper bound less the tolerance


def test_title_states_status_scope_and_gap(case):
    title = plot.figure(*case).layout.title.text
    for words in ("time_limit", "translation in norm space", "gap 0.5", "tolerance 0.25"):
        assert words in title


def test_page_needs_no_network(case, tmp_path):
    path = tmp_path / "page.html"
    plot.plot_registration(*case, path)
    html = path.read_text(encoding="utf-8")
    assert "Plotly.newPlot" in html
    assert len(html) > 1_000_000  # plotly.js is inside
    assert not re.search(r"<(script|link)[^>]+(src|href)=", html)


def test_same_result_same_page(case, tmp_path):
    for name in ("a.html", "b.html"):
        plot.plot_registration(*case, tmp_path / name)
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()


def test_large_clouds_are_thinned_and_say_so(monkeypatch):
    monkeypatch.setattr(plot, "_MAX_POINTS", 10)
    cloud = np.random.default_rng(0).random((35, 2))
    figure = plot.figure(cloud, cloud, result(2))
    (before, _) = traces(figure, "source (every 4th point)")
    np.testing.assert_allclose(coordinates(before), cloud[::4])
    assert list(before.customdata) == list(range(0, 35, 4))


def test_without_history_and_pairs(tmp_path):
    cloud = np.zeros((1, 2))
    empty = result(2, trace=Trace(), assignment=np.empty((0, 2), dtype=int))
    plot.plot_registration(cloud, cloud, empty, tmp_path / "a.html")
    assert (tmp_path / "a.html").stat().st_size > 0


# --- sweep ----------------------------------------------------------------------------------------


def sweep(dim=2, lower=(0.0, 0.8, 6.0, 29.0), upper=(0.5, 1.0, 8.0, 30.0)):
    """A made-up sweep over 2, 4, 6 and 8 pairs, with an elbow at 4."""
    results = [
        result(dim, low, upper_bound=high, n_inliers=k, objective=high, status=Status.OPTIMAL)
        for k, low, high in zip((2, 4, 6, 8), lower, upper, strict=True)
    ]
    return SweepResult(results, [None, 4, 6, 8])


def test_sweep_draws_residuals_with_their_bands():
    figure = plot.sweep_figure(sweep())
    bands = [trace for trace in figure.data if trace.fill == "toself"]
    residual, following = [trace for trace in figure.data if trace.fill != "toself"]
    k = np.array([2, 4, 6, 8])
    np.testing.assert_allclose(residual.x, k)
    np.testing.assert_allclose(residual.y, np.sqrt(np.array([0.5, 1.0, 8.0, 30.0]) / k))
    np.testing.assert_allclose(bands[0].y[4:], np.sqrt(np.array([0.0, 0.8, 6.0, 29.0]) / k)[::-1])
    np.testing.assert_allclose(following.x, [3, 5, 7])
    np.testing.assert_allclose(following.y, np.sqrt([0.25, 3.5, 11.0]))
    np.testing.assert_allclose(bands[1].y[:3], np.sqrt([0.5, 3.6, 12.0]))
    np.testing.assert_allclose(bands[1].y[3:], np.sqrt([10.5, 2.5, 0.15]))


def test_sweep_calls_the_elbow_a_suggestion():
    figure = plot.sweep_figure(sweep())
    assert {shape.x0 for shape in figure.layout.shapes} == {4}
    texts = [annotation.text for annotation in figure.layout.annotations]
    assert "suggestion: elbow at 4" in texts
    straight = plot.sweep_figure(sweep(upper=(2.0, 16.0, 54.0, 128.0)))
    assert not straight.layout.shapes


def test_sweep_in_space_shows_the_poses_beside_the_norms():
    names = [trace.name for trace in plot.sweep_figure(sweep(dim=3)).data]
    assert "RMSE of the final pose" in names
    assert "RMSE of the final pose" not in [trace.name for trace in plot.sweep_figure(sweep()).data]
    assert "translation in norm space" in plot.sweep_figure(sweep(dim=3)).layout.title.text


@pytest.mark.parametrize(("suffix", "start"), [(".html", b"<!doctype html>"), (".png", b"\x89PNG")])
def test_sweep_files_by_suffix(tmp_path, suffix, start):
    for name in ("a", "b"):
        plot.plot_sweep(sweep(), tmp_path / (name + suffix))
    content = (tmp_path / f"a{suffix}").read_bytes()
    assert content.startswith(start)
    assert content == (tmp_path / f"b{suffix}").read_bytes()


def test_sweep_as_svg_keeps_its_words(tmp_path):
    for name in ("a.svg", "b.svg"):
        plot.plot_sweep(sweep(dim=3), tmp_path / name)
    text = (tmp_path / "a.svg").read_text(encoding="utf-8")
    for words in ("pairs to match", "suggestion: elbow at 4", "RMSE of the final pose"):
        assert words in text
    assert text == (tmp_path / "b.svg").read_text(encoding="utf-8")


def test_sweep_of_one_cardinality_can_be_drawn(tmp_path):
    only = SweepResult(sweep().results[:1], [None])
    for name in ("a.html", "a.png"):
        plot.plot_sweep(only, tmp_path / name)
        assert (tmp_path / name).stat().st_size > 0


def test_sweep_refuses_other_kinds(tmp_path):
    with pytest.raises(InputError, match=r"a\.gif: '.gif' is no kind.*\.html, \.png, \.svg"):
        plot.plot_sweep(sweep(), tmp_path / "a.gif")
