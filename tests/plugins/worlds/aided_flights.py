"""Sensors and filter alone, on motions that are written down: no plant, no controller."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import casadi as ca
import numpy as np
from scipy.spatial.transform import Rotation

from quadexp.compile.backend import BufferedFunction, realise
from quadexp.physics.state import N_STATE, POSITION, VELOCITY
from quadexp.plugins.worlds.eskf import N_COVARIANCE, N_ERROR, N_NOMINAL, Navigation
from quadexp.plugins.worlds.inertial import N_BIAS, InertialSensors
from quadexp.world.effect import Clock, Readings, Start
from quadexp.world.streams import Streams, part_stream

GRAVITY = 9.81


@dataclass
class Body:
    """What sensors and filter know of a vehicle."""

    gravity: float = GRAVITY


def motion(t: np.ndarray, seed: int = 0, speed: float = 1.0) -> np.ndarray:
    """States (k, 13) of a smooth motion: sums of sines in position, and in a rotation vector of up to a radian."""
    rng = np.random.default_rng(seed)
    frequency, phase = rng.uniform(0.5, 3.0, (2, 3, 3)) * speed, rng.uniform(0, 2 * np.pi, (2, 3, 3))
    size = np.array([[2.0, 0.5, 0.2], [0.4, 0.15, 0.05]])[:, None, :]

    def waves(derivative: int) -> np.ndarray:
        turned = frequency * np.asarray(t)[:, None, None, None] + phase + derivative * np.pi / 2
        return (size * frequency**derivative * np.sin(turned)).sum(-1)

    small = 1e-6
    attitude = Rotation.from_rotvec(waves(0)[:, 1])
    later = Rotation.from_rotvec((waves(0) + small * waves(1))[:, 1])
    rates = (attitude.inv() * later).as_rotvec() / small
    q = attitude.as_quat(scalar_first=True)
    return np.hstack([waves(0)[:, 0], q, waves(1)[:, 0], rates])


def standing(t: np.ndarray) -> np.ndarray:
    """States (k, 13) at rest, level."""
    return np.tile(np.r_[0, 0, 1, 1, np.zeros(9)], (len(t), 1))


class AidedRun:
    """One run of sensors and filter: `go` over the states (k steps + 1, 13) of k control periods.

    backend: compiled is worth its time for many runs.

    Afterwards, a row a period: given (k, 13), nominal (k, 16), covariance (k, 15, 15), bias (k, 6), reading (k, 3).
    """

    def __init__(
        self,
        sensors: InertialSensors,
        settings: Navigation | None = None,
        *,
        period: float = 0.01,
        steps: int = 10,
        backend: str = "interpreted",
    ) -> None:
        self.clock = Clock(period, steps)
        self.sensors, self.filter = sensors, Navigation(**asdict(settings or Navigation(warm_up=0.0))).among([sensors])
        self.behind = self.filter.horizon(self.clock)
        self.function = BufferedFunction(realise(_period(self.sensors, self.filter, self.clock), backend))

    def go(self, states: np.ndarray, seed: int = 0, outage: tuple[float, float] = (0.0, 0.0)) -> AidedRun:
        """outage: from when (s) until when no fix gets through."""
        rng, other = np.random.default_rng(seed).spawn(2)
        f, begun = self.function, {}
        start = Start(states[0], 1.0, self.clock, Body(), np.empty(0), begun)
        f.arguments["inner"][:], f.arguments["parameters"][:] = self.sensors.start(rng, start)
        drawn = enumerate(self.sensors.sizes(self.clock, None).drawn)
        noise = Streams([(part_stream(rng, str(i)), one) for i, one in drawn], self.clock.period)
        begun["sensor"] = f.arguments["inner"].copy()
        f.arguments["known"][:], f.arguments["believed"][:] = self.filter.start(other, start)
        self.at_first, self.bias_at_first = f.arguments["known"].copy(), begun["sensor"][:N_BIAS]
        self.first = self.filter.first(f.arguments["known"], states[0])
        rows: dict[str, list[np.ndarray]] = {name: [] for name in ("state", "known", "inner", "specific_force")}
        for k in range(0, len(states) - 1, self.clock.steps):
            f.arguments["fixes"][0] = not outage[0] <= k * self.clock.step < outage[1]
            f.arguments["states"][:] = states[k : k + self.clock.steps + 1]
            noise.standard_normal(f.arguments["draws"])
            f()
            for name, row in rows.items():
                row.append(f.results[f"{name}_next"].copy())
            f.arguments["inner"][:], f.arguments["known"][:] = rows["inner"][-1], rows["known"][-1]
        found = {name: np.array(row) for name, row in rows.items()}
        self.inputs, self.reading, self.bias = found["state"], found["specific_force"], found["inner"][:, :N_BIAS]
        self.nominal = found["known"][:, :N_NOMINAL]
        self.covariance = full(found["known"][:, N_NOMINAL : N_NOMINAL + N_COVARIANCE])
        return self

    def nees(self, states: np.ndarray) -> np.ndarray:
        """Error squared, normalised by the covariance, of the filter on its horizon after each period, (k,)."""
        count = self.sensors.readings(self.clock)
        late = self.behind // count  # periods
        assert late * count == self.behind, "the horizon must lie at the end of a control period"
        truth, bias = states[self.clock.steps :: self.clock.steps], self.bias
        e = errors(self.nominal[late:], truth[: len(truth) - late], bias[: len(bias) - late])
        return np.einsum("ki,ki->k", e, np.linalg.solve(self.covariance[late:], e[:, :, None])[:, :, 0])


def errors(nominal: np.ndarray, states: np.ndarray, bias: np.ndarray) -> np.ndarray:
    """Errors (k, 15) of nominal states (k, 16), by scipy's rotations."""
    q, true = (Rotation.from_quat(x[:, 3:7], scalar_first=True) for x in (nominal, states))
    return np.hstack(
        [
            states[:, POSITION] - nominal[:, POSITION],
            states[:, VELOCITY] - nominal[:, VELOCITY],
            (q.inv() * true).as_rotvec(),
            bias - nominal[:, 10:],
        ]
    )


