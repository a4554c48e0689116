"""The rooms of quadexp and who imports whom, read from the sources, and the picture of it in CONTRIBUTING.md.

    python -m tests.house > docs/figures/house.svg

A room is a folder of quadexp; every room imports from rooms further down only (tests/test_layout.py). The picture
leaves out an arrow that follows from others, and those to the files that every room may use.
"""

import ast
import io
import math
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "quadexp"

# Floors of the house, the lowest first: a module imports from its own room and from floors below. A name is a folder of
# quadexp (a room) or a file beside the rooms; rooms on one floor do not import each other.
FLOORS = (
    ("",),  # the version
    ("errors", "messages", "progress", "provenance", "cache", "names", "writer", "plugin"),
    ("compile", "parts"),
    ("physics",),
    ("log",),
    ("models",),
    ("reference", "world", "control"),
    ("report",),
    ("experiment",),
    ("sweeps",),
    ("requests", "frames", "api", "loop"),
    ("cli",),
    ("__main__",),
)
# Floors of the plug-ins, above all of the core, which imports nothing from them.
PLUGIN_FLOORS = (
    ("laws", "aerodynamics", "drawing"),
    (
        "remedies",
        "tune",
        "worlds",
        "foreign",
        "cluster",
        "neural",
        "gaussian_process",
        "exchange",
        "logs",
        "margins",
    ),  # fmt: skip
    ("page",),
    ("papers", "auto", "bench", "gym", "vehicle", "archive", "check"),
    ("identification",),
    ("public",),
)


ALL_FLOORS = (*FLOORS, ("plugins",), *(tuple(f"plugins/{name}" for name in names) for names in PLUGIN_FLOORS))


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
    """The package below quadexp that a module is in, or its own name; "plugins/NAME" in a plug-in."""
    places = module.split(".")[1:]
    return "/".join(places[:2] if places[:1] == ["plugins"] else places[:1])


def floor(module: str) -> int:
    """From 0, the lowest."""
    own = place(module)
    for level, names in enumerate(ALL_FLOORS):
        if own in names:
            return level
    raise AssertionError(f"{module}: has no floor yet: add it to FLOORS or PLUGIN_FLOORS in tests/house.py")


@cache
def rooms() -> dict[str, set[str]]:
    """Room of the core -> rooms that it imports from."""
    return {name: below for name, below in all_rooms().items() if "/" not in name}


def plugins() -> list[str]:
    """Names of the plug-ins."""
    return sorted(name.partition("/")[2] for name in all_rooms() if "/" in name)


@cache
def all_rooms() -> dict[str, set[str]]:
    """Room or plug-in -> those that it imports from."""
    found: dict[str, set[str]] = {}
    for module, targets in imports().items():
        if is_room(place(module)):
            below = {place(target) for target in targets}
            found.setdefault(place(module), set()).update(name for name in below if is_room(name))
    return {name: below - {name} for name, below in found.items()}


def is_room(name: str) -> bool:
    return name not in ("", "plugins") and (PACKAGE / name).is_dir()


def arrows() -> list[tuple[str, str]]:
    """(room, room below) without those that follow from others."""
    graph = rooms()

    @cache
    def reached(name: str) -> frozenset[str]:
        return frozenset(graph[name]).union(*(reached(below) for below in graph[name]))

    return sorted(
        (name, below)
        for name, direct in graph.items()
        for below in direct
        if not any(below in reached(other) for other in direct - {below})
    )


def picture() -> str:
    """The SVG: a line of rooms a floor, arrows down; a long arrow goes round what may stand between. The id of an
    arrow is "above-below"."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure
    from matplotlib.patches import FancyArrowPatch

    levels = [names for floor in reversed(FLOORS) if (names := [name for name in floor if is_room(name)])]
    places = {n: (2 * (i - (len(row) - 1) / 2), -k) for k, row in enumerate(levels) for i, n in enumerate(row)}
    figure = Figure(figsize=(6, 0.7 * len(levels)), dpi=72)
    panel = figure.add_axes((0, 0, 1, 1), xlim=(-3.4, 3.4), ylim=(-len(levels) - 0.3, 1.0))
    panel.set_axis_off()
    box = {"boxstyle": "round", "facecolor": "#eef3fb", "edgecolor": "#4a6fa5"}
    boxes = {name: panel.text(*at, f"{name}/", ha="center", va="center", bbox=box) for name, at in places.items()}
    figure.draw_without_rendering()  # so that the boxes, from which arrows begin, have their sizes
    for above, below in arrows():
        (x, y), (to_x, to_y) = places[above], places[below]
        away = 1.25 * (y - to_y - 1) / math.hypot(to_x - x, to_y - y) * (1 if x + to_x >= 0 else -1)
        ends = {"patchA": boxes[above].get_bbox_patch(), "patchB": boxes[below].get_bbox_patch()}
        look = {"arrowstyle": "-|>", "connectionstyle": f"arc3,rad={-away}", "color": "#6e7781", "mutation_scale": 11}
        panel.add_patch(FancyArrowPatch((x, y), (to_x, to_y), gid=f"{above}-{below}", **look, **ends))
    files = ", ".join(name for name in FLOORS[1] if not is_room(name))
    small = {"ha": "center", "fontsize": 9, "color": "#57606a"}
    panel.text(0, -len(levels), f"{files}: used everywhere", **small)
    panel.text(0, 0.75, "plugins/: " + ", ".join(plugins()), **small)
    stream = io.StringIO()
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "house"}):
        figure.savefig(stream, format="svg", metadata={"Date": None})
    return stream.getvalue()


if __name__ == "__main__":
    print(picture(), end="")
