"""The page of `results --html` and `plot --out x.html` in a headless Chromium: it sorts numbers as numbers, filters,
and loads nothing; skipped where there is no browser."""

from __future__ import annotations

import json

import pytest

from quadexp.report.draw import page_of
from quadexp.report.frame import SweepFrame
from quadexp.report.tables import page_of as table_page
from quadexp.report.view import view
from tests.report.sweeps import swept
from tests.report.test_html_browser import browser, pytestmark, show  # noqa: F401

SIZES = ((1280, 900), (760, 900), (390, 800))
COLUMN = (
    "return [...document.querySelectorAll('tbody tr:not([hidden])')].map(row => row.cells[arguments[0]].textContent)"
)


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pages")
    asked = ["controller=nominal_mpc,perfect_mpc", "controller.nodes=5,10,20,40", "seed=0,1"]

    def error(config):
        lost = (config.controller.name, config.controller.nodes, config.seed) == ("nominal_mpc", 5, 1)
        return None if lost else 0.01 * config.controller.nodes * (1 + config.seed)

    frame = SweepFrame.read(swept(folder / "r", asked, error))
    names = ["controller", "controller.nodes", "seed", "outcome", "mean_error"]
    (folder / "table.html").write_text(table_page(frame, names, "a <i>title</i>"), encoding="utf-8")
    (folder / "plot.html").write_text(page_of(view(frame, x="controller.nodes"), "a plot"), encoding="utf-8")
    return folder


def opened(browser, path, width=1280, height=900):  # noqa: F811
    return show(browser, path, width, height, replay=False)


def requests(browser):  # noqa: F811
    messages = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    sent = [m["params"]["request"]["url"] for m in messages if m["method"] == "Network.requestWillBeSent"]
    return [url for url in sent if not url.startswith(("file:", "data:"))]


@pytest.mark.parametrize("name", ["table.html", "plot.html"])
@pytest.mark.parametrize("size", SIZES)
def test_it_opens_without_network_or_errors_in_three_widths(browser, pages, name, size):  # noqa: F811
    page = opened(browser, pages / name, *size)
    assert not requests(page) and not [e for e in page.get_log("browser") if e["level"] == "SEVERE"]
    wide = page.execute_script("return document.documentElement.scrollWidth - document.documentElement.clientWidth")
    assert wide <= 0, "the table scrolls in its box, not the page"


def test_headings_sort_numbers_as_numbers_and_back(browser, pages):  # noqa: F811
    page = opened(browser, pages / "table.html")
    nodes, error = page.find_elements("css selector", "th button")[1::3]
    nodes.click()
    assert page.execute_script(COLUMN, 1) == [str(n) for n in (5, 10, 20, 40) for _ in range(4)]
    nodes.click()
    assert page.execute_script(COLUMN, 1)[:5] == ["40"] * 4 + ["20"]
    heads = page.execute_script("return [...document.querySelectorAll('th')].map(h => h.getAttribute('aria-sort'))")
    assert heads == [None, "descending", None, None, None]
    error.click()
    shown = [float(text) for text in page.execute_script(COLUMN, 4)]
    assert shown == sorted(shown) and len(shown) == 16 and page.title == "a <i>title</i>"


def test_words_filter_rows(browser, pages):  # noqa: F811
    page = opened(browser, pages / "table.html")
    page.find_element("css selector", "input").send_keys("NOMINAL lost")
    assert page.execute_script(COLUMN, 0) == ["nominal_mpc"] and page.execute_script(COLUMN, 1) == ["5"]
    assert page.find_element("css selector", ".found").text == "1 of 16 rows"


def test_the_figure_is_drawn_beside_its_numbers(browser, pages):  # noqa: F811
    page = opened(browser, pages / "plot.html")
    box = page.execute_script(
        "const b = document.querySelector('figure svg').getBoundingClientRect(); return [b.width, b.height]"
    )
    assert min(box) > 200 and len(page.execute_script(COLUMN, 0)) == 8
