"""The look of all figures and of the report's page: colour and marker per controller, style, legends, logarithmic axes;
and how a figure is written.

A controller whose option states its look has it in every figure and on the page, and so does a model of the air:
`gp_mpc` and a GP are blue. Variants of a controller (settings, checkpoint) have its marker, hollow, and another dash;
their colours, and those of all others, are the next of CYCLE that nobody has. All colours have a contrast of 3:1 and
are distinct for colour-blind readers (tests/plugins/drawing/test_style.py).
"""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import wraps
from itertools import cycle, product
from pathlib import Path
from typing import Any

import matplotlib.figure
import numpy as np
from matplotlib.axis import Axis
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, LogNorm, Normalize, to_hex, to_rgb
from matplotlib.lines import Line2D
from matplotlib.text import Text
from matplotlib.ticker import FixedLocator, FuncFormatter, NullFormatter

from quadexp.errors import UsageError
from quadexp.messages import clean, html
from quadexp.names import distinct
from quadexp.parts.options import OptionFiles
from quadexp.progress import set_status
from quadexp.report import FORMATS
from quadexp.writer import check_output, written

PICTURES = ("png", "pdf", "svg")  # suffixes of a figure

HUES = {
    "ink": "#000000",
    "orange": "#b87708",
    "blue": "#004fc3",
    "green": "#0a7344",
    "pink": "#90338f",
    "vermillion": "#8c2e08",
    "sky": "#1e8fcc",
    "brown": "#4e1b06",
    "grey": "#5f6773",
}
USUAL_SHADES = (-0.45, 0.25, -0.7)  # of variants: share of white, or of black where negative
OTHER_SHADES = {  # where the usual ones are not distinct
    "ink": (0.5, 0.25, 0.38),
    "orange": (-0.45, -0.25, -0.7),
    "sky": (-0.45, -0.25, -0.7),
    "brown": (0.45, 0.25, -0.6),
}
COLOURS = tuple(colour for hue, colour in HUES.items() if hue != "grey")
GLYPHS = {  # marker of matplotlib -> the same as letters, filled and hollow
    "o": "●○", "s": "■□", "^": "▲△", "D": "◆◇", "v": "▼▽", "P": "✚✛", "X": "✖✕", "*": "★☆", "h": "⬢⬡", "<": "◀◁",
    ">": "▶▷", "p": "⬟⬠",
}  # fmt: skip
MARKERS = tuple(GLYPHS)
DASHES: tuple[Any, ...] = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)))  # points on, points off
STYLE: Any = {  # matplotlib types every single key
    "figure.constrained_layout.use": True,
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#DDDDDD",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.5,
    "legend.frameon": False,
    "svg.fonttype": "path",
    "svg.hashsalt": "quadexp",
    "text.parse_math": False,  # a name may hold any letter: mathematics is asked for where a text is mathematics
}
styled = matplotlib.rc_context(STYLE)  # decorator of functions that make a Figure


MANY = 20_000  # points
LARGEST_DRAWING = 100_000  # bytes of a drawing on a page
DOTS = 144  # of a picture on a page, an inch


class Figure(matplotlib.figure.Figure):
    """A figure whose texts have no control character, and whose fonts are whole in PDF and PostScript (Type 42: systems
    for submissions refuse Type 3). A line of more than MANY points is pixels in a vector format, as that of an hour of
    flight, which would be megabytes. A notebook shows it, also where matplotlib.pyplot is not in use."""

    def draw(self, renderer: Any) -> None:
        for axis in self.findobj(Axis):  # which makes its texts while it is drawn
            formatter = axis.get_major_formatter()
            if isinstance(formatter, FuncFormatter) and not hasattr(formatter.func, "__wrapped__"):
                formatter.func = _cleaned(formatter.func)
        for text in self.findobj(Text):
            if (shown := clean(text.get_text())) != text.get_text():
                text.set_text(shown)
        super().draw(renderer)

    def savefig(self, *args: Any, **kwargs: Any) -> None:
        for line in self.findobj(Line2D) + self.findobj(LineCollection):
            shown: Any = line
            if len(shown.get_xdata() if isinstance(line, Line2D) else shown.get_paths()) > MANY:
                line.set_rasterized(True)
        with matplotlib.rc_context({"pdf.fonttype": 42, "ps.fonttype": 42}):
            super().savefig(*args, **kwargs)

    def _repr_png_(self) -> bytes:
        return drawing(self, format="png", dpi=72, bbox_inches="tight")


