"""Words of the table that was applied do not come back; names that users type have theirs in parts/former.py."""

import ast
from collections.abc import Iterator

from tests.house import PACKAGE, ROOT

# What is not a name of a class, function, argument or variable of the program any more.
OLD = {
    "Told", "Instant", "Operation", "InOperations", "Given", "SensorSheet", "sensor_sheet", "Senses", "Earlier",
    "GPModel",
    "Remedy", "of_course", "refuse_mistakes", "doing", "in_operations", "instant_of",
}  # fmt: skip


def bound() -> Iterator[tuple[str, str]]:
    """File and name of everything that is bound in the program."""
    for path in sorted(PACKAGE.rglob("*.py")):
        file = str(path.relative_to(PACKAGE))
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
                yield file, node.name
            elif isinstance(node, ast.arg):
                yield file, node.arg
            elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                yield file, node.id


def test_old_words_do_not_come_back():
    names = [*bound()]
    assert len(names) > 10_000
    assert sorted(f"quadexp/{file}: {name}" for file, name in names if name in OLD) == []


def test_old_modules_do_not_come_back():
    for file in ("control/instant", "control/built", "parts/sensor_sheet", "plugins/remedies/earlier"):
        assert not (PACKAGE / f"{file}.py").exists()
    assert not (ROOT / "conf" / "inner").exists()
