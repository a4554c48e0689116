"""`make docs` makes a site whose pages need no network."""

import contextlib
import importlib.util
import io
import pkgutil
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.plugins.page.test_browser import browser, show  # noqa: F401

ROOT = Path(__file__).resolve().parents[2]
PAGES = (
    "index.html", "docs/guide.html", "docs/questions.html", "docs/leaderboard.html", "docs/geometric.html",
    "docs/paper.html", "docs/site/gallery.html",
)  # fmt: skip
# Commands that are not shown whole; cells of tables in which a word goes on in the next line.
CUT_OFF = (
    "return [...document.querySelectorAll('.language-bash pre')].filter(e => e.scrollWidth > e.clientWidth + 1)"
    ".map(e => e.textContent)"
)
BROKEN = (
    "return [...document.querySelectorAll('.md-typeset table:not([class]) td')]"
    ".filter(e => getComputedStyle(e).wordBreak != 'normal' || getComputedStyle(e).overflowWrap != 'normal')"
    ".map(e => e.textContent)"
)
LOADED = re.compile(r"<(?:script|link|img|iframe)[^>]*(?:src|href)=\"?https?://(?!squidfunk)[^\" >]+")


def site_builder():
    spec = importlib.util.spec_from_file_location("site_build", ROOT / "docs/site/build.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_navigation_has_the_pages_that_there_are(tmp_path, monkeypatch):
    """Of mkdocs.yml those that exist, and every other page of docs/; each once."""
    build = site_builder()
    monkeypatch.setattr(build, "ROOT", tmp_path)
    monkeypatch.setattr(build, "PAGES", tmp_path / "build" / "pages")
    (tmp_path / "docs/site").mkdir(parents=True)
    (tmp_path / "docs/site/mkdocs.yml").write_bytes((ROOT / "docs/site/mkdocs.yml").read_bytes())
    for page in ("index.md", "about.md", "docs/guide.md", "docs/observers.md", "docs/quite_new.md"):
        (build.PAGES / page).parent.mkdir(parents=True, exist_ok=True)
        (build.PAGES / page).touch()
    nav = build.configuration().read_text(encoding="utf-8").partition("\nnav:\n")[2]
    assert re.findall(r"\S+\.md", nav) == [
        "index.md", "about.md", "docs/guide.md", "docs/observers.md", "docs/quite_new.md"
    ]  # fmt: skip
    assert nav.index("More:") < nav.index("quite_new") and "docs/delays.md" not in nav


def test_a_command_and_what_it_prints_are_blocks_of_their_own():
    page = "Text:\n\n    quadexp simulate a=1 \\\n            b=2\n    printed 1\n\n    quadexp show x\n\nEnd.\n\n"
    page += "- item\n    more\n"
    made = site_builder().separated(page)
    assert made == (
        "Text:\n\n```bash\nquadexp simulate a=1 \\\n        b=2\n```\n\n```text\nprinted 1\n```\n\n"
        "```bash\nquadexp show x\n```\n\nEnd.\n\n- item\n    more\n"
    )
    kept = "```yaml\na:\n\n    b: 1\n```\n"
    assert site_builder().separated(kept) == kept


def test_every_page_keeps_its_lines_and_its_equations_are_typeset():
    build = site_builder()
    pytest.importorskip("latex2mathml")
    equations = 0
    for page in sorted((ROOT / "docs").glob("*.md")):
        text = page.read_text(encoding="utf-8")
        words = [line.strip() for line in text.splitlines() if line.strip()]
        made = build.separated(text)
        fences = ("```bash", "```text", "```")
        assert [w for w in words if w not in fences] == [
            line.strip() for line in made.splitlines() if line.strip() and line.strip() not in fences
        ]
        shown = build.typeset(made)
        assert "```math" not in shown and "merror" not in shown
        assert not re.search(r"<m[inot]+>\\", shown), f"{page.name}: a command that is not known"
        equations += shown.count("<math")
    assert equations > 15


def test_no_page_stands_twice_in_the_navigation():
    nav = (ROOT / "docs/site/mkdocs.yml").read_text(encoding="utf-8").partition("\nnav:\n")[2]
    pages = re.findall(r"\S+\.(?:md|ipynb)", nav)
    assert len(pages) == len(set(pages)) > 25


def test_what_the_reference_describes_is_there():
    names = re.findall(r"^::: (\S+)$", (ROOT / "docs/site/reference.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert len(names) > 20
    for name in names:
        assert pkgutil.resolve_name(name).__doc__, name


@pytest.mark.slow  # compiles two controllers
def test_the_ten_lines_of_python_on_the_first_page_run(tmp_path, monkeypatch):
    text = (ROOT / "docs/site/landing.md").read_text(encoding="utf-8").partition("## Ten lines of Python")[2]
    code = "\n".join(line[4:] for line in text.partition("## ")[0].splitlines() if line.startswith("    "))
    assert sum(bool(line) for line in code.splitlines()) <= 10
    monkeypatch.chdir(tmp_path)
    with contextlib.redirect_stdout(io.StringIO()) as out:
        exec(code, {})
    first, second = (line.split() for line in out.getvalue().splitlines())
    assert first[0] == second[0] == "ok" and float(second[1]) < 0.5 * float(first[1])


@pytest.mark.slow
def test_every_link_leads_somewhere_and_nothing_is_loaded_from_elsewhere():
    pytest.importorskip("mkdocs", reason="the extra `docs` is not installed")
    done = subprocess.run([sys.executable, ROOT / "docs/site/build.py"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    site = ROOT / "build" / "site"
    notebook = "examples/notebooks/compare_controllers.html"
    for page in ("index.html", "about.html", "docs/guide.html", "docs/site/gallery.html", notebook):
        assert "</html>" in (site / page).read_text(encoding="utf-8")
    assert "fit_gp" in (site / "docs/site/reference.html").read_text(encoding="utf-8")
    reference = (site / "docs/site/reference.html").read_text(encoding="utf-8")
    assert all(f"quadexp.plugins.{name}.api.{name}" in reference for name in ("tune", "bench"))
    for page in site.rglob("*.html"):
        assert not LOADED.findall(page.read_text(encoding="utf-8")), page


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_in_a_browser_a_page_opened_from_a_file_has_its_scheme_its_search_and_no_error(browser, scheme):  # noqa: F811
    """After the test above, which builds it; in three widths nothing is wider than the window."""
    site = ROOT / "build" / "site"
    if not (site / "index.html").is_file():
        pytest.skip("no site is built: make docs")
    for width in (390, 768, 1280):
        for page in PAGES:
            show(browser, site / page, width)
            features = [{"name": "prefers-color-scheme", "value": scheme}]
            browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
            browser.execute_script("localStorage.clear()")
            browser.get((site / page).as_uri())
            assert browser.execute_script("return document.documentElement.scrollWidth") <= width
            assert browser.execute_script(CUT_OFF) == []
            assert browser.execute_script(BROKEN) == []
            ground = browser.execute_script("return getComputedStyle(document.body).backgroundColor")
            assert (sum(map(int, re.findall(r"\d+", ground)[:3])) > 383) == (scheme == "light")
            assert (
                browser.execute_script("return [...document.images].filter(i => i.complete && !i.naturalWidth)") == []
            )
            assert browser.get_log("browser") == []
    browser.execute_script(
        "document.querySelector('#__search').click(); const i = document.querySelector('.md-search__input'); i.focus();"
        "i.value = 'gyroscope'; i.dispatchEvent(new KeyboardEvent('keyup', {bubbles: true}));"
        "i.dispatchEvent(new Event('input', {bubbles: true}))"
    )
    from selenium.common.exceptions import WebDriverException
    from selenium.webdriver.support.ui import WebDriverWait

    counted = "return document.querySelector('.md-search-result__meta').textContent.includes('document')"
    WebDriverWait(browser, 180, ignored_exceptions=[WebDriverException]).until(
        lambda page: page.execute_script(counted)
    )
    assert browser.get_log("browser") == []
