"""What the equations of a law, or of a layer around one, may read at a control instant. World ENU, body FLU, SI."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from quadexp.compile.memory import NEXT, NOW
from quadexp.compile.symbolic import ca
from quadexp.control.base import N_BELIEF, Belief
from quadexp.control.control_step import InputArrays
from quadexp.control.delivered import Delays, delivered_thrust, kept_sizes
from quadexp.errors import UsageError
from quadexp.messages import suggestion
from quadexp.models.residual import N_OUTPUTS, Residual
from quadexp.physics.expression import symbols
from quadexp.physics.rotation import air_velocity
from quadexp.physics.state import ATTITUDE, N_STATE, RATE, VELOCITY
from quadexp.physics.vehicle import Vehicle

AIR = {"air": "state", "air_reference": "reference"}  # acceleration and torque of the air -> the state that they are at


@dataclass(frozen=True)
class Circumstances:
    """What equations know beside the vehicle: the control period, dead time and lag of commands (s), by how much rotor
    speeds are older than body rates (s), whether they tell thrusts, whether functions are to be compiled, and by how
    much later the state is that the controller inside is given (s)."""

    period: float
    dead_time: float = 0.0
    lag: float = 0.0
    late: float = 0.0
    speeds: bool = True
    compiled: bool = False
    ahead: float = 0.0

    @property
    def delays(self) -> Delays:
        """Of the commands."""
        return Delays(self.period, self.dead_time, self.lag)


class Inputs:
    """What equations may read, as symbols; what they do not read costs nothing.

    state: (13,), position, quaternion body to world, velocity (world), body rate.
    reference: (13,), of the trajectory now, by flatness. thrusts: of the reference now, (n,) (N); thrusts_middle: in
    the middle of the control period. path: (3, 5), position of the reference to snap, world.
    heading: of the reference, its rate and acceleration (rad), (3,); drift: how fast it turns beside these, where it is
    left free (rad/s).
    specific_force: of the accelerometer, (3,), body (m/s^2). rotor_speed: (n,) (rad/s). fresh: (2,), whether these two
    were measured now; otherwise they are as they were.
    delivered: what the rotors give now, (n,) (N), measured, or by the commands that were sent; mean: over the last
    control period. command: of the controller inside, (n,) (N), for what is done after it.
    belief: what an observer tells; see control.base.Belief. air, air_reference: (6,), acceleration (m/s^2) and torque
    (N m) by the controller's model of the air, body, at state and reference; without a model zero. theta: its
    parameters. period: of control (s); about: all that is known, Circumstances.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        about: Circumstances,
        kind: Any,
        residual: Residual | None = None,
        *,
        later: bool = False,
    ) -> None:
        """kind: of symbols. residual: the model of the air. later: air is a symbol too, which is put in later."""
        self.vehicle = vehicle
        self.about = about
        self.period = about.period
        self.residual = residual
        self.air_thrusts = "thrusts"
        self.commanded = False  # whether the controller inside has given its command
        self.remembered: Collection[str] = ()  # names of what the equations remember
        self.kind = kind
        self._later = later
        n = vehicle.n_rotors
        self._shapes = {
            "state": (N_STATE, 1), "reference": (N_STATE, 1), "thrusts": (n, 1), "thrusts_middle": (n, 1),
            "path": (3, 5), "heading": (3, 1), "drift": (1, 1), "specific_force": (3, 1), "rotor_speed": (n, 1),
            "fresh": (2, 1), "belief": (N_BELIEF, 1), "command": (n, 1), **dict.fromkeys(AIR, (N_OUTPUTS, 1)),
        }  # fmt: skip
        self.read: dict[str, Any] = {}
        self.left: dict[str, Any] = {}  # next values of what it remembers of commands
        self._thrusts: tuple[Any, Any] | None = None

    def symbol(self, name: str, shape: tuple[int, int] | None = None) -> Any:
        """The symbol of an input, made when it is first asked for."""
        if name not in self.read:
            self.read[name] = self.kind.sym(name, *(shape or self._shapes[name]))
        return self.read[name]

    def __getattr__(self, name: str) -> Any:
        if name in ("delivered", "mean"):
            return self._deliver()[name == "mean"]
        if name.startswith("_") or name not in self._shapes:
            names = ", ".join([*self._shapes, "delivered", "mean"])
            raise AttributeError(f"there is no input {name}; inputs are {names}, period")
        if name == "command" and not self.commanded:
            raise AttributeError("inputs.command is that of the controller inside, which only `after` of a layer knows")
        if name in AIR and not self._later:
            return self._air(name)
        b = self.symbol(name)
        return Belief(b[0:3], b[3:6], b[6:9], b[9], b[10]) if name == "belief" else b

    @property
    def theta(self) -> Any:
        """Parameters of the model of the air, (p,)."""
        return self.symbol("theta", (0 if self.residual is None else len(self.residual.theta), 1))

    def model(self, z: Any) -> Any:
        """The model of the air at features z: y (6,), see models.residual; zeros where there is none."""
        if self.residual is None:
            return ca.DM.zeros(N_OUTPUTS)
        function = self.residual.form(self.about.compiled)
        return function(z, self.theta[: function.size1_in(1)])[0]

    def _air(self, name: str) -> Any:
        """`air` or `air_reference`, in the wind that is assumed where the belief is read."""
        if self.residual is None:
            return ca.DM.zeros(N_OUTPUTS)
        x, wind, u = symbols(ca.SX, x=N_STATE, wind=3, u=self.vehicle.n_rotors)
        velocity = air_velocity(x[ATTITUDE], x[VELOCITY], wind)
        features = ca.Function("features", [x, wind, u], [ca.vertcat(velocity, x[RATE], u)])
        believes = "belief" in self.read
        blows, scale = (self.belief.wind, self.belief.air_scale) if believes else (ca.DM.zeros(3), 1)
        z = features(self.symbol(AIR[name]), blows, getattr(self, self.air_thrusts))
        return ca.densify(scale * self.model(z))

    def _deliver(self) -> tuple[Any, Any]:
        """`delivered` and `mean`; what they need of the commands is remembered."""
        if self._thrusts is None:
            delays = self.about.delays
            coefficient = self.vehicle.thrust_coefficient
            sizes = kept_sizes(self.vehicle.n_rotors, delays)
            if taken := sizes.keys() & self.remembered:
                names = ", ".join(sorted(taken))
                raise UsageError(f"memory: inputs.delivered remembers {names} of its own: choose another name")
            measured = None
            turning = 0
            if coefficient is not None and self.about.speeds:
                measured = coefficient * self.rotor_speed**2
                turning = self.fresh[1]
            else:
                sizes.pop("before")
            kept = {name: self.symbol(NOW + name, (size, 1)) for name, size in sizes.items()}
            now, mean, next_values = delivered_thrust(kept, kept["sent"], ca.DM(delays.numbers), measured, turning)
            self._thrusts = (now, mean)
            self.left = {NEXT + name: value for name, value in next_values.items()}
        return self._thrusts


