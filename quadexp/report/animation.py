"""A moving picture of flights over one reference, in real time: the path, the vehicles to scale, the error over time.

The whole path shows where the vehicles are; a window that moves with the reference shows how far they are from it, with
every vehicle drawn to scale from above. Where there is wind, an arrow in its corner points where the air goes.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from PIL import Image
from scipy.spatial.transform import Rotation

from quadexp.errors import UsageError
from quadexp.files.writer import check_output, written
from quadexp.log.outcome import COMPLETED
from quadexp.log.schema import Flight
from quadexp.log.store import read_flight
from quadexp.report.metrics import position_error
from quadexp.report.page.replay import SOME_ROTORS
from quadexp.report.style import Figure, looks, plain_log, styled
from quadexp.report.text import speed_text

FORMATS = (".gif", ".webp")
DPI = 100
SIZE = (7.2, 3.9)  # inches
TRAIL = 1.5  # s of path behind a vehicle
COLOURS = 64  # of a frame
HOLD = 1.2  # s that the last frame stays
MOST_FRAMES = 3000
SAME = 1e-6  # m; references that differ by more are not the same
ALIKE = 1e-3  # m; the same of flights at different rates, whose references are compared between samples


def animate(
    paths: Sequence[Path],
    out: Path,
    *,
    rate: float = 20.0,
    begin: float = 0.0,
    end: float | None = None,
    force: bool = False,
) -> dict[str, Any]:
    """Write the flights as an animation, GIF or WebP by the suffix of `out`; returns path, frames and duration (s).

    rate: frames a second. begin, end: s of the flights that are shown; None: to the end.
    Raises UsageError where the flights do not follow one reference, or nothing is left to show.
    """
    if out.suffix.lower() not in FORMATS:
        raise UsageError(f"--out {out}: must end in {' or '.join(FORMATS)}")
    if not 1 <= rate <= 50:
        raise UsageError(f"--rate {rate:g}: must be in [1, 50] frames per second")
    flights = [read_flight(path, whole=True) for path in paths]
    _check_same_reference(paths, flights)
    last = max(float(flight["t"][-1]) for flight in flights)
    end = last if end is None else min(end, last)
    times = np.arange(begin, end + 1e-9, 1 / rate)
    if not 2 <= len(times) <= MOST_FRAMES:
        raise UsageError(
            f"{len(times)} frames from {begin:g} to {end:g} s at {rate:g} a second: must be 2 to {MOST_FRAMES}"
        )
    check_output(out, force=force)
    picture = _Picture(_labels(paths, flights), flights, begin, end)
    frames = [picture.frame(t) for t in times]
    unit = 10 if out.suffix.lower() == ".gif" else 1  # ms, of the durations that a file can hold
    shown = unit * np.diff(np.round(1000 * (times - begin) / unit)).astype(int)  # rounded, without drifting from t
    durations = [*shown.tolist(), round(1000 * HOLD)]

    with written(out, force=force) as file:
        frames[0].save(
            file, out.suffix[1:].upper(), save_all=True, append_images=frames[1:], duration=durations, loop=0
        )
    return {"path": out, "frames": len(frames), "duration": len(frames) / rate}


def _check_same_reference(paths: Sequence[Path], flights: Sequence[Flight]) -> None:
    for path, flight in zip(paths, flights, strict=True):
        if not len(flight["t"]) or "ref_p_x" not in flight.columns:
            raise UsageError(f"{path}: has no samples with a reference to show")
        coarse, fine = sorted((flight, flights[0]), key=lambda one: len(one) / max(float(one["t"][-1]), 1e-9))
        t = coarse["t"][coarse["t"] <= fine["t"][-1] + 1e-9]
        alike = SAME if np.isin(t.round(9), fine["t"].round(9)).all() else ALIKE
        for name in ("ref_p_x", "ref_p_y", "ref_p_z"):
            if np.abs(np.interp(t, fine["t"], fine[name]) - coarse[name][: len(t)]).max() > alike:
                raise UsageError(f"{path}: follows another reference than {paths[0]}; give flights of one trajectory")


def _labels(paths: Sequence[Path], flights: Sequence[Flight]) -> list[str]:
    """The controllers, with the file's name where two flights have the same one."""
    names = [str(flight.metadata.get("controller") or path.stem) for path, flight in zip(paths, flights, strict=True)]
    return [f"{name} {path.stem}" if names.count(name) > 1 else name for name, path in zip(names, paths, strict=True)]


