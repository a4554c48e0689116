"""The flight loop of rollout.py in C, for a compiled plant of quadexp.world under a controller that is operations.

flight.c makes whole control periods on the arrays that plant and controller have in Python, so that either can go on
where the other stopped. It returns where something is out of the ordinary (a failed step, a vehicle far from its
reference, a plant in doubt, a change of its parameters): Python then makes that step or period, with the same result as
if it had made all of them. The noise is drawn beforehand, a block of periods at once.
"""

from __future__ import annotations

import ctypes
import re
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.compile.backend import BufferedFunction, CFunction, strict_library
from quadexp.control.base import Controller
from quadexp.control.instant import KINDS, Instant, Operation, in_operations
from quadexp.control.mpc.active_set import Status
from quadexp.control.mpc.mpc import MAX_TURN, ModelPredictiveController, StepRecord
from quadexp.control.mpc.subproblem import TOLERANCE
from quadexp.physics.state import N_STATE
from quadexp.world.base import Plant
from quadexp.world.integrator import SimulatedPlant
from quadexp.world.streams import Streams
from quadexp.world.world import World

SOURCE = Path(__file__).with_name("flight.c")
INSIDE = 1 - 1e-9  # of a distance: what is nearer is nearer in any order of summation
LARGEST = 1e100  # of a number in a reference
PLAIN = {"integer": ctypes.c_longlong, "double": ctypes.c_double, "function": CFunction}  # types of fields
LEAN = {"X_new", "U_new", "checks"}  # results of a step that meets no bound


def _structure(name: str) -> type[ctypes.Structure]:
    """A structure of flight.c, field by field as its source declares it."""
    declared = re.sub(r"/\*.*?\*/", "", SOURCE.read_text(encoding="utf-8"), flags=re.DOTALL)
    body = next(body for body, named in re.findall(r"typedef struct {([^}]*)} (\w+);", declared) if named == name)
    fields: list[tuple[str, Any]] = []
    for kind, names in re.findall(r"^ *(?:const )?(\w+) ([^;(]*);", body, flags=re.MULTILINE):
        for field in re.split(r",\s*", names):
            fields.append((re.split(r"[* ]", field)[-1], ctypes.c_void_p if "*" in field else PLAIN[kind]))
    return type(name, (ctypes.Structure,), {"_fields_": fields})


OPERATION, FLIGHT = _structure("operation"), _structure("flight")


@cache
def _library() -> ctypes.CDLL:
    library = strict_library("flight", SOURCE)
    library.fly.argtypes, library.fly.restype = [ctypes.c_void_p, ctypes.c_longlong], ctypes.c_longlong
    return library


def covers(plant: Plant, controller: Controller, rng: Any, logged: int = 0) -> bool:
    """Whether plant and noise are of this program, compiled, so that C can fly a controller of operations.

    logged: how many numbers of the plant's inner states are columns of the flight; a plant from outside may have others
    under the same names.
    """
    if not isinstance(plant, SimulatedPlant) or type(plant).advance is not SimulatedPlant.advance:
        return False
    ours = type(plant).__module__.startswith("quadexp.world.")
    if logged and not (ours and (isinstance(plant, World) or logged == len(plant.inner))):
        return False
    if not ours and hasattr(plant, "rotor_speed"):
        return False
    return (
        plant.prepared(controller.control_period).for_c is not None
        and isinstance(rng, np.random.Generator)
        and controller.backend == "compiled"
        and controller.reference_period == 0
        and in_operations(controller)
    )


