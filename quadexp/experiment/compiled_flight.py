"""The flight loop of rollout.py in C, for a compiled plant of quadexp.world under a compiled MPC.

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

from quadexp.compile.backend import BufferedFunction, CFunction, strict_library
from quadexp.control.base import Controller
from quadexp.control.mpc.controller import PredictiveController
from quadexp.control.mpc.mpc import MAX_TURN, ModelPredictiveController
from quadexp.control.mpc.subproblem import TOLERANCE
from quadexp.physics.state import N_STATE
from quadexp.world.base import Plant
from quadexp.world.integrator import SimulatedPlant
from quadexp.world.streams import Streams
from quadexp.world.world import World

SOURCE = Path(__file__).with_name("flight.c")
INSIDE = 1 - 1e-9  # of a distance: what is nearer is nearer in any order of summation
LARGEST = 1e100  # of a number in a reference

# What flight.c knows of. Anything else that a controller has must be off (false, zero or None).
KNOWN_SETTINGS = {
    "horizon", "nodes", "first_node", "rate", "position_weight", "attitude_weight", "attitude_error", "velocity_weight",
    "rate_weight", "input_weight", "terminal_weight", "feedforward", "initial_iterations", "distance_limit",
    "input_hold",
}  # fmt: skip
LEAN = {"X_new", "U_new", "checks"}  # results of a step that meets no bound
KNOWN_ATTRIBUTES = {"mpc", "vehicle", "settings", "backend", "control_period", "node_times", "name", "source"}
KNOWN_ARGUMENTS = {
    "X", "U", "x0", "X_ref", "U_ref", "theta", "Q", "Q_end", "R", "u_min", "u_max", "dt", "shift",
}  # fmt: skip


class _Flight(ctypes.Structure):
    """`flight` of flight.c."""

    _fields_ = [
        (name, kind)
        for kind, names in (
            (CFunction, "step lean bounded plant"),
            (ctypes.c_longlong, "samples nodes inputs inner_size logged_size noise_size noise_argument"),
            (ctypes.c_longlong, "draws_argument draws_at doubt_size"),
            (ctypes.c_double, "near reach tolerance max_turn period"),
            (ctypes.c_void_p, "states thrusts along where"),
            (ctypes.c_longlong, "reference_rows"),
            (ctypes.c_void_p, "x0 X_ref U_ref X U checks X_new U_new X_lin U_lin"),
            (ctypes.c_void_p, "guess bounded_checks bounded_X bounded_U side"),
            (
                ctypes.c_void_p,
                "plant_x plant_inner plant_u plant_time x_next inner_next specific_force doubt measured noise",
            ),
            (ctypes.c_longlong, "first_drawn end_drawn"),
            (ctypes.c_void_p, "x told reading inner"),
            (ctypes.c_double, "time next_change"),
            (ctypes.c_longlong, "met commanded"),
            (ctypes.c_void_p, "logged log_state log_input log_reading log_inner log_record log_estimate"),
        )
        for name in names.split()
    ]


@cache
def _library() -> ctypes.CDLL:
    library = strict_library("flight", SOURCE)
    library.fly.argtypes, library.fly.restype = [ctypes.c_void_p, ctypes.c_longlong], ctypes.c_longlong
    return library


def covers(plant: Plant, controller: Controller, rng: Any, logged: int = 0) -> bool:
    """Whether flight.c does all that these do in an ordinary step: compiled, of this program, with nothing unknown.

    logged: how many numbers of the plant's inner states are columns of the flight; a plant from outside may have others
    under the same names.
    """
    if type(controller) is not PredictiveController or type(controller.mpc) is not ModelPredictiveController:
        return False
    if not isinstance(plant, SimulatedPlant) or type(plant).advance is not SimulatedPlant.advance:
        return False
    ours = type(plant).__module__.startswith("quadexp.world.")
    if logged and not (ours and (isinstance(plant, World) or logged == len(plant.inner))):
        return False
    step, bounded = controller.mpc.functions
    period = plant.prepared(controller.control_period)
    unknown = [value for name, value in vars(controller).items() if name not in KNOWN_ATTRIBUTES]
    unknown += [value for name, value in vars(controller.settings).items() if name not in KNOWN_SETTINGS]
    return (
        not any(unknown)
        and set(step.arguments) - {"first_share"} == KNOWN_ARGUMENTS
        and step.arguments["x0"].shape == (N_STATE,)
        and all(isinstance(f, BufferedFunction) and f.for_c is not None for f in (step, bounded, period))
        and isinstance(rng, np.random.Generator)
    )


class CompiledFlight:
    """The rest of a flight, as far as it goes in C.

    plant, controller: that `covers` accepts. along: the reference's states at the control instants, (k, 13).
    reference: states (g, 13) and inputs (g, n) on a grid, and which of its rows make each horizon, (k, N + 1).
    log: arrays to fill, (k, ..) each, by name: state, input, reading, inner, record, estimate. logged: which of the
    plant's inner states are logged; None: all, or none. noise: what `plant.begin` returned.
    lost_distance: m.
    """

    def __init__(
        self,
        plant: Any,
        controller: Any,
        reference: tuple[np.ndarray, np.ndarray, np.ndarray],
        along: np.ndarray,
        log: dict[str, np.ndarray],
        logged: np.ndarray | None,
        noise: Streams,
        lost_distance: float,
    ) -> None:
        step, bounded = controller.mpc.functions
        period, self._plant = plant.prepared(controller.control_period), plant
        self._drawn, self._world = noise, isinstance(plant, World)
        self._x, self._reading, self._inner = np.empty(N_STATE), np.empty(3), np.empty(len(plant.inner))
        self._told = np.empty(N_STATE) if self._world else self._x
        if logged is None:
            logged = np.arange(log["inner"].shape[1])
        states, thrusts, where = (np.ascontiguousarray(array) for array in reference)
        given, left = step.arguments, step.results
        arrays = {"states": states, "thrusts": thrusts, "along": np.ascontiguousarray(along), "where": where}
        arrays |= {name: given[name] for name in ("x0", "X_ref", "U_ref", "X", "U")}
        arrays |= {name: left[name] for name in ("checks", "X_new", "U_new", "X_lin", "U_lin")}
        arrays |= {"guess": bounded.arguments["guess"], "bounded_checks": bounded.results["checks"]}
        arrays |= {"bounded_X": bounded.results["X_new"], "bounded_U": bounded.results["U_new"]}
        arrays |= {"side": bounded.results["side"]}
        arrays |= {f"plant_{name}": period.arguments[name] for name in ("x", "inner", "u")}
        arrays |= {name: period.results[name] for name in ("x_next", "inner_next", "specific_force", "doubt")}
        if self._world:
            arrays |= {"plant_time": period.arguments["time"], "measured": period.results["measured"]}
        arrays |= {"x": self._x, "told": self._told, "reading": self._reading, "inner": self._inner}
        arrays["logged"] = np.ascontiguousarray(logged, np.int64)
        arrays |= {f"log_{name}": array for name, array in log.items()}
        self._arrays = arrays  # which must live as long as their addresses
        self._lean = step.lean(LEAN)
        names = list(period.arguments)
        finite = max(np.abs(states).max(), np.abs(thrusts).max()) < LARGEST
        self._flight = _Flight(
            step=step.for_c,
            lean=self._lean,
            bounded=bounded.for_c,
            plant=period.for_c,
            samples=len(along),
            nodes=len(given["U"]),
            reference_rows=where.shape[1],
            inputs=thrusts.shape[1],
            inner_size=len(plant.inner),
            logged_size=log["inner"].shape[1],
            noise_size=noise.size,
            noise_argument=names.index("noise"),
            draws_argument=names.index("draws") if self._world else -1,
            draws_at=period.arguments["noise"].size,
            doubt_size=period.results["doubt"].size,
            near=lost_distance * INSIDE if finite else -1.0,
            reach=controller.settings.distance_limit * INSIDE,
            tolerance=TOLERANCE,
            max_turn=MAX_TURN,
            period=controller.control_period,
            **{name: array.ctypes.data for name, array in arrays.items() if array.size},
        )

    def go_on(self, k: int, x: np.ndarray, reading: np.ndarray) -> tuple[int, bool, np.ndarray, np.ndarray]:
        """Fly from control instant k on, in the state x, (13,), with the last reading, (3,).

        Returns the instant at which Python is needed, whether its control step has been made, state and reading then.
        """
        flight, plant, drawn = self._flight, self._plant, self._drawn
        self._x[:], self._reading[:], self._inner[:] = x, reading, plant.inner
        if self._world:
            self._told[:] = plant.measured
        flight.time, flight.next_change = plant.time, plant.next_change
        flight.commanded = False
        while True:
            flight.noise, flight.first_drawn, flight.end_drawn = drawn.block.ctypes.data, drawn.first, drawn.end
            k = _library().fly(ctypes.byref(flight), k)
            if not (flight.commanded and k == drawn.end):
                break
            drawn.draw()
        drawn.taken, plant.time, plant.inner = k, flight.time, self._inner.copy()
        if self._world:
            plant.measured = self._told.copy()
        return k, bool(flight.commanded), self._x.copy(), self._reading.copy()
