"""Dead-time compensation: predict the state at which a command sent now begins to act.

Between a command and its thrust there is a dead time d: transport, computation, and a motor lag that is counted as dead
time. A command sent at t_j acts over [t_j + d, t_j + d + T], T the control period. At t_k the last K = ceil(d / T)
commands have not fully acted; the oldest of them still acts for d - (K - 1) T. With F(x, u, h) the model's state after
u is held for h,

    x(t_k + d) = F( .. F(F(x_k, u_{k-K}, d - (K - 1) T), u_{k-K+1}, T) .., u_{k-1}, T)

and the control problem is solved from that state, along the reference from t_k + d on (a predictor as of Smith 1957,
restarted from each measurement). Where the rotors' lag is known (controller.motor_lag or motor_lead), their thrusts are
not measured but computed from the commands by the same lag (physics.motor).
"""

from __future__ import annotations

import math

import numpy as np

from quadexp.compile.memory import NEXT, NOW, Memory, connected, sizes_of
from quadexp.compile.symbolic import ca
from quadexp.control.cached_function import cached_function
from quadexp.control.control_step import Call, call, copy, run
from quadexp.control.delivered import Delays, delivered_by_commands, kept_sizes
from quadexp.control.mpc.mpc import ModelPredictiveController
from quadexp.control.mpc.prediction import node_function
from quadexp.control.mpc.settings import MPCSettings
from quadexp.models.residual import Residual
from quadexp.names import named
from quadexp.physics.expression import limited, named_function, named_symbols
from quadexp.physics.rigid_body import N_DISTURBANCE
from quadexp.physics.rotation import with_unit_attitude
from quadexp.physics.state import N_STATE
from quadexp.physics.vehicle import Vehicle


class DeadTimePredictor:
    """Predicts the state after the dead time from the commands that have been sent but have not acted yet.

    mpc: its model, parameters, dead_time and known lag are used. `reset` begins a flight; its calls stand `before`
    and `after` the plan, at every control instant. memory: those commands, and with a known lag thrusts of the rotors.
    """

    def __init__(self, mpc: ModelPredictiveController) -> None:
        settings = mpc.settings
        n = mpc.vehicle.n_rotors
        self._delays = Delays(settings.control_period, settings.dead_time, settings.known_lag)
        disturbed = mpc.disturbance is not None
        form = mpc.vehicle, mpc.residual, self._delays
        self._function = cached_function(mpc.backend, prediction_function, *form, disturbed=disturbed)
        self._places = {"theta": mpc.parameters} | ({} if mpc.disturbance is None else {"disturbance": mpc.disturbance})
        self.memory = Memory("DeadTime", sizes_of([self._function]) | {"sent": n})
        self._predicted = {"x_next": np.zeros(self._function.size1_out("x_next"))}

    def reset(self, thrust: np.ndarray) -> None:
        """Start a flight: this command, (n,) (N), has been sent for a long time."""
        for memory, values in self.starts(thrust):
            memory.begin(values)

    def starts(self, thrust: np.ndarray) -> list[tuple[Memory, dict[str, np.ndarray]]]:
        """What is remembered then; thrust may be symbols."""
        start = {"commands": np.tile(thrust, self._delays.pending), "thrust": thrust, "sent": thrust}
        return [(self.memory, {name: value for name, value in start.items() if name in self.memory.sizes})]

    def predict(self, x: np.ndarray) -> np.ndarray:
        """State after the dead time, (13,), with a known lag (13 + n,), from the measured state x now, (13,)."""
        calls, predicted = self.before(np.ascontiguousarray(x, float))
        run(calls)
        return predicted.copy()

    def before(self, state: np.ndarray) -> tuple[list[Call], np.ndarray]:
        """Predicts from the state that is found there, (13,), and the array that has the predicted one then."""
        places = self._places | {"x": state}
        return [call(connected(self._function, places, self._predicted, self.memory))], self._predicted["x_next"]

    def after(self, command: np.ndarray) -> list[Call]:
        """Remembers the command that is found there, (n,) (N)."""
        return [copy(self.memory.of_next["sent"], command)]


