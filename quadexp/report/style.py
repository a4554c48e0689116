"""The look of all figures and of the report's page: colour and marker per controller, style, legends, logarithmic axes.

A controller looks the same in every figure and on the page, and so does a model of the air: `gp_mpc` and a GP are blue.
Variants of a controller (settings, checkpoint) have its hue in another shade, hollow markers, another dash. Every hue
has a colour on light ground (also on paper) and one on dark ground. All have a contrast of 3:1 and are distinct for
colour-blind readers (tests/report/test_palette.py).
"""

from __future__ import annotations

import io
import math
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import cycle
from typing import Any

import matplotlib.figure
from matplotlib.axis import Axis
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.lines import Line2D
from matplotlib.text import Text
from matplotlib.ticker import FixedLocator, FuncFormatter, NullFormatter

from quadexp.messages import clean
from quadexp.parts.options import OptionFiles

HUES: dict[str, tuple[str, str]] = {  # hue -> colour on light and on dark ground
    "ink": ("#000000", "#ffffff"),
    "orange": ("#b87708", "#ecb83f"),
    "blue": ("#004fc3", "#51a3fa"),
    "green": ("#0a7344", "#46d7a0"),
    "pink": ("#90338f", "#c751ba"),
    "vermillion": ("#8c2e08", "#e47048"),
    "sky": ("#1e8fcc", "#a3cee6"),
    "brown": ("#4e1b06", "#906b5a"),
    "grey": ("#5f6773", "#8d97a5"),
}
USUAL_SHADES = (
    (-0.45, 0.25, -0.7),
    (0.6, 0.35, -0.25),
)  # of variants on light and dark ground: share of white, or of black
OTHER_SHADES: dict[str, tuple[tuple[float, ...], tuple[float, ...]]] = {  # where the usual ones are not distinct
    "ink": ((0.5, 0.25, 0.38), (-0.55, -0.25, -0.4)),
    "orange": ((-0.45, -0.25, -0.7), (0.6, -0.35, 0.35)),
    "pink": (USUAL_SHADES[0], (0.65, 0.3, 0.48)),
    "sky": ((-0.45, -0.25, -0.7), (-0.45, 0.7, -0.25)),
    "brown": ((0.45, 0.25, -0.6), (0.65, 0.3, 0.48)),
}
COLOURS = tuple(HUES[hue][0] for hue in HUES if hue != "grey")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*", "h", "<", ">", "p")
DASHES: tuple[Any, ...] = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)))
STYLE: Any = {  # matplotlib types every single key
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


@dataclass(frozen=True)
class _Clean:
    """Texts of ticks without control characters. made: text of a value and its number."""

    made: Callable[..., str]

    def __call__(self, *tick: Any) -> str:
        return clean(self.made(*tick))


MANY = 20_000  # points


class Figure(matplotlib.figure.Figure):
    """A figure whose texts have no control character, and whose fonts are whole in PDF and PostScript (Type 42: systems
    for submissions refuse Type 3). A line of more than MANY points is pixels in a vector format, as that of an hour of
    flight, which would be megabytes. A notebook shows it, also where matplotlib.pyplot is not in use."""

    def draw(self, renderer: Any) -> None:
        for axis in self.findobj(Axis):  # which makes its texts while it is drawn
            formatter = axis.get_major_formatter()
            if isinstance(formatter, FuncFormatter) and not isinstance(formatter.func, _Clean):
                formatter.func = _Clean(formatter.func)
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
        stream = io.BytesIO()
        self.savefig(stream, format="png", dpi=72, bbox_inches="tight")
        return stream.getvalue()


PLAIN = FuncFormatter(lambda value, _: f"{value:g}")
Worn = tuple[str, str, Any]  # hue, marker, dash


def _looks_of_options() -> tuple[dict[str, Worn], dict[str, Worn]]:
    """The looks that the options of controllers state (`look:`), and those that share a hue with one of them that they
    seldom stand beside (`seldom: true`)."""
    files = OptionFiles()
    stated = {option: look for option in files.options("controller") if (look := files.look("controller", option))}
    worn = {option: (look["hue"], look["marker"], look["dash"]) for option, look in stated.items()}
    usual = {option: look for option, look in worn.items() if not stated[option].get("seldom")}
    return usual, {option: look for option, look in worn.items() if option not in usual}


LOOKS, MORE_LOOKS = _looks_of_options()
LOOKS |= {  # models of the air
    "nominal": ("grey", "o", "-"),
    "linear drag": ("orange", "s", "-"),
    "quadratic drag": ("green", "X", "--"),
    "blade element": ("vermillion", "D", "-."),
}
ALL_LOOKS = LOOKS | MORE_LOOKS
SELDOM = ("green", "sky", "pink", "brown", "vermillion")  # hues that controllers without a look of their own get first
KNOWN = {name: (HUES[hue][0], marker, dash) for name, (hue, marker, dash) in LOOKS.items()}  # with the colour on paper
BLUE, ORANGE, GREY = KNOWN["gp_mpc"][0], KNOWN["linear drag"][0], "#777777"
COUNTS = LinearSegmentedColormap.from_list("counts", ["#E4E7EC", "#9AA4B5", "#4A5468"])  # of data behind curves
MOST_VARIANTS = 4  # of one controller that share its hue; with more, each has a hue of its own


@dataclass(frozen=True)
class Look:
    """How one contestant is drawn. hue: of HUES. shade: 0, or the number of a variant. filled: its markers."""

    hue: str
    marker: str
    dash: Any
    shade: int = 0
    filled: bool = True

    @property
    def token(self) -> str:
        """Name of the colour, such as "blue-1": a CSS variable of the page."""
        return f"{self.hue}-{self.shade}"

    @property
    def colour(self) -> str:
        """On paper."""
        return shaded(self.hue, self.shade)

    def line(self) -> dict[str, Any]:
        """Keywords of `plot` for a line without markers."""
        return {"color": self.colour, "linestyle": self.dash}

    def points(self) -> dict[str, Any]:
        """Keywords of `plot` for a line with markers."""
        face = self.colour if self.filled else "#FFFFFF"
        return {**self.line(), "marker": self.marker, "markersize": 5, "markerfacecolor": face}


def shaded(hue: str, shade: int = 0, *, dark: bool = False) -> str:
    """The colour of a hue, or of the shade of a variant. dark: on dark ground."""
    colour = HUES[hue][dark]
    if shade == 0:
        return colour
    share = OTHER_SHADES.get(hue, USUAL_SHADES)[dark][shade - 1]
    end = 255 if share > 0 else 0
    mixed = (int(colour[i : i + 2], 16) * (1 - abs(share)) + end * abs(share) for i in (1, 3, 5))
    return "#" + "".join(f"{round(value):02x}" for value in mixed)


def looks(labels: Sequence[str]) -> dict[str, Look]:
    """Label -> look. The first word of a label is the controller, which decides hue and marker, whoever else is there;
    one with remedies (gp_mpc+wind) has the hue of the controller, and a shade and a hollow marker of the remedies.

    A controller without a look of its own gets one by its name; only where that is taken by another label, the next
    one that is free. The plain variant of a controller is the one on the plant ("@plant") of most labels.
    """
    labels = list(dict.fromkeys(labels))
    plants = [next((word for word in label.split(" ") if word.startswith("@")), "") for label in labels]
    usual = {label: plants.count(plant) for label, plant in zip(labels, plants, strict=True)}
    variants: dict[str, list[str]] = {}
    for label in sorted(labels, key=lambda label: -usual[label]):
        variants.setdefault(name_of(label), []).append(label)
    many = {name for name, own in variants.items() if len(own) > MOST_VARIANTS}
    taken = [ALL_LOOKS[name][:2] for name in variants if name in ALL_LOOKS and name not in many]
    chosen: dict[str, Look] = {}
    for name in sorted(variants, key=lambda name: ("+" in name, name not in LOOKS, name not in ALL_LOOKS)):
        if name in many:
            free = [[x for x in every if all(x not in pair for pair in taken)] or every for every in (HUES, MARKERS)]
            for i, (label, hue, marker) in enumerate(zip(variants[name], *map(cycle, free), strict=False)):
                chosen[label] = Look(hue, marker, DASHES[i // len(HUES) % len(DASHES)])
            continue
        controller, plus, remedies = name.partition("+")
        hue, marker, dash = ALL_LOOKS.get(name) or (*_pair_of(controller, chosen, taken), "-")
        taken.append((hue, marker))
        dashes = [dash, *(other for other in DASHES if other != dash)]
        for i, label in enumerate(variants[name]):
            look = Look(hue, marker, dashes[i], i, i == 0)
            others = list(chosen.values())
            chosen[label] = _with_remedies(look, f"{remedies} {i}", others) if plus else _apart(look, others)
    return {label: chosen[label] for label in labels}


def _pair_of(name: str, chosen: Mapping[str, Look], taken: Sequence[tuple[str, str]]) -> tuple[str, str]:
    """Hue and marker of a controller without a look of its own: with remedies that of the plain one, otherwise by its
    name, as far as nobody else has them."""
    if name in chosen:
        return chosen[name].hue, chosen[name].marker
    if name in ALL_LOOKS:
        return ALL_LOOKS[name][:2]
    at = zlib.crc32(name.encode())
    hues = [*_turned(SELDOM, at), *(hue for hue in HUES if hue not in SELDOM)]
    markers = _turned([m for m in MARKERS if m not in "os^v"], at // len(SELDOM))  # which the usual controllers have
    worn = {word for pair in taken for word in pair}
    pairs = [(hue, marker) for hue in hues for marker in markers]
    return min(pairs, key=lambda pair: (pair[0] in worn, pair[1] in worn, pair in taken))


def _turned(values: Sequence[Any], by: int) -> list[Any]:
    return [values[(by + i) % len(values)] for i in range(len(values))]


def _with_remedies(look: Look, remedies: str, others: Sequence[Look]) -> Look:
    """The look of a controller with remedies: a shade, marker and dash of these, as far as nobody else has them."""
    at, worn = zlib.crc32(remedies.encode()), {(other.hue, other.shade, other.marker, other.filled) for other in others}
    look = replace(look, dash=DASHES[1 + at % (len(DASHES) - 1)], filled=False)
    shades = range(1, MOST_VARIANTS)
    for k, marker in enumerate(_turned(MARKERS, at // 7)):
        for shade in _turned(shades, at + k * len(shades)):
            if (look.hue, shade, marker, False) not in worn:
                return replace(look, marker=marker, shade=shade)
    return look


def _apart(look: Look, others: Sequence[Look]) -> Look:
    """A look in a shade that no other label of the same hue has; the first one of a hue is unchanged."""
    worn = {other.shade for other in others if other.hue == look.hue}
    free = [shade for shade in range(MOST_VARIANTS) if shade not in worn]
    return replace(look, shade=free[0]) if look.shade in worn and free else look


def name_of(label: str) -> str:
    """The controller of a label such as "gp_mpc per_axis @ideal"; a model of the air is its whole label."""
    return label if label in LOOKS else label.split(" ", maxsplit=1)[0]


def entries(panels: Iterable[Any]) -> tuple[list[Any], list[str]]:
    """Handles and labels of a legend for several panels, each label once."""
    found: dict[str, Any] = {}
    for panel in panels:
        for handle, text in zip(*panel.get_legend_handles_labels(), strict=True):
            found.setdefault(text, handle)
    return list(found.values()), list(found)


def plain_log(axis: Any, *, minor: bool = False) -> None:
    """Round ticks of a logarithmic axis as plain numbers, as many as fit; a short span is widened.

    minor: keep unlabelled ticks between them.
    """
    low, high = axis.get_view_interval()
    if high / low < 1.6:
        middle = math.sqrt(low * high)
        low, high = middle / 1.6, middle * 1.6
        axis.set_view_interval(low, high, ignore=True)
    span = high / low
    steps = (1,) if span > 300 else (1, 2, 5) if span > 6 else (1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 8)
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    ticks = [step * 10.0**decade for decade in decades for step in steps]
    axis.set_major_locator(FixedLocator([tick for tick in ticks if low <= tick <= high]))
    axis.set_major_formatter(PLAIN)
    axis.set_minor_formatter(NullFormatter())
    if not minor or len(steps) > 3:
        axis.set_minor_locator(FixedLocator([]))
