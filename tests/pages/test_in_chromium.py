"""All pages in a real browser: no network, no messages on the console, keyboard, contrast, and rules of accessibility."""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from browser import Browser
from run_reports import RUNS

from mosaico_ingest.destinations.store import Store
from mosaico_ingest.pages.browser import BrowserServer
from mosaico_ingest.pages.run import run_page
from mosaico_ingest.pages.sequence import sequence_page

pytestmark = pytest.mark.slow

AXE = Path(sys.prefix) / "axe" / "node_modules" / "axe-core" / "axe.min.js"
"""The accessibility checker that `./dev check` installs with npm; it is not part of the project."""
PAGES = (*(f"run-{name}" for name in RUNS), "quickstart_drive", "hostile", "list", "missing")
SMALLEST_CONTRAST = 4.5
LOW_CONTRAST = """
(() => {
  const channels = (text) => text.match(/[\\d.]+/g).map(Number);
  const luminance = ([r, g, b]) => {
    const linear = [r, g, b].map((v) => (v /= 255) <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2];
  };
  const ground = (element) => {
    for (let at = element; at; at = at.parentElement) {
      const color = channels(getComputedStyle(at).backgroundColor);
      if (color.length < 4 || color[3] > 0.99) return color;
    }
    return [255, 255, 255];
  };
  const found = [];
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walker.nextNode()) {
    const element = walker.currentNode.parentElement;
    if (!walker.currentNode.textContent.trim() || !element.checkVisibility() || element.closest("svg, button:disabled, script")) continue;
    const [a, b] = [channels(getComputedStyle(element).color), ground(element)].map(luminance);
    const ratio = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
    if (ratio < LEAST) found.push(`${ratio.toFixed(2)} ${walker.currentNode.textContent.trim().slice(0, 40)}`);
  }
  return [...new Set(found)];
})()
""".replace("LEAST", str(SMALLEST_CONTRAST))


@pytest.fixture(scope="module")
def server(store: Store) -> Iterator[BrowserServer]:
    running = BrowserServer(str(store.path))
    thread = threading.Thread(target=running.serve_forever)
    thread.start()
    yield running
    running.shutdown()
    thread.join()
    running.close()


@pytest.fixture(scope="module")
def addresses(
    store: Store, server: BrowserServer, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, str]:
    """The address of each page: files of runs and sequences, and pages of the server."""
    folder = tmp_path_factory.mktemp("pages")
    pages = {f"run-{name}": run_page(report) for name, report in RUNS.items()}
    pages |= {name: sequence_page(store, name) for name in ("quickstart_drive", "hostile")}
    for name, html in pages.items():
        (folder / f"{name}.html").write_text(html)
    files = {name: (folder / f"{name}.html").as_uri() for name in pages}
    return {**files, "list": server.address, "missing": f"{server.address}sequence/nothing"}


def unroll(browser: Browser) -> None:
    """Open all details and wait until their content is there."""
    browser.evaluate(
        "(async () => { for (const each of document.querySelectorAll('details')) each.open = true;"
        " await new Promise(done => setTimeout(done, 500)); })()"
    )


@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
@pytest.mark.parametrize("name", PAGES)
def test_page_needs_no_network_and_reports_no_error(
    browser: Browser, addresses: dict[str, str], name: str, *, dark: bool
) -> None:
    browser.open(addresses[name], dark=dark)
    unroll(browser)
    expected = ["Failed to load resource: the server responded with a status of 404 (Not Found)"]
    assert browser.console == (expected if name == "missing" else [])
    assert [url for url in browser.requests if not url.startswith("data:image/")] == [addresses[name]]
    assert browser.evaluate("document.title") != "broken"
    assert browser.evaluate("document.documentElement.scrollWidth <= innerWidth")


@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
@pytest.mark.parametrize("name", PAGES)
def test_page_text_has_enough_contrast(
    browser: Browser, addresses: dict[str, str], name: str, *, dark: bool
) -> None:
    browser.open(addresses[name], dark=dark)
    unroll(browser)
    assert browser.evaluate(LOW_CONTRAST) == []


@pytest.mark.skipif(not AXE.exists(), reason="axe-core is not installed; ./dev check installs it with npm")
@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
@pytest.mark.parametrize("name", PAGES)
def test_page_satisfies_the_rules_of_axe(
    browser: Browser, addresses: dict[str, str], name: str, *, dark: bool
) -> None:
    browser.open(addresses[name], dark=dark)
    unroll(browser)
    browser.evaluate(AXE.read_text(encoding="utf-8"))
    result: Any = browser.evaluate("axe.run().then((result) => JSON.stringify(result.violations))")
    violations = [
        (one["id"], [node["html"][:120] for node in one["nodes"]][:3]) for one in json.loads(result)
    ]
    assert violations == []


