"""Recorded flights of known truth with the faults of real logs: is every fault named, does the printed correction mend
it, do the 95 % intervals of drag and delay hold the truth; and is no sound public flight blocked.

    python -m benchmarks.log_faults --seed 1000 --repetitions 16 [--sound FOLDER] --out faults.jsonl   # goes on

Each repetition is one log of 10 s on the ground, 60 s of flight and 6 s on the ground: exact motion (a sum of sines),
attitude along the specific force of a linear drag, thrust behind its command by one of DELAYS, noise of every sensor.
Its fault is the next of FAULTS, of a size that is drawn. The log is imported as a user does: as it is, then with the
lines that the findings print under `corrections`, and with --align where a time offset is named, up to ROUNDS times.
The delay of the thrust behind its command depends on which of two streams is taken to be the late one; where one is,
it is counted apart.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from quadexp.log.schema import Flight
from quadexp.log.store import read_flight
from quadexp.messages import yaml
from quadexp.plugins.identification.vehicle_model import FitSettings, fit_vehicle_model
from quadexp.plugins.logs.import_flights import Outcome, import_files
from quadexp.plugins.logs.importers import Options
from quadexp.plugins.logs.samples import gather, gather_to_fit
from quadexp.plugins.logs.signal.windows import STREAMS

GRAVITY = 9.81  # m/s^2
GROUND, FLIGHT, LANDED = 10.0, 60.0, 6.0  # s
RATE, FINE = 100.0, 10  # Hz of the log, samples of the truth for one of it
DRAG = 0.3  # 1/s, along x and y of the body
DELAYS = ((0.010, 0.030), (0.0, 0.040), (0.020, 0.0))  # s: dead time and lag of the thrust
NOISE = {"p": 0.0005, "v": 0.01, "w": 0.02, "f": 0.15}  # m, m/s, rad/s, m/s^2
TILT = 0.002  # rad: noise of the attitude
CURVE = 80.0  # m/s^2 at full command
ROUNDS = 3
FREQUENCIES = np.array([0.13, 0.31, 0.47, 0.71, 1.03])  # Hz
AMPLITUDES = np.array([3.0, 1.2, 0.5, 0.25, 0.1])  # m
MAPPING = {
    "position": "p", "attitude": "q", "velocity": "v", "rate": "w", "acceleration": "f",
}  # fmt: skip

Columns = dict[str, np.ndarray]  # stream by letter, t and command


def truth(rng: np.random.Generator, dead_time: float, lag: float) -> Columns:
    """A log without a fault."""
    step = 1 / (RATE * FINE)
    t = np.arange(0.0, GROUND + FLIGHT + LANDED, step)
    part = np.clip((t - GROUND) / FLIGHT, 0.0, 1.0)
    ramp = np.clip(np.minimum(part, 1 - part) * FLIGHT / 3.0, 0.0, 1.0)
    up = ramp**3 * (10 - 15 * ramp + 6 * ramp**2)
    phase = rng.uniform(0, 2 * np.pi, (3, len(FREQUENCIES)))
    sizes = AMPLITUDES * rng.uniform(0.7, 1.1, (3, 1)) * np.array([[1.0], [1.0], [0.3]])
    waves = np.sin(2 * np.pi * FREQUENCIES * t[:, None, None] + phase)
    p = up[:, None] * np.sum(sizes * waves, axis=2)
    p[:, 2] += 4.0 * up
    v = np.gradient(p, step, axis=0)
    a = np.gradient(v, step, axis=0)
    yaw = 0.6 * up * np.sin(0.5 * t + phase[0, 0])
    attitude = _attitude(v, a, yaw)
    w = np.zeros_like(v)
    w[1:-1] = (attitude[:-2].inv() * attitude[2:]).as_rotvec() / (2 * step)
    force = attitude.apply(a + [0.0, 0.0, GRAVITY], inverse=True)
    commanded = force[:, 2] + lag * np.gradient(force[:, 2], step)
    commanded = np.interp(t + dead_time, t, commanded)
    flying = (part > 0) & (part < 1)
    command = np.where(flying, np.sqrt(np.maximum(commanded, 0.0) / CURVE), 0.0)
    q = attitude.as_quat(scalar_first=True)
    q *= np.cumprod(np.append(1.0, np.where(np.sum(q[1:] * q[:-1], axis=1) < 0, -1.0, 1.0)))[:, None]
    return {"t": t, "p": p, "q": q, "v": v, "w": w, "f": force, "command": np.repeat(command[:, None], 4, axis=1)}


def _attitude(v: np.ndarray, a: np.ndarray, yaw: np.ndarray) -> Rotation:
    """With R^T (a + g e_z) + D R^T v along z."""
    attitude = Rotation.from_euler("Z", yaw[:, None])
    for _ in range(12):
        lateral = attitude.apply(v, inverse=True) * [DRAG, DRAG, 0.0]
        z = a + [0.0, 0.0, GRAVITY] + attitude.apply(lateral)
        z /= np.linalg.norm(z, axis=1, keepdims=True)
        x = np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)])
        y = np.cross(z, x)
        y /= np.linalg.norm(y, axis=1, keepdims=True)
        attitude = Rotation.from_matrix(np.stack([np.cross(y, z), y, z], axis=2))
    return attitude


# ------------------------------------------------------------------------------------------------------------- faults
Fault = Callable[[Columns, np.random.Generator], set[str]]  # changes the log; the findings of which one must be made


def _scaled(stream: str, axes: tuple[int, ...], low: float, high: float) -> Fault:
    def change(log: Columns, rng: np.random.Generator) -> set[str]:
        factor = rng.uniform(low, high)
        log[stream][:, list(axes)] *= factor if rng.random() < 0.5 else 1 / factor
        return {"scale", "units"}

    return change


def _unit(stream: str, factor: float) -> Fault:
    """One or two columns in another unit."""

    def change(log: Columns, rng: np.random.Generator) -> set[str]:
        axes = rng.permutation(3)[: rng.integers(1, 3)]
        log[stream][:, axes] *= factor
        return {"units", "scale"}

    return change


def _late(streams: str, drift: float = 0.0) -> Fault:
    def change(log: Columns, rng: np.random.Generator) -> set[str]:
        t = log["t"]
        late = rng.uniform(0.035, 0.09) + drift * (t - t.mean())
        for name in streams:
            log[name] = np.stack([np.interp(t - late, t, column) for column in log[name].T], axis=1)
        return {"clock_drift"} if drift else {"time_offset"}

    return change


def _turned(streams: str) -> Fault:
    def change(log: Columns, rng: np.random.Generator) -> set[str]:
        axis = rng.normal(size=3)
        axis *= np.radians(rng.uniform(5.0, 14.0)) / np.linalg.norm(axis)
        for name in streams:
            log[name] = Rotation.from_rotvec(axis).apply(log[name])
        return {"mounting"}

    return change


def _biased(stream: str, low: float, high: float) -> Fault:
    def change(log: Columns, rng: np.random.Generator) -> set[str]:
        bias = rng.normal(size=3)
        log[stream] = log[stream] + rng.uniform(low, high) * bias / np.abs(bias).max()
        return {"bias"}

    return change


def _none(log: Columns, rng: np.random.Generator) -> set[str]:
    return set()


FAULTS: dict[str, Fault] = {
    "none": _none,
    "accelerometer x": _scaled("f", (0,), 1.2, 1.5),
    "gyro z": _scaled("w", (2,), 1.1, 1.5),
    "gyro": _scaled("w", (0, 1, 2), 1.04, 1.3),
    "accelerometer": _scaled("f", (0, 1, 2), 1.06, 1.5),
    "gyro columns in deg/s": _unit("w", 180 / np.pi),
    "position columns in feet": _unit("p", 1 / 0.3048),
    "late attitude": _late("q"),
    "late pose": _late("pvq"),
    "late IMU": _late("wf"),
    "drifting IMU": _late("wf", 0.002),
    "drifting pose": _late("pvq", -0.003),
    "turned board": _turned("wf"),
    "turned accelerometer": _turned("f"),
    "biased accelerometer": _biased("f", 0.7, 1.5),
    "biased gyro": _biased("w", 0.06, 0.2),
}


# ------------------------------------------------------------------------------------------------------------ a log
def made(seed: int, folder: Path) -> tuple[Path, dict[str, Any]]:
    """One log as CSV, and what is true of it."""
    rng = np.random.default_rng([seed, 43])
    name = list(FAULTS)[seed % len(FAULTS)]
    dead_time, lag = DELAYS[seed % len(DELAYS)]
    log = truth(rng, dead_time, lag)
    expected = FAULTS[name](log, rng)
    log = {key: values[::FINE] for key, values in log.items()}
    for key, size in NOISE.items():
        log[key] = log[key] + size * rng.normal(size=log[key].shape)
    tilt = Rotation.from_rotvec(TILT * rng.normal(size=log["p"].shape))
    log["q"] = (Rotation.from_quat(log["q"], scalar_first=True) * tilt).as_quat(scalar_first=True)
    path = folder / f"log_{seed}.csv"
    names = ["t", *(column for letter in STREAMS for column in STREAMS[letter]), *(f"m{i}" for i in range(4))]
    table = np.column_stack([log["t"], *(log[letter] for letter in STREAMS), log["command"]])
    np.savetxt(path, table, delimiter=",", header=",".join(names), comments="", fmt="%.7g")
    return path, {"seed": seed, "fault": name, "expected": sorted(expected), "dead_time": dead_time, "lag": lag}


def mapping(folder: Path, corrections: list[dict[str, Any]]) -> Path:
    lines: dict[str, Any] = {"time": {"column": "t"}, "motor_command": {"columns": [f"m{i}" for i in range(4)]}}
    for key, letter in MAPPING.items():
        lines[key] = {"columns": list(STREAMS[letter])}
    if corrections:
        lines["corrections"] = corrections
    path = folder / "mapping.yaml"
    path.write_text(yaml(lines))
    return path


def repetition(seed: int) -> dict[str, Any]:
    """Import as a user does, then identify."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        path, record = made(seed, folder)
        corrections: list[dict[str, Any]] = []
        align = False
        for count in range(ROUNDS):
            options = Options(mapping=mapping(folder, corrections), align=align)
            outcome: Outcome
            (outcome,) = import_files([path], folder / "out", options, force=True, keep=True)
            said = [finding for finding in outcome.findings if finding.severity != "info"]
            if count == 0:
                record["named"] = sorted({finding.name for finding in said})
                record["blocked"] = any(finding.blocks for finding in said)
            more = [finding.correction for finding in said if finding.correction]
            late = any(finding.name in ("time_offset", "clock_drift") for finding in said) and not align
            if outcome.path is None or not (more or late):
                break
            corrections += more
            align = align or late
        record["left"] = sorted({finding.name for finding in said})
        if outcome.path is not None:
            record.update(identified(read_flight(outcome.path)))
    named = set(record["named"])
    record["right"] = bool(named & set(record["expected"])) if record["expected"] else not record["blocked"]
    return record


