"""Build the documentation site from the Markdown of the repository, without a network: `make docs`.

The pages are copied to build/pages with the layout of the repository, so that their links hold, together with every
file that they link to; MkDocs makes build/site from them. A link or an anchor that leads nowhere ends the build.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGES = ROOT / "build" / "pages"
SOURCES = ("*.md", "docs/*.md", "docs/site/*.md", "docs/figures/*", "benchmarks/*.md", "examples/notebooks/*.ipynb")
LINK = re.compile(r"\]\(([^)#\s]+)")
FOLDERS = {"examples/notebooks)": "examples/notebooks/compare_controllers.ipynb)"}  # a folder has no page


def stage() -> None:
    """Copy the pages, and what they link to."""
    shutil.rmtree(PAGES, ignore_errors=True)
    files = {path for pattern in SOURCES for path in ROOT.glob(pattern)}
    for page in [path for path in files if path.suffix == ".md"]:
        for target in LINK.findall(page.read_text(encoding="utf-8")):
            linked = (page.parent / target).resolve()
            if "://" not in target and linked.is_file():
                files.add(linked)
    for path in sorted(files):
        copy = PAGES / path.relative_to(ROOT)
        copy.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".md":
            text = path.read_text(encoding="utf-8")
            for folder, page in FOLDERS.items():
                text = text.replace(folder, page)
            copy.write_text(text, encoding="utf-8")
        else:
            shutil.copyfile(path, copy)


def main() -> int:
    """Stage and build; MkDocs's exit code."""
    stage()
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "-f", str(ROOT / "docs/site/mkdocs.yml")]
    quiet = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    code = subprocess.run(command, env=quiet, check=False).returncode
    if code == 0:
        print(ROOT / "build" / "site" / "index.html")
    return code


if __name__ == "__main__":
    sys.exit(main())
