"""The house: modules import along the data flow and in no circle; tests do not depend on how busy the machine is."""

import ast
import re

from tests.deleted import needs
from tests.house import (
    ALL_FLOORS,
    PACKAGE,
    ROOT,
    all_rooms,
    arrows,
    floor,
    imports,
    is_room,
    modules,
    picture,
    place,
    plugins,
    rooms,
)

# Imports against the flow that stand for a reason: (module, imported).
CROSSINGS: dict[tuple[str, str], str] = {}


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
    assert "quadexp.experiment.evaluate" in imports()["quadexp.requests"]
    assert sum(map(len, imports().values())) > len(modules())


def test_no_module_imports_itself_by_way_of_others():
    assert in_circles(imports()) == []


@needs()
def test_every_floor_is_of_this_house():
    places = {place(module) for module in modules()}
    named = {name for names in ALL_FLOORS for name in names}
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


@needs()
def test_the_core_imports_nothing_from_plugins():
    crossing = {
        (module, target)
        for module, targets in imports().items()
        for target in targets
        if target.startswith("quadexp.plugins") and not module.startswith("quadexp.plugins")
    }
    assert not crossing
    assert {"check", "identification", "logs", "page", "remedies"} <= set(plugins())


def both_modules(module: str, target: str) -> bool:
    """Whether both are single modules, which may share a floor; two packages on one floor do not know of each other."""
    return all(name.count(".") <= 1 and modules()[name].name != "__init__.py" for name in (module, target))


def test_few_files_stand_beside_the_rooms():
    """What is no room is used by all of them, or asks something of all of them; an idea of its own gets a room."""
    assert len([path for path in PACKAGE.iterdir() if path.is_file() and path.suffix in (".py", ".pyi")]) <= 15


def test_every_room_says_in_a_sentence_what_its_idea_is():
    for name in all_rooms():
        said = ast.get_docstring(ast.parse((PACKAGE / name / "__init__.py").read_text(encoding="utf-8")))
        assert said and said.splitlines()[0][0].isupper(), name


def test_an_arrow_that_follows_from_others_is_left_out():
    """And every import between rooms can be followed along the arrows that stay."""
    drawn = set(arrows())
    follows = {name: {below for above, below in drawn if above == name} for name in rooms()}
    for _ in follows:
        follows = {name: below.union(*(follows[one] for one in below)) for name, below in follows.items()}
    assert all(below <= follows[name] for name, below in rooms().items())
    for above, below in drawn:
        rest = {other for other in follows if other != above and below in follows[other] and other in rooms()[above]}
        assert not rest, (above, below)


def test_the_picture_is_of_the_imports_of_today():
    stored = (ROOT / "docs" / "figures" / "house.svg").read_text(encoding="utf-8")
    for svg in (stored, picture()):
        drawn = sorted(re.findall(r'id="([a-z]+)-([a-z]+)"', svg))
        assert drawn == arrows(), "make it anew: python -m tests.house > docs/figures/house.svg"
        assert all(f">{name}/</text>" in svg for name in rooms()) and is_room("world") and not is_room("errors")


def test_no_test_holds_a_clock_against_a_limit():
    """Speed is measured in benchmarks/, as ratios; a test that reads a stopwatch fails on a busy machine."""
    stopwatches = {"perf_counter", "perf_counter_ns", "process_time", "process_time_ns", "thread_time"}
    found = []
    for path in (ROOT / "tests").rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        for node in ast.walk(ast.parse(text)) if any(name in text for name in stopwatches) else ():
            name = node.attr if isinstance(node, ast.Attribute) else node.id if isinstance(node, ast.Name) else ""
            if name in stopwatches:
                found.append(f"{path.relative_to(ROOT)}:{node.lineno}")
    assert not found
