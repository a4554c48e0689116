"""Noise of residual targets that a simulated world states: what no model of the air can explain.

Standard deviations of the targets over a transition of dt, from white noise of the plant (densities S) and of the
estimate (standard deviations s per sample, velocity v, rate w, attitude q):

    a_i^2   = (S_force / m)^2 / dt + 2 s_v^2 / dt^2 + (T / m)^2 s_q^2 [i = x, y] + motors [i = z]
    tau_i^2 = S_torque^2 / dt + 2 (J_ii s_w)^2 / dt^2 + motors
    motors  = sum_j g_ij^2 S_motor^2 u_j u_max / dt,    g: effect of a thrust on that axis, 1 / m or the lever

with thrusts u and their sum T. The attitude enters by the direction of the predicted thrust. Noise of the features is
left out; it is multiplied by the slope of the residual. Nothing is known where a part states no noise (filters, the
user's plants).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from quadexp.models.dataset import ResidualDataset
from quadexp.models.residual import OUTPUTS
from quadexp.physics.vehicle import Vehicle

ESTIMATE = ("velocity_noise", "rate_noise", "attitude_noise")
SILENT = ("from_model", "blade_element", "simplified")  # plants whose only noise is that of their densities


def known_noise(
    dataset: ResidualDataset, vehicle: Vehicle, worlds: Sequence[Mapping[str, Any]], *, of_estimate: bool
) -> dict[str, Any] | None:
    """Root mean square of the known noise, {output: std}, over the rows of simulated flights.

    worlds: configuration of every flight, by group. of_estimate: the targets come from what the controller was told.
    None where some part of a world has noise that it does not state.
    """
    squares = np.zeros(len(OUTPUTS))
    flight = np.asarray(dataset.columns["flight"])
    thrust = dataset.matrix([f"u_{i}" for i in range(vehicle.n_rotors)])
    dt = np.asarray(dataset.columns["dt"], float)
    for index, world in enumerate(worlds):
        plant, estimator = world.get("plant") or {}, (world.get("estimator") or {}) if of_estimate else {}
        if plant.get("kind") not in SILENT or (estimator and not all(name in estimator for name in ESTIMATE)):
            return None
        rows = flight == index
        squares += np.sum(_variances(vehicle, plant, estimator, thrust[rows], dt[rows, None]), axis=0)
    return dict(zip(OUTPUTS, np.sqrt(squares / max(dataset.n_rows, 1)).tolist(), strict=True))


def _variances(
    vehicle: Vehicle, plant: Mapping[str, Any], estimator: Mapping[str, Any], thrust: np.ndarray, dt: np.ndarray
) -> np.ndarray:
    """Variance of every target in every row, (k, 6)."""
    density = {name: float(plant.get(f"{name}_noise_density") or 0.0) for name in ("force", "torque", "motor")}
    velocity, rate, attitude = (float(estimator.get(name) or 0.0) for name in ESTIMATE)
    mass = vehicle.mass + float(plant.get("payload") or 0.0)
    inertia = vehicle.inertia_matrix
    effect = np.vstack([np.zeros((2, vehicle.n_rotors)), np.full(vehicle.n_rotors, 1 / mass), vehicle.allocation[1:]])
    motors = density["motor"] ** 2 * vehicle.thrust_max * np.maximum(thrust, 0) @ (effect**2).T
    white = np.repeat([(density["force"] / mass) ** 2, density["torque"] ** 2], 3)
    sampled = 2 * np.concatenate([np.full(3, velocity**2), np.sum(inertia**2, axis=1) * rate**2])
    tilt = (attitude * thrust.sum(axis=1, keepdims=True) / vehicle.mass) ** 2 * np.array([1, 1, 0, 0, 0, 0])
    return (motors + white) / dt + sampled / dt**2 + tilt


def explained(rows: Sequence[Mapping[str, Any]], noise: Mapping[str, float]) -> dict[str, dict[str, float]]:
    """For every output of a held-out report: rmse of the model, known noise, and what it leaves unexplained.

    rows: of quadexp.models.evaluation; the first predictor of an output is the model.
    """
    shares: dict[str, dict[str, float]] = {}
    for row in rows:
        if row["output"] in noise and row["output"] not in shares:
            rmse, known = float(row["rmse"]), float(noise[row["output"]])
            unexplained = float(np.sqrt(max(rmse**2 - known**2, 0.0)))
            shares[row["output"]] = {"rmse": rmse, "known_noise": known, "unexplained": unexplained}
    return shares


def explained_lines(shares: Mapping[str, Mapping[str, float]]) -> list[str]:
    """As text."""
    lines = [
        f"  {output}  rmse {share['rmse']:.3g}, known noise {share['known_noise']:.3g}, unexplained"
        f" {share['unexplained']:.3g} {'m/s^2' if output.startswith('a_') else 'N m'}"
        for output, share in shares.items()
    ]
    head = "held-out error against the noise that the world states (motors, forces, estimate):"
    return [head, *lines] if lines else []
