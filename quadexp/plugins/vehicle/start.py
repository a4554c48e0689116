"""What a controller remembers as a flight begins, as a function of the state and of the first thrusts.

Each layer's `start` is called once with symbols in place of numbers; what it gives is compared with the memory that
`reset` leaves in Python, for states drawn at random. Only the MPC's last solution is not in it: vehicle.c makes that of
the reference.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np

from quadexp.compile.memory import Memory
from quadexp.compile.symbolic import ca
from quadexp.control.base import Window
from quadexp.control.control_step import in_calls
from quadexp.control.mpc.dead_time import DeadTimePredictor
from quadexp.control.wrapped import innermost, layers
from quadexp.errors import QuadexpError, UsageError
from quadexp.physics.state import ATTITUDE, N_STATE

TRIALS = 3  # states with which the function is compared with Python
EQUAL = 1e-12  # relative difference of what both leave

Starts = Iterator[tuple[Memory, dict[str, Any]]]


def start_function(controller: Any, name: str) -> tuple[ca.Function | None, list[np.ndarray]]:
    """(state (13,), thrust (n,)) -> what is remembered, and the arrays that it belongs in; None where all is zero.

    Raises UsageError where a `start` cannot be written as equations.
    """
    n = controller.vehicle.n_rotors
    x, thrust = ca.SX.sym("x", N_STATE), ca.SX.sym("thrust", n)
    expressions = list[Any]()
    places = list[np.ndarray]()
    for memory, values in _starts(controller, _elements(x), _elements(thrust)):
        for part, value in values.items():
            expressions.append(_column(value))
            places.append(memory.of_now[part])
    if not places:
        return None, []
    names = [f"start_{i}" for i in range(len(places))]
    return ca.Function(name, [x, thrust], ca.cse(expressions), ["x", "thrust"], names), places


def check_start(controller: Any, function: ca.Function | None, places: list[np.ndarray], window: Window) -> None:
    """Compare the function with `reset`, for random states and first thrusts. window: of a reference.

    Raises QuadexpError where they differ.
    """
    vehicle, rng = controller.vehicle, np.random.default_rng(0)
    planned = getattr(getattr(innermost(controller), "mpc", None), "memory", None)
    memories = [memory for memory in controller.running.control_step.memory if memory is not planned]
    for _ in range(TRIALS):
        x = window.state[0] + 0.1 * rng.normal(size=N_STATE)
        x[ATTITUDE] /= np.linalg.norm(x[ATTITUDE])
        thrusts = rng.uniform(vehicle.thrust_min, vehicle.thrust_max, window.input.shape)
        controller.reset(x, window._replace(input=thrusts))
        first = thrusts[0] if len(thrusts) else np.full(vehicle.n_rotors, vehicle.hover_thrust)
        expected = [memory.now.copy() for memory in memories]
        for memory in memories:
            memory.now[...] = 0.0
        if function is not None:
            for place, value in zip(places, function.call([x, first]), strict=True):
                place[...] = np.array(ca.DM(value).full()).ravel()
        for memory, before in zip(memories, expected, strict=True):
            if not np.allclose(memory.now, before, rtol=EQUAL, atol=EQUAL, equal_nan=True):
                raise QuadexpError(f"export: what {memory.owner} remembers at the start of a flight is not understood")


def _starts(controller: Any, x: np.ndarray, thrust: np.ndarray) -> Starts:
    """Memory and values by name, of every layer, of the controller inside and of its prediction."""
    core = innermost(controller)
    for part in (*layers(controller), core):
        if hasattr(part, "starts"):
            yield from _traced(part.starts, x, thrust)
        elif not in_calls(part):
            raise UsageError(f"export: {type(part).__name__} exists in Python only")
    if isinstance(getattr(core, "predictor", None), DeadTimePredictor):
        yield from core.predictor.starts(thrust)


def _traced(starts: Any, x: np.ndarray, thrust: np.ndarray) -> Any:
    """What `starts` gives for symbols: for arrays of numpy, or where it cannot have these for columns of CasADi.

    Raises UsageError where it does with both what equations cannot."""
    reason = ""
    for form in ((x, thrust), (_column(x), thrust), (_column(x), _column(thrust))):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of functions of numpy on symbols, which are tried
                return starts(*form)
        except Exception as error:  # of whatever a user's code does
            reason = " ".join(str(error).split())[:160]
    raise UsageError(f"export: start of {owner_of(starts.__self__)}: cannot be written as equations: {reason}")


def owner_of(part: Any) -> str:
    """The class that a user wrote."""
    return type(getattr(part, "part", getattr(part, "law", part))).__name__


def _elements(symbols: ca.SX) -> np.ndarray:
    """Scalar symbols as an array of numpy, (k,)."""
    array = np.empty(symbols.numel(), object)
    for i in range(symbols.numel()):
        array[i] = symbols[i]
    return array


def _column(value: Any) -> ca.SX:
    """Numbers and symbols, in their order."""
    if isinstance(value, (ca.SX, ca.DM)):
        return ca.SX(ca.densify(ca.vec(value)))
    return ca.vertcat(*[ca.SX(element) for element in np.ravel(np.asarray(value, object)).tolist()])
