"""The integrator that all plants share: one control period over [x, inner states] in one compiled call.

A plant is its `Equations`. Rotor speeds, a battery or a filter of wind are inner states beside the rigid body's x. The
period is divided into even steps, each with noise of its own that is held over the step. Where an effect belongs:

    command -> begin -> step -> end -> truth

The imperfections of the world around it, from the command's link to the estimator, are effects (effect.py); a plant
with effects is a World (world.py), whose function of a period composition.py makes from the same equations.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from quadexp.compile.backend import BufferedFunction, realise, resolve
from quadexp.compile.symbolic import ca
from quadexp.errors import UsageError
from quadexp.physics.expression import Expression, symbols
from quadexp.physics.integrator import euler_step, rk4_step
from quadexp.physics.rotation import with_unit_attitude
from quadexp.physics.state import N_STATE
from quadexp.physics.vehicle import Vehicle
from quadexp.world.streams import Drawn, Held, Streams

METHODS = {"euler": euler_step, "rk4": rk4_step}
INPUTS = ("x", "inner", "u", "noise", "parameters", "step")
OUTPUTS = ("x_next", "inner_next", "specific_force", "doubt")
STEP_INPUTS = ("s", "held", "noise", "parameters", "step")
STEP_OUTPUTS = ("s_next", "specific_force")


@dataclass(frozen=True)
class Equations:
    """A plant as CasADi functions of s = [x, inner states, what is iterated from step to step].

    step: STEP_INPUTS, s, held, noise (d,) standard normal, parameters (p,), step (s) -> s_next after the step, and what
    is kept of every step: without an `end` the specific force then (3,) (m/s^2).
    begin: (x, inner (m,), u (n,) (N), parameters) -> s, held: what the command asks for all the period; None: [x,
    inner] and u. end: (s, held, parameters) after the last step -> x, inner, specific force, and a doubt, not zero
    where all this may be wrong; None: s is [x, inner], and the last specific force holds.
    For effects (see effect.py), whose thrusts change from step to step: command: (u, parameters) -> held, as in begin;
    None: u itself. mass: parameters -> the mass that is flown (kg); None: the vehicle's. thrust: (s, held, parameters,
    step) -> what the plant's own rotors give in the middle of the step by their speeds (n,) (N); None: the command.
    """

    step: ca.Function
    begin: ca.Function | None = None
    end: ca.Function | None = None
    command: ca.Function | None = None
    mass: ca.Function | None = None
    thrust: ca.Function | None = None

    def __post_init__(self) -> None:
        """Raises UsageError where the step does not take or give what it has to."""
        step = self.step
        outputs = STEP_OUTPUTS[:1] if self.end else STEP_OUTPUTS
        if step.n_in() != len(STEP_INPUTS) or step.n_out() < len(outputs):
            needed = f"{', '.join(STEP_INPUTS)} -> {', '.join(outputs)}"
            counts = f"it has {step.n_in()} inputs and {step.n_out()} outputs"
            raise UsageError(f"{step.name()}: must be a function {needed}; {counts}")
        sizes = {STEP_OUTPUTS[0]: (step.numel_out(0), step.numel_in(0))}
        if self.end is None:
            sizes[STEP_OUTPUTS[1]] = (step.numel_out(1), 3)
        for name, (size, needed) in sizes.items():
            if size != needed:
                raise UsageError(f"{step.name()}: its output {name} has {size} numbers; {needed} are needed")

    @property
    def inner_size(self) -> int:
        """Inner states m."""
        if self.end:
            return self.end.size1_out(1)
        return self.step.size1_in(0) - N_STATE


def integrate(method: str, slope: Callable[[Expression], Expression], s: Expression, step: Expression) -> Expression:
    """s' = slope(s) over a step (s), its quaternion brought back to unit length; UsageError for an unknown method."""
    if method not in METHODS:
        raise UsageError(f"plant.method={method}: must be one of {', '.join(METHODS)}")
    return with_unit_attitude(METHODS[method](slope, s, step))