@pytest.mark.parametrize("name", ["run-large", "quickstart_drive", "list"])
def test_page_fits_a_narrow_window(browser: Browser, addresses: dict[str, str], name: str) -> None:
    browser.open(addresses[name], width=400, height=800)
    assert browser.evaluate("document.documentElement.scrollWidth <= innerWidth")


def focused(browser: Browser) -> str:
    """Return tag and text of the element with the focus."""
    return str(
        browser.evaluate(
            "(() => { const at = document.activeElement;"
            " return `${at.tagName} ${at.id} ${at.textContent.trim().slice(0, 30)}`; })()"
        )
    )


def press_until(browser: Browser, wanted: str) -> None:
    """Press Tab until an element with this text has the focus."""
    for _ in range(60):
        browser.press("Tab")
        if wanted in focused(browser):
            return
    pytest.fail(f"{wanted} is not reached with the Tab key")


def test_keyboard_first_stop_skips_to_the_content(browser: Browser, addresses: dict[str, str]) -> None:
    browser.open(addresses["run-large"])
    browser.press("Tab")
    assert "Skip to the content" in focused(browser)
    browser.press("Enter")
    assert focused(browser).startswith("MAIN content")


def test_keyboard_opens_a_packed_recording(browser: Browser, addresses: dict[str, str]) -> None:
    browser.open(addresses["run-large"])
    assert browser.evaluate("document.getElementById('r400')") is None  # it is not on the first page
    press_until(browser, "INPUT words")
    for character in "drive_400":
        browser.press(character)
    assert browser.evaluate("document.getElementById('shown').textContent") == "1 recording (of 500)"
    press_until(browser, "SUMMARY  drive_400")
    browser.press("Enter")
    browser.evaluate("new Promise(done => setTimeout(done, 300))")
    tracks = "document.querySelectorAll('#r400 td.track svg').length"
    assert browser.evaluate(tracks) == 6


def test_list_of_recordings_has_pages_and_orders(browser: Browser, addresses: dict[str, str]) -> None:
    browser.open(addresses["run-large"])
    shown = "document.getElementById('shown').textContent"
    names = "[...document.querySelectorAll('summary .name')].map(each => each.textContent)"
    assert browser.evaluate(shown) == "1 to 50 of 500 recordings"
    browser.evaluate("document.getElementById('next').click()")
    assert browser.evaluate(shown) == "51 to 100 of 500 recordings"
    browser.evaluate(
        "(() => { const order = document.getElementById('order'); order.value = 'name';"
        " order.dispatchEvent(new Event('change')); })()"
    )
    assert browser.evaluate(names) == [f"drive_{at:03}" for at in range(50)]
    browser.evaluate("document.getElementById('problems').click()")
    assert browser.evaluate(shown) == "26 recordings (of 500)"


def test_link_to_a_packed_recording_shows_and_opens_it(browser: Browser, addresses: dict[str, str]) -> None:
    browser.open(f"{addresses['run-large']}#r444")
    assert browser.evaluate("document.getElementById('r444').open")
    assert browser.evaluate("document.querySelectorAll('#r444 td.track svg').length") == 6


def test_plots_are_drawn_in_the_colors_of_the_theme(browser: Browser, addresses: dict[str, str]) -> None:
    browser.open(addresses["quickstart_drive"], height=4000)
    unroll(browser)
    assert int(browser.evaluate("document.querySelectorAll('.plot canvas').length")) >= 8
    before = browser.screenshot()
    browser.evaluate("document.getElementById('theme').click()")
    browser.evaluate("new Promise(done => setTimeout(done, 500))")
    assert browser.evaluate("document.documentElement.dataset.theme") == "dark"
    assert int(browser.evaluate("document.querySelectorAll('.plot canvas').length")) >= 8
    assert browser.screenshot() != before


def test_search_on_the_list_of_sequences(
    browser: Browser, addresses: dict[str, str], server: BrowserServer
) -> None:
    browser.open(addresses["list"])
    press_until(browser, "INPUT")
    for character in "hostile":
        browser.press(character)
    browser.press("Enter")
    time.sleep(1)  # a script would end with the page
    assert browser.evaluate("location.search") == "?q=hostile"
    links = browser.evaluate("[...document.querySelectorAll('tbody a')].map(each => each.href)")
    assert links == [f"{server.address}sequence/hostile"]
