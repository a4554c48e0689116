"""The figures over what was swept in a headless Chromium; skipped where there is none."""

from __future__ import annotations

import pytest

from quadexp.report.page import make_report
from tests.report.sweeps import swept
from tests.report.test_html_browser import browser, pytestmark, show  # noqa: F401
from tests.report.test_swept import TWO, error

SHOWN = (
    "return [...document.querySelectorAll('#{} [data-metric]')].filter(e => e.offsetHeight).map(e => e.dataset.metric)"
)


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    folder = tmp_path_factory.mktemp("swept")
    return make_report(swept(folder / "two", TWO, error), folder / "two.html")["path"]


@pytest.mark.parametrize("width", [390, 768, 1280])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_three_widths_in_light_and_dark(browser, page, width, scheme):  # noqa: F811
    show(browser, page, width=width, color_scheme=scheme, replay=False)
    assert browser.execute_script("return document.documentElement.scrollWidth") <= width
    sizes = browser.execute_script(
        "return [...document.querySelectorAll('#swept [data-metric=mean_error] svg')]"
        ".map(s => [s.getBoundingClientRect().width, s.getBoundingClientRect().height])"
    )
    assert len(sizes) == 2 and all(w > 300 and h > 100 for w, h in sizes)
    ink, ground, plate = browser.execute_script(
        "const t = document.querySelector('#swept figure:not(.plate) text');"
        "const p = document.querySelector('#swept .plate');"
        "return [getComputedStyle(t).fill, getComputedStyle(document.body).backgroundColor,"
        " getComputedStyle(p).backgroundColor].map(c => c.match(/[0-9]+/g).slice(0, 3).reduce((a, b) => +a + +b, 0))"
    )
    assert abs(ink - ground) > 200 and (ground > 383) == (scheme == "light") and plate == 765
    assert browser.get_log("browser") == []


def test_tabs_choose_within_their_section(browser, page):  # noqa: F811
    show(browser, page, replay=False)
    assert browser.execute_script(SHOWN.format("swept")) == ["mean_error"]
    browser.execute_script("document.querySelector('#swept [data-metric-switch=success]').click()")
    assert browser.execute_script(SHOWN.format("swept")) == ["success"]
    assert browser.execute_script(SHOWN.format("tables")) == ["mean_error"]


def test_print_shows_every_quantity_with_its_title(browser, page):  # noqa: F811
    show(browser, page, width=1046, replay=False)
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    shown = browser.execute_script(SHOWN.format("swept"))
    titles = browser.execute_script(
        "return [...document.querySelectorAll('#swept h3')].filter(e => e.offsetHeight).length"
    )
    right = "return Math.max(...[...document.querySelectorAll('#swept svg')].map(s => s.getBoundingClientRect().right))"
    wide = browser.execute_script(right)
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})
    assert shown == ["mean_error", "rmse", "max_error", "success"] and titles == 4 and wide <= 1046
