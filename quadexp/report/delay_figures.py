"""Delays of a flight as a figure: what every candidate leaves unexplained; and what a controller believed in flight."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes

from quadexp.report.style import HUES, Figure, styled

MS = 1e3
SHOWN = 20.0  # log likelihood below the best that is drawn
BELIEVED = {  # column -> what it is, hue
    "delay_time": ("age of the state", "blue"),
    "delay_dead_time": ("dead time of the commands", "vermillion"),
    "delay_lag": ("lag of the motors", "green"),
}


@dataclass(frozen=True)
class Profile:
    """One delay. candidates: (k,) (s). score: log likelihood of each less that of the best, (k,). found, error: the
    delay and its standard error (s)."""

    name: str
    candidates: np.ndarray
    score: np.ndarray
    found: float
    error: float


@styled
def delay_figure(
    profiles: Sequence[Profile], columns: Mapping[str, np.ndarray], true: Mapping[str, float] | None = None
) -> Figure:
    """A panel for each profile; below them, where the flight had delay=identified, what was believed over time.

    columns: of the flight. true: by column of BELIEVED, what the flight's world states (s).
    """
    flown = "delay_known" in columns
    figure = Figure(figsize=(9.0, 5.6 if flown else 3.0), layout="constrained")
    grid = figure.add_gridspec(2 if flown else 1, len(profiles))
    for i, profile in enumerate(profiles):
        panel = figure.add_subplot(grid[0, i])
        _draw_profile(panel, profile)
        if not i:
            panel.set_ylabel("log likelihood, less the best")
    if flown:
        _draw_believed(figure.add_subplot(grid[1, :]), columns, true or {})
    return figure


def _draw_profile(panel: Axes, profile: Profile) -> None:
    colour, mark = HUES["blue"][0], HUES["vermillion"][0]
    panel.plot(MS * profile.candidates, profile.score, color=colour)
    low, high = (max(profile.found + side * profile.error, 0.0) for side in (-1, 1))
    panel.axvspan(MS * low, MS * high, color=mark, alpha=0.15, linewidth=0)
    panel.axvline(MS * profile.found, color=mark, linestyle="--")
    panel.set_ylim(-SHOWN, 0.05 * SHOWN)
    panel.set_xlim(MS * profile.candidates[0], MS * profile.candidates[-1])
    panel.set_title(profile.name)
    panel.set_xlabel(f"candidate, ms\nfound {MS * profile.found:.1f} ms, standard error {MS * profile.error:.1f}")


def _draw_believed(panel: Axes, columns: Mapping[str, np.ndarray], true: Mapping[str, float]) -> None:
    for column, (name, hue) in BELIEVED.items():
        colour = HUES[hue][0]
        panel.step(columns["t"], MS * columns[column], where="post", color=colour, label=name)
        if column in true:
            panel.axhline(MS * true[column], color=colour, linestyle=":", linewidth=1.0)
    panel.set_title("made good in flight; dotted: true" if true else "made good in flight")
    panel.set_xlabel("time, s")
    panel.set_ylabel("ms")
    panel.legend(loc="center right")