class Symbols:
    """Symbols of the inputs by shorter names, made when they are asked for. prefix: before these names. sizes: how many
    numbers each has. what: they are, for messages."""

    def __init__(self, inputs: Inputs, prefix: str, sizes: Mapping[str, int], what: str) -> None:
        self._inputs = inputs
        self._prefix = prefix
        self._sizes = sizes
        self._what = what

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or name not in self._sizes:
            raise AttributeError(f"{name} is not {self._what}; that is {', '.join(self._sizes) or 'nothing'}")
        return self._inputs.symbol(self._prefix + name, (self._sizes[name], 1))


def remembered(inputs: Inputs, sizes: Mapping[str, int]) -> Symbols:
    """What equations remember, by name."""
    inputs.remembered = sizes.keys()
    return Symbols(inputs, NOW, sizes, "what is remembered")


def places_of(inputs: InputArrays, state: np.ndarray) -> dict[str, np.ndarray]:
    """Where the inputs lie that are given to a controller; state: as it is given, (13,)."""
    return {
        "state": state,
        "path": inputs.path,
        "heading": inputs.yaw[:3],
        "drift": inputs.yaw[3:],
        "specific_force": inputs.specific_force,
        "rotor_speed": inputs.rotor_speed,
        "fresh": inputs.fresh,
    }


def at_start(vehicle: Vehicle, about: Circumstances, thrust: np.ndarray) -> dict[str, np.ndarray]:
    """What `delivered` remembers where this command, (n,) (N), has been sent for a long time."""
    return {"commands": np.tile(thrust, about.delays.pending), "thrust": thrust, "sent": thrust}


def started(part: Any, values: Any, sizes: Mapping[str, int]) -> dict[str, Any]:
    """What a part remembers at the start, as its `start` says it, checked. sizes: of what it remembers."""
    what = f"start of {type(part).__name__}"
    if not isinstance(values, Mapping):
        raise UsageError(f"{what}: must return a dict of names and numbers, not {type(values).__name__}")
    for name, numbers in values.items():
        if name not in sizes:
            raise UsageError(f"{what}: {name!r} is not remembered{suggestion(str(name), [*sizes])}")
        symbolic = isinstance(numbers, ca.SX) or np.asarray(numbers).dtype == object
        size = numbers.numel() if isinstance(numbers, ca.SX) else np.size(numbers)
        if size not in (1, sizes[name]) or not (symbolic or np.isfinite(np.asarray(numbers, float)).all()):
            raise UsageError(f"{what}: {name!r} is {numbers}; {sizes[name]} finite numbers are needed")
    return dict(values)
