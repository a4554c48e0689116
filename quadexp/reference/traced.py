"""The flatness iteration compiled: its numpy equations, run once on symbols, become functions of one instant.

`Symbols` is an array of CasADi scalars that goes through the numpy code of flat_map.py, motion.py and air_step.py as an
array of one instant, (d, 1), would: the equations are written there and nowhere else. Two functions come of it, called
at every instant from C: the twist's rates, which must be integrated along the path before the rest can be known, and
the whole step, with the model of the air inside.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from quadexp.compile.backend import BufferedFunction, realise_together
from quadexp.compile.symbolic import ca
from quadexp.models.residual import FEATURES, N_OUTPUTS
from quadexp.physics.expression import symbols
from quadexp.physics.vehicle import Vehicle
from quadexp.reference.air_step import AirModel, AirResponse, outputs_and_gradients, predicted_and_next
from quadexp.reference.flat_map import Tilt, tilt
from quadexp.reference.motion import NO_ATTITUDE, Air, Calculus, Constant, Demand

N_DEMAND = 15  # of a demand at one instant: velocity, jerk, snap, specific force, yaw (0: free)
N_AIR = N_OUTPUTS + 2 + 2


class Symbols(np.ndarray):
    """An object array of SX scalars that numpy's comparisons, choices and norms work on too."""

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **options: Any) -> Any:
        plain = [np.asarray(value) for value in inputs]
        into = options.pop("out", None)
        if ufunc in (np.minimum, np.maximum) and method == "reduce":
            return _symbols(_BY_ELEMENT[ufunc].reduce(plain[0], **options))
        if ufunc is np.logical_or and method == "reduce":  # any(): what may not be zero
            return any(not (value.is_zero() if isinstance(value, ca.SX) else value == 0) for value in plain[0].ravel())
        result = _symbols(getattr(_BY_ELEMENT.get(ufunc, ufunc), method)(*plain, **options))
        if into is None:
            return result
        into[0][...] = result
        return into[0]

    def __array_function__(self, function: Callable[..., Any], types: Any, arguments: Any, options: Any) -> Any:
        if function in _FUNCTIONS:
            return _symbols(_FUNCTIONS[function](*map(np.asarray, arguments), **options))
        return _symbols(super().__array_function__(function, types, arguments, options))


def _element(function: Callable[..., Any], inputs: int) -> np.ufunc:
    if inputs == 2:
        return np.frompyfunc(function, inputs, 1, identity=None)
    return np.frompyfunc(function, inputs, 1)


_BY_ELEMENT: dict[Any, np.ufunc] = {
    np.minimum: _element(ca.fmin, 2),
    np.maximum: _element(ca.fmax, 2),
    np.greater: _element(operator.gt, 2),
    np.less: _element(operator.lt, 2),
    np.greater_equal: _element(operator.ge, 2),
    np.equal: _element(operator.eq, 2),
    np.bitwise_and: _element(ca.logic_and, 2),
    np.arctan2: _element(ca.atan2, 2),
}
_FUNCTIONS: dict[Callable[..., Any], Callable[..., Any]] = {
    np.where: _element(ca.if_else, 3),
    np.clip: lambda value, low, high: _BY_ELEMENT[np.minimum](_BY_ELEMENT[np.maximum](value, low), high),
    np.linalg.norm: lambda value, axis: np.sqrt((value * value).sum(axis=axis)),
    np.linalg.solve: lambda system, right: _solve(system[0], right[0])[None],
}


def _solve(system: np.ndarray, right: np.ndarray) -> np.ndarray:
    solution = ca.solve(ca.blockcat(system.tolist()), ca.blockcat(right.tolist()))
    return np.array([ca.horzsplit(row) for row in ca.vertsplit(solution)], dtype=object)


def _symbols(array: Any) -> Any:
    if not isinstance(array, np.ndarray):
        return array
    return array.astype(object).view(Symbols)


def _column(vector: ca.SX, shape: Sequence[int]) -> Symbols:
    """A vector of symbols as an array of one instant, (.., 1)."""
    return _symbols(np.array(ca.vertsplit(vector), dtype=object).reshape(*shape, 1))


class _DemandOfSymbols(Demand):
    """A demand whose attitude nobody checks: whoever calls the function has done so."""

    def tilt(self, lateral: np.ndarray) -> Tilt:
        return tilt(self.specific_force, lateral)


