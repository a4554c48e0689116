"""The report in a headless Chromium; skipped where there is none (test_html.py checks the file itself)."""

from __future__ import annotations

import base64
import io
import json
import shutil
import time

import numpy as np
import pytest
from PIL import Image

from quadexp.log.store import write_table
from quadexp.report.metrics import to_columns
from quadexp.report.page import make_report
from tests.report.results import make_results, weather
from tests.report.test_tables import row

BROWSER = next(
    (found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), None
)
DRIVER = shutil.which("chromedriver")
pytestmark = pytest.mark.skipif(not (BROWSER and DRIVER), reason="needs chromium and chromedriver on the PATH")
PAIR = ("nominal_mpc", "perfect_mpc")
FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--disable-dev-shm-usage",
)  # fmt: skip


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    folder = tmp_path_factory.mktemp("browser")
    return make_report(make_results(folder / "table1"), folder / "report.html")["path"]


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


@pytest.fixture
def opened(browser, page):
    """The page, freshly loaded at desktop width."""
    return show(browser, page)


def show(browser, page, width=1280, height=900, replay=True, **media):
    features = [{"name": f"prefers-{name.replace('_', '-')}", "value": value} for name, value in media.items()]
    metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
    for kind in ("browser", "performance"):
        browser.get_log(kind)
    browser.get(page.as_uri())
    if replay:
        wait(browser, "document.querySelector('[data-replay=time]').textContent !== '0.00 s'")
    return browser


def wait(browser, condition, seconds=180.0):
    until = time.monotonic() + seconds
    while not browser.execute_script(f"return Boolean({condition})"):
        assert time.monotonic() < until, f"waited in vain for {condition}"
        time.sleep(0.02)


def clock(browser):
    return float(browser.execute_script("return document.querySelector('[data-replay=scrub]').value"))


def press(browser, key, where="[data-replay=scene]", **more):
    event = json.dumps({"key": key, "bubbles": True, "cancelable": True, **more})
    browser.execute_script(f"document.querySelector('{where}').dispatchEvent(new KeyboardEvent('keydown', {event}))")
    time.sleep(0.1)


def picture(browser):
    return browser.execute_script("return document.querySelector('[data-replay=scene]').toDataURL()")


def test_no_error_and_no_request(opened):
    assert opened.get_log("browser") == []
    events = [json.loads(entry["message"])["message"] for entry in opened.get_log("performance")]
    asked = [e["params"]["request"]["url"] for e in events if e["method"] == "Network.requestWillBeSent"]
    assert asked and [url for url in asked if not url.startswith(("file:", "data:"))] == []


def test_the_first_screen_holds_the_answer_and_the_best(opened):
    for selector in ("[data-answer]", "[data-table=scoreboard] .top"):
        box = opened.execute_script(f"return document.querySelector('{selector}').getBoundingClientRect().toJSON()")
        assert box["top"] >= 0 and box["bottom"] <= 900


@pytest.fixture(scope="module")
def wide_page(tmp_path_factory):
    """Eleven contestants, two of them variants of one controller, and a setting that varies: wider than a screen."""
    root = tmp_path_factory.mktemp("wide")
    names = ["nominal_mpc", "linear_drag_mpc", "rls_mpc", "perfect_mpc", "static_feedback", "rls_feedback"]
    who = [(name, "") for name in (*names, "oracle_feedback", "literal_feedback", "own_mpc")]
    who += [("gp_mpc", f"controller.nodes={n} ") for n in (10, 20)]
    rows = [
        row(name, seed=seed, speed=speed, error=0.001 * (k + 1) * (1 + 0.01 * ((7 * seed + k) % 5)))
        | {"variant": f"{own}plant.payload={payload}", "solve_time_median": 3e-5, "solve_time_p99": 6e-5}
        for payload in ("0", "0.1")
        for speed in (4.0, 8.0)
        for k, (name, own) in enumerate(who)
        for seed in range(3)
    ]
    rows = [made | {"key": f"{i:020x}", "backend": "compiled"} for i, made in enumerate(rows)]
    record = {"metric": "mean_error", "grids": [], "conditions": [], "versions": {}, "provenance": {}}
    write_table(root / "results.parquet", to_columns(rows), record, "results")
    return make_report(root, root / "report.html")["path"]


