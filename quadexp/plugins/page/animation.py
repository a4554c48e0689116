"""A moving picture of flights over one reference, in real time: the path, the vehicles to scale, the error over time.

The whole path shows where the vehicles are; a window that moves with the reference shows how far they are from it, with
every vehicle drawn to scale from above.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from PIL import Image
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from quadexp.errors import UsageError
from quadexp.log.outcome import COMPLETED
from quadexp.log.schema import Flight
from quadexp.log.store import read_flight
from quadexp.physics.state import norms
from quadexp.plugins.drawing.style import Figure, looks, plain_log, styled
from quadexp.progress import Progress
from quadexp.report.metrics import position_error
from quadexp.report.text import speed_text
from quadexp.writer import check_output, written

DPI = 100  # of matplotlib's usual figure
SIZE = (7.2, 3.9)  # inches
TRAIL = 1.5  # s of path behind a vehicle
COLOURS = 64  # of a GIF
HOLD = 1.2  # s that the last frame stays
MOST_FRAMES = 3000  # 2 min at 25 a second
AFTER_END = 0.1  # s from which on a vehicle is shown to have ended
LEAST_ERROR = 1e-9  # m, on a logarithmic axis
REFERENCE = ("ref_p_x", "ref_p_y", "ref_p_z")
SAME = 1e-3  # m; references that differ by more are not the same: those of other control rates are interpolated


def animate(
    paths: Sequence[Path],
    out: Path,
    *,
    rate: float = 20.0,
    begin: float = 0.0,
    end: float | None = None,
    force: bool = False,
) -> dict[str, Any]:
    """Write the flights as an animation; returns path, frames and duration (s).

    out: a GIF. rate: frames a second. begin, end: s of the flights that are shown; None: to
    the end. Raises UsageError where the flights do not follow one reference, or nothing is left to show.
    """
    if out.suffix.lower() != ".gif":
        raise UsageError(f"--out {out}: must end in .gif")
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
    with written(out, force=force) as file, Progress("frames") as progress:
        _write_gif(picture, times, file, progress)
    return {"path": out, "frames": len(times), "duration": len(times) / rate}


def _write_gif(picture: _Picture, times: np.ndarray, file: BinaryIO, progress: Progress) -> None:
    """All frames have the colours of the one in the middle."""
    typical = picture.frame(times[len(times) // 2])
    palette = typical.quantize(COLOURS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)

    def frames() -> Iterator[Image.Image]:
        for k, t in enumerate(times):
            yield picture.frame(t).quantize(palette=palette, dither=Image.Dither.NONE)
            progress(k + 1, len(times))

    hundredths = np.round(100 * (times - times[0]))  # the file's unit, without drifting
    shown = 10 * np.diff(hundredths).astype(int)  # ms
    durations = [*shown.tolist(), round(1000 * HOLD)]
    every = frames()
    next(every).save(file, "GIF", save_all=True, append_images=every, duration=durations, loop=0)


def _check_same_reference(paths: Sequence[Path], flights: Sequence[Flight]) -> None:
    """UsageError where a flight has another reference; those of other control rates are compared between samples."""
    for path, flight in zip(paths, flights, strict=True):
        if not len(flight) or "ref_p_x" not in flight.columns:
            raise UsageError(f"{path}: has no samples with a reference to show")
        coarse, fine = sorted((flight, flights[0]), key=_samples_a_second)
        common = coarse.t <= fine.t[-1] + 1e-9
        between = fine.stack(REFERENCE)
        if len(fine) > 1:
            between = CubicSpline(fine.t, between)(coarse.t[common])
        apart = between - coarse.stack(REFERENCE)[common]
        if np.abs(apart).max() > SAME:
            raise UsageError(f"{path}: follows another reference than {paths[0]}; give flights of one trajectory")


def _samples_a_second(flight: Flight) -> float:
    return len(flight) / max(float(flight.t[-1]), 1e-9)


def _labels(paths: Sequence[Path], flights: Sequence[Flight]) -> list[str]:
    """The controllers, with the file's name where two flights have the same one."""
    names = []
    for path, flight in zip(paths, flights, strict=True):
        names.append(str(flight.metadata.get("controller") or path.stem))
    return [f"{name} {path.stem}" if names.count(name) > 1 else name for name, path in zip(names, paths, strict=True)]


class _Panels(NamedTuple):
    """path: all of it. near: around the reference, to scale. course: the error over time."""

    path: Any
    near: Any
    course: Any


