"""What all figures share: the style, who wears which colour and marker, and logarithmic axes with plain numbers.

Colours are Okabe and Ito's, with a dark brown for their yellow, which white paper swallows: colour-blind readers can
tell them apart, and markers and dashes differ as well. A controller looks the same in every figure, and so does a model
of the air: `gp_mpc` and a fitted GP are blue.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib.ticker import FixedLocator, FuncFormatter, NullFormatter

COLOURS = ("#000000", "#E69F00", "#0072B2", "#009E73", "#CC79A7", "#D55E00", "#56B4E9", "#663311")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*", "h", "<", ">", "p")
DASHES: tuple[Any, ...] = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)))
GREY = "#5F6773"
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
}
PLAIN = FuncFormatter(lambda value, _: f"{value:g}")
KNOWN: dict[str, tuple[str, str, Any]] = {  # controller or model of the air -> colour, marker, dash
    "nominal_mpc": (GREY, "o", "-"),
    "linear_drag_mpc": (COLOURS[1], "s", "-"),
    "gp_mpc": (COLOURS[2], "^", "-"),
    "rls_mpc": (COLOURS[5], "D", "-"),
    "perfect_mpc": (COLOURS[0], "v", ":"),
    "static_feedback": (COLOURS[4], "P", "--"),
    "rls_feedback": (COLOURS[3], "X", "-"),
    "oracle_feedback": (COLOURS[6], "*", ":"),
    "literal_feedback": (COLOURS[7], "h", "-."),
    "nominal": (GREY, "o", "-"),
    "linear drag": (COLOURS[1], "s", "-"),
    "quadratic drag": (COLOURS[3], "X", "--"),
    "blade element": (COLOURS[5], "D", "-."),
}
MOST_VARIANTS = 4  # of one controller that share its colour; of more, every one takes a colour of its own


@dataclass(frozen=True)
class Look:
    """How one line is drawn. filled: its markers."""

    colour: str
    marker: str
    dash: Any
    filled: bool = True

    def line(self) -> dict[str, Any]:
        """Keywords of `plot` for a line without markers."""
        return {"color": self.colour, "linestyle": self.dash}

    def points(self) -> dict[str, Any]:
        """Keywords of `plot` for a line with markers."""
        face = self.colour if self.filled else "#FFFFFF"
        return {**self.line(), "marker": self.marker, "markersize": 5, "markerfacecolor": face}


def looks(labels: Sequence[str]) -> dict[str, Look]:
    """Label -> look. The first word of a label is the controller, which decides colour and marker.

    Further variants of a controller have its colour, hollow markers and another dash; the plain one is that on the
    plant ("@plant") which most labels share.
    """
    labels = list(dict.fromkeys(labels))
    plants = [_plant(label) for label in labels]
    usual = {label: plants.count(plant) for label, plant in zip(labels, plants, strict=True)}
    variants: dict[str, list[str]] = {}
    for label in sorted(labels, key=lambda label: -usual[label]):
        variants.setdefault(name_of(label), []).append(label)
    worn = {KNOWN[name][:2] for name, own in variants.items() if name in KNOWN and len(own) <= MOST_VARIANTS}
    spare = _spare(worn)
    found: dict[str, Look] = {}
    for name, own in variants.items():
        if len(own) > MOST_VARIANTS:
            for i, label in enumerate(own):
                colour, marker = next(spare)
                found[label] = Look(colour, marker, DASHES[i // len(COLOURS) % len(DASHES)])
            continue
        colour, marker, dash = KNOWN[name] if name in KNOWN else (*next(spare), "-")
        others = [other for other in DASHES if other != dash]
        for i, label in enumerate(own):
            found[label] = Look(colour, marker, dash if i == 0 else others[i - 1], filled=i == 0)
    return {label: found[label] for label in labels}


def name_of(label: str) -> str:
    """The controller of a label such as "gp_mpc per_axis @ideal"; a model of the air is its whole label."""
    return label if label in KNOWN else label.split(" ", maxsplit=1)[0]


def _plant(label: str) -> str:
    return next((word for word in label.split(" ") if word.startswith("@")), "")


def _spare(worn: set[tuple[str, str]]) -> Iterator[tuple[str, str]]:
    """Pairs of colour and marker without end, those first that nobody wears."""
    colours = [c for c in COLOURS if c not in {w[0] for w in worn}] or list(COLOURS)
    markers = [m for m in MARKERS if m not in {w[1] for w in worn}] or list(MARKERS)
    i = 0
    while True:
        yield colours[i % len(colours)], markers[i % len(markers)]
        i += 1


def plain_log(axis: Any, *, minor: bool = False) -> None:
    """Round ticks of a logarithmic axis as plain numbers, as many as its span has room for; a short span is widened.

    minor: unlabelled ticks between them stay.
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