BOX = "document.querySelector('[data-table=mean_error]').closest('.scroll')"


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [390, 768, 1280])
def test_a_wide_table_scrolls_visibly_and_its_first_columns_stay(browser, wide_page, width, scheme):
    show(browser, wide_page, width=width, replay=False, color_scheme=scheme)
    assert browser.execute_script("return document.documentElement.scrollWidth") <= width
    assert browser.execute_script(f"return {BOX}.scrollWidth > {BOX}.clientWidth + 100")
    wait(browser, f"{BOX}.classList.contains('over')")
    hint = "const h = arguments[0].previousElementSibling; return [h.textContent, h.offsetHeight > 0]"
    box = browser.execute_script(f"return {BOX}")
    text, seen = browser.execute_script(hint, box)
    assert "scroll sideways" in text and seen
    if width > 600:  # a phone lays its scroll bars over the page while they are used
        assert browser.execute_script("return arguments[0].offsetHeight - arguments[0].clientHeight", box) > 8
    lefts = (
        "return [...arguments[0].querySelectorAll('tbody tr:first-child > *')].slice(0, 3)"
        ".map(e => e.getBoundingClientRect().left)"
    )
    before = browser.execute_script(lefts, box)
    browser.execute_script("arguments[0].scrollLeft = 120", box)
    after = browser.execute_script(lefts, box)
    assert after[:2] == pytest.approx(before[:2], abs=2) and after[2] == pytest.approx(before[2] - 120, abs=2)
    ground = "return getComputedStyle(arguments[0].querySelector('tbody th')).backgroundColor"
    assert browser.execute_script(ground, box) not in ("rgba(0, 0, 0, 0)", "transparent")


def test_a_wide_table_fits_a_sheet_of_paper(browser, wide_page):
    show(browser, wide_page, width=1046, replay=False)  # A4 across, margins of 1 cm
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    wide = "return [...document.querySelectorAll('table')].map(t => t.getBoundingClientRect().right)"
    rights = browser.execute_script(wide)
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})
    assert rights and max(rights) <= 1046


def test_the_replay_plays_and_pauses(opened):
    began, before = clock(opened), picture(opened)
    opened.execute_script("document.querySelector('[data-replay=play]').click()")
    wait(opened, f"document.querySelector('[data-replay=scrub]').value > {began} + 0.1")
    opened.execute_script("document.querySelector('[data-replay=play]').click()")
    time.sleep(0.1)
    stopped = clock(opened)
    time.sleep(0.2)
    assert clock(opened) == stopped > began and picture(opened) != before


def test_speed_scales_time(opened):
    def after(seconds, rate):
        opened.execute_script(
            "const s = document.querySelector('[data-replay=rate]'); s.value = arguments[0];"
            "const b = document.querySelector('[data-replay=scrub]'); b.value = 0; b.dispatchEvent(new Event('input'));"
            "document.querySelector('[data-replay=play]').click()",
            rate,
        )
        time.sleep(seconds)
        opened.execute_script("document.querySelector('[data-replay=play]').click()")
        time.sleep(0.1)
        return clock(opened)

    assert after(0.5, "0.1") < 0.3 < after(0.5, "2")


def test_keys(opened):
    began = clock(opened)
    press(opened, "ArrowRight")
    assert clock(opened) == pytest.approx(began + 0.1, abs=0.021)
    press(opened, "Home")
    assert clock(opened) == 0
    press(opened, "+")
    assert opened.execute_script("return document.querySelector('[data-replay=rate]').value") == "2"
    press(opened, "-")
    press(opened, " ")
    wait(opened, "document.querySelector('[data-replay=scrub]').value > 0.05")
    press(opened, " ")
    before = picture(opened)
    press(opened, "ArrowRight", shiftKey=True)
    assert picture(opened) != before  # turned
    press(opened, "1")
    assert opened.execute_script("return document.querySelector('.pilot').getAttribute('aria-pressed')") == "false"


