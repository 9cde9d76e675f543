"""A page in a headless browser: its size and theme, its requests, what it draws, what axe-core finds."""

from __future__ import annotations

import json
import shutil
import time
from pathlib import Path

import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
DRIVER = shutil.which("chromedriver")

needs_browser = [
    pytest.mark.browser,
    pytest.mark.skipif(
        not (CHROMIUM and DRIVER),
        reason="chromium or chromedriver is missing: apt-get install chromium chromium-driver",
    ),
]


def start(profile: Path):
    """Start a browser that logs its requests and messages."""
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for argument in (
        "--headless=new", "--no-sandbox", "--disable-gpu", "--no-first-run",
        "--disable-background-networking", "--disable-component-update", "--disable-sync",
        "--enable-unsafe-swiftshader",  # 3D without a graphics card
        f"--user-data-dir={profile}",
    ):  # fmt: skip
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    driver = webdriver.Chrome(options=options, service=Service(DRIVER))
    driver.set_script_timeout(60)
    return driver


def view(browser, width: int, scheme: str) -> None:
    size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    media = {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", media)


def open_page(browser, path: Path) -> None:
    """Open a file, and forget what was logged before; the previous page stops loading first."""
    browser.get("about:blank")
    browser.get_log("performance")
    browser.get_log("browser")
    browser.get(path.as_uri())


def errors(browser) -> list[dict]:
    """Return the messages of the console that are errors."""
    return [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"]


def requests(browser) -> set[str]:
    """Return the addresses asked for, apart from data inside the page."""
    messages = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    urls = {
        message["params"]["request"]["url"]
        for message in messages
        if message["method"] == "Network.requestWillBeSent"
    }
    return {url for url in urls if not url.startswith(("data:", "blob:"))}


def wait(browser, script: str, seconds: float = 60):
    """Return the value of `script` once it is true."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if value := browser.execute_script(f"return {script}"):
            return value
        time.sleep(0.1)
    raise AssertionError(f"still false after {seconds} s: {script}")


def show(browser, element: str, script: str):
    """Return `script` once true; keeps `element` in view, which figures drawn above it move."""
    view_of = f"{element}.scrollIntoView({{ behavior: 'instant' }})"
    return wait(browser, f"({view_of}, {script})")


def barriers(browser, *rules: str) -> list[str]:
    """Return the serious and critical findings of axe-core, with the first element of each."""
    from axe_selenium_python import Axe

    axe = Axe(browser)
    if not browser.execute_script("return Boolean(window.axe)"):
        axe.inject()
    drawings = {"exclude": [["svg"]]}  # thousands of elements, without text that axe judges
    chosen = {"runOnly": list(rules)} if rules else {}
    found = axe.run(drawings, {"resultTypes": ["violations"], **chosen})["violations"]
    return [
        f"{one['id']}: {one['nodes'][0]['html'][:200]}"
        for one in found
        if one["impact"] in ("serious", "critical")
    ]


# Titles of axes and names in legends, each with the tick label or title of its figure that it covers.
_OVERPRINTED = """
const overlap = (a, b) => Math.min(a.right, b.right) - Math.max(a.left, b.left) > 1
  && Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top) > 1;
return [...document.querySelectorAll('.js-plotly-plot')].flatMap((plot) => {
  const all = (selector) => [...plot.querySelectorAll(selector)]
    .map((text) => [text.textContent, text.getBoundingClientRect()]);
  const titles = all('text[class*=title], .legendtext');
  const labels = all('[class*=tick] text, text[class*=title]');
  return titles.flatMap(([title, box]) => labels
    .filter(([label, other]) => label !== title && overlap(box, other))
    .map(([label]) => `${title} over ${label}`));
});
"""


def overprinted(browser) -> list[str]:
    """Return titles and legends of figures that print over tick labels or other titles."""
    return browser.execute_script(_OVERPRINTED)
