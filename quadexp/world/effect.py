"""An effect: one imperfection of the world between a command and what the controller is given.

    command -> link -> actuator -> battery -> health -> ground -> airframe in wind -> sensor -> estimator -> controller

An effect is a class with one equation and its settings. It overrides the hooks that it needs; composition.py joins all
effects and the airframe's equations into the one function of a control period. Hooks are CasADi expressions of what a
`Moment` or `Readings` holds, so they hold for every airframe, and the flight in C needs to know none of them.

What has a memory is an inner state; what is drawn once a flight is a parameter; noise comes as standard normal numbers
from the effect's own random stream, by time (see streams.py): switching an effect on, or another control rate, changes
no numbers. What a hook is for is said here; that of an effect says what is its own.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.errors import UsageError
from quadexp.parts.former import names_of
from quadexp.parts.part import Part
from quadexp.parts.schema import WORLD
from quadexp.parts.sensor_spec import SensorSpec
from quadexp.parts.settings import keyed
from quadexp.physics.expression import Expression
from quadexp.physics.vehicle import Vehicle
from quadexp.world.streams import Drawn

# Groups of effects in the order in which a command meets them; `truth` changes the vehicle, `wind` and `external` act
# on the airframe, the last two on what is measured. A payload is a part of the vehicle, or an effect of another stage.
STAGES = tuple(group for group in WORLD if group != "payload")


@dataclass(frozen=True)
class Clock:
    """How a control period is divided: `period` (s) into `steps` integration steps."""

    period: float
    steps: int

    @property
    def step(self) -> float:
        """s."""
        return self.period / self.steps


class Sizes(NamedTuple):
    """How many inner states and parameters an effect has, and what it draws in a control period.

    streams: the name of each random stream; those of no name are called by the part and a number.
    """

    inner: int = 0
    parameters: int = 0
    drawn: tuple[Drawn, ...] = ()
    streams: tuple[str, ...] = ()

    @property
    def draws(self) -> int:
        """How many numbers are drawn in a control period."""
        return sum(drawn.size for drawn in self.drawn)


@dataclass(frozen=True)
class Layout:
    """Where the numbers of airframe and effects stand: the airframe's first, then each effect's, then the wind."""

    airframe: Sizes
    effects: tuple[Sizes, ...]

    def ends(self, kind: str) -> list[int]:
        """Where each begins, and the end of all: offsets for vertsplit."""
        offsets = [0]
        for sizes in (self.airframe, *self.effects):
            offsets.append(offsets[-1] + getattr(sizes, kind))
        return offsets

    def size(self, kind: str) -> int:
        """How many numbers there are; of the inner states without the wind."""
        return self.ends(kind)[-1]


class Start(NamedTuple):
    """What is known when a flight begins. x: state (13,). duration: s, of the reference. vehicle: the true one.

    thrust: what the rotors give and every command before was, (n,) (N). begun: inner states of the effects that begin
    before, by part.
    """

    x: np.ndarray
    duration: float
    clock: Clock
    vehicle: Vehicle
    thrust: np.ndarray
    begun: Mapping[str, np.ndarray] = {}


class Moment(NamedTuple):
    """The beginning of an integration step, as expressions.

    t: s since the start. x: true state (13,), world. inner, parameters: the effect's own. step: s.
    draws: the effect's own, in `begin` only. command: thrusts (n,) (N) that enter the effect; in `begin` those just
    commanded. wind: sum of all winds (3,), world (m/s), zero in `begin` and `wind`. thrust: (n,) (N) that the airframe
    gets, in `advance`; in `wrench` what its rotors give, which may lag. x_next: true state after a step, in `advance`.
    """

    t: Any
    x: Any
    inner: Any
    parameters: Any
    step: Any
    draws: Any
    command: Any
    wind: Any
    thrust: Any
    x_next: Any


class Readings(NamedTuple):
    """The end of a control period, as MX expressions.

    t: s since the start. states: true states (13, steps + 1) at the beginning and after every integration step.
    inner, parameters, draws: the effect's own. step: s. clock: the same in numbers. vehicle: the true one.
    columns: of names of columns that are inner states of airframe and effects, such as "rotor_speed_0": their values
    (k, steps + 1) at the times of the states; KeyError where there is no such column. forces: specific forces
    (3, steps), body (m/s^2), after every integration step.
    """

    t: ca.MX
    states: ca.MX
    inner: ca.MX
    parameters: ca.MX
    draws: ca.MX
    step: ca.MX
    clock: Clock
    vehicle: Vehicle
    columns: Callable[[Sequence[str]], ca.MX]
    forces: Callable[[], ca.MX]


Measured = dict[str, Any]  # readings by name: "state" (13,), "specific_force" (3,), and what sensors add for estimators


@keyed
class Effect(Part):
    """Base of all effects: does nothing. A subclass overrides the hooks that it needs.

    stage: one of STAGES. symbols: "SX" or "MX", the expressions that its hooks can be written in; MX for what SX cannot
    say, such as an interpolation table. loop_delay, loop_lag: s, what it adds to the loop, for the loop's margins.
    """

    stage: ClassVar[str]
    symbols: ClassVar[str] = "SX"
    hooks = (
        "begin", "wind", "thrusts", "wrench", "advance", "end", "measure", "ended", "true_vehicle", "stated", "first",
    )  # fmt: skip

    @property
    def part(self) -> str:
        """Name of its random stream; two effects of one world differ in it."""
        return self.stage

    @property
    def ground_height(self) -> float | None:
        """Of the ground, world (m); None where it knows of none."""
        return None

    @property
    def loop_delay(self) -> float:
        """Time (s) by which commands or states come late; the mean where it varies."""
        return 0.0

    @property
    def loop_lag(self) -> float:
        """Time constant (s) of what follows with a first-order lag."""
        return 0.0

    def sizes(self, clock: Clock, vehicle: Vehicle) -> Sizes:
        """How many numbers it has."""
        return Sizes()

    def start(self, rng: np.random.Generator, start: Start) -> tuple[Any, Any]:
        """Inner states and parameters at the beginning of a flight; what varies from flight to flight is drawn here."""
        return (), ()

    def among(self, effects: Sequence[Effect]) -> Effect:
        """The effect as it is in a world of these effects. Raises UsageError where it lacks another that it needs."""
        return self

    @property
    def tells_state(self) -> bool:
        """Whether the state that is given may differ from the true one."""
        return self.has("measure")

    def beside(self, columns: Collection[str]) -> Effect:
        """The effect as it is where airframe and other effects have inner states that are columns of these names."""
        return self

    def first(self, inner: np.ndarray, state: np.ndarray) -> np.ndarray:
        """The state (13,) that is given when a flight begins. inner: its own; state: what it would be otherwise."""
        return state

    def true_vehicle(self, vehicle: Vehicle) -> Vehicle:
        """The vehicle that is flown, from the one that controllers assume."""
        return vehicle

    def stated(self, sensor_spec: SensorSpec, vehicle: Vehicle) -> SensorSpec:
        """The data sheets of the true vehicle's sensors, from what they are without this effect."""
        return sensor_spec

    def columns(self, clock: Clock, vehicle: Vehicle) -> Mapping[str, int]:
        """Names of the columns of a flight that are inner states of its own, and which."""
        return {}

    # Hooks, in the order in which they are called. One that a class does not override is not called.
    def begin(self, at: Moment) -> Expression:
        """Inner states at the beginning of a control period, with the new command."""
        raise NotImplementedError

    def wind(self, at: Moment) -> Expression:
        """Velocity of the air (3,), world (m/s), held over the step."""
        raise NotImplementedError

    def thrusts(self, at: Moment) -> Expression:
        """Thrusts (n,) (N) that at.command becomes, held over the step."""
        raise NotImplementedError

    def wrench(self, at: Moment) -> tuple[Expression, Expression]:
        """Force (3,), world (N), and torque (3,), body (N m), at the centre of mass, held over the step."""
        raise NotImplementedError

    def advance(self, at: Moment) -> Expression:
        """Inner states after the step."""
        raise NotImplementedError

    def end(self, at: Moment) -> Expression:
        """Inner states at the end of a control period, with its time and state, before anything is measured."""
        raise NotImplementedError

    def measure(self, at: Readings, measured: Measured) -> tuple[Expression, Measured]:
        """Inner states after the period, and what is given: `given` with some of it changed, or something added."""
        raise NotImplementedError

    def ended(self, inner: Any, parameters: Any) -> Any:
        """Not zero where the flight is over, of its own inner states after a period and its parameters."""
        raise NotImplementedError

    def reason(self, inner: np.ndarray, parameters: np.ndarray) -> str:
        """Why the flight is over, in one line; "" where it is not."""
        return ""

    @classmethod
    def steps(cls) -> bool:
        """Whether it has anything to do before a control period ends, to which its inner states belong then."""
        return any(cls.has(hook) for hook in ("begin", "wind", "thrusts", "wrench", "advance", "end"))

    @classmethod
    def has(cls, hook: str) -> bool:
        """Whether this class overrides a hook."""
        return getattr(cls, hook) is not getattr(Effect, hook)


def ordered(effects: list[Effect]) -> tuple[Effect, ...]:
    """Effects in the order of STAGES. Raises UsageError for two with one random stream."""
    for effect in effects:
        stage = getattr(effect, "stage", "none")
        if stage not in STAGES:
            raise UsageError(f"{effect.class_path}: its stage is {stage!r}; it must be one of {', '.join(STAGES)}")
    parts = [effect.part for effect in effects]
    twice = [part for part in parts if parts.count(part) > 1]
    if twice:
        raise UsageError(f"{twice[0]}: two effects of that name; each needs one of its own")
    return tuple(sorted(effects, key=lambda effect: STAGES.index(effect.stage)))


__getattr__ = names_of(__name__)
