"""The rooms of quadexp and who imports whom, read from the sources, and the picture of it in CONTRIBUTING.md.

    python -m tests.house > docs/figures/house.svg

A room is a folder of quadexp; every room imports from rooms further down only (tests/test_layout.py). The picture
leaves out an arrow that follows from others, and those to the files that every room may use.
"""

from __future__ import annotations

import ast
from functools import cache
from itertools import pairwise
from pathlib import Path
from statistics import mean

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "quadexp"

# Floors of the house, the lowest first: a module imports from its own room and from floors below. A name is a folder of
# quadexp (a room) or a file beside the rooms; rooms on one floor do not import each other.
FLOORS = (
    ("",),  # the version
    ("errors", "messages", "progress", "provenance", "cache", "names", "writer"),
    ("compile", "parts"),
    ("physics",),
    ("log",),
    ("models",),
    ("reference", "world", "control"),
    ("report",),
    ("experiment", "papers"),
    ("sweeps",),
    ("tune",),
    ("bench",),
    ("requests", "frames", "api", "loop"),
    ("cli",),
    ("__main__",),
)

# Of the picture: size of a box, of a floor and of the whole, in pixels.
BOX, FLOOR, WIDTH, MARGIN = (132, 34), 66, 760, 14
STYLE = """
text { font: 14px sans-serif; text-anchor: middle; dominant-baseline: central; fill: #1f2328; }
rect { fill: #eef3fb; stroke: #4a6fa5; } .files { fill: #f4f4f4; stroke: #888; }
path { fill: none; stroke: #6e7781; stroke-width: 1.3; } marker path { fill: #6e7781; stroke: none; }
@media (prefers-color-scheme: dark) {
text { fill: #e6edf3; } rect { fill: #1d2a3d; stroke: #7ea3d8; } .files { fill: #262626; stroke: #999; }
path { stroke: #9aa4af; } marker path { fill: #9aa4af; }
}"""


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
    """From 0, the lowest."""
    own = place(module)
    for level, names in enumerate(FLOORS):
        if own in names:
            return level
    raise AssertionError(f"{module}: has no floor yet: add it to FLOORS in tests/house.py")


@cache
def rooms() -> dict[str, set[str]]:
    """Room -> rooms that it imports from."""
    found: dict[str, set[str]] = {}
    for module, targets in imports().items():
        if is_room(place(module)):
            below = {place(target) for target in targets}
            found.setdefault(place(module), set()).update(name for name in below if is_room(name))
    return {name: below - {name} for name, below in found.items()}


def is_room(name: str) -> bool:
    return bool(name) and (PACKAGE / name).is_dir()


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
    """The SVG: a line of boxes a floor, arrows down; long arrows pass between the boxes of the floors they cross."""
    levels = [[name for name in names if is_room(name)] for names in reversed(FLOORS)]
    levels = [names for names in levels if names]
    of = {name: i for i, names in enumerate(levels) for name in names}
    chains = []  # every arrow as its points, one a floor: rooms, and places where it passes
    for above, below in arrows():
        passed = [f"{above}>{below}@{i}" for i in range(of[above] + 1, of[below])]
        for i, point in enumerate(passed, of[above] + 1):
            levels[i] = [*levels[i], point]
        chains.append([above, *passed, below])
    near: dict[str, set[str]] = {}
    for one, other in (pair for chain in chains for pair in pairwise(chain)):
        near.setdefault(one, set()).add(other)
        near.setdefault(other, set()).add(one)
    x = _places(levels, near)
    y = {name: MARGIN + BOX[1] / 2 + i * FLOOR for i, names in enumerate(levels) for name in names}
    height = MARGIN * 2 + len(levels) * FLOOR + BOX[1]
    lines = [f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height:g}" width="{WIDTH}">']
    lines.append(f"<title>Rooms of quadexp: imports go down only</title><style>{STYLE}</style>")
    lines.append('<marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" orient="auto">')
    lines.append('<path d="M0 0L8 4L0 8Z"/></marker>')
    for chain in chains:
        lines.append(f'<path marker-end="url(#tip)" d="{_curve([(x[name], y[name]) for name in chain])}"/>')
    for name in of:
        lines.append(_box(name + "/", x[name], y[name], BOX[0]))
    files = ", ".join(name for name in FLOORS[1] if not is_room(name))
    lines.append(_box(f"{files}: used everywhere", WIDTH / 2, height - MARGIN - BOX[1] / 2, 600, "files"))
    return "\n".join([*lines, "</svg>"]) + "\n"


def _places(levels: list[list[str]], near: dict[str, set[str]]) -> dict[str, float]:
    """x of every room and passing point: each floor spread out evenly, in the order of the means of its neighbours."""
    x = {}

    def spread(names: list[str]) -> None:
        widths = [BOX[0] + 24 if is_room(name) else 40 for name in names]
        left = WIDTH / 2 - sum(widths) / 2
        for name, width in zip(names, widths, strict=True):
            x[name], left = left + width / 2, left + width

    for names in levels:
        spread(names)
    for _ in range(20):
        for names in [*levels, *reversed(levels)]:
            names.sort(key=lambda name: (mean([x[other] for other in sorted(near.get(name, {name}))]), name))
            spread(names)
    return x


def _curve(points: list[tuple[float, float]]) -> str:
    """From the lower edge of the first box to the upper edge of the last, straight down past boxes between."""
    half = BOX[1] / 2
    x, y = points[0]
    text = f"M{x:.0f} {y + half:.0f}"
    y += half
    for i, (to_x, to_y) in enumerate(points[1:], 2):
        end = to_y - half
        text += f"C{x:.0f} {(y + end) / 2:.0f} {to_x:.0f} {(y + end) / 2:.0f} {to_x:.0f} {end:.0f}"
        x, y = to_x, end
        if i < len(points):
            y = to_y + half
            text += f"L{x:.0f} {y:.0f}"
    return text


def _box(text: str, x: float, y: float, width: float, kind: str = "room") -> str:
    left, top = x - width / 2, y - BOX[1] / 2
    shape = f'<rect class="{kind}" x="{left:.0f}" y="{top:.0f}" width="{width}" height="{BOX[1]}" rx="5"/>'
    return f'{shape}<text x="{x:.0f}" y="{y:.0f}">{text}</text>'


if __name__ == "__main__":
    print(picture(), end="")
