"""The pages in a headless Chromium; skipped where there is none (test_html.py checks the file itself)."""

import json
import shutil
import time

import pytest

from quadexp.plugins.page.document import page_of as table_page
from quadexp.plugins.page.draw import page_of
from quadexp.plugins.page.report import make_report
from quadexp.plugins.page.view import view
from quadexp.report.frame import SweepFrame
from tests.report.sweeps import swept

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
DRIVER = shutil.which("chromedriver")
pytestmark = pytest.mark.skipif(not (BROWSER and DRIVER), reason="needs chromium and chromedriver on the PATH")
FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--disable-dev-shm-usage",
)  # fmt: skip
COLUMN = (
    "return [...document.querySelectorAll('tbody tr:not([hidden])')].map(row => row.cells[arguments[0]].textContent)"
)
SHOWN = "return [...document.querySelectorAll('#{} [data-metric]')].filter(e => e.offsetHeight).length"


@pytest.fixture(scope="module")
def pages(results, tmp_path_factory):
    """Name -> page: a report, a table that sorts, a figure with its numbers."""
    folder = tmp_path_factory.mktemp("pages")
    make_report(results, folder / "report.html")
    asked = ["controller=nominal_mpc,perfect_mpc", "controller.nodes=5,10,20,40", "seed=0,1"]

    def error(config):
        lost = (config.controller.name, config.controller.nodes, config.seed) == ("nominal_mpc", 5, 1)
        return None if lost else 0.01 * config.controller.nodes * (1 + config.seed)

    frame = SweepFrame.read(swept(folder / "r", asked, error))
    names = ["controller", "controller.nodes", "seed", "outcome", "mean_error"]
    (folder / "table.html").write_text(table_page(frame, names, "a <i>title</i>"), encoding="utf-8")
    (folder / "plot.html").write_text(page_of(view(frame, x="controller.nodes"), "a plot"), encoding="utf-8")
    return {name: folder / f"{name}.html" for name in ("report", "table", "plot")}


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    webdriver = pytest.importorskip("selenium.webdriver")
    if not (BROWSER and DRIVER):
        pytest.skip("needs chromium and chromedriver on the PATH")
    options = webdriver.ChromeOptions()
    options.binary_location = BROWSER
    for flag in (*FLAGS, f"--user-data-dir={tmp_path_factory.mktemp('profile')}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(DRIVER))
    yield driver
    driver.quit()


def show(browser, page, width=1280, height=900, media=""):
    metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": media})
    for kind in ("browser", "performance"):
        browser.get_log(kind)
    browser.get(page.as_uri())
    return browser


@pytest.fixture
def opened(browser, pages):
    """The report, freshly loaded at desktop width."""
    return show(browser, pages["report"])


def act(browser, script, *arguments):
    """Run a script, and wait until what it changed is drawn."""
    browser.execute_script(script, *arguments)
    time.sleep(0.15)


@pytest.mark.parametrize("name", ["report", "table", "plot"])
@pytest.mark.parametrize("width", [390, 768, 1280])
def test_it_opens_without_network_or_errors_on_every_screen(browser, pages, name, width):
    show(browser, pages[name], width)
    assert browser.get_log("browser") == []
    events = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    asked = [e["params"]["request"]["url"] for e in events if e["method"] == "Network.requestWillBeSent"]
    assert asked and [url for url in asked if not url.startswith(("file:", "data:"))] == []
    assert browser.execute_script("return document.documentElement.scrollWidth") <= width
    figures = "return [...document.querySelectorAll('figure img')].filter(e => e.offsetWidth).map(e => e.naturalWidth)"
    assert all(size > 200 for size in browser.execute_script(figures))


def test_the_first_screen_holds_the_answer_and_the_first_of_the_scoreboard(opened):
    for selector in ("[data-answer]", "[data-table=scoreboard] tbody tr"):
        box = opened.execute_script(f"return document.querySelector('{selector}').getBoundingClientRect().toJSON()")
        assert box["top"] >= 0 and box["bottom"] <= 900


def test_tabs_choose_within_their_section_and_print_shows_all(browser, pages):
    show(browser, pages["report"])
    act(browser, "document.querySelector('#swept [data-metric-switch=success]').click()")
    assert [browser.execute_script(SHOWN.format(name)) for name in ("swept", "tables")] == [1, 1]
    show(browser, pages["report"], 1046, media="print")  # A4 across, margins of 1 cm
    assert [browser.execute_script(SHOWN.format(name)) for name in ("swept", "tables")] == [4, 3]
    wide = "return Math.max(...[...document.querySelectorAll('table, img')].map(e => e.getBoundingClientRect().right))"
    buttons = "return [...document.querySelectorAll('main button')].filter(e => e.offsetHeight).length"
    assert browser.execute_script(wide) <= 1046 and browser.execute_script(buttons) == 0
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})


def test_everything_that_acts_is_reached_by_tab_and_has_a_name(opened):
    script = (
        "return [...document.querySelectorAll('button, select, input, a[href]')].filter(e => e.tabIndex < 0 ||"
        " !(e.textContent.trim() || e.getAttribute('aria-label') || e.closest('label'))).length"
    )
    assert opened.execute_script(script) == 0


def test_headings_sort_numbers_as_numbers_and_words_filter_rows(browser, pages):
    show(browser, pages["table"])
    nodes, error = browser.find_elements("css selector", "th button")[1::3]
    nodes.click()
    assert browser.execute_script(COLUMN, 1) == [str(n) for n in (5, 10, 20, 40) for _ in range(4)]
    nodes.click()
    assert browser.execute_script(COLUMN, 1)[:5] == ["40"] * 4 + ["20"]
    error.click()
    *shown, lost = browser.execute_script(COLUMN, 4)
    assert (
        [*map(float, shown)] == sorted(map(float, shown))
        and len(shown) == 15
        and lost == ""
        and browser.title == "a <i>title</i>"
    )
    browser.find_element("css selector", "input").send_keys("NOMINAL lost")
    assert browser.execute_script(COLUMN, 0) == ["nominal_mpc"] and browser.execute_script(COLUMN, 1) == ["5"]
    assert browser.find_element("css selector", ".found").text == "1 of 16 rows"
