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

from quadexp.compile.backend import BufferedFunction
from quadexp.compile.symbolic import ca
from quadexp.control.built import built
from quadexp.control.delivered import Delays, commands_function
from quadexp.control.instant import Operation, call, copy, run
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

    mpc: its model, parameters, dead_time and known lag are used. `reset` begins a flight; its operations stand `before`
    and `after` the plan, at every control instant.

    commands: sent and not yet fully acting, (K, n) (N), the oldest first. thrust: of the rotors at the control instant,
    (n,) (N), with a known lag only.
    """

    def __init__(self, mpc: ModelPredictiveController) -> None:
        settings, n = mpc.settings, mpc.vehicle.n_rotors
        self._lag = settings.known_lag
        delays = Delays(settings.control_period, settings.dead_time, self._lag)
        self._pending = pending = delays.pending
        self._full = np.zeros(N_STATE + n * bool(self._lag))
        self._predict: BufferedFunction | None = None
        commands = np.zeros((pending, n))
        if pending:
            form = {"lag": bool(self._lag), "disturbed": mpc.disturbance is not None}
            function = built(mpc.backend, prediction_function, mpc.vehicle, mpc.residual, pending, **form)
            shared = {"theta": mpc.parameters}
            shared |= {} if mpc.disturbance is None else {"disturbance": mpc.disturbance}
            self._predict = BufferedFunction(function, shared | {"x": self._full})
            self._x_next = self._predict.results["x_next"]
            commands = self._predict.arguments["U"]
            durations = self._predict.arguments["dt"]
            durations[...], durations[0] = delays.period, delays.durations[0]
            if self._lag:
                self._predict.arguments["tau"][...] = self._lag
        # All of these are views of what `predict` reads.
        self.commands = commands.reshape(pending, n)
        self.thrust = self._full[N_STATE:] if self._lag else np.zeros(n)
        self._x, sent = self._full[:N_STATE], commands.reshape(-1)
        self._older, self._newer, self._newest = sent[:-n], sent[n:], sent[-n:]
        if self._lag:
            self._on = commands_function(n, delays, mpc.backend, {"commands": commands, "thrust": self.thrust})

    def reset(self, thrust: np.ndarray) -> None:
        """Start a flight: this command, (n,) (N), has been sent for a long time."""
        self.commands[...] = self.thrust[...] = thrust

    def predict(self, x: np.ndarray) -> np.ndarray:
        """State after the dead time, (13,), with a known lag (13 + n,), from the measured state x now, (13,)."""
        operations, predicted = self.before(x)
        run(operations)
        return predicted.copy()

    def before(self, state: np.ndarray) -> tuple[list[Operation], np.ndarray]:
        """Predicts from the state that is found there, (13,), and the array that has the predicted one then."""
        given = copy(self._x, state)
        return ([given], self._full) if self._predict is None else ([given, call(self._predict)], self._x_next)

    def after(self, command: np.ndarray) -> list[Operation]:
        """Goes on by one control period under the command that is found there, (n,) (N)."""
        on = []
        if self._lag:
            on = [copy(self._on.arguments["sent"], command), call(self._on)]
            on.append(copy(self.thrust, self._on.results["thrust_next"]))
        return [*on, copy(self._older, self._newer), copy(self._newest, command)] if self._pending else on


class MotorLead:
    """The command with which lagging rotors deliver a planned thrust when the next command comes.

        u = T + (T* - T) / (1 - exp(-h / tau)),    h the control period, T the thrust now, T* the planned one

    clipped to limits, (n,) each (N), of thrusts that are delivered, which may change: those of the plan. It inverts
    T(t + h) of physics.motor, tau being settings.motor_lead (s). Two other
    laws are worse: a command for the mean thrust over the period amplifies noise and errors of the timing, and
    T* + tau T*' with T*' from the plan takes damping away (docs/delays.md has the figures).
    """

    def __init__(
        self, limits: tuple[np.ndarray, np.ndarray], settings: MPCSettings, backend: str = "interpreted"
    ) -> None:
        function = built(backend, inversion_function, len(limits[0]))
        self._invert = BufferedFunction(function, named(("low", "high"), limits))
        self.tune(settings)

    def tune(self, settings: MPCSettings) -> None:
        """Go on with the lag of other settings; without one, a command is what is planned."""
        period, lag = settings.control_period, settings.motor_lead
        self._invert.arguments["gain"][...] = -1 / math.expm1(-period / lag) if lag else 1.0

    def after(self, planned: np.ndarray, thrust: np.ndarray) -> tuple[list[Operation], np.ndarray]:
        """Inverts for the thrusts that are found there, (n,) (N), planned and now; and the array of the command."""
        given = self._invert.arguments
        operations = [copy(given["planned"], planned), copy(given["now"], thrust), call(self._invert)]
        return operations, self._invert.results["command"]


def inversion_function(rotors: int) -> ca.Function:
    """planned, now, low, high (n,) (N); gain -> command (n,) (N)."""
    given = named_symbols(ca.SX, {"planned": rotors, "now": rotors, "low": rotors, "high": rotors, "gain": 1})
    planned, now, low, high, gain = given.values()
    command = limited(now + gain * (planned - now), low, high)
    return named_function("motor_lead", given, {"command": command})


def prediction_function(
    vehicle: Vehicle, residual: Residual, commands: int, *, lag: bool = False, disturbed: bool = False
) -> ca.Function:
    """The model's state after K = commands held inputs.

    Inputs: x (m,), m = 13, with `lag` 13 + n; U (n, K) (N), the first to act first; dt (K,), for how long each acts
    (s); theta (p,); with `lag` tau (s); with `disturbed` disturbance (6,), see physics.rigid_body. Output: x_next (m,),
    its quaternion of unit length.
    """
    n = vehicle.n_rotors
    node = node_function(vehicle, residual, lag=lag, disturbed=disturbed)
    shapes = {"x": N_STATE + n * lag, "U": (n, commands), "dt": commands, "theta": residual.function.size1_in(1)}
    shapes |= {"tau": 1} if lag else {}
    shapes |= {"disturbance": N_DISTURBANCE} if disturbed else {}
    arguments = named_symbols(ca.MX, shapes)
    x, further = arguments["x"], [arguments[name] for name in ("tau", "disturbance") if name in arguments]
    for u, dt in zip(ca.horzsplit(arguments["U"]), ca.vertsplit(arguments["dt"]), strict=True):
        x = node(x, u, arguments["theta"], dt, *further)
    return named_function("mpc_prediction", arguments, {"x_next": with_unit_attitude(x)})
