"""A matplotlib figure as inline SVG that follows the page's theme: colours become CSS variables, text stays text."""

from __future__ import annotations

import html
import io
import re
from typing import Any

import matplotlib
from matplotlib.figure import Figure

from quadexp.report.page.palette import STANDINS

STYLE: Any = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 8.5,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titlepad": 8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.linewidth": 0.8,
    "grid.linewidth": 0.6,
    "xtick.major.size": 3,
    "ytick.major.size": 0,
    "xtick.minor.size": 0,
    "ytick.minor.size": 0,
    "lines.linewidth": 1.6,
    "lines.markersize": 5,
    "legend.frameon": False,
    "pdf.fonttype": 42,
    "svg.hashsalt": "quadexp",
}
_DROPPED = re.compile(r"<\?xml.*?\?>|<!DOCTYPE.*?>|<metadata>.*?</metadata>|<!--.*?-->", re.DOTALL)
_ID = re.compile(r'(\bid="|xlink:href="#|url\(#)')
_SIZE = re.compile(r'(<svg\b[^>]*?)\s(?:width|height)="[^"]*"')
_PATH = re.compile(r'\bd="[^"]*"')
_DECIMALS = re.compile(r"(\d+\.\d{2})\d+")
_VARIABLES = {standin: f"var(--{name})" for name, standin in STANDINS.items()}
_STANDIN = re.compile("|".join(_VARIABLES), re.IGNORECASE)


def inline_svg(figure: Figure, name: str, label: str) -> str:
    """The figure as an <svg> element. name: unique on the page. label: what it shows, for those who cannot see it."""
    stream = io.StringIO()
    with matplotlib.rc_context({**STYLE, "svg.fonttype": "none"}):
        figure.savefig(stream, format="svg", transparent=True, metadata={"Date": None})
    text = _DROPPED.sub("", stream.getvalue()).strip()
    text = _ID.sub(lambda match: f"{match[1]}{name}-", text)
    for _ in range(2):
        text = _SIZE.sub(r"\1", text, count=1)
    text = _STANDIN.sub(lambda match: _VARIABLES[match[0].lower()], text)
    text = _PATH.sub(lambda match: _DECIMALS.sub(r"\1", match[0]), text)
    text = re.sub(r"\s*\n\s*", "\n", text)
    return text.replace("<svg ", f'<svg role="img" aria-label="{html.escape(label, quote=True)}" ', 1)
