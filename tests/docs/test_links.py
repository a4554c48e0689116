"""What the documentation points to is there: links, files and functions."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "benchmarks").glob("*.md")])
LINK = re.compile(r"\]\(([^)#\s]+)(?:#([\w-]+))?\)")
# Not the names of environments of Gymnasium.
PLACE = re.compile(r"(?<![\w/.])((?![\w/]+-v0)(?:quadexp|tests|benchmarks|examples|conf)/[\w/.-]*\w)")
NAMED = re.compile(r"(quadexp/[\w/]+\.py) ((?:`[\w.]+`(?:, )?)+)")


def anchors(page):
    """Headings of a page as links name them."""
    lines = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", line.lower()).replace(" ", "-") for line in lines}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_and_paths_are_there(page):
    text = page.read_text(encoding="utf-8")
    for target, anchor in LINK.findall(text):
        if "://" in target:
            continue
        file = (page.parent / target).resolve()
        assert file.exists(), f"{page.name}: {target}"
        assert not anchor or anchor in anchors(file), f"{page.name}: {target}#{anchor}"
    for path in PLACE.findall(text):
        assert (ROOT / path).exists() or (ROOT / f"{path}.py").exists(), f"{page.name}: {path}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_functions_that_equations_are_mapped_to_are_there(page):
    for path, names in NAMED.findall(page.read_text(encoding="utf-8")):
        source = (ROOT / path).read_text(encoding="utf-8")
        for name in re.findall(r"`([\w.]+)`", names):
            for part in name.split("."):
                assert re.search(rf"\b(def|class) {part}\b|^{part}\b", source, re.MULTILINE), (
                    f"{page.name}: {path} {name}"
                )