def identified(flight: Flight) -> dict[str, Any]:
    """Drag along x and y and the delay of the thrust, with their 95 % intervals."""
    samples = gather_to_fit([flight], None, ["log"])
    model = fit_vehicle_model([flight], None, FitSettings(), names=["log"], samples=samples, best="linear")
    found: dict[str, Any] = {"terms": model.models["linear"].records()}
    late = gather([flight], "motor_command", ["log"]).command_lag()
    if late is not None:
        found["delay"] = late.dead_time + late.lag
        found["delay_interval"] = late.intervals[2].tolist()
    return found


def sound(folder: Path) -> list[str]:
    """Names of what blocks the public flights of a folder that are whole, one line each."""
    blocked = []
    logs = sorted(folder.glob("*.csv"))
    with tempfile.TemporaryDirectory() as place:
        for outcome in import_files(logs, Path(place), Options(), keep=True):
            names = sorted({finding.name for finding in outcome.findings if finding.blocks})
            blocked.append(f"{outcome.log.name}: {', '.join(names) or 'not blocked'}")
    return blocked


# ---------------------------------------------------------------------------------------------------------- report
def held(record: dict[str, Any]) -> dict[str, bool]:
    """Which intervals hold the truth."""
    holds = {}
    for term in record.get("terms", ()):
        if term["axis"] in ("x", "y") and term["term"] == "linear":
            holds[f"drag {term['axis']}"] = term["low"] <= DRAG <= term["high"]
    if "delay" in record:
        low, high = record["delay_interval"]
        beside = ", where a stream is late" if {"time_offset", "clock_drift"} & set(record["expected"]) else ""
        holds[f"delay{beside}"] = low <= record["dead_time"] + record["lag"] <= high
    return holds