def test_dragging_turns_and_the_trace_scrubs(opened):
    drag = (
        "const c = document.querySelector(arguments[0]), b = c.getBoundingClientRect();"
        "const at = (k, x) => c.dispatchEvent(new PointerEvent(k, {pointerId: 1, bubbles: true,"
        " clientX: b.left + x * b.width, clientY: b.top + b.height / 2}));"
        "c.setPointerCapture = () => {};"
        "at('pointerdown', arguments[1]); at('pointermove', arguments[2]); at('pointerup', arguments[2])"
    )
    before = picture(opened)
    opened.execute_script(drag, "[data-replay=scene]", 0.4, 0.6)
    time.sleep(0.1)
    assert picture(opened) != before
    opened.execute_script(drag, "[data-replay=trace]", 0.2, 0.9)
    time.sleep(0.1)
    assert 2.4 < clock(opened) < 3.0  # of 3 s


def test_the_error_shown_is_that_of_the_flight(opened):
    press(opened, "Home")
    shown = opened.execute_script(
        "return [...document.querySelectorAll('.pilot')].map(p => [p.textContent, p.querySelector('.now').textContent])"
    )
    errors = {text.removesuffix(now): float(now.split()[0]) for text, now in shown}
    assert errors["nominal_mpc"] == pytest.approx(160, rel=0.1)  # half of 40 mm per m/s at 8 m/s
    assert errors["nominal_mpc"] / errors["gp_mpc"] == pytest.approx(20, rel=0.02)


def slide(browser, name, value):
    browser.execute_script(
        "const s = document.querySelector(`[data-replay=${arguments[0]}]`); s.value = arguments[1];"
        "s.dispatchEvent(new Event('input'))",
        name,
        value,
    )
    time.sleep(0.1)


def test_sliders_go_over_the_seeds_and_speeds_of_a_course_at_the_same_moment(opened):
    title = "const s = document.querySelector('[data-replay=case]'); return s.selectedOptions[0].text"
    before, moment = opened.execute_script(title), clock(opened)
    assert "at 8 m/s, seed 0" in before
    slide(opened, "seeds", 3)
    assert opened.execute_script(title) == before.replace("seed 0", "seed 3")
    assert opened.execute_script("return document.querySelector('[data-replay=at-seed]').textContent") == "3"
    slide(opened, "speeds", 0)
    assert opened.execute_script(title) == before.replace("8 m/s, seed 0", "4 m/s, seed 3")
    assert clock(opened) == pytest.approx(moment, abs=0.05)


def test_two_flights_side_by_side(opened):
    """Left and right half each hold the colours of their own flight only."""
    opened.execute_script("document.querySelector('[data-replay=beside]').click()")
    choose = (
        "for (const [n, v] of [['left', arguments[0]], ['right', arguments[1]]]) {"
        " const s = document.querySelector(`[data-replay=${n}]`); s.value = v; s.dispatchEvent(new Event('change')); }"
    )
    names = opened.execute_script("return [...document.querySelector('[data-replay=left]').options].map(o => o.text)")
    nominal, gp = names.index("nominal_mpc"), names.index("gp_mpc")
    seen = {}
    for order in ((gp, nominal), (nominal, gp)):
        opened.execute_script(choose, *order)
        time.sleep(0.15)
        stream = io.BytesIO(base64.b64decode(picture(opened).partition(",")[2]))
        pixels = np.asarray(Image.open(stream).convert("RGBA"), int)
        blue = (pixels[..., 3] > 200) & (pixels[..., 2] - pixels[..., 0] > 100)  # gp_mpc is the blue one
        seen[order] = [int(half.sum()) for half in np.array_split(blue, 2, axis=1)]
        hint = opened.execute_script("return document.querySelector('[data-replay=hint]').textContent")
        left, right = (float(part.split()[1]) for part in hint.split(", ")[-2:])
        assert (left < right) == (order[0] == gp)
    assert seen[gp, nominal][0] > 100 > 10 > seen[gp, nominal][1]
    assert seen[nominal, gp][1] > 100 > 10 > seen[nominal, gp][0]
    opened.execute_script("document.querySelector('[data-replay=beside]').click()")
    assert opened.execute_script("return document.querySelector('[data-replay=pair]').offsetHeight") == 0


