"""The pages in a browser: messages, requests, figures, and drawing time."""

import base64
import time
from pathlib import Path

import pytest

from pdhef_logtool.reports.comparison import comparison_page
from pdhef_logtool.reports.pages import write_pages
from pdhef_logtool.results.comparing import compare_runs, figure
from pdhef_logtool.results.opened_run import open_run
from tests.reports.browser import AXE, CHROMIUM, WHY_NOT, Browser, serious
from tests.reports.made_runs import NAMES, drive_tracks, write_run
from tests.reports.test_drive import hostile_run, plan_of
from tests.reports.test_fleet_page import run_of
from tests.results import made_run

pytestmark = [pytest.mark.skipif(CHROMIUM is None, reason=WHY_NOT), pytest.mark.slow]
#: A picture of one point.
_DOT = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJggg=="
)
_DRAWN = "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"


@pytest.fixture(scope="module")
def browser():
    with Browser() as made:
        yield made


def page_of(folder: Path) -> Path:
    file = write_pages(open_run(folder)).pages[0].file
    assert file is not None
    return file


@pytest.fixture(autouse=True)
def _usual_window(browser):
    browser.show()


def opened(browser: Browser, file: Path) -> None:
    """Open a page and assert that it requests only its file and prints no message."""
    browser.open(file)
    assert browser.messages == []
    assert browser.requests == [file.resolve().as_uri()]


def test_a_page_draws_all_figures_zooms_all_of_them_and_says_nothing(browser, tmp_path):
    file = page_of(write_run(tmp_path, drive_tracks(60.0, NAMES)))
    opened(browser, file)
    places = browser.value("document.querySelectorAll('[data-figure]').length")
    assert browser.value("document.querySelectorAll('.canvas canvas').length") == places == 9
    browser.drag('[data-figure="sideslip"] .u-over', 0.1, 0.2)
    browser.value(_DRAWN)
    low, high = (float(s) for s in browser.value("document.querySelector('.range').textContent").split()[0:3:2])
    assert (low, high) == pytest.approx((6.0, 12.0), abs=0.3)
    browser.value("document.querySelector('button.jump').click()")
    at = float(browser.value("document.querySelector('button.jump').textContent").split()[0])
    low, high = (float(s) for s in browser.value("document.querySelector('.range').textContent").split()[0:3:2])
    assert low <= at <= high
    assert high - low == pytest.approx(5.0, abs=0.1)
    shown = "[...document.querySelectorAll('.legend .item')].filter(n => !n.hidden).length"
    before = browser.value(shown)
    browser.value("document.querySelector('.toggles input').click()")
    browser.wait_for(f"{shown} > {before}")
    browser.value("document.querySelector('button.whole').click()")
    assert browser.value("document.querySelector('.range').textContent") == "0.0 to 60.0 s (whole drive)"
    assert browser.messages == []


@pytest.mark.parametrize("kind", ["short", "standstill", "truthless", "failed", "one stamp"])
def test_odd_drives_say_nothing_in_the_console(browser, tmp_path, kind):
    given = {"short": {"duration_s": 3.0}, "standstill": {"speed_m_s": 0.0}, "truthless": {"truth": False}}
    given["one stamp"] = {"duration_s": 0.0}
    tracks = [] if kind == "failed" else drive_tracks(**given[kind])
    opened(browser, page_of(write_run(tmp_path, tracks, outcome="failed: for a test" if kind == "failed" else "ok")))


def test_hostile_names_run_nothing(browser, tmp_path):
    opened(browser, page_of(hostile_run(tmp_path / "out")))
    assert "ran" not in browser.value("document.title").split()
    assert browser.value("document.images.length") == 0
    assert browser.value("document.scripts.length") == browser.value(
        "document.querySelectorAll('script[type]').length + 3"
    )
    browser.value("document.querySelectorAll('.toggles input').forEach(n => n.click())")
    browser.drag('[data-figure="sideslip"] .u-over', 0.1, 0.2)
    time.sleep(0.2)
    assert browser.messages == []
    assert len(browser.requests) == 1


def test_a_script_that_came_into_the_page_would_not_run(browser, tmp_path):
    file = page_of(write_run(tmp_path, drive_tracks(3.0)))
    text = file.read_text().replace("</main>", "<script>document.title='ran'</script><img src='x.png'></main>")
    (file.parent / "x.png").write_bytes(_DOT)
    file.write_text(text.replace("<h1>", "<h1 onclick=\"document.title='ran'\">"))
    browser.open(file)
    browser.value("document.querySelector('h1').click()")
    assert browser.value("document.title") != "ran"
    assert len([m for m in browser.messages if "Content Security Policy" in m]) >= 2
    assert browser.value("document.images[0].naturalWidth") == 0


def test_the_keyboard_zooms(browser, tmp_path):
    opened(browser, page_of(write_run(tmp_path, drive_tracks(60.0))))
    press = (
        "(key) => document.querySelector('[data-figure=sideslip] .canvas')"
        ".dispatchEvent(new KeyboardEvent('keydown', {key, bubbles: true, cancelable: true}))"
    )
    seen = "document.querySelector('.range').textContent"
    for key, text in (("+", "15.0 to 45.0 s"), ("ArrowRight", "22.5 to 52.5 s"), ("-", "0.0 to 60.0 s (whole drive)")):
        browser.value(f"({press})('{key}')")
        assert browser.value(seen) == text


@pytest.mark.skipif(AXE is None, reason="axe-core is not installed (pip install axe-core-python)")
def test_axe_finds_nothing_serious_and_nothing_is_wider_than_the_screen(browser, tmp_path):
    run = open_run(write_run(tmp_path / "made", drive_tracks(3.0), plan=plan_of("PASS", "FAIL", "INCONCLUSIVE")))
    cells = [
        {"speed": i % 3, "ay": i // 3, "seconds": 3.0**i, "scored": 9, "sideslip_mse_rad2": 1e-4} for i in range(9)
    ]
    space = {"speed_edges_m_s": [0, 5, 10], "ay_edges_m_s2": [0, 1, 2], "cells": cells}
    drives = {f"d{i}": {"errors": (0.001 * (1 + i), 0.0015), "operating_space": space} for i in range(12)}
    fleet = open_run(run_of(tmp_path / "fleet", drives, {"bad": "/x/bad.mcap: expected a log, got 3 bytes"}))
    write_pages(fleet)
    drive = write_pages(run).pages[0].file
    a, b = (made_run.write_run(tmp_path / str(x), {f"d{i}": 0.001 * x * (1 + i) for i in range(10)}) for x in (1, 2))
    comparison = tmp_path / "comparison.html"
    comparison.write_bytes(comparison_page(compare_runs(open_run(a), open_run(b), (figure(limit=0.05),))))
    fleet_page, failed_page = fleet.folder / "report.html", fleet.folder / "logs/bad/report.html"
    figures = {drive: 8, fleet_page: 3, failed_page: 0, comparison: 2}
    for scheme, width, ground in (("dark", 390, "rgb(20, 24, 29)"), ("light", 1280, "rgb(255, 255, 255)")):
        browser.show(width, scheme=scheme)
        for page, least in figures.items():
            opened(browser, page)
            assert browser.value("document.querySelectorAll('.canvas canvas').length") >= least
            assert browser.value("getComputedStyle(document.body).backgroundColor") == ground
            assert serious(browser) == []
            assert browser.value("document.documentElement.scrollWidth") <= width
