"""A simulated airframe in a world: any plant of quadexp.world with effects around it (see effect.py).

It is flown as the airframe alone is, in one compiled call a control period. The state that the controller is given is
`measured`, which differs from the truth where sensors or an estimator stand between.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from quadexp.compile.backend import BufferedFunction, realise
from quadexp.compile.symbolic import ca
from quadexp.errors import ModelDomainError, UsageError
from quadexp.models.residual import Residual
from quadexp.parts.sensor_spec import SensorSpec, Stated
from quadexp.world.composition import WIND, compose, wind_function
from quadexp.world.effect import Clock, Effect, Layout, Sizes, Start, ordered
from quadexp.world.integrator import Equations, SimulatedPlant
from quadexp.world.streams import Drawn, Streams, part_stream

WIND_COLUMNS = ("wind_x", "wind_y", "wind_z")


class _Prepared(BufferedFunction):
    """A period's function with the array that holds its noise and its draws."""

    def __init__(
        self, function: ca.Function, shared: Mapping[str, np.ndarray], buffer: np.ndarray, clock: Clock
    ) -> None:
        super().__init__(function, shared)
        self.buffer = buffer
        self.clock = clock


class World(SimulatedPlant):
    """An airframe with effects, as a Plant; `begin` begins a flight.

    airframe: the plant, made with the true vehicle. effects: in any order. assumed: the same plant made with the
    vehicle that controllers assume; None: the airframe itself.
    """

    def __init__(
        self, airframe: SimulatedPlant, effects: Sequence[Effect], believed: SimulatedPlant | None = None
    ) -> None:
        self.airframe = airframe
        clock = Clock(airframe.step, 1)
        joined = ordered([effect.among(effects) for effect in effects])
        columns = {*airframe.inner_columns}.union(*(effect.columns(clock, airframe.vehicle) for effect in joined))
        self.effects = tuple(effect.beside(columns) for effect in joined)
        self._turning = "rotor_speed_0" in columns
        self._believed: Any = believed or airframe  # a Plant too
        self._made: dict[Clock, _Prepared] = {}
        self._winds: dict[Clock, ca.Function] = {}
        self._layouts: dict[Clock, Layout] = {}
        self._columns: dict[Clock, dict[str, int]] = {}
        self._own_parameters = np.empty(0)
        self._rotors = list[int]()
        self._shares: list[tuple[Effect, slice, slice]] = []  # of the inner states, and of the effects' parameters
        rough = any(effect.has("wind") or effect.has("thrusts") for effect in self.effects)
        equations = airframe.rough_equations if rough else airframe.equations
        super().__init__(airframe.vehicle, equations, step=airframe.step, backend=airframe.backend)

    # ------------------------------------------------------------------------------------------------- a flight begins
    def reset(self) -> None:
        """What is flown and what is assumed; the flight itself begins with `begin`."""
        self.airframe.reset()
        self._believed.reset()  # which another flight may have flown
        self.time = 0.0
        self.inner = np.empty(0)

    def begin(
        self, x: np.ndarray, period: float, duration: float, rng: np.random.Generator, thrust: np.ndarray | None = None
    ) -> Streams:
        """Begin a flight in the state x, (13,), with control periods of `period` (s), of a duration (s).

        Returns the noise of the flight, for `advance`. rng: of the airframe's noise; its seed gives the effects'
        streams. thrust: that the rotors give and that was commanded before, (n,) (N); None: that of hover.
        """
        self.reset()
        if thrust is None:
            thrust = np.full(self.vehicle.n_rotors, self.vehicle.hover_thrust)
        clock = self.clock(period)
        begun: dict[str, np.ndarray] = {}
        start = Start(np.array(x, float), duration, clock, self.vehicle, thrust, begun)
        layout = self._layout(clock)
        parts = list[tuple[np.random.Generator, Drawn]]()
        inner = [self.airframe.initial(thrust)]
        parameters = []
        for effect, sizes in zip(self.effects, layout.effects, strict=True):
            stream = part_stream(rng, effect.part)
            begins = [np.asarray(values, float).ravel() for values in effect.start(stream, start) or ()]
            if [len(values) for values in begins] != [sizes.inner, sizes.parameters]:
                needed = f"{sizes.inner} inner states and {sizes.parameters} parameters, as `sizes` says"
                given = [len(numbers) for numbers in begins]
                raise UsageError(f"{effect.stage}={effect.name}: start gives {given} numbers; {needed}")
            begun[effect.part] = begins[0]
            inner.append(begins[0])
            parameters.append(begins[1])
            streams = sizes.streams or [f"{effect.part} {i}" for i in range(len(sizes.drawn))]
            for name, drawn in zip(streams, sizes.drawn, strict=True):
                parts.append((part_stream(rng, name), drawn))
        self._shares = []
        first = layout.airframe.inner
        place = 0  # of the parameters
        for effect, sizes in zip(self.effects, layout.effects, strict=True):
            end = first + sizes.inner
            last = place + sizes.parameters
            self._shares.append((effect, slice(first, end), slice(place, last)))
            first = end
            place = last
        columns = self.columns(period)
        self._rotors = []
        if self.sensor_spec.rotor_speed:
            for i in range(self.vehicle.n_rotors):
                self._rotors.append(columns.get(f"est_rotor_speed_{i}", columns.get(f"rotor_speed_{i}", -1)))
        self._own_parameters = np.concatenate(parameters)
        self.measured = start.x.copy()
        for effect, effect_states in zip(self.effects, inner[1:], strict=True):
            self.measured = effect.first(effect_states, self.measured)
        self.inner = np.concatenate([*inner, self._first_wind(start, np.concatenate(inner[1:]))])
        return Streams([*self.own_noise(rng, period), *parts], period, duration)

    def require_flight(self) -> None:
        if not len(self.inner):
            raise UsageError(
                "a flight in a world begins with plant.begin(x, period, duration, rng), which returns its noise, for"
                " plant.advance; plant.measured is what the controller is given"
            )

    def _first_wind(self, start: Start, of_effects: np.ndarray) -> np.ndarray:
        """The wind when the flight begins, but for white noise. of_effects: inner states of the effects."""
        if not any(effect.has("wind") for effect in self.effects):
            return np.zeros(WIND)
        layout = self._layout(start.clock)
        step = start.clock.step
        if start.clock not in self._winds:
            self._winds[start.clock] = wind_function(self.equations, self.effects, layout, self.vehicle)
        wind = self._winds[start.clock]
        return np.array(
            wind(0.0, start.x, of_effects, np.zeros(self.vehicle.n_rotors), self.parameters(step), step)
        ).ravel()

    def clock(self, period: float) -> Clock:
        """How a control period (s) is divided."""
        return Clock(period, self.steps(period))

    def _layout(self, clock: Clock) -> Layout:
        if clock not in self._layouts:
            step = self.equations.step
            airframe = Sizes(self.equations.inner_size, step.size1_in(3))
            effects = tuple(effect.sizes(clock, self.vehicle) for effect in self.effects)
            self._layouts[clock] = Layout(airframe, effects)
        return self._layouts[clock]

    # ------------------------------------------------------------------------------------------------------- one period
    def prepared(self, duration: float) -> BufferedFunction:
        """Noise and draws are two views of one array, in the order of `Streams`."""
        clock = self.clock(duration)
        if clock not in self._made:
            function = realise(self._period(self.equations, clock), self.backend)
            rows = function.size1_in("noise")
            draws = function.size1_in("draws")
            buffer = np.zeros(clock.steps * rows + draws)
            views = dict[str, np.ndarray]()
            if rows:
                noise = buffer[: clock.steps * rows]
                views["noise"] = noise.reshape(clock.steps, rows) if clock.steps > 1 else noise
            if draws:
                views["draws"] = buffer[-draws:]
            self._made[clock] = _Prepared(function, views, buffer, clock)
        prepared = self._made[clock]
        prepared.arguments["step"][0] = clock.step
        prepared.arguments["time"][0] = self.time
        if len(self.inner):  # a flight has begun
            prepared.arguments["parameters"][:] = self.parameters(clock.step)
        return prepared

    def noise(self, function: BufferedFunction) -> np.ndarray:
        assert isinstance(function, _Prepared)
        return function.buffer

    def parameters(self, step: float) -> np.ndarray:
        """The airframe's, then each effect's."""
        self.airframe.time = self.time
        return np.concatenate([self.airframe.parameters(step), self._own_parameters])

    @property
    def next_change(self) -> float:  # type: ignore[override]  # an attribute there
        """See SimulatedPlant."""
        return self.airframe.next_change

    def settle(self, results: Mapping[str, np.ndarray]) -> None:
        self.inner = results["inner_next"].copy()
        self.measured = results["measured"].copy()
        if results["doubt"].any():
            self._check_ended()

    def _check_ended(self) -> None:
        """Raise ModelDomainError where an effect ends the flight."""
        for effect, inner, parameters in self._shares:
            reason = effect.reason(self.inner[inner], self._own_parameters[parameters])
            if reason:
                raise ModelDomainError(f"{reason} at t={self.time:.2f} s")

    def _period(self, equations: Equations, clock: Clock) -> ca.Function:
        columns = self.columns(clock.period)
        return compose(equations, self.effects, self._layout(clock), clock, self.vehicle, columns)

    def same_period(self, function: BufferedFunction, equations: Equations) -> ca.Function:
        assert isinstance(function, _Prepared)
        return self._period(equations, function.clock)

    @property
    def safe_equations(self) -> Equations | None:
        return self.airframe.safe_equations

    def check_safe(self, flown: dict[str, np.ndarray], step: float) -> None:
        self.airframe.time = self.time
        self.airframe.check_safe(flown, step)

    # ------------------------------------------------------------------------------------------ what others ask for
    def columns(self, period: float) -> dict[str, int]:
        """Names of the columns of a flight that are inner states, and which. Of one name, the airframe's holds, then
        that of the last stage."""
        clock = self.clock(period)
        if clock not in self._columns:
            self._columns[clock] = self._named_columns(clock)
        return self._columns[clock]

    def _named_columns(self, clock: Clock) -> dict[str, int]:
        layout = self._layout(clock)
        columns: dict[str, int] = {}
        airframe = {name: i for i, name in enumerate(self.airframe.inner_columns)}
        for effect, sizes, first in zip(self.effects, layout.effects, layout.ends("inner")[1:-1], strict=True):
            for name, place in effect.columns(clock, self.vehicle).items():
                said = f"{effect.stage}={effect.name}: columns: {name}"
                if not 0 <= place < sizes.inner:
                    raise UsageError(f"{said} is inner state {place}, of {sizes.inner} that it has, from 0")
                if not effect.shipped and name in (*columns, *airframe, *WIND_COLUMNS):
                    raise UsageError(f"{said} is a column of another part: choose another name for it")
                columns[name] = first + place
        columns |= airframe
        if any(effect.has("wind") for effect in self.effects):
            columns |= {name: layout.size("inner") + i for i, name in enumerate(WIND_COLUMNS)}
        return columns

    @property
    def estimates(self) -> bool:
        """Whether `measured` may differ from the truth."""
        return any(effect.tells_state for effect in self.effects)

    @property
    def sensor_spec(self) -> SensorSpec:
        """What the data sheets of its sensors say."""
        sensor_spec = SensorSpec(rotor_speed=Stated() if self._turning else None)
        for effect in self.effects:
            sensor_spec = effect.stated(sensor_spec, self.vehicle)
        return sensor_spec

    @property
    def loop_delay(self) -> float:
        """Known delays of the loop (s): of commands, and of what is measured."""
        return sum(effect.loop_delay for effect in self.effects)

    @property
    def age(self) -> float:
        """The share of loop_delay that is of what is measured (s)."""
        return sum(effect.loop_delay for effect in self.effects if effect.stage in ("sensor", "estimator"))

    @property
    def loop_lag(self) -> float:  # type: ignore[override]  # an attribute there
        """The airframe's and the effects'."""
        return self.airframe.loop_lag + sum(effect.loop_lag for effect in self.effects)

    def residual(self) -> Residual:
        """The airframe's own; it names what it does not know of the world."""
        believed: Residual = self._believed.residual()
        unknown = ", ".join(effect.part for effect in self.effects if effect.names_world)
        if not unknown:
            return believed
        return replace(believed, source=f"{believed.source}; does not know: {unknown}")

    @property
    def rotor_speed(self) -> np.ndarray:
        """(n,), rad/s, of airframes and effects that have it; AttributeError otherwise."""
        if not self._rotors:
            raise AttributeError("rotor_speed")
        return self.inner[self._rotors]

    @property
    def rotor_places(self) -> list[int]:
        """Which inner states these are."""
        return self._rotors

    @property
    def coefficients(self) -> Any:
        """Of the airframe, for controllers that are given them; AttributeError where it has none."""
        return self._believed.coefficients