class _Flown:
    """A flight, and what of it moves. error: of its samples (m). rotors: their positions (m)."""

    def __init__(self, flight: Flight, label: str, colour: str, panels: _Panels) -> None:
        self.flight = flight
        self.error = position_error(flight)
        self.rotors = flight.rotor_position
        of_all = flight.outcome
        if of_all in COMPLETED:
            of_all = f"mean {1e3 * self.error.mean():.3g} mm"
        (self._trail,) = panels.path.plot([], [], color=colour, linewidth=2)
        (self._vehicle,) = panels.path.plot([], [], marker="o", markersize=5, color=colour, linestyle="none")
        (self._line,) = panels.course.plot([], [], color=colour, label=f"{label}: {of_all}")
        self._body = panels.near.add_collection(LineCollection([], colors=colour, linewidths=2.2))
        self.moving = (self._trail, self._vehicle, self._line, self._body)

    def sample(self, t: float) -> int:
        """The last sample that is not after a time (s), or the first one."""
        following = int(np.searchsorted(self.flight.t, t + 1e-9))
        return max(following - 1, 0)

    def largest_error(self, begin: float, end: float) -> float:
        """Between two times (s), in m."""
        return float(self.error[self.sample(begin) : self.sample(end) + 1].max())

    def show(self, t: float) -> None:
        """Move everything to a time (s)."""
        flight = self.flight
        k = self.sample(t)
        behind = slice(int(np.searchsorted(flight.t, t - TRAIL)), k + 1)
        self._trail.set_data(flight["p_x"][behind], flight["p_y"][behind])
        self._vehicle.set_data(flight["p_x"][k : k + 1], flight["p_y"][k : k + 1])
        error = np.maximum(self.error[: k + 1], LEAST_ERROR)
        self._line.set_data(flight.t[: k + 1], 1e3 * error)
        if t > flight.t[-1] + AFTER_END:
            self._vehicle.set_marker("x")
            self._body.set_segments([])
        else:
            self._vehicle.set_marker("o")
            self._body.set_segments(_body(flight, k, self.rotors))


class _Picture:
    """The figure: its ground is drawn once, and what moves over it again in every frame."""

    @styled
    def __init__(self, labels: Sequence[str], flights: Sequence[Flight], begin: float, end: float) -> None:
        figure = Figure(figsize=SIZE, dpi=DPI)
        halves: Any = figure.subfigures(1, 2, width_ratios=(1.15, 1))
        path, course = halves[0].subplots(2, 1, height_ratios=(2.2, 1))
        panels = _Panels(path, halves[1].subplots(), course)
        longest = max(flights, key=len)
        path.plot(longest["ref_p_x"], longest["ref_p_y"], color="#AAAAAA", linewidth=0.8)
        path.set_aspect("equal", "datalim")
        path.set(xlabel="x (m)", ylabel="y (m)")
        path.set_title(_title(longest), fontsize=9)
        look = looks(labels)
        self._flown = []
        for label, flight in zip(labels, flights, strict=True):
            self._flown.append(_Flown(flight, label, look[label].colour, panels))
        self._clock = panels.near.set_title("to scale", fontsize=9)
        self._scale_near(panels.near, begin, end)
        self._scale_course(course, float(longest.t[-1]))
        halves[1].legend(*course.get_legend_handles_labels(), loc="outside lower center", fontsize=8)
        figure.draw_without_rendering()
        figure.set_layout_engine("none")  # one layout for all frames
        self._moving = [self._clock]
        for flown in self._flown:
            self._moving += flown.moving
        for artist in self._moving:
            artist.set_animated(True)
        canvas: Any = FigureCanvasAgg(figure)
        canvas.draw()
        self._canvas = canvas
        self._ground = canvas.copy_from_bbox(figure.bbox)

    def _scale_near(self, near: Any, begin: float, end: float) -> None:
        """So large that the vehicles are in it from one time (s) to the other."""
        error = max(flown.largest_error(begin, end) for flown in self._flown)
        size = max(float(norms(flown.rotors).max()) for flown in self._flown)
        reach = 1.05 * error + 1.6 * size
        near.set(xlim=(-reach, reach), ylim=(-reach, reach), xlabel="x - reference (m)", ylabel="y - reference (m)")
        near.set_aspect("equal")
        near.plot(0, 0, marker="+", markersize=12, color="#777777")

    def _scale_course(self, course: Any, duration: float) -> None:
        """From small errors to the largest one, of the whole flights (s)."""
        small = []
        largest = 0.0
        for flown in self._flown:
            moving = flown.error[flown.error > 0]
            if len(moving):
                small.append(float(np.percentile(moving, 5)))
            largest = max(largest, flown.error.max())
        low = max(min(small, default=0.0), 1e-6)
        high = 1.3 * max(2 * low, largest)
        course.set(xlim=(0, duration), yscale="log", ylim=(1e3 * low, 1e3 * high))
        course.set(xlabel="time (s)", ylabel="error (mm)")
        plain_log(course.yaxis)

    def frame(self, t: float) -> Image.Image:
        """The picture at a time (s)."""
        self._canvas.restore_region(self._ground)
        self._clock.set_text(f"to scale, from above, t = {t:.1f} s")
        for flown in self._flown:
            flown.show(t)
        for artist in self._moving:
            artist.axes.draw_artist(artist)
        pixels = np.asarray(self._canvas.buffer_rgba())
        return Image.fromarray(pixels[..., :3].copy())


def _title(flight: Flight) -> str:
    config = flight.metadata.get("config", {})
    speed = (config.get("trajectory") or {}).get("speed")
    name = flight.metadata.get("trajectory", "")
    if speed:
        return f"{name} at {speed_text(speed)}"
    return str(name)


def _body(flight: Flight, k: int, rotors: np.ndarray) -> list[np.ndarray]:
    """Arms and rotor discs seen from above, relative to the reference (m)."""
    rotation = Rotation.from_quat([flight[f"q_{axis}"][k] for axis in "xyzw"])
    centre = np.array([flight[f"p_{axis}"][k] - flight[f"ref_p_{axis}"][k] for axis in "xyz"])
    angle = np.linspace(0, 2 * np.pi, 17)
    radius = 0.55 * norms(rotors[:, :2]).min()
    disc = radius * np.column_stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)])
    lines = [np.stack([np.zeros(3), rotor]) for rotor in rotors]
    lines += [rotor + disc for rotor in rotors]
    return [(centre + rotation.apply(line))[:, :2] for line in lines]