class CompiledStep:
    """`predicted_and_next` of a demand under a compiled model of the air, for one air after another.

    calculus: of the demand's times; it integrates the twist of a free heading.
    """

    def __init__(self, demand: Demand, vehicle: Vehicle, model: AirModel, calculus: Calculus) -> None:
        residual = model.residual
        self._demand = demand
        self._calculus = calculus
        functions = compiled_steps(vehicle, residual.form(True), demand.yaw is None)
        self._first, self._step = map(BufferedFunction, functions)
        self._step.arguments["theta"].ravel()[:] = residual.theta
        self._step.arguments["share"][:] = model.share
        self._rows = np.zeros((len(demand.t), N_DEMAND + N_AIR + 1))
        yaw = demand.yaw
        if yaw is None:
            yaw = np.zeros((3, len(demand.t)))
        moving = [demand.path[1], demand.path[3], demand.path[4], demand.specific_force, yaw]
        self._rows[:, :N_DEMAND] = np.concatenate(moving).T

    def __call__(self, air: Air) -> tuple[np.ndarray, np.ndarray]:
        """The model's outputs and the next iterate, (6, k) each; UsageError where the attitude is not determined."""
        rows = self._rows
        rows[:, N_DEMAND:-1] = np.concatenate([air.outputs, air.lateral_1, air.lateral_2]).T
        upright, axial, o_z, o_dot_z = self._first.each(rows).T
        if not (upright.min() > NO_ATTITUDE and (axial > NO_ATTITUDE * self._demand.size).all()):
            self._demand.tilt(air.outputs[:2])  # says where
        if self._demand.yaw is None:
            rows[:, -1] = self._calculus.integrate(-o_z, -o_dot_z)
        both = np.ascontiguousarray(self._step.each(rows).T)
        return both[:N_OUTPUTS], both[N_OUTPUTS:]


@lru_cache(maxsize=64)
def compiled_steps(vehicle: Vehicle, residual: ca.Function, free_heading: bool) -> tuple[ca.Function, ca.Function]:
    """(row) -> q_w, f_z of the tilt frame, o_z, o_z'; and (row, theta, share) -> predicted, next (12,).

    row: N_DEMAND numbers, an Air's outputs, l', l'', and the twist at one instant, (26,).
    """
    row, chi = symbols(ca.SX, row=N_DEMAND + N_AIR, chi=1)
    rows = _column(row, (N_DEMAND + N_AIR,))
    velocity, jerk, snap, force, yaw = (rows[3 * i : 3 * i + 3] for i in range(5))
    outputs = rows[N_DEMAND:]
    air = Air(outputs[:N_OUTPUTS], outputs[N_OUTPUTS : N_OUTPUTS + 2], outputs[N_OUTPUTS + 2 :])
    nothing = 0 * velocity
    derivatives = [np.asarray(value) for value in (nothing, velocity, nothing, jerk, snap)]
    path = _symbols(np.stack(derivatives))
    demand = _DemandOfSymbols(np.zeros(1), path, force, None if free_heading else yaw)
    frame = demand.tilt(air.outputs[:2])
    o, o_dot = frame.rates(jerk, snap, air.lateral_1, air.lateral_2)
    first = _vector([frame.quaternion[0], frame.force[2], o[2], o_dot[2]])

    n = vehicle.n_rotors
    y, by_velocity, by_thrust = symbols(ca.SX, y=N_OUTPUTS, by_velocity=3 * N_OUTPUTS, by_thrust=n * N_OUTPUTS)
    knows_thrust = ca.DM(residual.sparsity_out(1), 1)[:, len(FEATURES) :].nnz()
    response = AirResponse(
        _column(y, (N_OUTPUTS,)),
        _column(by_velocity, (N_OUTPUTS, 3)),
        _column(by_thrust, (N_OUTPUTS, n)) if knows_thrust else np.zeros((N_OUTPUTS, n, 1)),
    )
    features: list[ca.SX] = []

    def model(z: np.ndarray) -> AirResponse:
        features.append(_vector(z))
        return response

    predicted, after = predicted_and_next(demand, vehicle, model, air, Constant(_column(chi, ())))
    symbolic_response = ca.vertcat(y, by_velocity, by_thrust)
    last = ca.Function("last", [row, chi, symbolic_response], [ca.cse(_vector([*predicted, *after]))])
    middle = ca.Function("middle", [row, chi], [ca.cse(features[0])])

    # The function of all: the model of the air is called between `middle` and `last`.
    arguments, theta, share = symbols(ca.MX, row=N_DEMAND + N_AIR + 1, theta=residual.size1_in(1), share=1)
    split = [arguments[:-1], arguments[-1]]
    step = last(*split, share * outputs_and_gradients(residual, middle(*split), theta))
    air_first = ca.Function("air_first", [ca.vertcat(row, chi)], [ca.cse(first)], ["row"], ["first"])
    air_step = ca.Function("air_step", [arguments, theta, share], [step], ["row", "theta", "share"], ["step"])
    first_step, second_step = realise_together([air_first, air_step], "compiled")
    return first_step, second_step


def _vector(values: Any) -> ca.SX:
    """Scalars, or arrays of one, one after the other."""
    return ca.vertcat(*(np.asarray(value, dtype=object).item() for value in values))
