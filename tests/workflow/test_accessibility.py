"""Every kind of page on a phone and a screen, light and dark: no barrier, error, request or overprint."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dcreg import Trace, plot_registration, plot_sweep, register
from dcreg.search import recording
from tests.browsing import (
    barriers,
    errors,
    needs_browser,
    open_page,
    overprinted,
    requests,
    show,
    view,
)
from tests.browsing import wait as wait_for
from tests.results import event, made_result, made_sweep

pytestmark = needs_browser

ARCHIVE = Path(__file__).parents[2] / "reports" / "archive" / "0.2.0"
KINDS = (
    "report", "claims", "history", "register", "sweep", "boxes", "archive", "figures",
)  # fmt: skip
FIGURES = ("method_dc", "paper_2d", "paper_images")  # a drawing, curves, photographs
VIEWS = [(width, scheme) for width in (420, 1400) for scheme in ("light", "dark")]
DEPENDENT = (
    "color-contrast",
    "scrollable-region-focusable",
)  # rules whose result a view can change
# Rows of a table and cards of a list are alike, and axe judges no drawing: a few of each make it faster.
SHORTEN = """
for (const [parent, kept] of [['tbody', 4], ['.cards', 2], ['section:has(> .claim)', 4]]) {
  const lists = [...document.querySelectorAll(parent)];
  lists.flatMap((list) => [...list.children].slice(kept)).forEach((item) => item.remove());
}
for (const figure of document.querySelectorAll('[data-figure]')) {
  delete figure.dataset.drawn; // not drawn again in another theme
  figure.querySelectorAll('.main-svg').forEach((drawing) => drawing.remove());
}
"""


@pytest.fixture(scope="module")
def pages(tmp_path_factory, made_report):
    """One page of each kind."""
    from reports import claims, paper_page
    from reports.archive import pages as archive_pages
    from reports.history import page
    from reports.ledger.book import ledger
    from reports.ledger.judging import judge
    from tests.unit.claim_fixture import evidence, runs_of
    from tests.unit.record_fixture import table, write_record
    from tests.unit.test_paper_figures import write_results

    folder = tmp_path_factory.mktemp("pages")
    found = evidence(runs_of("paper"), runs_of("rival"), runs_of("half"))
    cloud = np.random.default_rng(0).random((100, 3))
    history = [event("bound", "search", t, 9 * t, 0.02 * t, 0.5) for t in range(1, 9)]
    result = made_result(model="rigid3d", T_target_source=np.eye(4), trace=Trace(history))
    plot_registration(cloud, cloud, result, folder / "register.html")
    plot_sweep(made_sweep(), folder / "sweep.html")
    runs = table(np.random.default_rng(0))
    write_record(folder / "v1" / "e", runs)
    write_record(folder / "v2" / "e", runs.assign(n_nodes=runs["n_nodes"] + 1), "2026-01-02")
    return {
        "history": page.build(folder / "history", folder),
        "report": made_report / "index.html",
        "claims": claims.write(ledger(), judge(ledger(), found), found, folder),
        "register": folder / "register.html",
        "sweep": folder / "sweep.html",
        "boxes": page_of_boxes(folder / "boxes.html"),
        "archive": archive_pages._index(ARCHIVE, folder),
        "figures": paper_page.build(
            folder / "figures", [write_results(folder / "results")], FIGURES
        ),
    }


def page_of_boxes(path: Path) -> Path:
    """Write the page of the boxes of a small search."""
    from reports import boxes

    rng = np.random.default_rng(2)
    with recording() as recorder:
        found = register(*rng.random((2, 8, 2)), n_inliers=7, model="similarity2d")
    told = {
        "method": "DC-Reg (ours)", "test": "made-up", "trial": 0, "status": found.status,
        "stored": "same", "lower_bound": found.lower_bound, "upper_bound": found.objective,
    }  # fmt: skip
    path.write_text(boxes._render("1f", told, recorder, "similarity2d"), encoding="utf-8")
    return path


def draw(browser) -> None:
    """Open all that is folded, and wait for the first and the last figure."""
    browser.execute_script(
        "document.querySelectorAll('main details').forEach(d => { d.open = true })"
    )
    for at in (0, -1):
        plot = f"[...document.querySelectorAll('.plot')].at({at})"
        if browser.execute_script(f"return Boolean({plot})"):
            show(browser, plot, f"{plot}.querySelector('.main-svg')")


@pytest.mark.parametrize("kind", KINDS)
def test_page_has_no_barrier_and_prints_over_nothing(browser, pages, kind):
    view(browser, *VIEWS[0])
    open_page(browser, pages[kind])
    draw(browser)
    assert overprinted(browser) == []
    browser.execute_script(SHORTEN)
    for number, (width, scheme) in enumerate(VIEWS):
        view(browser, width, scheme)
        assert browser.execute_script("return document.documentElement.scrollWidth") <= width
        assert barriers(browser, *(DEPENDENT if number else ())) == []  # all rules in the first
    assert errors(browser) == []
    folder = pages[kind].parent.as_uri()
    assert {url for url in requests(browser) if not url.startswith(folder)} == set()


def test_tables_of_pages_without_scripts_are_cards_on_a_phone(browser, pages):
    """Their headings, which nothing can sort by, are not shown."""
    view(browser, 420, "light")
    for kind in ("archive", "claims", "history"):
        open_page(browser, pages[kind])
        widths = browser.execute_script(
            "return [...document.querySelectorAll('table')].filter(t => t.offsetParent)"
            ".map(t => [t.scrollWidth, t.parentElement.clientWidth, t.tHead.offsetHeight])"
        )
        assert widths, kind
        assert all(own <= room and not head for own, room, head in widths), kind


def test_view_of_a_run_has_no_barrier(browser, pages):
    view(browser, 420, "dark")
    open_page(browser, pages["report"])
    browser.execute_script("location.hash = 'gallery'")
    show(browser, "document.getElementById('gallery')", "document.querySelector('a.view')")
    browser.execute_script("location.hash = document.querySelector('a.view').hash")
    wait_for(browser, "document.getElementById('run').dataset.drawn")
    browser.execute_script(SHORTEN)
    assert barriers(browser) == []
    assert browser.execute_script("return document.documentElement.scrollWidth") <= 420


def test_a_page_without_scripts_switches_its_theme(browser, pages):
    background = "return getComputedStyle(document.body).backgroundColor"
    seen = []
    for scheme in ("light", "dark"):
        view(browser, 1400, scheme)
        open_page(browser, pages["history"])
        before = browser.execute_script(background)
        browser.find_element("css selector", ".theme").click()
        seen.append((before, browser.execute_script(background)))
    (light, dark), switched = seen
    assert light != dark
    assert switched == (dark, light)