@pytest.mark.parametrize("width", [320, 390, 768, 1280])
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("name", ["table", "weather"])
def test_a_page_fits_every_screen_in_both_themes(browser, page, worlds, name, width, scheme):
    show(browser, page if name == "table" else worlds("weather", weather), width=width, color_scheme=scheme)
    browser.execute_script("document.querySelector('[data-replay=beside]').click()")
    right = "Math.max(...[...document.querySelectorAll('.transport *, .overlay *')].filter(e => e.offsetWidth)"
    box = f"return {right}.map(e => e.getBoundingClientRect().right))"
    assert browser.execute_script(box) <= width
    assert browser.execute_script("return document.documentElement.scrollWidth") <= width
    ground, ink = browser.execute_script(
        "const s = getComputedStyle(document.querySelector('[data-flown]')), b = getComputedStyle(document.body);"
        "return [b.backgroundColor, s.color].map(c => c.match(/[0-9]+/g).slice(0, 3).map(Number))"
    )
    assert (sum(ground) > sum(ink)) == (scheme == "light") and abs(sum(ground) - sum(ink)) > 300
    panels = browser.execute_script("return document.querySelectorAll('#power figure svg').length")
    assert panels == (2 if name == "weather" else 0) and browser.get_log("browser") == []


def test_in_print_no_heading_is_torn_from_what_it_is_about(browser, page):
    """The rules that keep it, of every heading, and a sheet that a printer takes: light, without what acts."""
    show(browser, page, color_scheme="dark")
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    torn = browser.execute_script(
        "return [...document.querySelectorAll('h1, h2, h3, .lead, caption')]"
        ".filter(e => getComputedStyle(e).breakAfter !== 'avoid').map(e => e.outerHTML)"
    )
    split = browser.execute_script(
        "return [...document.querySelectorAll('figure, tr, .player, h2, h3')]"
        ".filter(e => getComputedStyle(e).breakInside !== 'avoid').length"
    )
    acting = browser.execute_script(
        "return [...document.querySelectorAll('main button:not(.pilot)')].filter(e => e.offsetHeight).length"
    )
    ground = browser.execute_script("return getComputedStyle(document.body).backgroundColor")
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})
    assert torn == [] and split == 0 and acting == 0 and ground == "rgb(255, 255, 255)"
    made = base64.b64decode(
        browser.execute_cdp_cmd("Page.printToPDF", {"paperWidth": 8.27, "paperHeight": 11.69})["data"]
    )
    assert made.startswith(b"%PDF") and 3 <= made.count(b"/Type /Page\n") + made.count(b"/Type /Page ") <= 15


def test_a_worst_flight_opens_in_the_replay(opened):
    opened.execute_script("document.querySelector('[data-open-case]').click()")
    time.sleep(0.2)
    press(opened, "End")
    assert "lost" in opened.execute_script("return document.querySelector('[data-replay=pilots]').textContent")
    assert opened.execute_script("return document.activeElement.dataset.replay") == "scene"


def test_themes(browser, page):
    ground = "return getComputedStyle(document.body).backgroundColor"
    show(browser, page, color_scheme="light")
    light = browser.execute_script(ground)
    show(browser, page, color_scheme="dark")
    dark = browser.execute_script(ground)
    assert light != dark
    browser.execute_script("document.querySelector('[data-theme-switch]').click()")
    assert browser.execute_script(ground) == light
    browser.execute_script("localStorage.clear()")


