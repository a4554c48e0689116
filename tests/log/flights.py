"""Small flights for tests, with errors that are known by hand."""

import numpy as np

from quadexp.log.schema import Flight
from quadexp.physics.state import STATE_COLUMNS, input_columns


def straight_flight(samples: int = 5, offset: tuple[float, float, float] = (0.0, 0.0, 0.0), **metadata) -> Flight:
    """Level flight along x at 2 m/s, sampled at 50 Hz; the reference lies at `offset` (m) from it."""
    t = np.arange(samples) * 0.02
    columns = {"t": t}
    columns |= {name: np.zeros(samples) for name in STATE_COLUMNS}
    columns |= {"q_w": np.ones(samples), "p_x": 2.0 * t, "v_x": np.full(samples, 2.0)}
    columns |= {name: np.full(samples, 2.4525) for name in input_columns(4)}
    columns |= {f"ref_{name}": columns[name].copy() for name in (*STATE_COLUMNS, *input_columns(4))}
    for axis, distance in zip("xyz", offset, strict=True):
        columns[f"ref_p_{axis}"] = columns[f"p_{axis}"] + distance
    columns |= {f"acc_{axis}": np.zeros(samples) for axis in "xyz"}
    columns["solve_time"] = np.linspace(1e-5, 2e-5, samples)
    columns["status"] = np.zeros(samples, np.int8)
    columns |= {"sweeps": np.zeros(samples, np.int16), "active": np.zeros(samples, np.int16), "kkt": np.zeros(samples)}
    return Flight(columns, {"outcome": "ok", **metadata})
