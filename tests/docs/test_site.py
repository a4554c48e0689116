"""`make docs` makes a site whose pages need no network."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("mkdocs", reason="the extra `docs` is not installed")

ROOT = Path(__file__).resolve().parents[2]
LOADED = re.compile(r"<(?:script|link|img|iframe)[^>]*(?:src|href)=\"?https?://(?!squidfunk)[^\" >]+")


@pytest.mark.slow
def test_every_link_leads_somewhere_and_nothing_is_loaded_from_elsewhere():
    done = subprocess.run([sys.executable, ROOT / "docs/site/build.py"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    site = ROOT / "build" / "site"
    for page in (
        "index.html",
        "docs/guide.html",
        "docs/site/gallery.html",
        "examples/notebooks/compare_controllers.html",
    ):
        assert "</html>" in (site / page).read_text(encoding="utf-8")
    assert "fit_gp" in (site / "docs/site/reference.html").read_text(encoding="utf-8")
    for page in site.rglob("*.html"):
        assert not LOADED.findall(page.read_text(encoding="utf-8")), page
