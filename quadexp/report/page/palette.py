"""Colours of the page in its two themes and of the figures on paper, and who wears which colour, marker and dash.

Colours say a contestant's part (baseline, best, bound); markers are those of quadexp/report/style.py.

Figures of the page are drawn once, in stand-in colours that `svg.py` replaces by CSS variables, so one drawing serves
both themes. Series colours keep 3:1 against their ground and can be told apart by colour-blind readers; they differ in
marker and dash as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from quadexp.report.style import KNOWN, name_of

# CSS variable -> (light, dark)
TOKENS = {
    "ground": ("#fbfbf9", "#0f1216"),
    "panel": ("#ffffff", "#161a20"),
    "ink": ("#17191d", "#e9ebee"),
    "muted": ("#5a616c", "#9ba4b0"),
    "rule": ("#e3e3de", "#2a3038"),
    "accent": ("#0b63a5", "#62b5f5"),
    "wash": ("#eef4f9", "#15222e"),
    "alarm": ("#b3261e", "#ff8a7d"),
    "series-0": ("#5f6773", "#9aa3af"),  # the baseline
    "series-1": ("#0b63a5", "#62b5f5"),  # the best: the accent
    "series-2": ("#17191d", "#e9ebee"),  # a bound
    "series-3": ("#b45f00", "#f0a04b"),
    "series-4": ("#00694f", "#3cc79d"),
    "series-5": ("#6c1d5a", "#d90cb6"),
    "series-6": ("#44180b", "#df5c39"),
    "series-7": ("#494002", "#f7e73b"),
}
BASELINE, BEST, BOUND, OTHERS = 0, 1, 2, (3, 4, 5, 6, 7)
SHAPES = ("circle", "square", "diamond", "triangle", "wedge", "plus", "cross", "star")
MARKERS = {
    "circle": "o", "square": "s", "diamond": "D", "triangle": "^", "wedge": "v", "plus": "P", "cross": "X", "star": "*",
}  # fmt: skip
DASHES = (
    "solid",
    (0, (5, 1.5)),
    (0, (1.2, 1.4)),
    (0, (6, 1.5, 1.2, 1.5)),
)


@dataclass(frozen=True)
class Palette:
    """What a figure is drawn with; series: by colour number."""

    ink: str
    muted: str
    rule: str
    panel: str
    accent: str
    alarm: str
    series: tuple[str, ...]


def _palette(colour: dict[str, str]) -> Palette:
    series = tuple(colour[name] for name in TOKENS if name.startswith("series-"))
    return Palette(
        **{name: colour[name] for name in ("ink", "muted", "rule", "panel", "accent", "alarm")}, series=series
    )


STANDINS = {name: f"#fe{i:02x}fd" for i, name in enumerate(TOKENS)}  # CSS variable -> the colour it is drawn in
PAGE = _palette(STANDINS)
PAPER = _palette({name: light for name, (light, _) in TOKENS.items()})


@dataclass(frozen=True)
class Look:
    """How one contestant is drawn everywhere: colour number, shape, dash."""

    colour: int
    shape: str
    dash: int

    @property
    def marker(self) -> str:
        return MARKERS[self.shape]

    @property
    def dashes(self) -> Any:
        return DASHES[self.dash]


def looks(labels: Sequence[str], baseline: str | None, best: str | None, bounds: Sequence[str]) -> dict[str, Look]:
    """A look for every contestant: grey for the baseline, the accent for the best, ink for bounds, others in turn."""
    others = iter(i for _ in range(len(labels)) for i in OTHERS)
    shapes = _shapes(labels)
    worn: dict[str, Look] = {}
    for k, label in enumerate(labels):
        if label == baseline:
            colour, dash = BASELINE, 0
        elif label == best:
            colour, dash = BEST, 0
        elif label in bounds:
            colour, dash = BOUND, 2
        else:
            colour, dash = next(others), k % len(DASHES)
        worn[label] = Look(colour, shapes[k], dash)
    return worn


def _shapes(labels: Sequence[str]) -> list[str]:
    """A shape each: the controller's own for the first label that has it, then those that nobody has."""
    own = {marker: shape for shape, marker in MARKERS.items()}
    wanted = [own.get(KNOWN[name_of(label)][1]) if name_of(label) in KNOWN else None for label in labels]
    first = [shape if shape is not None and wanted.index(shape) == k else None for k, shape in enumerate(wanted)]
    free = [shape for shape in SHAPES if shape not in first] or list(SHAPES)
    spare = iter([*free, *(SHAPES[k % len(SHAPES)] for k in range(len(labels)))])
    return [shape or next(spare) for shape in first]


def css_blocks() -> list[str]:
    """Declarations of the light and of the dark theme."""
    return ["".join(f"--{name}:{pair[i]};" for name, pair in TOKENS.items()) for i in (0, 1)]
