"""Colours of the page in its two themes and of its figures on paper, and figures as inline SVG.

Colours and markers of contestants are in report/style.py. Figures of the page are drawn once, in stand-in colours that
`inline_svg` replaces by CSS variables, so one drawing serves both themes.
"""

from __future__ import annotations

import io
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import matplotlib

from quadexp.messages import html
from quadexp.report import style
from quadexp.report.style import HUES, MOST_VARIANTS, Figure, Look, shaded

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
    "shade": ("#c9ccd1", "#3d4652"),  # where a table continues beyond the edge
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

SHAPE_PATHS = {
    "circle": "M-4.4 0A4.4 4.4 0 1 1 4.4 0A4.4 4.4 0 1 1 -4.4 0Z",
    "square": "M-4-4H4V4H-4Z",
    "diamond": "M0-5L5 0L0 5L-5 0Z",
    "triangle": "M0-4.8L4.8 4H-4.8Z",
    "wedge": "M0 4.8L4.8-4H-4.8Z",
    "plus": "M-1.8-5H1.8V-1.8H5V1.8H1.8V5H-1.8V1.8H-5V-1.8H-1.8Z",
    "cross": "M-5-2.6L-2.6-5L0-2.4L2.6-5L5-2.6L2.4 0L5 2.6L2.6 5L0 2.4L-2.6 5L-5 2.6L-2.4 0Z",
    "hexagon": "M-4.3-2.5L0-5L4.3-2.5V2.5L0 5L-4.3 2.5Z",
    "left": "M-4.8 0L4-4.8V4.8Z",
    "right": "M4.8 0L-4-4.8V4.8Z",
    "pentagon": "M0-5L4.8-1.5L2.9 4H-2.9L-4.8-1.5Z",
    "star": "M0-5L1.4-1.6L5-1.5L2.1.7L3.1 4.4L0 2.3L-3.1 4.4L-2.1.7L-5-1.5L-1.4-1.6Z",
}


@dataclass(frozen=True)
class Palette:
    """The colours of a figure. series: by `Look.token`."""

    ink: str
    muted: str
    rule: str
    panel: str
    accent: str
    alarm: str
    series: Mapping[str, str]

    def mark(self, look: Look) -> dict[str, Any]:
        """Keywords of `plot` for colour and marker of a look: filled, or hollow for the variants of a controller."""
        colour = self.series[look.token]
        if look.filled:
            edge = {"markeredgecolor": self.panel, "markeredgewidth": 0.7}
        else:
            edge = {"markerfacecolor": self.panel, "markeredgecolor": colour, "markeredgewidth": 1.3}
        return {"color": colour, "marker": look.marker, **edge}


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


def dress(panel: Any, palette: Palette) -> None:
    """Colours of frame, ticks and grid."""
    panel.set_facecolor("none")
    panel.grid(True, color=palette.rule, linewidth=0.6)
    for spine in panel.spines.values():
        spine.set_color(palette.rule)
    panel.spines["left"].set_visible(False)
    panel.tick_params(which="both", colors=palette.muted, labelcolor=palette.muted)
    panel.xaxis.label.set_color(palette.muted)
    panel.yaxis.label.set_color(palette.muted)


STYLE: Any = {
    **style.STYLE,
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 8.5,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "axes.titlepad": 8,
    "axes.linewidth": 0.8,
    "xtick.major.size": 3,
    "ytick.major.size": 0,
    "xtick.minor.size": 0,
    "ytick.minor.size": 0,
    "lines.linewidth": 1.6,
    "lines.markersize": 5,
}
_DROPPED = re.compile(r"<\?xml.*?\?>|<!DOCTYPE.*?>|<metadata>.*?</metadata>|<!--.*?-->", re.DOTALL)
_ID = re.compile(r'(\bid="|xlink:href="#|url\(#)')
_SIZE = re.compile(r'(<svg\b[^>]*?)\s(?:width|height)="[^"]*"')
_PATH = re.compile(r'\bd="[^"]*"')
_DECIMALS = re.compile(r"(\d+\.\d{2})\d+")
_VARIABLES = {standin: f"var(--{name})" for name, standin in STANDINS.items()}
_COLOUR = re.compile("#[0-9a-f]{6}")
_STANDIN = re.compile("|".join(_VARIABLES), re.IGNORECASE)


def inline_svg(figure: Figure, name: str, label: str, themed: Mapping[str, str] | None = None) -> str:
    """The figure as an <svg> element. name: unique on the page. label: its description for screen readers. themed:
    colours on paper -> CSS variable that takes their place, beside the stand-ins."""
    stream = io.StringIO()
    with matplotlib.rc_context({**STYLE, "svg.fonttype": "none"}):
        figure.savefig(stream, format="svg", transparent=True, metadata={"Date": None})
    text = _DROPPED.sub("", stream.getvalue()).strip()
    text = _ID.sub(lambda match: f"{match[1]}{name}-", text)
    for _ in range(2):
        text = _SIZE.sub(r"\1", text, count=1)
    text = _STANDIN.sub(lambda match: _VARIABLES[match[0].lower()], text)
    if themed:
        text = _COLOUR.sub(lambda match: f"var(--{themed[match[0]]})" if match[0] in themed else match[0], text)
    text = _PATH.sub(lambda match: _DECIMALS.sub(r"\1", match[0]), text)
    text = re.sub(r"\s*\n\s*", "\n", text)
    return text.replace("<svg ", f'<svg role="img" aria-label="{html(label)}" ', 1)
