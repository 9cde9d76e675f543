"""The browser of runs in a real browser: filters, sorting, the view of a run, wrong runs."""

from __future__ import annotations

import pytest

from tests.browsing import needs_browser, requests, show, view, wait
from tests.workflow.test_report_browser import choose, drawn, page  # noqa: F401 (a fixture)

pytestmark = needs_browser


@pytest.fixture
def runs(page):  # noqa: F811
    show(page, "document.getElementById('runs')", "$('#runs-table').dataset.took")
    return page


def rows(runs, column: str) -> list[str]:
    return runs.execute_script(
        "const heads = [...$('#runs-table').tHead.rows[0].cells];"
        "const at = heads.findIndex(c => c.dataset.column === arguments[0]);"
        "return [...$('#runs-table').tBodies[0].rows].map(r => r.cells[at].textContent)",
        column,
    )


def set_filter(runs, selector: str, value: str) -> None:
    runs.execute_script(
        "const c = $(`#runs-filter ${arguments[0]}`);"
        "c.value = [...(c.options ?? [])].find(o => o.text === arguments[1])?.value ?? arguments[1];"
        "c.dispatchEvent(new Event('input', {bubbles: true}))",
        selector,
        value,
    )


def counted(runs) -> str:
    return wait(runs, "$('#runs-count').textContent").replace("\u202f", "")


def opened(runs, run: str) -> None:
    runs.execute_script("location.hash = `run=${arguments[0]}`", run)
    wait(runs, f"$('#run').dataset.drawn === '{run}'")


def first_run(runs, **filters: str) -> str:
    for name, value in filters.items():
        set_filter(runs, f"[data-choice={name}]", value)
    wait(runs, "$('#runs-table').tBodies[0].rows.length")
    return rows(runs, "run")[0]


def test_filters_narrow_the_table_and_100_rows_are_in_the_page(runs):
    assert counted(runs) == "1–100 of 270 runs"  # those that were started
    assert len(rows(runs, "run")) == 100
    runs.execute_script("$('[data-page=\"1\"]').click()")
    wait(runs, "$('#runs-count').textContent.startsWith('101–200')")
    set_filter(runs, "[data-choice=method]", "ICP")
    set_filter(runs, "[data-choice=answer]", "wrong")
    wait(runs, "$('#runs-table').tBodies[0].rows.length < 63")
    assert set(rows(runs, "answer")) == {"wrong"}
    assert set(rows(runs, "method")) == {"ICP"}
    set_filter(runs, "[data-least=rmse]", "0.34")
    wait(runs, "$$('#runs-table tbody tr').length > 0")
    assert min(map(float, rows(runs, "rmse"))) >= 0.34
    assert float(runs.execute_script("return $('#runs-table').dataset.took")) < 1000
    set_filter(runs, "[data-words]", "no such run")
    wait(runs, "$('#runs-count').textContent === 'no run fits'")


def test_a_click_on_a_heading_sorts_all_runs(runs):
    for way in ("ascending", "descending"):
        runs.execute_script("$('#runs-table [data-column=rmse] button').click()")
        wait(runs, f"$('#runs-table [data-column=rmse]').ariaSort === '{way}'")
        values = list(map(float, filter(lambda text: text != "–", rows(runs, "rmse"))))
        assert values == sorted(values, reverse=way == "descending")
        assert len(values) == 100


def test_a_hidden_method_has_no_rows(runs):
    set_filter(runs, "[data-choice=method]", "ICP")
    wait(runs, "$('#runs-count').textContent.includes('63')")
    runs.execute_script("document.querySelector('[data-toggle-method=icp]').click()")
    wait(runs, "$('#runs-count').textContent === 'no run fits'")


