"""Words: docstrings name only what exists, and a number of a module has its unit or its reason beside it."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.deleted import needs
from tests.house import PACKAGE, ROOT, modules

FILE = re.compile(r"(?<![\w/.*-])((?:[\w-]+/)*[a-z_][\w-]*\.(?:py|c|yaml|md|toml))\b")
MODULE = re.compile(r"\bquadexp(?:\.[a-z_]\w*)+")
MADE_UP = {
    "submission.md",
    "params.toml",
    "my_model.py",
    "mapping.yaml",
    "table.md",
    "model.c",
    "mpc.c",
    "node.c",
}  # which commands write, or users
PLAIN = (0, 1, 2, -1)  # numbers that say themselves what they are


def docstrings() -> Iterator[tuple[Path, str]]:
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)):
                yield path, ast.get_docstring(node) or ""


def exists(path: Path, name: str, files: set[str]) -> bool:
    """Whether such a file is there: from the root, the package or the folder of the docstring, or by its end."""
    places = (ROOT, PACKAGE, path.parent, ROOT / "conf", ROOT / "tests")
    return any((place / name).exists() for place in places) or any(file.endswith(f"/{name}") for file in files)


@needs()
def test_docstrings_name_files_that_exist():
    files = {f"/{path.relative_to(ROOT)}" for folder in ("quadexp", "conf", "tests", "docs", "examples", "benchmarks")
             for path in (ROOT / folder).rglob("*") if path.is_file()}  # fmt: skip
    named = {
        (path, name) for path, text in docstrings() for name in FILE.findall(text) if Path(name).name not in MADE_UP
    }
    assert len(named) > 100
    assert sorted(f"{path.relative_to(ROOT)}: {name}" for path, name in named if not exists(path, name, files)) == []


def test_docstrings_name_modules_that_exist():
    known = modules().keys()
    named = {(path, name) for path, text in docstrings() for name in MODULE.findall(text)}
    wrong = []
    for path, name in named:
        home = name
        while home not in known and "." in home:  # a class or function of a module
            home = home.rpartition(".")[0]
        rest = name.removeprefix(home).strip(".").partition(".")[0]
        if rest and rest != "conf" and not re.search(rf"\b{rest}\b", modules()[home].read_text(encoding="utf-8")):
            wrong.append(f"{path.relative_to(ROOT)}: {name}")
    assert len(named) > 10 and sorted(wrong) == []


def numbers(text: str) -> Iterator[tuple[int, str]]:
    """Line and name of every number, or collection of numbers alone, of a module without a word beside it."""
    lines = text.split("\n")
    plain = (ast.Constant, ast.UnaryOp, ast.BinOp, ast.Tuple, ast.List, ast.Dict, ast.operator, ast.unaryop,
             ast.expr_context)  # fmt: skip
    for node in ast.parse(text).body:
        value = node.value if isinstance(node, (ast.Assign, ast.AnnAssign)) else None
        if value is None or not all(isinstance(part, plain) for part in ast.walk(value)):
            continue
        stated = [part.value for part in ast.walk(value) if isinstance(part, ast.Constant)]
        if all(isinstance(number, (str, bytes, bool, type(None))) or number in PLAIN for number in stated):
            continue
        said = [
            *lines[node.lineno - 1 : node.end_lineno],
            lines[node.lineno - 2] * lines[node.lineno - 2].startswith("#"),
        ]
        if not any("#" in line for line in said):
            yield node.lineno, lines[node.lineno - 1]


def test_numbers_of_modules_have_a_reason():
    found = [
        f"{path.relative_to(ROOT)}:{line}: {text}"
        for path in sorted(PACKAGE.rglob("*.py"))
        for line, text in numbers(path.read_text(encoding="utf-8"))
    ]
    assert found == []


@pytest.mark.parametrize(
    ("text", "count"), [("A = 3.5\n", 1), ("A = 3.5  # s\n", 0), ("# s\nA = 3.5\n", 0), ("A = (1, 2)\n", 0)]
)
def test_a_number_without_a_reason_is_found(text, count):
    assert len([*numbers(text)]) == count
