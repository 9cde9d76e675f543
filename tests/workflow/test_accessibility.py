"""Every kind of page on a phone and a screen, light and dark: no barrier, error, request or overprint."""

from __future__ import annotations

import numpy as np
import pytest

from dcreg import Trace, plot_registration, plot_sweep
from tests.browsing import barriers, errors, needs_browser, open_page, overprinted, requests, view
from tests.browsing import wait as wait_for
from tests.results import event, made_result, made_sweep

pytestmark = needs_browser

VIEWS = [(width, scheme) for width in (420, 1400) for scheme in ("light", "dark")]


@pytest.fixture(scope="module")
def pages(tmp_path_factory, made_report):
    """One page of each kind."""
    from reports import claims
    from reports.ledger.book import ledger
    from reports.ledger.judging import judge
    from tests.unit.claim_fixture import evidence, runs_of

    folder = tmp_path_factory.mktemp("pages")
    found = evidence(runs_of("paper"), runs_of("rival"), runs_of("half"))
    cloud = np.random.default_rng(0).random((100, 3))
    history = [event("bound", "search", t, 9 * t, 0.02 * t, 0.5) for t in range(1, 9)]
    result = made_result(model="rigid3d", T_target_source=np.eye(4), trace=Trace(history))
    plot_registration(cloud, cloud, result, folder / "register.html")
    plot_sweep(made_sweep(), folder / "sweep.html")
    return {
        "report": made_report / "index.html",
        "claims": claims.write(ledger(), judge(ledger(), found), found, folder),
        "register": folder / "register.html",
        "sweep": folder / "sweep.html",
    }


def draw_all(browser) -> None:
    """Open all that is folded, and wait until the figures below are drawn."""
    browser.execute_script(
        "document.querySelectorAll('main details').forEach(d => { d.open = true })"
    )
    count = browser.execute_script("return document.querySelectorAll('.plot').length")
    for at in range(count):
        browser.execute_script(f"document.querySelectorAll('.plot')[{at}].scrollIntoView()")
        wait_for(browser, f"document.querySelectorAll('.plot')[{at}].querySelector('.main-svg')")


@pytest.mark.parametrize("kind", ["report", "claims", "register", "sweep"])
def test_page_has_no_barrier_and_fits_phone_and_screen(browser, pages, kind):
    view(browser, *VIEWS[0])
    open_page(browser, pages[kind])
    draw_all(browser)
    for width, scheme in VIEWS:
        view(browser, width, scheme)
        assert browser.execute_script("return document.documentElement.scrollWidth") <= width
        assert barriers(browser) == []
    assert errors(browser) == []
    folder = pages[kind].parent.as_uri()
    assert {url for url in requests(browser) if not url.startswith(folder)} == set()


@pytest.mark.parametrize("kind", ["register", "sweep"])
def test_legends_and_titles_of_plots_print_over_nothing_on_a_phone(browser, pages, kind):
    view(browser, 420, "light")
    open_page(browser, pages[kind])
    draw_all(browser)
    assert browser.execute_script("return document.querySelectorAll('.legendtext').length") > 2
    assert overprinted(browser) == []
