"""The flight loop of rollout.py in C, for a compiled plant of quadexp.world under a controller that is calls.

flight.c makes whole control periods on the arrays that plant and controller have in Python, so that either can go on
where the other stopped. It returns where something is out of the ordinary (a failed step, a vehicle far from its
reference, a plant in doubt, a change of its parameters): Python then makes that step or period, with the same result as
if it had made all of them. The noise is drawn beforehand, a block of periods at once.
"""

from __future__ import annotations

import ctypes
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.compile.backend import strict_library
from quadexp.control.base import Controller
from quadexp.control.compiled_loop import SOURCE as INSTANT
from quadexp.control.compiled_loop import CompiledLoop, CompiledReference, addresses, goes_in_c, structure
from quadexp.control.control_step import in_calls
from quadexp.physics.state import N_STATE
from quadexp.world.base import Plant
from quadexp.world.integrator import RotorSpeedPlant, SimulatedPlant
from quadexp.world.streams import Streams
from quadexp.world.world import World

SOURCE = Path(__file__).with_name("flight.c")
INSIDE = 1 - 1e-9  # of a distance: what is nearer is nearer in any order of summation
LARGEST = 1e100  # of a number in a reference


FLIGHT = structure(SOURCE, "flight")


@cache
def _library() -> ctypes.CDLL:
    library = strict_library("flight", INSTANT, SOURCE)
    library.fly.argtypes = [ctypes.c_void_p, ctypes.c_longlong]
    library.fly.restype = ctypes.c_longlong
    return library


def covers(plant: Plant, controller: Controller, rng: Any) -> bool:
    """Whether C can fly them: a plant whose period is its compiled function, under a controller of calls.

    A plant that overrides `advance`, or says in Python how fast its rotors turn, is flown in Python."""
    if not isinstance(plant, SimulatedPlant) or type(plant).advance is not SimulatedPlant.advance:
        return False
    turns = getattr(type(plant), "rotor_speed", None)
    return (
        turns in (None, RotorSpeedPlant.rotor_speed, World.rotor_speed)
        and plant.prepared(controller.control_period).for_c is not None
        and isinstance(rng, np.random.Generator)
        and controller.backend == "compiled"
        and controller.reference_period == 0
        and in_calls(controller)
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
        period = plant.prepared(controller.control_period)
        self._plant = plant
        self._drawn = noise
        self._world = isinstance(plant, World)
        self._x = np.empty(N_STATE)
        self._inner = np.empty(len(plant.inner))
        rotors = np.array(plant.rotor_places, np.int64) if hasattr(plant, "rotor_speed") else None
        if logged is None:
            logged = np.arange(log["inner"].shape[1])
        instant = controller.running.control_step
        inputs = controller.running.inputs
        self.flies = goes_in_c(controller) and sum(array.size for array in instant.logged) == log["extra"].shape[1]
        if not self.flies:
            return
        self._loop = CompiledLoop(controller.running, controller.control_period)
        self._reference = CompiledReference(reference, path)
        self._told = inputs
        self._turning = rotors is not None
        arrays = {f"plant_{name}": period.arguments[name] for name in ("x", "inner", "u")}
        arrays |= {name: period.results[name] for name in ("x_next", "inner_next", "specific_force", "doubt")}
        if self._world:
            arrays |= {"plant_time": period.arguments["time"], "measured": period.results["measured"]}
        arrays |= {"along": np.ascontiguousarray(along), "x": self._x, "inner": self._inner}
        arrays |= {"command": instant.command, "held": instant.saturated, "rotors": rotors}
        arrays["logged"] = np.ascontiguousarray(logged, np.int64)
        arrays["extra"] = np.array([array.ctypes.data for array in instant.logged], np.uintp)
        arrays["extra_sizes"] = np.array([array.size for array in instant.logged], np.int64)
        arrays |= {f"log_{name}": array for name, array in log.items()}
        self._arrays = arrays  # which must live as long as their addresses
        names = list(period.arguments)
        table = self._reference
        finite = max(np.abs(table.states).max(), np.abs(table.inputs).max()) < LARGEST
        self._flight = FLIGHT(
            **addresses(arrays),
            loop=ctypes.addressof(self._loop.structure),
            reference=ctypes.addressof(table.structure),
            plant=period.for_c,
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
        )

    def go_on(self, k: int, x: np.ndarray, reading: np.ndarray) -> tuple[int, bool, np.ndarray, np.ndarray]:
        """Fly from control instant k on, in the state x, (13,), with the last reading, (3,).

        Returns the instant at which Python is needed, whether its control step has been made, state and reading then.
        """
        plan = self._loop.running.control_step.plan if self.flies else None
        if not self.flies or (plan is not None and plan.mpc.cold):
            return k, False, x, reading
        flight = self._flight
        plant = self._plant
        drawn = self._drawn
        inputs = self._told
        mpc = self._loop.mpc
        self._x[:] = x
        inputs.specific_force[:] = reading
        self._inner[:] = plant.inner
        inputs.state[:] = plant.measured if self._world else x
        inputs.accelerometer_valid[0] = 1.0
        inputs.rotor_speed_valid[0] = self._turning
        if self._turning:
            inputs.rotor_speed[:] = plant.rotor_speed
        flight.time = plant.time
        flight.next_change = plant.next_change
        flight.commanded = False
        records = self._arrays["log_record"]
        if mpc is not None:
            _, mpc.status, mpc.sweeps, mpc.active, mpc.kkt, mpc.converged = records[k - 1]
        while True:
            flight.noise = drawn.block.ctypes.data
            flight.first_drawn = drawn.first
            flight.end_drawn = drawn.end
            k = _library().fly(ctypes.byref(flight), k)
            if not (flight.commanded and k == drawn.end):
                break
            drawn.draw()
        drawn.taken = k
        plant.time = flight.time
        plant.inner = self._inner.copy()
        if self._world:
            plant.measured = inputs.state.copy()
        at = k + flight.commanded
        self._loop.running.k = at
        self._loop.record(records.item(at - 1, 0))
        return k, bool(flight.commanded), self._x.copy(), inputs.specific_force.copy()