def full(numbers: np.ndarray) -> np.ndarray:
    """Covariances (k, 15, 15) of their upper triangles (k, 120), column by column."""
    columns, rows = np.tril_indices(N_ERROR)
    found = np.zeros((len(numbers), N_ERROR, N_ERROR))
    found[:, rows, columns] = found[:, columns, rows] = numbers
    return found


def _period(sensors: InertialSensors, estimator: Navigation, clock: Clock) -> ca.Function:
    sizes, own = sensors.sizes(clock, None), estimator.sizes(clock, None)
    symbols = {
        "states": ca.MX.sym("states", N_STATE, clock.steps + 1),
        "inner": ca.MX.sym("inner", sizes.inner),
        "known": ca.MX.sym("known", own.inner),
        "draws": ca.MX.sym("draws", sizes.draws),
        "parameters": ca.MX.sym("parameters", sizes.parameters),
        "believed": ca.MX.sym("believed", own.parameters),
        "fixes": ca.MX.sym("fixes"),
    }
    step = ca.MX(clock.step)
    x, inner, known, draws, parameters, believed, fixes = symbols.values()
    at = Readings(ca.MX(0), x, inner, parameters, draws, step, clock, *[None] * 3)  # an IMU asks for no more
    told: Any = {"state": x[:, -1], "specific_force": ca.MX.zeros(3)}
    inner_next, told = sensors.measure(at, told)
    told |= {aid.name: fixes * told[aid.name] for aid in sensors.aids}
    known_next, told = estimator.measure(at._replace(inner=known, parameters=believed), told)
    results = {"state_next": told["state"], "known_next": known_next, "inner_next": inner_next}
    results["specific_force_next"] = told["specific_force"]
    return ca.Function("aided", list(symbols.values()), list(results.values()), list(symbols), list(results))
