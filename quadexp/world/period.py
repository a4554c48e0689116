"""One control period of a plant: even integration steps, each with noise of its own that is held over the step."""

from __future__ import annotations

import math

import casadi as ca
import numpy as np

from quadexp.compile.backend import BufferedFunction, realise, resolve
from quadexp.physics.expression import Expression
from quadexp.physics.state import ATTITUDE, RATE, VELOCITY

STEP_INPUTS = ("x", "u", "noise", "parameters", "step")
STEP_OUTPUTS = ("x_next", "specific_force")


def even_steps(duration: float, longest: float) -> int:
    """How many steps of equal length, none above `longest` (s), make a duration (s)."""
    return max(1, math.ceil(duration / longest - 1e-9))


def unit_attitude(x: Expression) -> Expression:
    """The state x (13,) with its quaternion brought back to unit length."""
    q = x[ATTITUDE]
    return ca.vertcat(x[:3], q / ca.norm_2(q), x[VELOCITY], x[RATE])


def repeated(one: ca.Function, steps: int) -> ca.Function:
    """STEP_INPUTS -> STEP_OUTPUTS over `steps` steps of the function `one` of the same; noise (d, steps)."""
    x, u, noise, parameters, step = (ca.MX.sym(name, one.sparsity_in(i)) for i, name in enumerate(STEP_INPUTS))
    noise = ca.MX.sym("noise", noise.shape[0], steps)
    state, reading = x, None
    for column in ca.horzsplit(noise):
        state, reading = one(state, u, column, parameters, step)
    arguments = [x, u, noise, parameters, step]
    return ca.Function(f"{one.name()}_period", arguments, [state, reading], STEP_INPUTS, STEP_OUTPUTS)


class NoisyPeriod:
    """A control period of any length, compiled where the backend compiles.

    one: a step, x (13,), u (n,) (N), noise (d,) standard normal, parameters (p,), step (s) -> x_next and the specific
    force then (3,) (m/s^2). parameters: (p,). step: the longest (s).
    """

    def __init__(self, one: ca.Function, parameters: np.ndarray, step: float, backend: str) -> None:
        self._one, self._parameters, self._step = one, parameters, step
        self._backend = resolve(backend)
        self._by_steps: dict[int, BufferedFunction] = {}

    def advance(
        self, x: np.ndarray, u: np.ndarray, duration: float, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """See Plant.advance."""
        steps = even_steps(duration, self._step)
        function = self._function(steps)
        arguments, results = function.arguments, function.results
        arguments["x"][:], arguments["u"][:] = x, u
        arguments["step"][0] = duration / steps
        rng.standard_normal(out=arguments["noise"])
        function()
        return results["x_next"].copy(), results["specific_force"].copy()

    def _function(self, steps: int) -> BufferedFunction:
        if steps not in self._by_steps:
            function = BufferedFunction(realise(repeated(self._one, steps), self._backend))
            function.arguments["parameters"][...] = self._parameters
            self._by_steps[steps] = function
        return self._by_steps[steps]