def report(records: list[dict[str, Any]]) -> list[str]:
    lines = []
    total: dict[str, list[bool]] = {}
    for record in records:
        holds = held(record)
        for name, holding in holds.items():
            total.setdefault(name, []).append(holding)
        missed = [name for name, holding in holds.items() if not holding]
        verdict = "right" if record["right"] else "WRONG"
        text = f"{record['seed']} {record['fault']}: {verdict}: {', '.join(record['named']) or 'nothing'}"
        text += f"; left: {', '.join(record['left'])}" if record["left"] else ""
        lines.append(text + (f"; outside its interval: {', '.join(missed)}" if missed else ""))
    for name, holding in total.items():
        lines.append(f"{name}: the truth inside its 95 % interval in {sum(holding)} of {len(holding)}")
    right = sum(record["right"] for record in records)
    lines.append(f"named as they should be: {right} of {len(records)}")
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("--repetitions", type=int, default=len(FAULTS))
    parser.add_argument("--sound", type=Path, help="folder of public flights that must not be blocked")
    parser.add_argument("--out", type=Path, default=Path("log_faults.jsonl"))
    asked = parser.parse_args()
    if asked.sound is not None and not any(asked.sound.glob("*.csv")):
        parser.error(f"--sound {asked.sound}: has no CSV files")
    done = [json.loads(line) for line in asked.out.read_text().splitlines()] if asked.out.exists() else []
    known = {record["seed"] for record in done}
    for seed in range(asked.seed, asked.seed + asked.repetitions):
        if seed in known:
            continue
        record = repetition(seed)
        done.append(record)
        with open(asked.out, "a") as file:
            file.write(json.dumps(record, default=float) + "\n")
        print(report([record])[0], flush=True)
    lines = report(done)
    if asked.sound is not None:
        lines += sound(asked.sound)
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