class MotorLead:
    """The command with which lagging rotors deliver a planned thrust when the next command comes.

        u = T + (T* - T) / (1 - exp(-h / tau)),    h the control period, T the thrust now, T* the planned one

    clipped to limits, (n,) each (N), of thrusts that are delivered, which may change: those of the plan. gain: the
    array of the factor, which may change too; 1: a command is what is planned. It inverts T(t + h) of physics.motor,
    tau being settings.motor_lead (s). Two other
    laws are worse: a command for the mean thrust over the period amplifies noise and errors of the timing, and
    T* + tau T*' with T*' from the plan takes damping away (docs/delays.md has the figures).
    """

    def __init__(
        self, limits: tuple[np.ndarray, np.ndarray], settings: MPCSettings, backend: str = "interpreted"
    ) -> None:
        self._function = cached_function(backend, inversion_function, len(limits[0]))
        self._places = named(("low", "high"), limits)
        self.gain = np.zeros(1)
        self._inverted = {"command": np.zeros_like(limits[0])}
        period = settings.control_period
        lag = settings.motor_lead
        self.gain[...] = -1 / math.expm1(-period / lag) if lag else 1.0

    def after(self, planned: np.ndarray, thrust: np.ndarray) -> tuple[list[Call], np.ndarray]:
        """Inverts for the thrusts that are found there, (n,) (N), planned and now; and the array of the command."""
        places = self._places | {"gain": self.gain, "planned": planned, "now": thrust}
        return [call(connected(self._function, places, self._inverted))], self._inverted["command"]


def inversion_function(rotors: int) -> ca.Function:
    """planned, now, low, high (n,) (N); gain -> command (n,) (N)."""
    arguments = named_symbols(ca.SX, {"planned": rotors, "now": rotors, "low": rotors, "high": rotors, "gain": 1})
    planned, now, low, high, gain = arguments.values()
    command = limited(now + gain * (planned - now), low, high)
    return named_function("motor_lead", arguments, {"command": command})


def prediction_function(
    vehicle: Vehicle, residual: Residual, delays: Delays, *, disturbed: bool = False
) -> ca.Function:
    """The model's state after the dead time.

    Inputs: x (13,); theta (p,); with `disturbed` disturbance (6,), see physics.rigid_body; and the memory: commands
    that are pending, thrust, the command that was sent last. Output: x_next, its quaternion of unit length, (13,), with
    a lag (13 + n,); the memory's next values.
    """
    n = vehicle.n_rotors
    lag = bool(delays.lag)
    kept = kept_sizes(vehicle.n_rotors, delays)
    shapes = {"x": N_STATE, "theta": residual.function.size1_in(1)}
    shapes |= {"disturbance": N_DISTURBANCE} if disturbed else {}
    arguments = named_symbols(ca.MX, shapes | {NOW + name: kept[name] for name in ("commands", "thrust", "sent")})
    x = arguments["x"]
    theta = arguments["theta"]
    before = ca.reshape(arguments[f"{NOW}commands"], n, delays.pending)
    numbers = ca.DM(delays.numbers)
    commands, thrust, _ = delivered_by_commands(before, arguments[f"{NOW}thrust"], arguments[f"{NOW}sent"], numbers)
    further = [ca.MX(delays.lag)] if lag else []
    if disturbed:
        further.append(arguments["disturbance"])
    if lag:
        x = ca.vertcat(x, thrust)
    if delays.pending:
        node = node_function(vehicle, residual, lag=lag, disturbed=disturbed)
        durations = [delays.durations[0], *[delays.period] * (delays.pending - 1)]  # for how long each command acts
        for u, dt in zip(ca.horzsplit(commands), durations, strict=True):
            x = node(x, u, theta, dt, *further)
        x = with_unit_attitude(x)
    results = {"x_next": x, f"{NEXT}commands": ca.vec(commands)} | ({f"{NEXT}thrust": thrust} if lag else {})
    return named_function("mpc_prediction", arguments, results)
