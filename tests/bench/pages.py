"""Seconds until a report can be read, and until its table of 10,000 runs answers a filter.

``python -m tests.bench.pages`` prints the median of some openings in headless Chromium. Nothing else
should run. `tests/workflow/test_report_browser.py` asserts the work behind both, which does not vary.
"""

from __future__ import annotations

import json
import shutil
import statistics
import tempfile
from pathlib import Path

from dcreg.plot import packing
from reports.build import build
from reports.page import DATA, pack_json
from tests import browsing
from tests.unit.report_fixture import write_tables

MANY = 10_000
OPENINGS = 7
READABLE = """
const [page] = performance.getEntriesByType("navigation");
const paint = performance.getEntriesByName("first-contentful-paint")[0];
return page.loadEventEnd && paint && [page.domContentLoadedEventEnd, paint.startTime];
"""
# Chooses the next method in the filter of the runs.
FILTER = """
const choice = document.querySelector("#runs-filter [data-choice=method]");
choice.selectedIndex = (choice.selectedIndex + 1) % choice.options.length;
choice.dispatchEvent(new Event("input", { bubbles: true }));
"""


def with_many_runs(report: Path, out: Path, count: int = MANY) -> Path:
    """Copy a report, repeat its runs until its table has `count` rows; return the path of its page."""
    shutil.copytree(report, out)
    path = out / DATA / "runs.js"
    table = json.loads(packing.unpack(path.read_text("ascii").split('"')[3]))
    columns = table["values"]
    times = -(-count // len(columns["run"]))
    table["values"] = {name: (column * times)[:count] for name, column in columns.items()}
    table["values"]["run"] = [f"{number:08x}" for number in range(count)]
    path.write_text(f'store("runs", "{pack_json(table)}");\n', "ascii")
    return out / "index.html"


def readable_ms(browser, page: Path) -> list[float]:
    """Return the median times until the document is parsed, and until its first text is painted."""
    found = []
    for _ in range(OPENINGS):
        browsing.open_page(browser, page)
        found.append(browsing.wait(browser, f"(() => {{{READABLE}}})()"))
    return [statistics.median(times) for times in zip(*found, strict=True)]


def filter_ms(browser, page: Path) -> float:
    """Return the median of the times that the table of runs states for a filter."""
    browsing.open_page(browser, page)
    took = "document.getElementById('runs-table').dataset.took"
    browsing.show(browser, "document.getElementById('runs')", took)
    found = []
    for _ in range(OPENINGS):
        browser.execute_script(f"delete {took}; {FILTER}")
        found.append(float(browsing.wait(browser, took)))
    return statistics.median(found)


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        build(write_tables(root / "report" / "tables"), root / "report" / "index.html")
        trivial = root / "trivial.html"
        trivial.write_text("<!doctype html><title>t</title><p>text", encoding="utf-8")
        browser = browsing.start(root / "profile")
        try:
            browsing.view(browser, 1400, "light")
            many = with_many_runs(root / "report", root / "many")
            for page in (trivial, root / "report" / "index.html", many):
                parsed, painted = readable_ms(browser, page)
                name = page.relative_to(root)
                print(
                    f"{name}: parsed after {parsed / 1e3:.3f} s, painted after {painted / 1e3:.3f} s"
                )
            print(f"filter of {MANY} runs: {filter_ms(browser, many) / 1e3:.3f} s")
        finally:
            browser.quit()


if __name__ == "__main__":
    main()