def _cleaned(text_of: Callable[..., str]) -> Callable[..., str]:
    """What makes the text of a tick, without control characters."""
    return wraps(text_of)(lambda *tick: clean(text_of(*tick)))


PLAIN = FuncFormatter(lambda value, _: f"{value:g}")


@dataclass(frozen=True)
class Look:
    """How one contestant is drawn. hue: of HUES. shade: 0, or the number of a variant. filled: its markers. own: a
    colour that a user gave, "#rrggbb"."""

    hue: str
    marker: str
    dash: Any
    shade: int = 0
    filled: bool = True
    own: str = ""

    @property
    def colour(self) -> str:
        """As "#rrggbb"."""
        return self.own or shaded(self.hue, self.shade)

    @property
    def glyph(self) -> str:
        """The marker as a letter."""
        return GLYPHS[self.marker][not self.filled]

    def line(self) -> dict[str, Any]:
        """Keywords of `plot` for a line without markers."""
        return {"color": self.colour, "linestyle": self.dash}

    def points(self) -> dict[str, Any]:
        """Keywords of `plot` for a line with markers."""
        face = self.colour if self.filled else "#FFFFFF"
        return {**self.line(), "marker": self.marker, "markersize": 5, "markerfacecolor": face}


def shaded(hue: str, shade: int = 0) -> str:
    """The colour of a hue, or of the shade of a variant."""
    if shade == 0:
        return HUES[hue]
    share = OTHER_SHADES.get(hue, USUAL_SHADES)[shade - 1]
    red, green, blue = (value + abs(share) * ((share > 0) - value) for value in to_rgb(HUES[hue]))
    return to_hex((red, green, blue))


def _looks_of_options() -> dict[str, Look]:
    """The looks that the options of controllers state (`look:`); last those that share a hue with another one that they
    seldom stand beside (`seldom: true`)."""
    files = OptionFiles()
    stated = {}
    for option in files.options("controller"):
        look = files.look("controller", option)
        if look:
            stated[option] = look
    usual_first = sorted(stated.items(), key=lambda item: bool(item[1].get("seldom")))
    return {option: Look(look["hue"], look["marker"], look["dash"]) for option, look in usual_first}


MODELS = {  # of the air
    "nominal": Look("grey", "o", "-"),
    "linear drag": Look("orange", "s", "-"),
    "quadratic drag": Look("green", "X", "--"),
    "blade element": Look("vermillion", "D", "-."),
}
LOOKS = MODELS | _looks_of_options()
BLUE = HUES["blue"]
ORANGE = HUES["orange"]
GREY = "#777777"
# Light for small errors, dark for large ones; without the end that is invisible on white paper.
ERROR_COLOURS = LinearSegmentedColormap.from_list(
    "error", matplotlib.colormaps["magma_r"](np.linspace(0.18, 0.97, 256))
)
COUNTS = LinearSegmentedColormap.from_list("counts", ["#E4E7EC", "#9AA4B5", "#4A5468"])  # of data behind curves
SHADES = 1 + len(USUAL_SHADES)  # of a hue, itself among them
CYCLE = tuple(  # the looks of those that state none: every hue, then every hue in another shade
    Look(hue, marker, DASHES[shade], shade)
    for (shade, hue), marker in zip(product(range(SHADES), HUES), cycle(MARKERS), strict=False)
)


def looks(labels: Sequence[str]) -> dict[str, Look]:
    """Label -> look; no two have one colour, up to the length of CYCLE. The first word of a label is the controller. A
    controller that states its look has it, in whatever company. Every other label, and a variant of a controller or the
    same with remedies (gp_mpc+wind), has the next colour that is free: a hue as long as there is one, then a shade. A
    variant keeps the marker of its controller, hollow, and has another dash.
    """
    labels = distinct(labels)
    order = {name: place for place, name in enumerate(LOOKS)}
    in_order = sorted(labels, key=lambda label: order.get(name_of(label), len(order)))
    chosen: dict[str, Look] = {}
    for label in in_order:  # those that state their look first
        stated = LOOKS.get(name_of(label))
        if stated is not None and stated.colour not in {look.colour for look in chosen.values()}:
            chosen[label] = stated
    used = {look.colour for look in chosen.values()}
    free = cycle([look for look in CYCLE if look.colour not in used])
    for label in in_order:
        if label in chosen:
            continue
        look = next(free)
        stated = LOOKS.get(name_of(label).partition("+")[0])
        if stated is not None:
            alike = sum(other.marker == stated.marker for other in chosen.values())
            look = replace(look, marker=stated.marker, filled=False, dash=DASHES[alike % len(DASHES)])
        chosen[label] = look
    return {label: chosen[label] for label in labels}


