"""A folder of results with errors that are known, without a simulation: what a report is made from."""

from pathlib import Path
from typing import Any

import numpy as np

from quadexp.log.cell_store import CellStore
from quadexp.log.schema import Flight
from quadexp.log.store import write_flight, write_table
from quadexp.report.frame import SweepFrame
from quadexp.report.metrics import flight_metrics, to_columns
from quadexp.report.pairing import BASELINE, Groups
from quadexp.report.significance import Tests
from quadexp.report.winner import verdict
from tests.log.flights import straight_flight

ROTORS = [[0.17, -0.17, 0.0], [-0.17, -0.17, 0.0], [-0.17, 0.17, 0.0], [0.17, 0.17, 0.0]]
ERRORS = {"nominal_mpc": 0.04, "linear_drag_mpc": 0.012, "gp_mpc": 0.002, "perfect_mpc": 0.0015}  # m per m/s
TIMES = {"nominal_mpc": 2e-5, "linear_drag_mpc": 3e-5, "gp_mpc": 5e-5, "perfect_mpc": 4e-5}  # s
SEEDS = range(6)
SPEEDS = (4.0, 8.0)


def own_part(controller: str, seed: int) -> float:
    """What a seed does to one controller alone: a ratio that is the same for every seed has no p."""
    return 1 + 1e-4 * np.random.default_rng([seed, *controller.encode()]).standard_normal()


def flown(controller: str, trajectory: str, speed: float, seed: int, lost: bool) -> Flight:
    """Three seconds around a circle, a known distance off the reference."""
    flight = straight_flight(60 if lost else 151, controller=controller, seed=seed)
    t = flight.t
    noise = (1 + 0.02 * np.random.default_rng([seed, int(speed)]).standard_normal()) * own_part(controller, seed)
    offset = ERRORS[controller] * speed * noise * (0.5 + 0.5 * np.sin(2 * t) ** 2)
    angle = speed * t / 5
    columns = dict(flight.columns)
    columns |= {"ref_p_x": 5 * np.cos(angle), "ref_p_y": 5 * np.sin(angle), "ref_p_z": np.ones_like(t)}
    columns |= {"p_x": columns["ref_p_x"] + offset, "p_y": columns["ref_p_y"].copy(), "p_z": columns["ref_p_z"].copy()}
    columns["solve_time"] = np.full(len(t), TIMES[controller])
    config = {
        "controller": {"name": controller, "rate": 50.0},
        "vehicle": {"name": "torrente", "rotor_position": ROTORS, "thrust_min": 0.0, "thrust_max": 20.0},
        "trajectory": {"name": trajectory, "speed": speed},
        "seed": seed,
    }
    outcome = {"outcome": "lost", "cause": "10.2 m from the reference at t=1.18 s"} if lost else {"outcome": "ok"}
    about = {"versions": {"quadexp": "0"}, "provenance": {"cpu": "some cpu", "platform": "Linux x86_64"}}
    return Flight(columns, {**flight.metadata, "config": config, "model": "", **about, **outcome})


def make_results(root: Path, *, controllers: tuple[str, ...] = tuple(ERRORS), lost: bool = True) -> Path:
    """Write cells and results.parquet; with `lost`, one flight of linear_drag_mpc is lost."""
    store = CellStore(root)
    rows: list[dict[str, Any]] = []
    axes = [[f"trajectory={name}" for name in ("circle", "lemniscate")], [f"trajectory.speed={v:g}" for v in SPEEDS]]
    axes += [[f"controller={name}" for name in controllers], [f"seed={seed}" for seed in SEEDS]]
    for trajectory in ("circle", "lemniscate"):
        for speed in SPEEDS:
            for controller in controllers:
                for seed in SEEDS:
                    gone = lost and (controller, trajectory, speed, seed) == ("linear_drag_mpc", "lemniscate", 8.0, 3)
                    flight = flown(controller, trajectory, speed, seed, gone)
                    row = {"plant": "simplified", "vehicle": "torrente", "trajectory": trajectory, "speed": speed}
                    row |= {"controller": controller, "model": "", "variant": "", "seed": seed}
                    row |= flight_metrics(flight, 0.0, 20.0) | {"backend": "compiled", "key": f"{len(rows):020x}"}
                    row |= {"outcome": flight.outcome, "cause": flight.metadata.get("cause", "")}
                    write_flight(
                        store.path(row["key"]), Flight(flight.columns, flight.metadata | {"row": row}), key=row["key"]
                    )
                    rows.append(row)
    record = {
        "metric": "mean_error",
        "grids": [axes],
        "conditions": [],
        "versions": {"quadexp": "0"},
        "provenance": {"cpu": "some cpu", "platform": "Linux x86_64", "created": "2026-01-01T00:00:00+00:00"},
    }
    write_table(root / "results.parquet", to_columns(rows), record, "results")
    return root


def speed_figure(rows: list[dict[str, Any]], confidence: float = 0.95) -> Any:
    """What is drawn of rows in which the speed was swept."""
    from quadexp.plugins.page.draw import figure_of
    from quadexp.plugins.page.view import automatic

    return figure_of(automatic(SweepFrame([{"key": "", **row} for row in rows], "none"), "mean_error", confidence)[0])


def many_results(root: Path, conditions: int, seeds: int = 2) -> Path:
    """Only the table: four controllers with some seeds in each of many conditions, as `make_results` flies them."""
    rows = []
    for i in range(conditions):
        for controller, error in ERRORS.items():
            for seed in range(seeds):
                off = error * 8 * (1 + 0.01 * seed + 0.001 * (i % 7)) * own_part(controller, seed)
                row = {"plant": "simplified", "vehicle": "torrente", "trajectory": "circle", "speed": 8.0}
                row |= {"controller": controller, "model": "", "variant": f"plant.lift={i / 1000:g}", "seed": seed}
                row |= {"rmse": off, "mean_error": off, "max_error": 2 * off, "attitude_rmse": 0.1}
                row |= {"solve_time_median": TIMES[controller], "solve_time_p99": 2 * TIMES[controller]}
                row |= {"backend": "compiled", "outcome": "ok", "cause": "", "key": f"{len(rows):020x}"}
                rows.append(row)
    record = {"metric": "mean_error", "grids": [], "conditions": [], "versions": {}, "provenance": {}}
    write_table(root / "results.parquet", to_columns(rows), record, "results")
    return root


def verdicts(rows):
    """One verdict for every plant and vehicle."""
    tests = Tests(Groups(rows, BASELINE, ("mean_error",)), 0, 0.95)
    return [verdict(tests, conditions) for conditions in tests.groups.worlds.values()]