def period(equations: Equations, steps: int) -> ca.Function:
    """INPUTS -> OUTPUTS over `steps` steps of length `step` (s), noise (d, steps); then what is kept of the steps."""
    function = equations.step
    begin = equations.begin
    end = equations.end
    x, inner, step, u, noise, parameters = symbols(
        ca.MX,
        x=N_STATE,
        inner=equations.inner_size,
        step=1,
        u=begin.size1_in(2) if begin else function.size1_in(1),
        noise=(function.size1_in(2), steps),
        parameters=function.size1_in(3),
    )
    s, held = begin(x, inner, u, parameters) if begin else (ca.vertcat(x, inner), u)
    again = [ca.repmat(value, 1, steps) for value in (held, parameters, step)]
    states, *kept = function.mapaccum(steps).call([s, again[0], noise, *again[1:]])
    names = []
    if end:
        results = [*end(states[:, -1], held, parameters), *kept]
        names = function.name_out()[1:]
    else:
        results = [states[:N_STATE, -1], states[N_STATE:, -1], kept[0][:, -1], ca.MX(1, 1)]
    arguments = [x, inner, u, noise, parameters, step]
    return ca.Function(f"{function.name()}_period", arguments, results, INPUTS, [*OUTPUTS, *names])


class SimulatedPlant:
    """A Plant (see base) that is its equations.

    parameters: (p,). step: largest integration step (s); a control period is divided evenly.
    `time`: s since `reset`. `inner`: inner states now, (m,). `next_change`: s, until which the parameters hold.
    `loop_lag`: s, time constant of rotors that no option `motor_lag` states.
    """

    next_change = math.inf
    loop_lag = 0.0

    def __init__(
        self, vehicle: Vehicle, equations: Equations, parameters: npt.ArrayLike = (), *, step: float, backend: str
    ) -> None:
        self.vehicle = vehicle
        self.step = step
        self.equations = equations
        self.backend = resolve(backend)
        self._parameters = np.asarray(parameters)
        self._periods: dict[int, BufferedFunction] = {}
        self._safe: dict[BufferedFunction, ca.Function] = {}
        self.reset()

    def reset(self) -> None:
        hovering = np.full(self.vehicle.n_rotors, self.vehicle.hover_thrust)
        self.time = 0.0
        self.inner = self.initial(hovering)
        needed = (self.equations.inner_size,)
        if np.shape(self.inner) != needed:
            said = f"initial gives inner states of shape {np.shape(self.inner)}"
            raise UsageError(f"{type(self).__name__}: {said}; {needed} is needed")

    def begin(
        self, x: np.ndarray, period: float, duration: float, rng: np.random.Generator, thrust: np.ndarray | None = None
    ) -> Streams:
        """Begin a flight in the state x, (13,), with control periods of `period` (s), of a duration (s).

        Returns the noise of the flight, for `advance`: the same function of time at any period and integration step.
        rng: of the noise. thrust: that the rotors give and that was commanded before, (n,) (N); None: that of hover.
        """
        self.reset()
        if thrust is not None:
            self.inner = self.initial(thrust)
        return Streams(self.own_noise(rng, period), period, duration)

    def own_noise(self, rng: np.random.Generator, period: float) -> list[tuple[np.random.Generator, Drawn]]:
        """What the equations draw in control periods (s), and its stream."""
        numbers = self.equations.step.size1_in(2)
        bounds = np.linspace(0, period, self.steps(period) + 1)
        if not numbers:
            return []
        return [(rng, Held(numbers, tuple(bounds.tolist())))]

    def initial(self, thrust: np.ndarray) -> np.ndarray:
        """Inner states at the beginning of a flight whose rotors give these thrusts (n,) (N); (m,)."""
        return np.zeros(self.equations.inner_size)

    @property
    def inner_columns(self) -> tuple[str, ...]:
        """Names of the first inner states, for the columns of a flight in a world."""
        return ()

    def parameters(self, step: float) -> np.ndarray:
        """Parameters of the equations during the next period, whose steps are that long (s); (p,)."""
        return self._parameters

    def advance(
        self, x: np.ndarray, u: np.ndarray, duration: float, rng: np.random.Generator | Streams | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """rng: what `begin` returned; or a Generator, whose noise is new in every period and step.

        It may be None where the equations have no noise.
        """
        self.require_flight()
        function = self.prepared(duration)
        arguments = function.arguments
        results = function.results
        arguments["x"][:] = x
        arguments["inner"][:] = self.inner
        arguments["u"][:] = u
        if rng is not None:
            rng.standard_normal(out=self.noise(function))
        function()
        if results["doubt"].any() or not math.isfinite(results["x_next"] @ results["x_next"]):
            results = self.in_doubt(function)
        self.settle(results)
        self.time += duration
        return results["x_next"].copy(), results["specific_force"].copy()

    def require_flight(self) -> None:
        """Raise UsageError where a flight has to begin first."""

    def prepared(self, duration: float) -> BufferedFunction:
        """The function of a period of this duration (s), with the parameters of the next one."""
        steps = self.steps(duration)
        if steps not in self._periods:
            self._periods[steps] = BufferedFunction(realise(period(self.equations, steps), self.backend))
        arguments = self._periods[steps].arguments
        arguments["step"][0] = duration / steps
        arguments["parameters"][:] = self.parameters(duration / steps)
        return self._periods[steps]

    def steps(self, duration: float) -> int:
        """Integration steps of a control period (s)."""
        return max(1, math.ceil(duration / self.step - 1e-9))

    def noise(self, function: BufferedFunction) -> np.ndarray:
        """The array of a period's standard normal numbers."""
        return function.arguments["noise"]

    def settle(self, results: Mapping[str, np.ndarray]) -> None:
        """Take over what a period leaves behind besides the state."""
        self.inner = results["inner_next"].copy()

    def in_doubt(self, function: BufferedFunction) -> dict[str, np.ndarray]:
        """What to take for the results of the period flown last where they are in doubt or not finite: as they are,
        or those of the safe equations."""
        if self.safe_equations is None:
            return function.results
        arguments = {name: value.T for name, value in function.arguments.items()}  # a matrix is stored transposed
        if function not in self._safe:
            self._safe[function] = self.same_period(function, self.safe_equations)
        results = self._safe[function](**arguments)
        results = {name: np.array(value.full()) for name, value in results.items()}
        self.check_safe(results, float(function.arguments["step"][0]))
        return {name: results[name].ravel() for name in function.results}

    @property
    def rough_equations(self) -> Equations:
        """The equations for wind and thrusts that jump from one integration step to the next."""
        return self.equations

    @property
    def safe_equations(self) -> Equations | None:
        """Equations that are never in doubt, with the same inputs; None where there are none."""
        return None

    def check_safe(self, flown: dict[str, np.ndarray], step: float) -> None:
        """Raise ModelDomainError where the safe equations, whose results these are, have no answer. step: s."""

    def same_period(self, function: BufferedFunction, equations: Equations) -> ca.Function:
        """The function of a control period as another one, with these equations."""
        return period(equations, function.function.size2_in("noise"))


class RotorSpeedPlant(SimulatedPlant):
    """A plant whose first inner states are its rotors' speeds, (n,) (rad/s)."""

    @property
    def inner_columns(self) -> tuple[str, ...]:
        return tuple(f"rotor_speed_{rotor}" for rotor in range(self.vehicle.n_rotors))

    @property
    def rotor_speed(self) -> np.ndarray:
        """(n,), rad/s."""
        return self.inner[: self.vehicle.n_rotors]

    @property
    def rotor_places(self) -> list[int]:
        """Which inner states these are."""
        return [*range(self.vehicle.n_rotors)]