def test_the_view_of_a_run_shows_poses_pairs_bounds_and_replay(runs):
    run = first_run(runs, method="Term-wise BnB (reconstructed)", status="time_limit")
    opened(runs, run)
    text = runs.find_element("id", "run").text
    assert "status time_limit: hit its limit of 10 s (made-up bound)" in text
    assert f"make replay RUN={run}" in text
    names = runs.execute_script("return $('#run-overlay').data.map(t => t.name)")
    assert {"target", "source, pose found", "source, reference pose"} <= set(names)
    assert "pairs beyond the noise bound" in names
    names = runs.execute_script("return $('#run-history').data.map(t => t.name)")
    assert {"lower bound", "upper bound", "gap", "error of the incumbent", "tolerance"} <= set(
        names
    )
    before = runs.execute_script("return $('#run-history').data[0].x.at(-1)")
    choose(runs, "#run-axis", "c.value = 'nodes'")
    wait(runs, "$('#run-history').layout.xaxis.title.text === 'nodes'")
    assert runs.execute_script("return $('#run-history').data[0].x.at(-1)") > before
    choose(runs, '[data-part="before"]', "c.checked = true")
    wait(runs, "$('#run-overlay').data.some(t => t.name === 'source as given')")
    runs.execute_script("$('[data-run-step=\"1\"]').click()")
    wait(
        runs,
        f"location.hash !== '#run={run}' && $('#run').dataset.drawn === location.hash.slice(5)",
    )
    runs.execute_script("$('#run-close').click()")
    wait(runs, "!$('#run').open && location.hash === ''")


def test_first_bounds_far_from_the_last_ones_do_not_flatten_the_others(runs):
    assert runs.execute_script("return farFrom([null, 5, 2, 1])") == [0, 2]
    assert runs.execute_script("return farFrom([3, 2, 1])") is None
    assert runs.execute_script("return near([-1, 2], 5, -10)") == {"range": [-12, 6]}
    assert runs.execute_script("return near(undefined, 5)") == {}
    opened(runs, first_run(runs, method="Term-wise BnB (reconstructed)", status="time_limit"))
    history = "$('#run-history')"
    runs.execute_script("clipped = () => ({ range: [-1e9, 3] })")
    before = runs.execute_script(f"return {history}.layout.yaxis3.range")
    choose(runs, "#run-axis", "c.value = 'nodes'")
    wait(runs, f"{history}.layout.yaxis.range[0] === -1e9")
    assert runs.execute_script(f"return {history}.layout.yaxis3.range") == before


def test_a_run_in_3d_can_be_turned_and_a_missing_one_is_named(runs):
    set_filter(runs, "[data-choice=model]", "rigid3d")
    opened(runs, first_run(runs, answer="right"))
    kinds = runs.execute_script("return $('#run-overlay').data.map(t => t.type)")
    assert set(kinds) == {"scatter3d"}
    runs.execute_script("location.hash = 'run=0000'")
    wait(runs, "!$('#run-missing').hidden")
    assert "no run 0000" in runs.find_element("id", "run").text


def test_an_address_with_a_run_opens_it(runs):
    run = first_run(runs, answer="wrong")
    runs.execute_script("location.hash = `run=${arguments[0]}`", run)
    runs.refresh()
    wait(runs, f"$('#run').open && $('#run').dataset.drawn === '{run}'")


def test_the_page_in_one_file_shows_a_run_too(runs, made_report):
    run = first_run(runs, answer="wrong")
    requests(runs)
    runs.get(f"{(made_report / 'whole.html').as_uri()}#run={run}")
    wait(runs, f"$('#run').open && $('#run').dataset.drawn === '{run}'")
    assert requests(runs) == {(made_report / "whole.html").as_uri()}


def test_wrong_runs_of_a_method_are_a_gallery(runs):
    choose(runs, "#wrong-method", "c.value = 'fgr'")
    wait(runs, "$('#wrong-count').textContent.includes('largest error first')")
    links = wait(runs, "$$('#wrong-cards a').map(a => a.hash)")
    runs.execute_script("$('#wrong-cards a').click()")
    wait(runs, f"$('#run').open && location.hash === '{links[0]}'")
    assert runs.find_element("id", "run-verdict").text.startswith(("wrong", "no pose"))


def test_a_point_of_a_scatter_opens_its_run(runs):
    element = drawn(runs, "attribution")
    run = runs.execute_script(f"return {element}.data[0].customdata[0]")
    point = f"{{ customdata: '{run}', data: {{ meta: {{}} }} }}"
    runs.execute_script(f"{element}.emit('plotly_click', {{ points: [{point}] }})")
    wait(runs, f"$('#run').open && location.hash === '#run={run}'")


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_nothing_is_wider_than_a_phone(runs, scheme):
    view(runs, 420, scheme)
    run = first_run(runs, answer="wrong")
    assert runs.execute_script("return document.documentElement.scrollWidth") <= 420
    opened(runs, run)
    edges = runs.execute_script(
        "return $$('#run h2, #run p, #run dd, #run select, #run .run-plot').filter(e => e.offsetParent)"
        ".map(e => e.getBoundingClientRect().right)"
    )
    assert max(edges) <= 420
