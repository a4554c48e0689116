"""A residual dataset with a known truth, like Torrente's simplified simulation: drag and motor loss."""

import numpy as np

from quadexp.models.dataset import ResidualDataset

MASS = 1.0  # kg
LINEAR = np.array([0.3, 0.3, 0.0])  # N s/m
QUADRATIC = 0.08  # N s^2/m^2
LOSS = 20 * 0.1 / (20 * 1.3) ** 2  # lost thrust per rotor: LOSS u^2, N
VEHICLE = {"name": "synthetic", "fingerprint": "0123456789ab", "mass": MASS}


def truth(velocity: np.ndarray, thrust: np.ndarray) -> np.ndarray:
    """Residual acceleration, (k, 3) (m/s^2); velocity (k, 3), rotor thrusts (k, 4) (N)."""
    force = -LINEAR * velocity - QUADRATIC * velocity * np.abs(velocity)
    force[:, 2] -= LOSS * np.sum(thrust**2, axis=1)
    return force / MASS


def synthetic_dataset(rows: int = 22000, flights: int = 12, noise: float = 0.05, seed: int = 0) -> ResidualDataset:
    """Flights of slowly varying speed and thrust; noise: standard deviation of the target, m/s^2."""
    rng = np.random.default_rng(seed)
    k = rows // flights
    t = np.arange(k) * 0.02
    tables = []
    for _ in range(flights):
        peak = rng.uniform(4, 17)
        phase, rate = rng.uniform(0, 2 * np.pi, (2, 3)), rng.uniform(0.3, 1.5, (2, 3))
        shape = np.sin(rate[0] * t[:, None] + phase[0]) * np.cos(rate[1] * t[:, None] / 3 + phase[1])
        velocity = peak * shape * [1, 1, 0.6]
        collective = 17.5 + 12.5 * np.sin(rng.uniform(0.5, 2) * t + rng.uniform(0, 6)) + 3 * rng.normal(size=k)
        rotor = np.clip(collective, 5, 40)[:, None] / 4 * (1 + 0.03 * rng.normal(size=(k, 4)))
        target = truth(velocity, rotor) + noise * rng.normal(size=(k, 3))
        tables.append(np.hstack([velocity, 0.5 * rng.normal(size=(k, 3)), rotor, target]))
    table = np.vstack(tables)
    names = [f"{p}_{a}" for p in "vw" for a in "xyz"] + [f"u_{i}" for i in range(4)] + ["a_x", "a_y", "a_z"]
    columns = {name: table[:, i].copy() for i, name in enumerate(names)}
    columns["thrust"] = table[:, 6:10].sum(axis=1)
    columns |= {f"tau_{a}": 1e-3 * rng.normal(size=len(table)) for a in "xyz"}
    columns["t"], columns["dt"] = np.tile(t, flights), np.full(len(table), 0.02)
    columns["flight"] = np.repeat(np.arange(flights, dtype=np.int32), k)
    columns["flight_name"] = np.array([f"flight_{i}" for i in columns["flight"]], object)
    return ResidualDataset(columns, {"vehicle": VEHICLE, "frame": "midpoint"})
