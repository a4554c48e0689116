"""Flights as a log has them, with a known truth: thrust from motor commands and voltage, drag in the air, wind."""

import numpy as np
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from quadexp.log.schema import Flight

DRAG = np.array([0.40, 0.36, 0.12])  # 1/s
OFFSET = np.array([0.05, -0.03, 0.0])  # m/s^2
CURVE = (1.5, 3.0)  # m/s^2 per rotor, of s and s^2
VEHICLE = {"name": "known", "fingerprint": "0123456789ab"}


def coloured(rng: np.random.Generator, n: int, memory: float) -> np.ndarray:
    """Gauss-Markov noise of unit variance; memory: samples, 0 for white noise."""
    a = np.exp(-1 / memory) if memory else 0.0
    burn = int(10 * memory) + 1
    return lfilter([np.sqrt(1 - a * a)], [1, -a], rng.normal(size=n + burn))[burn:]


def logged_flight(
    seed: int, *, seconds: float = 20.0, rate: float = 100.0, noise: float = 0.05, memory: float = 10.0,
    wind=(0.0, 0.0, 0.0), quadratic=(0.0, 0.0, 0.0), exponent: float = 1.0, drag: np.ndarray = DRAG,
    name: str | None = None,
) -> Flight:  # fmt: skip
    """One flight, its battery changed every minute; wind (m/s, world) is in its columns where it is not zero."""
    rng = np.random.default_rng(seed)
    n = int(rate * seconds)
    t = np.arange(n) / rate
    phase, omega = rng.uniform(0, 2 * np.pi, 8), rng.uniform(0.4, 1.6, 8)
    angles = np.stack([0.4 * np.sin(omega[i] * t + phase[i]) for i in range(3)], axis=1)
    attitude = Rotation.from_euler("zyx", angles)
    air = np.stack([[2.5, 2.2, 1.2][i] * np.sin(omega[3 + i] * t + phase[3 + i]) for i in range(3)], axis=1)
    air += 0.1 * np.stack([coloured(rng, n, 20) for _ in range(3)], axis=1)
    voltage = 4.1 - 0.02 * (t % 60) + 0.03 * np.sin(0.3 * t + phase[6])
    command = 0.75 + 0.12 * np.sin(omega[7] * t + phase[7])[:, None] + 0.03 * rng.normal(size=(n, 4))
    scaled = command * (voltage[:, None] / 4) ** exponent
    force = OFFSET - drag * air - np.array(quadratic) * air * np.abs(air)
    force[:, 2] += np.sum(CURVE[0] * scaled + CURVE[1] * scaled**2, axis=1)
    force += noise * np.stack([coloured(rng, n, memory) for _ in range(3)], axis=1)
    velocity = attitude.apply(air) + np.array(wind)
    columns = {"t": t}
    for prefix, values in (("p", 0 * velocity), ("v", velocity), ("w", 0 * velocity), ("acc", force)):
        columns |= {f"{prefix}_{axis}": values[:, i].copy() for i, axis in enumerate("xyz")}
    columns |= {f"q_{axis}": attitude.as_quat(scalar_first=True)[:, i].copy() for i, axis in enumerate("wxyz")}
    columns |= {f"motor_command_{i}": command[:, i].copy() for i in range(4)} | {"battery_voltage": voltage}
    if np.any(wind):
        columns |= {f"wind_{axis}": np.full(n, float(wind[i])) for i, axis in enumerate("xyz")}
    return Flight(columns, {"name": name or f"flight_{seed}", "vehicle": dict(VEHICLE), "recorded": True})


def specific_force(model, flight: Flight, kind: str = "best") -> np.ndarray:
    """Specific force predicted by a vehicle model, (k, 3) body FLU (m/s^2); kind: "best", "nominal", ..."""
    rotors = model.thrust.rotor_acceleration(flight)
    force = (
        np.zeros((len(rotors), 3)) if kind == "nominal" else model.model(kind).acceleration(flight.air_velocity, rotors)
    )
    return force + rotors.sum(axis=1)[:, None] * [0, 0, 1]