class _Picture:
    """The figure, of which a frame changes only what moves."""

    @styled
    def __init__(self, labels: Sequence[str], flights: Sequence[Flight], begin: float, end: float) -> None:
        self._flights, found = flights, looks(labels)
        self._errors = [position_error(flight) for flight in flights]
        self._arms = [_rotors(flight) for flight in flights]
        longest = max(flights, key=lambda flight: len(flight["t"]))
        self._reference = longest
        self.figure = Figure(figsize=SIZE, dpi=DPI, layout="constrained")
        FigureCanvasAgg(self.figure)
        parts: Any = self.figure.subfigures(1, 2, width_ratios=(1.15, 1))
        left, right = parts
        path, course = left.subplots(2, 1, height_ratios=(2.2, 1))
        near = right.subplots()
        path.plot(longest["ref_p_x"], longest["ref_p_y"], color="#AAAAAA", linewidth=0.8)
        path.set_aspect("equal", "datalim")
        path.set(xlabel="x (m)", ylabel="y (m)")
        path.set_title(_title(longest), fontsize=9)
        self._here, self._trails, self._lines, self._bodies = [], [], [], []
        for label, flight, error in zip(labels, flights, self._errors, strict=True):
            colour = found[label].colour
            self._trails += path.plot([], [], color=colour, linewidth=2)
            self._here += path.plot([], [], marker="o", markersize=5, color=colour, linestyle="none")
            of_all = f"mean {1e3 * error.mean():.3g} mm" if flight.outcome in COMPLETED else flight.outcome
            self._lines += course.plot([], [], color=colour, label=f"{label}: {of_all}")
            body = LineCollection([], colors=colour, linewidths=2.2)
            near.add_collection(body)
            self._bodies.append(body)
        largest = max(
            float(error[_between(flight, begin, end)].max())
            for flight, error in zip(flights, self._errors, strict=True)
        )
        reach = 1.05 * largest + 1.6 * max(float(np.linalg.norm(arms, axis=1).max()) for arms in self._arms)
        near.set(xlim=(-reach, reach), ylim=(-reach, reach), xlabel="x - reference (m)", ylabel="y - reference (m)")
        near.set_aspect("equal")
        near.plot(0, 0, marker="+", markersize=12, color="#777777")
        self._add_wind(near, [found[label].colour for label in labels], reach)
        self._clock = near.set_title("to scale", fontsize=9)
        positive = [error[error > 0] for error in self._errors]
        low = (
            max(min(float(np.percentile(one, 5)) for one in positive if len(one)), 1e-6)
            if any(map(len, positive))
            else 1e-6
        )
        course.set(
            xlim=(0, longest["t"][-1]),
            yscale="log",
            ylim=(1e3 * low, 1.3e3 * max(max(float(error.max()) for error in self._errors), 2 * low)),
            xlabel="time (s)",
            ylabel="error (mm)",
        )
        plain_log(course.yaxis)
        right.legend(*course.get_legend_handles_labels(), loc="outside lower center", fontsize=8)
        self.figure.draw_without_rendering()
        self.figure.set_layout_engine("none")  # one layout for all frames

    def _add_wind(self, near: Any, colours: Sequence[str], reach: float) -> None:
        """Arrows of the winds, all around one point; the strongest is a quarter of the window long."""
        blown = [
            (flight, flight.wind, colour)
            for flight, colour in zip(self._flights, colours, strict=True)
            if flight.wind is not None and flight.wind.any()
        ]
        strongest = max((float(np.linalg.norm(wind, axis=1).max()) for _, wind, _ in blown), default=1.0)
        drawn = {"angles": "xy", "scale_units": "xy", "scale": 2 * strongest / reach, "pivot": "mid", "width": 0.012}
        at = -0.7 * reach, 0.7 * reach
        self._winds = [
            (flight["t"], wind, near.quiver(*at, 0, 0, color=colour, **drawn)) for flight, wind, colour in blown
        ]
        self._strength = near.text(0.02, 0.02, "", transform=near.transAxes, fontsize=8, color="#777777")

    def frame(self, t: float) -> Image.Image:
        """The picture at a time (s)."""
        for flight, error, arms, here, trail, line, body in zip(
            self._flights, self._errors, self._arms, self._here, self._trails, self._lines, self._bodies, strict=True
        ):
            k = int(np.searchsorted(flight["t"], t + 1e-9)) - 1
            ended = t > flight["t"][-1] + 0.1
            first = int(np.searchsorted(flight["t"], t - TRAIL))
            here.set_data(flight["p_x"][k : k + 1], flight["p_y"][k : k + 1])
            here.set_marker("x" if ended else "o")
            trail.set_data(flight["p_x"][first : k + 1], flight["p_y"][first : k + 1])
            line.set_data(flight["t"][: k + 1], 1e3 * np.maximum(error[: k + 1], 1e-9))
            body.set_segments([] if ended else _body(flight, k, arms))
        for times, wind, arrow in reversed(self._winds):
            now = wind[int(np.searchsorted(times, t + 1e-9)) - 1]
            arrow.set_UVC(now[0], now[1])
            self._strength.set_text(f"wind {np.linalg.norm(now):.1f} m/s")
        self._clock.set_text(f"to scale, from above, t = {t:.1f} s")
        canvas: Any = self.figure.canvas
        canvas.draw()
        return Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy()).quantize(
            COLOURS, dither=Image.Dither.NONE
        )


def _between(flight: Flight, begin: float, end: float) -> np.ndarray:
    """Whether a sample is shown, (k,); the last one where the flight ended before."""
    t = flight["t"]
    return (t >= min(begin, float(t[-1]))) & (t <= end)


def _title(flight: Flight) -> str:
    config = flight.metadata.get("config", {})
    speed = (config.get("trajectory") or {}).get("speed")
    name = flight.metadata.get("trajectory", "")
    return f"{name} at {speed_text(speed)}" if speed else str(name)


def _rotors(flight: Flight) -> np.ndarray:
    """Rotor positions in the body frame, (n, 3) (m)."""
    config = flight.metadata.get("config", {}).get("vehicle") or {}
    return np.array(config.get("rotor_position") or SOME_ROTORS, float)


def _body(flight: Flight, k: int, rotors: np.ndarray) -> list[np.ndarray]:
    """Arms and rotor discs seen from above, relative to the reference (m)."""
    rotation = Rotation.from_quat([flight[f"q_{axis}"][k] for axis in "xyzw"]).as_matrix()
    centre = np.array([flight[f"p_{axis}"][k] - flight[f"ref_p_{axis}"][k] for axis in "xyz"])
    angle = np.linspace(0, 2 * np.pi, 17)
    radius = 0.55 * np.linalg.norm(rotors[:, :2], axis=1).min()
    disc = radius * np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    lines = [np.stack([centre, centre + rotation @ rotor])[:, :2] for rotor in rotors]
    return lines + [(centre + (rotor + disc) @ rotation.T)[:, :2] for rotor in rotors]
