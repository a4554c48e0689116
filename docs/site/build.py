"""Build the documentation site from the Markdown of the repository, without a network: `make docs`.

The pages are copied to build/pages with the layout of the repository, so that their links hold, together with every
file that they link to; MkDocs makes build/site from them. The navigation is that of mkdocs.yml, without pages that do
not exist; a page of docs/ that it does not name stands under `More`. A link or an anchor that leads nowhere ends the
build.
"""

from __future__ import annotations

import os
import re
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGES = ROOT / "build" / "pages"
SOURCES = (
    "*.md",
    "docs/*.md",
    "docs/site/*.md",
    "docs/site/*.js",
    "docs/site/*.css",
    "docs/figures/*",
    "benchmarks/*.md",
    "examples/notebooks/*.ipynb",
)
LANDING = ROOT / "docs" / "site" / "landing.md"  # index.html of the site; README.md is the page `about`
NAV_PAGE = re.compile(r"^\s+- (?:.*: )?(\S+\.(?:md|ipynb))$")
LINK = re.compile(r"\]\(([^)#\s]+)")
MATH = re.compile(r"^```math\n(.*?)^```\n", re.MULTILINE | re.DOTALL)
PROGRAMS = ("quadexp", "python", "pip", "source", "export", "git", "dask", "apt-get", "pytest", "sha256sum")
COMMANDS = ("make", "QUADEXP", "DASK", "CC=", *(f"{program} " for program in PROGRAMS))  # how one begins
FOLDERS = {"examples/notebooks)": "examples/notebooks/compare_controllers.ipynb)"}  # a folder has no page


def stage() -> None:
    """Copy the pages, and what they link to."""
    shutil.rmtree(PAGES, ignore_errors=True)
    files = {path for pattern in SOURCES for path in ROOT.glob(pattern) if path.is_file()}
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
            copy = PAGES / "about.md" if path == ROOT / "README.md" else copy
            copy.write_text(typeset(separated(_with_about(path, text))), encoding="utf-8")
        else:
            shutil.copyfile(path, copy)

    (PAGES / "docs" / "configuration.md").write_text(_configuration(), encoding="utf-8")
    landing = LANDING.read_text(encoding="utf-8").replace("](../../", "](").replace("](../", "](docs/")
    landing = landing.replace('src="../', 'src="docs/').replace("](README.md", "](about.md")
    (PAGES / "index.md").write_text(separated(landing), encoding="utf-8")


def separated(text: str) -> str:
    """The page with its indented blocks as fenced ones: every command by itself, and what it prints by itself."""
    made: list[str] = []
    kind = ""  # of the block that is open: "bash", "text", or "" for none
    fenced = goes_on = False
    blank = True

    def end() -> None:
        while not made[-1]:
            made.pop()
        made.extend(["```", ""])

    for line in text.splitlines():
        fenced ^= line.startswith("```")
        if line.startswith("    ") and not fenced and (kind or blank):
            is_command = goes_on or line[4:].startswith(COMMANDS)
            goes_on = is_command and line.endswith("\\")
            wanted = "bash" if is_command else "text"
            if kind != wanted:
                if kind:
                    end()
                made.append(f"```{wanted}")
                kind = wanted
            made.append(line[4:])
        else:
            if kind and line:
                end()
                kind = ""
            made.append(line)
        blank = not line
    if kind:
        end()
    return "\n".join(made).rstrip() + "\n"


def typeset(text: str) -> str:
    """The page with its equations (blocks ```math, which GitHub sets too) as MathML, which needs no script."""
    try:
        from latex2mathml.converter import convert
    except ImportError:  # shown as they are written
        return text.replace("```math", "```text")

    def equation(match: re.Match[str]) -> str:
        lines = [line.rstrip().removesuffix(r"\\") for line in match[1].strip().splitlines()]
        shown = "".join(f"<p>{convert(line, display='block')}</p>" for line in lines if line)
        return f'<div class="equation">{shown}</div>\n'

    return MATH.sub(equation, text)


def _configuration() -> str:
    """The page of all keys, made from the parts and from conf/."""
    page: str = runpy.run_path(str(ROOT / "docs" / "site" / "configuration.py"))["reference"]()
    return page


def _with_about(path: Path, text: str) -> str:
    """A page's text with links to README.md, which is the page `about` of the site."""

    def lead(match: re.Match[str]) -> str:
        here = (path.parent / match[1]).resolve() == ROOT / "README.md"
        return f"]({match[1].removesuffix('README.md')}about.md" if here else match[0]

    return LINK.sub(lead, text)


def configuration() -> Path:
    """MkDocs's configuration with the pages that there are: of mkdocs.yml those that exist, and every other page of
    docs/ under `More`."""
    lines, named = [], set()
    for line in (ROOT / "docs" / "site" / "mkdocs.yml").read_text(encoding="utf-8").splitlines():
        page = NAV_PAGE.match(line)
        if page is None or (PAGES / page[1]).is_file():
            lines.append(line)
            named |= {page[1]} if page else set()
    more = sorted(f"docs/{path.name}" for path in (PAGES / "docs").glob("*.md") if f"docs/{path.name}" not in named)
    lines += ["  - More:", *(f"      - {page}" for page in more)] if more else []
    text = "\n".join(lines) + "\n"
    for above in ("docs_dir: ../../build/", "site_dir: ../../build/"):
        text = text.replace(above, above.split(" ")[0] + " ")
    made = ROOT / "build" / "mkdocs.yml"
    made.write_text(text.replace("paths: [../..]", "paths: [..]"), encoding="utf-8")
    return made


def main() -> int:
    """Stage and build; MkDocs's exit code."""
    stage()
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "-f", str(configuration())]
    quiet = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    code = subprocess.run(command, env=quiet, check=False).returncode
    if code == 0:
        print(ROOT / "build" / "site" / "index.html")
    return code


if __name__ == "__main__":
    sys.exit(main())