class CompiledFlight:
    """The rest of a flight, as far as it goes in C.

    plant, controller: that `covers` accepts. along: the reference's states at the control instants, (k, 13).
    reference: states (g, 13) and inputs (g, n) on a grid, and which of its rows make each horizon, (k, N + 1).
    path: of the reference, see SampledReference.path. log: arrays to fill, (k, ..) each, by name: state, input,
    reading, inner, record, estimate, extra. logged: which of the plant's inner states are logged; None: all, or none.
    noise: what `plant.begin` returned. lost_distance: m.
    """

    def __init__(
        self,
        plant: Any,
        controller: Any,
        reference: tuple[np.ndarray, np.ndarray, np.ndarray],
        along: np.ndarray,
        path: tuple[np.ndarray, np.ndarray],
        log: dict[str, np.ndarray],
        logged: np.ndarray | None,
        noise: Streams,
        lost_distance: float,
    ) -> None:
        period, self._plant = plant.prepared(controller.control_period), plant
        self._drawn, self._world = noise, isinstance(plant, World)
        self._x, self._inner = np.empty(N_STATE), np.empty(len(plant.inner))
        rotors = np.array(plant.rotor_places, np.int64) if hasattr(plant, "rotor_speed") else None
        if logged is None:
            logged = np.arange(log["inner"].shape[1])
        self._running, self._told = controller.running, controller.running.told
        self.instant = instant = self._running.instant
        self.flies = _in_c(instant, log["extra"].shape[1])
        if not self.flies:
            return
        states, thrusts, where = (np.ascontiguousarray(array) for array in reference)
        arrays = {"states": states, "thrusts": thrusts, "along": np.ascontiguousarray(along), "where": where}
        planned: dict[str, Any] = {}
        if instant.plan is not None:
            step, bounded = instant.plan.mpc.functions
            self._lean = step.lean(LEAN)
            planned = {
                "step": step.for_c,
                "lean": self._lean,
                "bounded": bounded.for_c,
                "nodes": len(step.arguments["U"]),
                "plan_rows": len(step.arguments["X_ref"]),
            }
            arrays |= {name: step.arguments[name] for name in ("x0", "X_ref", "X", "U")}
            arrays |= {name: step.results[name] for name in ("checks", "X_new", "U_new", "X_lin", "U_lin")}
            arrays |= {"guess": bounded.arguments["guess"], "bounded_checks": bounded.results["checks"]}
            arrays |= {"bounded_X": bounded.results["X_new"], "bounded_U": bounded.results["U_new"]}
            arrays |= {"side": bounded.results["side"]}
        arrays |= {f"plant_{name}": period.arguments[name] for name in ("x", "inner", "u")}
        arrays |= {name: period.results[name] for name in ("x_next", "inner_next", "specific_force", "doubt")}
        if self._world:
            arrays |= {"plant_time": period.arguments["time"], "measured": period.results["measured"]}
        if rotors is not None:
            arrays |= {"rotors": rotors}
        arrays |= {"paths": np.ascontiguousarray(path[0]), "yaws": np.ascontiguousarray(path[1])}
        told, self._turning = self._told, rotors is not None
        arrays |= {"x": self._x, "told": told.state, "reading": told.force, "inner": self._inner}
        arrays |= {"speed": told.speed, "path": told.path, "yaw": told.yaw}
        arrays |= {"command": instant.command} | ({} if instant.held is None else {"held": instant.held})
        arrays["logged"] = np.ascontiguousarray(logged, np.int64)
        arrays["extra"] = np.array([array.ctypes.data for array in instant.logged], np.uintp)
        arrays["extra_sizes"] = np.array([array.size for array in instant.logged], np.int64)
        arrays |= {f"log_{name}": array for name, array in log.items()}
        self._arrays = arrays  # which must live as long as their addresses
        self._kept = [np.empty_like(o.to) if o.kind == "move" else None for o in instant.operations]
        made = [_operation(o, kept) for o, kept in zip(instant.operations, self._kept, strict=True)]
        self._operations = (OPERATION * len(made))(*made)
        names = list(period.arguments)
        finite = max(np.abs(states).max(), np.abs(thrusts).max()) < LARGEST
        self._flight = FLIGHT(
            **planned,
            plant=period.for_c,
            samples=len(along),
            operations=ctypes.addressof(self._operations),
            operations_size=len(made),
            reference_rows=where.shape[1],
            inputs=thrusts.shape[1],
            inner_size=len(plant.inner),
            logged_size=log["inner"].shape[1],
            extra_size=log["extra"].shape[1],
            extra_arrays=len(instant.logged),
            noise_size=noise.size,
            noise_argument=names.index("noise"),
            draws_argument=names.index("draws") if self._world else -1,
            draws_at=period.arguments["noise"].size,
            doubt_size=period.results["doubt"].size,
            near=lost_distance * INSIDE if finite else -1.0,
            tolerance=TOLERANCE,
            max_turn=MAX_TURN,
            period=controller.control_period,
            **{name: array.ctypes.data for name, array in arrays.items() if array.size},
        )

    def go_on(self, k: int, x: np.ndarray, reading: np.ndarray) -> tuple[int, bool, np.ndarray, np.ndarray]:
        """Fly from control instant k on, in the state x, (13,), with the last reading, (3,).

        Returns the instant at which Python is needed, whether its control step has been made, state and reading then.
        """
        plan = self.instant.plan
        if not self.flies or (plan is not None and plan.mpc.cold):
            return k, False, x, reading
        flight, plant, drawn, told = self._flight, self._plant, self._drawn, self._told
        self._x[:], told.force[:], self._inner[:] = x, reading, plant.inner
        told.state[:] = plant.measured if self._world else x
        told.read[0], told.turning[0] = 1.0, self._turning
        if self._turning:
            told.speed[:] = plant.rotor_speed
        flight.time, flight.next_change = plant.time, plant.next_change
        flight.commanded = False
        records = self._arrays["log_record"]
        _, flight.status, flight.sweeps, flight.active, flight.kkt, flight.converged = records[k - 1]
        while True:
            flight.noise, flight.first_drawn, flight.end_drawn = drawn.block.ctypes.data, drawn.first, drawn.end
            k = _library().fly(ctypes.byref(flight), k)
            if not (flight.commanded and k == drawn.end):
                break
            drawn.draw()
        drawn.taken, plant.time, plant.inner = k, flight.time, self._inner.copy()
        if self._world:
            plant.measured = told.state.copy()
        at = k + flight.commanded
        took, status, sweeps, active, kkt, converged = records[at - 1].tolist()
        self._running.k = at
        if plan is not None:
            plan.record = StepRecord(took, Status(int(status)), int(sweeps), int(active), kkt, bool(converged))
        return k, bool(flight.commanded), self._x.copy(), told.force.copy()


