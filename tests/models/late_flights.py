"""Recorded vertical flights of known truth, whose motors act late: drag along z 0 or as given, thrust c s^2 a rotor.

v' = sum_i c L[s_i]^2 - g - d_z v        L: dead time, then a first-order lag; s from a loop with feedback, held
"""

import numpy as np

from quadexp.log.schema import Flight

G, C = 9.81, 9.0  # m/s^2; of a rotor at full command
FINE = 1e-3


def late_flight(
    dead_time: float, lag: float, *, seed: int = 0, seconds: float = 40.0, period: float = 0.01, drag: float = 0.0,
    noise: float = 0.1, forward: float = 2.0,
) -> Flight:  # fmt: skip
    rng = np.random.default_rng(seed)
    steps, parts = int(seconds / period), round(period / FINE)
    queue = [np.sqrt(G / 4 / C)] * round(dead_time / FINE)
    kept = np.exp(-FINE / lag) if lag else 0.0
    motor, z, v = np.sqrt(G / 4 / C), 0.0, 0.0
    frequency, phase = rng.uniform(0.15, 1.2, 6), rng.uniform(0, 6, 6)
    rows = []
    for k in range(steps):
        wanted = np.sum(0.5 * np.sin(2 * np.pi * frequency * k * period + phase))
        push = G + 3.0 * (wanted - z) - 3.0 * (v + 0.02 * rng.normal())
        s = np.sqrt(max(push + 0.5 * rng.normal(), 1.0) / 4 / C)
        rows.append((z, v, 4 * C * motor**2 - drag * v, s))
        for _ in range(parts):
            queue.append(s)
            motor += (1 - kept) * (queue.pop(0) - motor)
            a = 4 * C * motor**2 - G - drag * v
            z, v = z + v * FINE, v + a * FINE
    z, v, force, s = np.array(rows).T
    t = np.arange(steps) * period
    side = forward * np.sin(0.7 * t)
    columns = {"t": t, "p_x": np.cumsum(side) * period, "p_y": 0 * t, "p_z": z}
    columns |= {"q_w": np.ones(steps), "q_x": 0 * t, "q_y": 0 * t, "q_z": 0 * t}
    columns |= {"v_x": side, "v_y": 0.5 * np.cos(0.9 * t), "v_z": v}
    columns |= {f"w_{axis}": 0.01 * rng.normal(size=steps) for axis in "xyz"}
    columns |= {"acc_x": -0.3 * side, "acc_y": -0.15 * np.cos(0.9 * t), "acc_z": force}
    for axis in "xyz":
        columns[f"acc_{axis}"] = columns[f"acc_{axis}"] + noise * rng.normal(size=steps)
    columns |= {f"motor_command_{i}": s for i in range(4)}
    return Flight(columns, {"recorded": True, "name": f"late_{seed}"})
