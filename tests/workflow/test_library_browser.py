"""The page of the library in a real browser: opened from a file, without network requests."""

import pytest

from data.library.problem import all_problems
from data.library.record import read_record
from reports.library.page import build
from tests.browsing import barriers, errors, needs_browser, open_page, requests, view, wait

pytestmark = needs_browser


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return build(tmp_path_factory.mktemp("library"))


@pytest.fixture
def page(browser, path):
    """The page freshly opened, wide and light; afterwards no error and no request was made."""
    view(browser, 1400, "light")
    open_page(browser, path)
    wait(browser, "document.querySelector('[data-count]').textContent")
    yield browser
    assert errors(browser) == []
    assert {url.partition("#")[0] for url in requests(browser)} <= {path.as_uri()}


def shown(page):
    return page.execute_script(
        "return [...document.querySelectorAll('#problems tbody tr:not([hidden]) th')]"
        ".map((head) => head.innerText)"
    )


def choose(page, field, value):
    page.execute_script(
        "const f = document.querySelector(arguments[0]); f.value = arguments[1];"
        "f.dispatchEvent(new Event('input', {bubbles: true}))",
        field, value,
    )  # fmt: skip


def test_the_page_says_how_problems_are_proven(page):
    text = page.find_element("css selector", "main").text
    bounds = [read_record(name).best_bound for name in all_problems()]
    enumerated = sum(bound is not None and bound.proof.kind == "enumeration" for bound in bounds)
    assert f"for {enumerated} tiny problems, all matchings were enumerated" in text
    assert text.count("the view states the CPU time of the longest search") == 1


def test_filters_and_sorting_change_the_table(page):
    assert shown(page) == list(all_problems())
    choose(page, "[data-filter=model]", "rigid3d")
    choose(page, "[data-filter=status]", "open")
    choose(page, "[data-least=points]", "60")
    choose(page, "[data-most=overlap]", "0.7")
    expected = [
        name
        for name, problem in all_problems().items()
        if problem.dim == 3
        and read_record(name).status(problem) == "open"
        and max(problem.n_source, problem.n_target) >= 60
        and len(problem.truth.pairs) <= 0.7 * max(problem.n_source, problem.n_target)
    ]
    assert len(expected) > 10
    assert shown(page) == expected
    page.find_elements("css selector", "#problems thead button")[3].click()
    pairs = [all_problems()[name].n_inliers for name in shown(page)]
    assert pairs == sorted(all_problems()[name].n_inliers for name in expected) != pairs[::-1]


@pytest.mark.parametrize(("width", "scheme"), [(1400, "light"), (420, "dark")])
def test_a_problem_has_a_view_that_fits(page, width, scheme):
    view(page, width, scheme)
    choose(page, "[data-filter-text]", "pony-60-noise-03")
    assert barriers(page) == []
    page.find_element("link text", "pony-60-noise-03@1").click()
    wait(page, "document.querySelector('#one canvas')")
    assert barriers(page) == []
    assert not page.find_element("css selector", "#all").is_displayed()
    text = page.find_element("css selector", "#one").text
    assert "proven lower bound" in text
    assert "@misc{dcreg-library-pony-60-noise-03" in text
    pixels = "document.querySelector('#one canvas').toDataURL()"
    before = page.execute_script(f"return {pixels}")
    page.find_element("css selector", "#one canvas").send_keys("\ue014")  # arrow to the right
    assert page.execute_script(f"return {pixels}") != before
    assert page.execute_script("return document.documentElement.scrollWidth") <= width
    page.find_element("partial link text", "All problems").click()
    wait(page, "!document.querySelector('#all').hidden")


def test_a_problem_with_a_recipe_has_a_drawing_or_says_why_not(page):
    page.execute_script("location.hash = 'bunny-60@1'")
    note = wait(page, "document.querySelector('#one .note')?.textContent")
    is_drawn = page.execute_script("return Boolean(document.querySelector('#one svg.still'))")
    assert is_drawn != ("no picture" in note)
    assert page.execute_script("return document.querySelector('#one canvas')") is None
    assert barriers(page) == []
