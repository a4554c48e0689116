"""Docstrings and comments name files of this program that exist."""

import re
from pathlib import Path

from tests.deleted import needs

ROOT = Path(__file__).resolve().parents[2]
NAMED = re.compile(r"(?<![\w./-])[\w./]*\w\.py\b(?!\()")


def named(text: str) -> set[str]:
    """Names of files of code in docstrings and comments."""
    words = re.findall(r'"""(.*?)"""|#(.*)', text, flags=re.DOTALL if '"""' in text else 0)
    return {name for pieces in words for piece in pieces for name in NAMED.findall(piece)}


@needs()
def test_named_files_exist():
    files = [path for path in (ROOT / "quadexp").rglob("*") if path.suffix == ".py"]
    files += [*(ROOT / "benchmarks").rglob("*.py"), *(ROOT / "examples").rglob("*.py"), *(ROOT / "tests").rglob("*.py")]
    there = [f"/{path.relative_to(ROOT)}" for path in files]
    missing = {
        f"{path.relative_to(ROOT)}: {name}"
        for path in files
        if "quadexp" in path.relative_to(ROOT).parts and path.suffix == ".py"
        for name in named(path.read_text(encoding="utf-8"))
        if not any(file.endswith(f"/{name}") for file in there)
    }
    assert not missing
    assert len({name for path in files for name in named(path.read_text(encoding="utf-8"))}) > 50