def test_everything_that_acts_is_reached_by_tab_and_shows_its_focus(opened):
    hidden = opened.execute_script(
        "return [...document.querySelectorAll('button, select, input, a[href]')].filter(e => e.tabIndex < 0).length"
    )
    assert hidden == 0
    nameless = opened.execute_script(
        "return [...document.querySelectorAll('button, select, input')].filter(e => !(e.textContent.trim() ||"
        " e.getAttribute('aria-label') || e.closest('label'))).length"
    )
    assert nameless == 0
    from selenium.webdriver.common.keys import Keys

    opened.execute_script("document.body.focus(); window.scrollTo(0, 0)")
    opened.switch_to.active_element.send_keys(Keys.TAB, Keys.TAB)
    outline = "const s = getComputedStyle(document.activeElement); return s.outlineStyle + ' ' + s.outlineWidth"
    assert opened.execute_script(outline) == "solid 2px"


@pytest.fixture(scope="module")
def worlds(tmp_path_factory):
    """Pages of two controllers, with further columns of their flights: name -> page."""
    folder = tmp_path_factory.mktemp("worlds")

    def made(name, beside):
        page = folder / f"{name}.html"
        if not page.exists():
            world = "clean" if name == "clean" else "race"
            make_report(make_results(folder / name, controllers=PAIR, lost=False, world=world, beside=beside), page)
        return page

    return made


def from_above(browser, page):
    """The replay of the first controller alone, (height, width, 4)."""
    show(browser, page)
    browser.execute_script("document.querySelector('[data-view=top]').click()")
    press(browser, "2")
    stream = io.BytesIO(base64.b64decode(picture(browser).partition(",")[2]))
    return np.asarray(Image.open(stream).convert("RGBA"), int)


def added(before, after):
    """Where two pictures differ, as pixels (x, y), (n, 2)."""
    return np.argwhere(np.abs(after - before).sum(axis=2) > 60)[:, ::-1]


@pytest.mark.parametrize("axis", [0, 1])
def test_the_arrow_of_the_wind_points_where_the_air_goes_and_ends_at_the_vehicle(browser, worlds, axis):
    """From above, x is to the right and y up."""

    def blown(speed):
        return lambda flight: {f"wind_{i}": np.full(len(flight), speed * (k == axis)) for k, i in enumerate("xyz")}

    clean = from_above(browser, worlds("clean", lambda _: {}))
    middles = []
    for speed in (4.0, -4.0):
        arrow = added(clean, from_above(browser, worlds(f"wind{axis}{speed}", blown(speed))))
        along = arrow[:, axis] * (-1 if axis else 1) * np.sign(speed)
        assert np.ptp(along) > 30 and np.ptp(along) > 2.5 * np.ptp(arrow[:, 1 - axis])
        assert along.mean() > (along.min() + along.max()) / 2  # the head has more pixels than the tail
        middles.append(along.mean() * np.sign(speed))
        hint = "return document.querySelector('[data-replay=hint]').textContent"
        assert browser.execute_script(hint).endswith("wind 4.0 m/s")
    assert middles[0] < middles[1] - 30  # it comes from the other side


@pytest.mark.parametrize("off", [1.0, -1.0])
def test_the_estimate_is_drawn_where_the_controller_was_told(browser, worlds, off):
    def told(flight):
        return {f"est_p_{i}": flight[f"p_{i}"] + off * (i == "y") for i in "xyz"}

    clean = from_above(browser, worlds("clean", lambda _: {}))
    ghost = added(clean, from_above(browser, worlds(f"told{off}", told)))
    flown = np.nonzero(clean[..., 3] > 200)[0].mean()  # the trail and the vehicle
    assert np.ptp(ghost[:, 1]) > 20 and (ghost[:, 1].mean() - flown) * off < -5
