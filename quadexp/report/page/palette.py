"""Colours of the page in its two themes and of its figures on paper; who wears which is in quadexp/report/style.py.

Figures of the page are drawn once, in stand-in colours that `svg.py` replaces by CSS variables, so one drawing serves
both themes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from quadexp.report.style import HUES, MOST_VARIANTS, shaded

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
    "shade": ("#c9ccd1", "#3d4652"),  # where a table goes on beyond the edge
    **{
        f"series-{hue}-{shade}": (shaded(hue, shade), shaded(hue, shade, dark=True))
        for hue in HUES
        for shade in range(MOST_VARIANTS)
    },
}
SHAPES = {  # marker -> name of its shape on the page
    "o": "circle", "s": "square", "D": "diamond", "^": "triangle", "v": "wedge", "P": "plus", "X": "cross",
    "*": "star", "h": "hexagon", "<": "left", ">": "right", "p": "pentagon",
}  # fmt: skip


@dataclass(frozen=True)
class Palette:
    """What a figure is drawn with; series: by `Look.token`."""

    ink: str
    muted: str
    rule: str
    panel: str
    accent: str
    alarm: str
    series: Mapping[str, str]


def _palette(colour: dict[str, str]) -> Palette:
    series = {name.removeprefix("series-"): colour[name] for name in TOKENS if name.startswith("series-")}
    return Palette(
        **{name: colour[name] for name in ("ink", "muted", "rule", "panel", "accent", "alarm")}, series=series
    )


STANDINS = {name: f"#fe{i:02x}fd" for i, name in enumerate(TOKENS)}  # CSS variable -> the colour it is drawn in
PAGE = _palette(STANDINS)
PAPER = _palette({name: light for name, (light, _) in TOKENS.items()})


def css_blocks() -> list[str]:
    """Declarations of the light and of the dark theme."""
    return ["".join(f"--{name}:{pair[i]};" for name, pair in TOKENS.items()) for i in (0, 1)]
