"""Figures of Lei & Li 2017's examples (their Figures 2-4) and of adaptation in flight.

Each function returns a matplotlib Figure and changes no global state. World ENU, SI units.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from quadexp.log.schema import Flight
from quadexp.physics.rotor import THETA
from quadexp.report.metrics import position_error
from quadexp.report.style import COLOURS, DASHES, GREY, Figure, entries, looks, plain_log, styled

SYMBOLS = {"C_d0": "$C_{d0}$", "C_la": r"$C_{l\alpha}$ (1/rad)"} | {f"C_D{a}": f"$C_{{D{a}}}$" for a in "xyz"}
QUIET_SHARE = 0.05  # of a flight, at its start: estimates jump and are not used for the limits of the panels


@styled
def path_figure(flights: Mapping[str, Flight], title: str) -> Figure:
    """Path seen from above and altitude over time, the reference in grey. flights: controller -> flight."""
    figure = Figure(figsize=(10.0, 4.4), layout="constrained")
    above, height = figure.subplots(1, 2, width_ratios=(1, 1.25))
    look = looks(list(flights))
    first = next(iter(flights.values()))
    above.plot(first["ref_p_x"], first["ref_p_y"], color=GREY, linewidth=3.5, alpha=0.45, label="reference")
    height.plot(first.t, first["ref_p_z"], color=GREY, linewidth=3.5, alpha=0.45)
    for name, flight in flights.items():
        above.plot(flight["p_x"], flight["p_y"], label=name, **look[name].line())
        height.plot(flight.t, flight["p_z"], **look[name].line())
    above.set(xlabel="east (m)", ylabel="north (m)", aspect="equal", title="path from above")
    height.axhline(0.0, color="#000000", linewidth=0.8)
    height.annotate(
        "ground", (0.99, 0.0), (0, 3), xycoords=("axes fraction", "data"), textcoords="offset points", ha="right"
    )
    height.set(xlabel="time (s)", ylabel="altitude (m)", title="altitude")
    figure.legend(loc="outside lower center", ncols=len(flights) + 1)
    figure.suptitle(title)
    return figure


@styled
def running_mean_figure(flights: Mapping[str, Flight], title: str) -> Figure:
    """Averages since the start of ||e_xi|| (m) and of ||e_eta|| (rad), the distance to the desired attitude."""
    figure = Figure(figsize=(10.0, 3.9), layout="constrained")
    panels = figure.subplots(1, 2)
    look = looks(list(flights))
    for name, flight in flights.items():
        count = np.arange(1, len(flight) + 1)
        errors = position_error(flight), flight["error_eta"]
        for panel, error in zip(panels, errors, strict=True):
            panel.plot(flight.t, np.cumsum(error) / count, label=name, **look[name].line())
    panels[0].set_ylabel(r"running mean of $\|e_\xi\|$ (m)", parse_math=True)
    panels[1].set_ylabel(r"running mean of $\|e_\eta\|$ (rad)", parse_math=True)
    panels[0].set(title="position")
    panels[1].set(title="attitude", yscale="log")
    plain_log(panels[1].yaxis)
    for panel in panels:
        panel.set_xlabel("time (s)")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(flights))
    figure.suptitle(title)
    return figure


@styled
def induced_velocity_figure(flight: Flight, title: str) -> Figure:
    """Induced velocity and speed of every rotor over time."""
    figure = Figure(figsize=(10.0, 3.9), layout="constrained")
    panels = figure.subplots(1, 2)
    for i, side in enumerate(("front", "right", "rear", "left")[: flight.n_rotors]):
        look = {"color": COLOURS[i + 1], "linestyle": DASHES[i], "linewidth": 1.1}
        panels[0].plot(flight.t, flight[f"induced_velocity_{i}"], label=f"rotor {i + 1} ({side})", **look)
        panels[1].plot(flight.t, flight[f"rotor_speed_{i}"], **look)
    panels[0].set(ylabel="induced velocity (m/s)", xlabel="time (s)")
    panels[1].set(ylabel="rotor speed (rad/s)", xlabel="time (s)")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    figure.suptitle(title)
    return figure


@styled
def parameter_figure(flights: Sequence[Flight], title: str) -> Figure:
    """Coefficients in use over time, every seed a thin line and their mean a thick one, the truth dashed."""
    plant = flights[0].metadata["config"]["plant"]
    truth = dict(zip(THETA, [plant["profile_drag"], plant["lift_slope"], *plant["body_drag"]], strict=True))
    samples = min(len(flight) for flight in flights)
    figure = Figure(figsize=(11.0, 5.2), layout="constrained")
    panels = figure.subplots(2, 3, sharex=True).flat
    for panel, name in zip(panels, ("C_la", "C_d0", "C_Dx", "C_Dy", "C_Dz"), strict=False):
        values = np.stack([flight[name][:samples] for flight in flights])
        t = flights[0].t[:samples]
        for line in values:
            panel.plot(t, line, color=COLOURS[6], linewidth=0.7, alpha=0.7, label="one seed")
        panel.plot(t, values.mean(axis=0), color=COLOURS[2], label=f"mean of {len(flights)} seeds")
        panel.axhline(truth[name], color="#000000", linestyle="--", linewidth=1.0, label="truth")
        panel.set_title(SYMBOLS[name], parse_math=True)
        late = np.concatenate([values[:, t > QUIET_SHARE * t[-1]].ravel(), [truth[name]]])
        low, high = late.min(), late.max()
        panel.set_ylim(low - 0.15 * (high - low), high + 0.15 * (high - low))
    panels = list(figure.axes)
    panels[-1].set_axis_off()
    for panel in panels[2:5]:
        panel.set_xlabel("time (s)")
        panel.xaxis.set_tick_params(labelbottom=True)
    beyond = f"the first {QUIET_SHARE * flights[0].t[-1]:.0f} s may leave the panels"
    panels[-1].legend(*entries(panels[:1]), loc="center", title=beyond, title_fontsize=9)
    figure.suptitle(title)
    return figure


@styled
def adaptation_figure(flights: Mapping[str, Mapping[str, Flight]], titles: Mapping[str, str]) -> Figure:
    """Position error over time around a change of the vehicle, a panel per change and a line per controller.

    flights: plant -> controller -> flight. titles: plant -> what changes.
    """
    figure = Figure(figsize=(4.0 * len(flights) + 0.6, 4.0), layout="constrained")
    panels = figure.subplots(1, len(flights), sharey=True, squeeze=False)[0]
    look = looks([name for by_controller in flights.values() for name in by_controller])
    for panel, (plant, by_controller) in zip(panels, flights.items(), strict=True):
        for name, flight in by_controller.items():
            panel.plot(flight.t, 1e3 * position_error(flight), label=name, linewidth=1.3, **look[name].line())
        change = change_time(next(iter(by_controller.values())))
        panel.axvline(change, color="#000000", linewidth=0.9, linestyle=":")
        panel.annotate(
            "change",
            (change, 1.0),
            (3, -3),
            xycoords=("data", "axes fraction"),
            textcoords="offset points",
            va="top",
            fontsize=8,
        )
        panel.set(yscale="log", title=titles.get(plant, plant), xlabel="time (s)", ylim=(0.05, 1000))
    plain_log(panels[0].yaxis, minor=True)
    panels[0].set_ylabel("position error (mm)")
    handles = panels[0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside lower center", ncols=len(handles[0]))
    return figure


def change_time(flight: Flight) -> float:
    """When the vehicle of a flight changes first (s)."""
    return min(float(change["t"]) for change in flight.metadata["config"]["plant"]["schedule"])
