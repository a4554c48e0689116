"""One closed-loop flight: plant, controller and reference, sample by sample."""

from __future__ import annotations

from typing import Any

import numpy as np

from quadexp.control.active_set import Status
from quadexp.control.mpc import ModelPredictiveController
from quadexp.errors import QuadexpError
from quadexp.flight.schema import Flight
from quadexp.plant.base import Plant
from quadexp.residual.base import Residual
from quadexp.state import POSITION, STATE_COLUMNS, input_columns
from quadexp.trajectory.flatness import Reference, flat_reference

LOST_DISTANCE = 10.0  # m from the reference: further away nobody calls it tracking
TIME_RESOLUTION = 1e-9  # s, two sampling times closer than this are one


class SampledReference:
    """The reference at every control instant and every node of the horizon that starts there.

    trajectory: what to fly. controller: its period and node times decide where to sample, and its residual, where it
    feeds forward, enters attitude, rates and thrusts.
    """

    def __init__(self, trajectory, controller: ModelPredictiveController) -> None:
        settings = controller.settings
        samples = int(np.floor(trajectory.duration * settings.rate + 1e-6)) + 1
        self.t = np.arange(samples) * settings.control_period
        times = self.t[:, None] + controller.node_times
        grid, where = np.unique(np.round(times / TIME_RESOLUTION).astype(np.int64), return_inverse=True)
        self._where = where.reshape(times.shape)
        residual: Residual | None = controller.residual if settings.feedforward else None
        if residual is not None and residual.is_zero:
            residual = None
        self.reference: Reference = flat_reference(
            trajectory, grid * TIME_RESOLUTION, controller.vehicle, residual=residual
        )

    def __len__(self) -> int:
        return len(self.t)

    def horizon(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """States (N + 1, 13) and inputs (N, n) over the horizon from control instant k."""
        where = self._where[k]
        return self.reference.state[where], self.reference.input[where[:-1]]

    def along(self) -> tuple[np.ndarray, np.ndarray]:
        """States (k, 13) and inputs (k, n) at the control instants."""
        where = self._where[:, 0]
        return self.reference.state[where], self.reference.input[where]


def fly(
    plant: Plant,
    controller: ModelPredictiveController,
    reference: SampledReference,
    rng: np.random.Generator,
    *,
    start: np.ndarray | None = None,
    lost_distance: float = LOST_DISTANCE,
    metadata: dict[str, Any] | None = None,
) -> Flight:
    """Fly the reference from its start (or from `start`, (13,)) and return the log, one row per control instant.

    The flight ends early, with the log up to there, where the vehicle is further than lost_distance (m) from the
    reference ("lost") or a control step fails ("solver_failed"). metadata is kept and extended by the outcome.
    """
    state_along, input_along = reference.along()
    period, rotors = controller.settings.control_period, plant.vehicle.n_rotors
    samples = len(reference)
    state, command = np.full((samples, len(STATE_COLUMNS)), np.nan), np.full((samples, rotors), np.nan)
    specific_force = np.full((samples, 3), np.nan)
    records = []

    x = state_along[0].copy() if start is None else np.array(start, float)
    reading = np.array([0.0, 0.0, plant.vehicle.gravity])
    controller.reset(x, *reference.horizon(0))
    outcome, cause = "ok", ""
    for k in range(samples):
        distance = float(np.linalg.norm(x[POSITION] - state_along[k, POSITION]))
        if not distance <= lost_distance:
            outcome, cause = "lost", f"{distance:.1f} m from the reference at t={reference.t[k]:.2f} s"
            break
        u, record = controller.command(x, *reference.horizon(k))
        state[k], command[k], specific_force[k] = x, u, reading
        records.append(record)
        if record.status == Status.FAILED:
            outcome, cause = "solver_failed", f"the control step failed at t={reference.t[k]:.2f} s"
            break
        x, reading = plant.advance(x, u, period, rng)
    flown = len(records)
    if flown == 0:
        raise QuadexpError(f"the flight is over before it began: {cause}")

    inputs = input_columns(rotors)
    columns = {"t": reference.t[:flown]}
    columns |= dict(zip(STATE_COLUMNS, state[:flown].T, strict=True))
    columns |= dict(zip(inputs, command[:flown].T, strict=True))
    columns |= {f"ref_{name}": values for name, values in zip(STATE_COLUMNS, state_along[:flown].T, strict=True)}
    columns |= {f"ref_{name}": values for name, values in zip(inputs, input_along[:flown].T, strict=True)}
    columns |= {f"acc_{axis}": values for axis, values in zip("xyz", specific_force[:flown].T, strict=True)}
    columns |= {
        "solve_time": np.array([record.solve_time for record in records]),
        "status": np.array([record.status for record in records], np.int8),
        "sweeps": np.array([record.sweeps for record in records], np.int16),
        "active": np.array([record.active for record in records], np.int16),
        "kkt": np.array([record.kkt for record in records]),
    }
    columns = {name: np.ascontiguousarray(values) for name, values in columns.items()}
    details = {"outcome": outcome, "cause": cause, "backend": controller.backend}
    return Flight(columns, {**(metadata or {}), **details})