def name_of(label: str) -> str:
    """The controller of a label such as "gp_mpc per_axis @ideal"; a model of the air is its whole label."""
    return label if label in LOOKS else label.split(" ", maxsplit=1)[0]


def entries(panels: Iterable[Any]) -> tuple[list[Any], list[str]]:
    """Handles and labels of a legend for several panels, each label once."""
    handles: dict[str, Any] = {}
    for panel in panels:
        for handle, text in zip(*panel.get_legend_handles_labels(), strict=True):
            handles.setdefault(text, handle)
    return list(handles.values()), list(handles)


def plain_log(axis: Any, *, minor: bool = False) -> None:
    """Round ticks of a logarithmic axis as plain numbers, as many as fit; a short span is widened.

    minor: keep unlabelled ticks between them.
    """
    low, high = axis.get_view_interval()
    if high / low < 1.6:
        middle = math.sqrt(low * high)
        low = middle / 1.6
        high = middle * 1.6
        axis.set_view_interval(low, high, ignore=True)
    span = high / low
    steps = [1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 8]
    if span > 300:
        steps = [1]
    elif span > 6:
        steps = [1, 2, 5]
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    ticks = [step * 10.0**decade for decade in decades for step in steps]
    axis.set_major_locator(FixedLocator([tick for tick in ticks if low <= tick <= high]))
    axis.set_major_formatter(PLAIN)
    axis.set_minor_formatter(NullFormatter())
    if not minor or len(steps) > 3:
        axis.set_minor_locator(FixedLocator([]))


def mathematics(panel: Any) -> None:
    """Let what stands between $ in the texts of a panel be mathematics."""
    legend = panel.get_legend()
    texts = [panel.xaxis.label, panel.yaxis.label, panel.title, *panel.get_xticklabels()]
    for text in [*texts, *(legend.get_texts() if legend else ())]:
        text.set_parse_math(True)


def error_bar(figure: Figure, norm: Normalize, panels: Any, label: str, **where: Any) -> None:
    """The scale of ERROR_COLOURS beside panels, with plain numbers."""
    bar = figure.colorbar(ScalarMappable(norm, ERROR_COLOURS), ax=panels, label=label, **where)
    if isinstance(norm, LogNorm):
        plain_log(bar.ax.yaxis)


@styled
def save_figure(figure: Figure, path: Path, *, force: bool = True) -> Path:
    """Write a figure as PNG, PDF or SVG, as its suffix says, without the time at which it was drawn."""
    form = path.suffix.lower().lstrip(".")
    undated = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(form)
    with written(path, force=force) as file:
        figure.savefig(file, format=form, dpi=150, metadata=undated)
    return path


def check_path(path: Path, force: bool, suffixes: Sequence[str] = PICTURES) -> Path:
    """The path of a figure; UsageError for a suffix of none of the formats, or a file that is there."""
    if path.suffix.lower().lstrip(".") not in suffixes:
        raise UsageError(f"--out {path}: a figure is a file .{', .'.join(suffixes)}")
    return check_output(path, force=force)


def save(figure: Figure, path: Path) -> Path:
    """Write a figure as PNG and SVG; returns the path of the SVG, the last that is written."""
    set_status(f"drawing {path.name}")
    for form in reversed(FORMATS):
        save_figure(figure, path.with_suffix(f".{form}"))
    return path.with_suffix(".svg")


def figure_html(figure: Figure, label: str) -> str:
    """A figure inside a page: a drawing (SVG), or where it has too many marks a picture (PNG). label: its description
    for screen readers."""
    with matplotlib.rc_context({**STYLE, "svg.fonttype": "none"}):
        form = "svg+xml"
        drawn = drawing(figure, format="svg", transparent=True, metadata={"Date": None})
    if len(drawn) > LARGEST_DRAWING:
        form = "png"
        drawn = drawing(figure, format="png", dpi=DOTS)
    source = f"data:image/{form};base64,{base64.b64encode(drawn).decode()}"
    return f'<figure style="--wide:{figure.get_size_inches()[0]:.1f}"><img alt="{html(label)}" src="{source}"></figure>'


def drawing(figure: Figure, **how: Any) -> bytes:
    """A figure as a file. how: keywords of `savefig`."""
    stream = io.BytesIO()
    figure.savefig(stream, **how)
    return stream.getvalue()
