"""A control law in closed form: one class, with its settings, what it remembers, and one method `equations`.

    class Mine(Law):
        \"\"\"Tracking with an integral: F = m (a_r - g - k_p e_p - k_v e_v - k_i i), i' = e_p.\"\"\"
        k_i: float = key(1.0, "gain of the integral", "[0, 100]", "1/s^3")
        memory = {"integral": 3}  # m s
        logged = ("integral",)

        def equations(self, vehicle, given, memory):
            error = given.state[POSITION] - given.path[:, 0]
            ...
            return {"command": thrusts, "integral": memory.integral + given.period * error}

The equations are written once, in CasADi, and called when the controller is built. From them follow its step in C, the
delays that its loop tolerates, its columns, and every remedy: observers, where they read a belief, L1, INDI,
predictions of delays, remedies=auto.

World ENU, body FLU, SI.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np

from quadexp.compile.backend import resolve
from quadexp.compile.symbolic import ca
from quadexp.control.allocation import held
from quadexp.control.base import N_BELIEF, Belief
from quadexp.control.built import built
from quadexp.control.laws.explicit import BelievingController, ExplicitController, Rate
from quadexp.control.part import ControllerPart
from quadexp.errors import UsageError
from quadexp.models.residual import N_OUTPUTS, Residual
from quadexp.parts.part import Given
from quadexp.parts.settings import Backend, keyed
from quadexp.physics.expression import named_function, split, symbols
from quadexp.physics.rotation import air_velocity
from quadexp.physics.state import ATTITUDE, N_STATE, RATE, VELOCITY
from quadexp.physics.vehicle import Vehicle

Air = Callable[["Inputs", str], Any]
AIR = {"air": "state", "air_reference": "reference"}  # acceleration and torque of the air -> the state that they are at


class Inputs:
    """What a law's equations may read, as symbols; what they do not read costs nothing.

    state: (13,), position, quaternion body to world, velocity (world), body rate. reference: (13,), of the trajectory
    now, by flatness. thrusts: of the reference now, (n,) (N); thrusts_middle: in the middle of the control period.
    path: (3, 5), position of the reference to snap, world. heading: of the reference, its rate and acceleration (rad),
    (3,). specific_force: of the accelerometer, (3,), body (m/s^2). rotor_speed: (n,) (rad/s). fresh: (2,), whether
    these two were measured now; otherwise they are as they were. delivered: what the rotors give now, (n,) (N),
    measured, or by the commands that were sent. belief: what an observer tells; see control.base.Belief. air,
    air_reference: (6,), acceleration (m/s^2) and torque (N m) by the controller's model of the air, body, at state and
    reference; without a model zero. period: of control (s).
    """

    def __init__(self, vehicle: Vehicle, period: float, kind: Any, air: Air | None = None) -> None:
        n, self.period, self._kind, self._air = vehicle.n_rotors, period, kind, air
        self._shapes = {
            "state": (N_STATE, 1), "reference": (N_STATE, 1), "thrusts": (n, 1), "thrusts_middle": (n, 1),
            "path": (3, 5), "heading": (3, 1), "specific_force": (3, 1), "rotor_speed": (n, 1), "fresh": (2, 1),
            "delivered": (n, 1), "belief": (N_BELIEF, 1), **dict.fromkeys(AIR, (N_OUTPUTS, 1)),
        }  # fmt: skip
        self.read: dict[str, Any] = {}

    def symbol(self, name: str, shape: tuple[int, int] | None = None) -> Any:
        """The symbol of an input, made when it is first asked for; with `air` what that says of it."""
        if self._air and name in AIR:
            return self._air(self, name)
        if name not in self.read:
            self.read[name] = self._kind.sym(name, *(shape or self._shapes[name]))
        return self.read[name]

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or name not in self._shapes:
            raise AttributeError(f"there is no input {name}; inputs are {', '.join(self._shapes)}, period")
        b = self.symbol(name)
        return Belief(b[0:3], b[3:6], b[6:9], b[9], b[10]) if name == "belief" else b


@keyed
class Law(ControllerPart):
    """A law in closed form, see the module.

    memory: what it remembers from step to step, names and lengths; zero at the start of a flight unless `start` says
    otherwise. logged: names of results that become columns; a vector of three has _x, _y, _z. nodes: times from now at
    which it is told the reference, in control periods; the last interval's thrusts are `thrusts_middle`. symbols: of
    the equations, ca.SX, or ca.MX where these call functions. air_thrusts: which thrusts its model of the air is told.
    """

    memory: ClassVar[Mapping[str, int]] = {}
    logged: ClassVar[tuple[str, ...]] = ()
    nodes: ClassVar[tuple[float, ...]] = (0.0, 0.5, 1.0)
    symbols: ClassVar[Any] = ca.SX
    air_thrusts: ClassVar[str] = "thrusts"

    rate: Rate = 100.0
    backend: Backend = "auto"

    def equations(self, vehicle: Vehicle, given: Inputs, memory: Any) -> dict[str, Any]:
        """`command`, thrusts (n,) (N), within the limits; of everything in `memory` the next value; what is logged; and
        `held`, how many rotors are at a limit, where the command does not show it."""
        raise NotImplementedError

    def start(self, vehicle: Vehicle, x: np.ndarray) -> dict[str, np.ndarray]:
        """What it remembers at the start of a flight in the state x, (13,), where that is not zero."""
        return {}

    def build(self, given: Given) -> Any:
        """See ControllerPart."""
        return self.controller(given.vehicle, given.residual(*self.kinds))

    def controller(self, vehicle: Vehicle, residual: Residual | None = None) -> ExplicitController:
        """The Controller (see control.base) of a vehicle. residual: its model of the air, None for none.

        Raises UsageError for equations that do not give what they must."""
        known = None if residual is None or residual.is_zero else residual
        structure = replace(self, name="law", models=(), allow_unstable=False)  # of which the function depends
        compiled = resolve(self.backend) == "compiled"
        function = built(self.backend, law_function, structure, vehicle, known, compiled=compiled)
        kind = BelievingController if "belief" in function.name_in() else ExplicitController
        return kind(vehicle, self, function, known)

    def initial(self, vehicle: Vehicle, x: np.ndarray) -> np.ndarray:
        """`start` as one vector."""
        values = {name: np.zeros(size) for name, size in self.memory.items()} | self.start(vehicle, x)
        return np.hstack([values[name] for name in self.memory])


def law_function(law: Law, vehicle: Vehicle, residual: Residual | None, *, compiled: bool) -> ca.Function:
    """What the law reads, and `memory`, -> command, held, memory_next, and log_NAME of what is logged.

    residual: its model of the air, None for none. compiled: whether it is taken in its form for compilation."""
    model = None if residual is None else residual.form(compiled)
    inputs = Inputs(vehicle, 1 / law.rate, law.symbols)
    outputs = _outputs(law, vehicle, inputs)
    given = Inputs(vehicle, 1 / law.rate, ca.MX, _air(law, vehicle, model))
    for name, symbol in inputs.read.items():
        if name not in AIR:  # which come behind: they read the belief if the law does
            given.symbol(name, symbol.shape)
    if law.symbols is ca.MX:
        return named_function("law", given.read, _outputs(law, vehicle, given))
    inner = ca.Function("law", [*inputs.read.values()], ca.cse([*outputs.values()]))
    results = inner.call([given.symbol(name) for name in inputs.read])
    return named_function("law", given.read, dict(zip(outputs, results, strict=True)))


def _outputs(law: Law, vehicle: Vehicle, inputs: Inputs) -> dict[str, Any]:
    """The outputs of `law_function`, which reads inputs."""
    sizes = [*law.memory.values()]
    memory = inputs.symbol("memory", (sum(sizes), 1)) if sizes else ca.DM(0, 1)
    pieces = split(memory, sizes) if sizes else []
    try:
        found = law.equations(vehicle, inputs, SimpleNamespace(**dict(zip(law.memory, pieces, strict=True))))
        found = {name: ca.densify(law.symbols(value)) for name, value in found.items()}
    except UsageError:
        raise
    except Exception as error:
        raise UsageError(f"equations of {type(law).__name__}: {type(error).__name__}: {error}") from error
    for name, size in {**dict.fromkeys(law.logged), "command": vehicle.n_rotors, **law.memory}.items():
        if name not in found or size not in (None, found[name].numel()):
            numbers = "" if size is None else f", {size} numbers"
            raise UsageError(f"equations of {type(law).__name__}: must give {name!r}{numbers}")
    outputs = {"command": found["command"], "held": found.get("held", held(vehicle, found["command"]))}
    if sizes:
        outputs["memory_next"] = ca.vertcat(*(found[name] for name in law.memory))
    return outputs | {f"log_{name}": found[name] for name in law.logged}


def _air(law: Law, vehicle: Vehicle, model: ca.Function | None) -> Air:
    """What says `air` and `air_reference` of inputs by a residual's function."""
    x, wind, u = symbols(ca.SX, x=N_STATE, wind=3, u=vehicle.n_rotors)
    velocity = air_velocity(x[ATTITUDE], x[VELOCITY], wind)
    features = ca.Function("features", [x, wind, u], [ca.vertcat(velocity, x[RATE], u)])

    def air(inputs: Inputs, name: str) -> Any:
        if model is None:
            return ca.DM.zeros(N_OUTPUTS)
        read = inputs.read.keys() & {"belief"}
        wind, scale = (inputs.belief.wind, inputs.belief.air_scale) if read else (ca.DM.zeros(3), 1)
        z = features(inputs.symbol(AIR[name]), wind, inputs.symbol(law.air_thrusts))
        return ca.densify(scale * model(z, inputs.symbol("theta", (model.size1_in(1), 1)))[0])

    return air
