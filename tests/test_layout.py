"""The house: modules import along the data flow and in no circle; tests do not depend on how busy the machine is."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "quadexp"

# Floors of the house, the lowest first: a module imports from its own room and from floors below. A name is a folder of
# quadexp (a room) or a file beside the rooms; rooms on one floor do not import each other.
FLOORS = (
    ("",),  # the version
    ("errors", "messages", "progress", "provenance"),
    ("compile",),
    ("config", "physics"),
    ("air", "log"),
    ("reference", "learn", "world", "control"),
    ("report",),
    ("experiment", "papers"),
    ("sweep",),
    ("api",),
    ("cli",),
    ("__main__",),
)

# Imports against the flow that stand for a reason: (module, imported).
CROSSINGS: dict[tuple[str, str], str] = {}


@cache
def modules() -> dict[str, Path]:
    """Name -> file of every module; a package is its __init__."""
    found = {}
    for path in PACKAGE.rglob("*.py"):
        parts = path.relative_to(ROOT).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


@cache
def imports() -> dict[str, frozenset[str]]:
    """Module -> modules of quadexp that it imports, anywhere in it."""
    graph = {}
    for name, path in modules().items():
        found = set()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                wanted = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                assert node.level == 0, f"{path}: imports are absolute"
                wanted = [f"{node.module}.{alias.name}" for alias in node.names]
            else:
                continue
            for target in wanted:
                while target and target not in modules():  # a name inside a module
                    target = target.rpartition(".")[0]
                if target:
                    found.add(target)
        graph[name] = frozenset(found - {name})
    return graph


def place(module: str) -> str:
    """The package below quadexp that a module is in, or its own name."""
    return module.split(".")[1] if "." in module else ""


def floor(module: str) -> int:
    own = place(module)
    for level, names in enumerate(FLOORS):
        if own in names:
            return level
    raise AssertionError(f"{module}: has no floor yet: add it to FLOORS in {Path(__file__).name}")


def in_circles(graph: dict[str, frozenset[str]]) -> list[str]:
    """Modules on a circle of imports, or between two: what is left after all that imports nothing, or that nothing
    imports, has been taken away again and again."""
    left = {name: set(targets) for name, targets in graph.items()}
    while left:
        free = {name for name, targets in left.items() if not targets & left.keys()}
        free |= left.keys() - set().union(*left.values())
        if not free:
            break
        left = {name: targets - free for name, targets in left.items() if name not in free}
    return sorted(left)


def test_the_finder_of_circles_finds_one():
    graph = {"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": {"a"}, "e": {"c"}}
    assert in_circles({name: frozenset(targets) for name, targets in graph.items()}) == ["b", "c"]
    assert in_circles({"a": frozenset({"b", "c"}), "b": frozenset({"c"}), "c": frozenset()}) == []


def test_the_graph_sees_imports_inside_functions():
    assert "quadexp.experiment.evaluate" in imports()["quadexp.cli.fly"]
    assert sum(map(len, imports().values())) > len(modules())


def test_no_module_imports_itself_by_way_of_others():
    assert in_circles(imports()) == []


def test_every_floor_is_of_this_house():
    places = {place(module) for module in modules()}
    named = {name for names in FLOORS for name in names}
    assert named <= places, "FLOORS names what is there no more"


def test_imports_go_along_the_data_flow():
    wrong = set()
    for module, targets in imports().items():
        for target in targets:
            same_place = place(module) == place(target)
            beside = floor(module) == floor(target) and both_modules(module, target)
            if not (same_place or beside or floor(target) < floor(module)):
                wrong.add((module, target))
    assert wrong == set(CROSSINGS), "import against the data flow, or a crossing that is none any more"


def both_modules(module: str, target: str) -> bool:
    """Whether both are single modules, which may share a floor; two packages on one floor do not know of each other."""
    return all(name.count(".") <= 1 and modules()[name].name != "__init__.py" for name in (module, target))


def test_no_test_holds_a_clock_against_a_limit():
    """Speed is measured in benchmarks/, as ratios; a test that reads a stopwatch fails on a busy machine."""
    stopwatches = {"perf_counter", "perf_counter_ns", "process_time", "process_time_ns", "thread_time"}
    found = []
    for path in (ROOT / "tests").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            name = node.attr if isinstance(node, ast.Attribute) else node.id if isinstance(node, ast.Name) else ""
            if name in stopwatches:
                found.append(f"{path.relative_to(ROOT)}:{node.lineno}")
    assert not found
