"""A control law in closed form: one class, with its settings, what it remembers, and one method `equations`.

    class Mine(Law):
        \"\"\"Tracking with an integral: F = m (a_r - g - k_p e_p - k_v e_v - k_i i), i' = e_p.\"\"\"
        k_i: float = key(1.0, "gain of the integral", "[0, 100]", "1/s^3")
        memory = {"integral": 3}  # m s
        logged = ("integral",)

        def equations(self, vehicle, inputs, memory):
            error = inputs.state[POSITION] - inputs.path[:, 0]
            ...
            return {"command": thrusts, "integral": memory.integral + inputs.period * error}

The equations are written once, in CasADi, and called when the controller is built. From them follow its step in C, the
delays that its loop tolerates, its columns, and every compensation: observers, where they read a belief, L1, INDI,
predictions of delays.

World ENU, body FLU, SI.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

from quadexp.compile.backend import resolve
from quadexp.compile.memory import NEXT
from quadexp.compile.symbolic import ca
from quadexp.control.allocation import saturated_count
from quadexp.control.cached_function import cached_function
from quadexp.control.inputs import AIR, Circumstances, Inputs, remembered
from quadexp.control.laws.explicit import BelievingController, ExplicitController, Rate
from quadexp.control.part import ControllerPart
from quadexp.errors import UsageError
from quadexp.messages import suggestion
from quadexp.models.build_context import BuildContext
from quadexp.models.residual import Residual
from quadexp.names import named
from quadexp.parts.settings import Backend, keyed
from quadexp.parts.user_modules import fault
from quadexp.physics.expression import NAN, holds_nan, named_function
from quadexp.physics.vehicle import Vehicle

TAKEN = {"held": "the number of rotors at a limit", "sent": "the command that was sent last"}  # names of no memory


@keyed
class Law(ControllerPart):
    """A law in closed form, see the module.

    memory: what it remembers from step to step, names and lengths; zero at the start of a flight unless `start` says
    otherwise. logged: names of results that become columns; a vector of three has _x, _y, _z. nodes: times from now at
    which it is given the reference, in control periods; the last interval's thrusts are `thrusts_middle`. symbols: of
    the equations, ca.SX, or ca.MX where these call functions. air_thrusts: which thrusts its model of the air is given.
    """

    memory: ClassVar[Mapping[str, int]] = {}
    logged: ClassVar[tuple[str, ...]] = ()
    nodes: ClassVar[tuple[float, ...]] = (0.0, 0.5, 1.0)
    symbols: ClassVar[Any] = ca.SX
    air_thrusts: ClassVar[str] = "thrusts"

    rate: Rate = 100.0
    backend: Backend = "auto"

    def equations(self, vehicle: Vehicle, inputs: Inputs, memory: Any) -> dict[str, Any]:
        """`command`, thrusts (n,) (N), within the limits; of everything in `memory` the next value; what is logged; and
        `held`, how many rotors are at a limit, where the command does not show it."""
        raise NotImplementedError

    def remembers(self, inputs: Inputs) -> Mapping[str, int]:
        """`memory`, where lengths are of this vehicle (inputs.vehicle)."""
        return self.memory

    def start(self, vehicle: Vehicle, x: np.ndarray) -> dict[str, np.ndarray]:
        """What it remembers at the start of a flight in the state x, (13,), where that is not zero."""
        return {}

    def build(self, context: BuildContext) -> Any:
        """See ControllerPart."""
        return self.controller(context.vehicle, context.residual(*self.kinds))

    def controller(
        self, vehicle: Vehicle, residual: Residual | None = None, places: Mapping[str, np.ndarray] | None = None
    ) -> ExplicitController:
        """The Controller (see control.base) of a vehicle. residual: its model of the air, None for none. places: values
        of inputs that nobody else has.

        Raises UsageError for equations that do not give what they must."""
        known = None if residual is None or residual.is_zero else residual
        structure = replace(self, name="law", models=(), allow_unstable=False)  # of which the function depends
        about = Circumstances(1 / self.rate, compiled=resolve(self.backend) == "compiled")
        function = cached_function(self.backend, law_function, structure, vehicle, about, known)
        kind = BelievingController if "belief" in function.name_in() else ExplicitController
        return kind(vehicle, self, about, function, known, places)


def law_function(law: Law, vehicle: Vehicle, about: Circumstances, residual: Residual | None) -> ca.Function:
    """What the law reads of Inputs and of its memory -> command, held, of the memory the next values, and log_NAME of
    what is logged. residual: its model of the air, None for none."""
    symbols_read = Inputs(vehicle, about, ca.MX, residual)
    symbols_read.air_thrusts = law.air_thrusts
    if law.symbols is ca.MX:
        return named_function("law", symbols_read.read, _outputs(law, vehicle, symbols_read))
    inputs = Inputs(vehicle, about, law.symbols, residual, later=True)
    outputs = _outputs(law, vehicle, inputs)
    for name, symbol in inputs.read.items():
        if name not in AIR:  # which come behind: they read the belief if the law does
            symbols_read.symbol(name, symbol.shape)
    inner = ca.Function("law", [*inputs.read.values()], ca.cse([*outputs.values()]))
    read = [symbols_read.symbol(name) if name not in AIR else getattr(symbols_read, name) for name in inputs.read]
    return named_function("law", symbols_read.read, named(outputs, inner.call(read)))


def _outputs(law: Law, vehicle: Vehicle, inputs: Inputs) -> dict[str, Any]:
    """The outputs of `law_function`, which reads inputs."""
    kept = sizes_given(law, law.remembers(inputs))
    if not isinstance(law.logged, tuple) or not all(isinstance(name, str) for name in law.logged):
        raise UsageError(f'{type(law).__name__}.logged: must be a tuple of names, such as ("error",)')
    needed = {*law.logged, "command", *kept}
    sizes = {**dict.fromkeys(law.logged), "command": vehicle.n_rotors, "held": 1, **kept}
    results = given_by(law, inputs, lambda: law.equations(vehicle, inputs, remembered(inputs, kept)), sizes, needed)
    refuse_unread(law, results, ("command", "held", *kept, *law.logged))
    outputs = {"command": results["command"], "held": results.get("held", saturated_count(vehicle, results["command"]))}
    outputs |= {NEXT + name: results[name] for name in kept} | inputs.left
    return outputs | {f"log_{name}": results[name] for name in law.logged}


def given_by(
    part: Any,
    inputs: Inputs,
    equations: Callable[[], dict[str, Any]],
    sizes: Mapping[str, int | None],
    needed: Collection[str] | None = None,
) -> dict[str, Any]:
    """What equations of a part give, dense. sizes: of what they may give; None: any. needed: what they must; None: all.

    Raises UsageError where they fail or give something else."""
    what = f"equations of {type(part).__name__}"
    try:
        stated = equations()
        if not isinstance(stated, Mapping):
            raise UsageError(f"{what}: must return a dict of names and expressions, not {type(stated).__name__}")
        results = {name: ca.densify(inputs.kind(value)) for name, value in stated.items()}
        results = {name: value.T if value.size1() == 1 else value for name, value in results.items()}
    except UsageError:
        raise
    except NotImplementedError:
        raise UsageError(f"{what}: there are none") from None
    except Exception as error:
        raise UsageError(f"{what}: {fault(error)}") from error
    if inputs.kind is ca.SX and not part.shipped and holds_nan(ca.vertcat(*results.values())):
        raise UsageError(f"{what}: {NAN}")
    for name, size in sizes.items():
        lacks = name not in results and (needed is None or name in needed)
        differs = name in results and size not in (None, results[name].numel())
        if lacks or differs:
            numbers = "" if size is None else f", {size} numbers"
            has = f"; it has {results[name].numel()}" if differs else ""
            raise UsageError(f"{what}: must give {name!r}{numbers}{has}")
    return results


def sizes_given(part: Any, sizes: Any) -> Mapping[str, int]:
    """What a part remembers, checked: names, and how many numbers there are of each."""
    fine = isinstance(sizes, Mapping) and all(
        isinstance(name, str) and name.isidentifier() and type(size) is int and size > 0 for name, size in sizes.items()
    )
    if not fine:
        raise UsageError(
            f'memory of {type(part).__name__}: {sizes!r} must be a dict of names and numbers, {{"integral": 3}}'
        )
    taken = {} if part.shipped else TAKEN
    for name in taken.keys() & sizes.keys():
        raise UsageError(f"memory of {type(part).__name__}: {name!r} is {taken[name]}: choose another name")
    known: Mapping[str, int] = sizes
    return known


def refuse_unread(part: Any, results: Iterable[str], known: Iterable[str]) -> None:
    """UsageError where equations give what nobody reads."""
    allowed = [*known]
    for name in results:
        if name not in allowed:
            near = suggestion(name, allowed)
            raise UsageError(f"equations of {type(part).__name__}: they return {name!r}, which nothing reads{near}")