def _in_c(instant: Instant, columns: int) -> bool:
    """Whether an instant leaves every column, and C can do it: nothing is always Python's, all that it calls is
    compiled, and its arrays lie as C reads them."""
    functions: list[Any] = [o.function for o in instant.operations if o.function is not None]
    if instant.plan is not None:
        mpc = instant.plan.mpc
        if type(mpc) is not ModelPredictiveController or mpc.reference[0].shape[1] != N_STATE:
            return False
        functions += mpc.functions
    arrays = [array for o in instant.operations for array in (o.to, o.source, o.other, o.when) if array is not None]
    return (
        sum(array.size for array in instant.logged) == columns
        and not any(o.kind == "python" and o.when is None for o in instant.operations)
        and all(isinstance(f, BufferedFunction) and f.for_c is not None for f in functions)
        and all(array.flags.c_contiguous and array.dtype == float for array in arrays)
    )


def _operation(o: Operation, kept: np.ndarray | None) -> ctypes.Structure:
    """As C has it."""
    arrays = {"to": o.to, "source": o.source, "other": o.other, "when": o.when, "kept": kept}
    counted = o.to if o.to is not None else o.source
    places = {name: array.ctypes.data for name, array in arrays.items() if array is not None and array.size}
    if o.function is not None:
        places["function"] = ctypes.addressof(o.function.for_c)  # type: ignore[arg-type]  # `_in_c` saw to it
    count = 0 if counted is None else counted.size
    return OPERATION(kind=KINDS.index(o.kind), every=o.every, count=count, factor=o.factor, **places)
