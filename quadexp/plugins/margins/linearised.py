"""The linear loop of a controller and its plant, as they fly, with everything that is in the loop.

z: the body's state in its tangent space (rotation vector about body axes), the plant's inner states, the readings, and
what the calls of the controller remember: the numbers that they read before they write them. Derivatives are
central differences of the functions that fly: of motors that lag more down than up the mean of both.

Before that, the vehicle flies along the reference without noise, so that its error, filters and covariances settle; one
that does not settle is carried along. Frozen as they are then: what a controller learns from readings in Python; the
MPC's last solution, on which its next one does not depend to first order.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from fractions import Fraction
from typing import Any

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.control.base import Measurement, Window
from quadexp.control.control_step import Call, in_calls, run
from quadexp.control.wrapped import innermost
from quadexp.errors import ModelDomainError, QuadexpError
from quadexp.physics.rotation import left_matrix
from quadexp.physics.state import ATTITUDE, N_STATE
from quadexp.plugins.margins.linear_loop import LinearLoop, Phase
from quadexp.plugins.margins.remembered import Remembered, calls_to_command
from quadexp.world.integrator import SimulatedPlant
from quadexp.world.streams import TICK, Drawn, Held, Silence, Ticking
from quadexp.world.world import World

SETTLING = 0.5, 5.0  # s, at least and at most
STILL = 0.01  # 1/s: as fast as any number of the state's error may change where it has settled
FAR = 5.0  # m, m/s, rad/s: a flight that is further from its reference does not settle there
DIFFERENCE = 1e-5  # of a number of a size up to 1, for derivatives; of larger ones relative
SMALLER = np.array([1.0, 1e-2, 1e-4])  # differences that are tried in turn, where f is not finite
COPIED = 1e-6  # relative difference of a copied change
FEW = 4  # columns that are not worth being looked at together
REPEATS = 1e-7  # by how much an instant may differ when it is repeated
MOST_NUMBERS = 2000  # inner states of a plant, over all instants that differ
MOST_PHASES = 100  # instants after which the loop must be the same again
N_TANGENT = N_STATE - 1


class UnknownLoopError(QuadexpError):
    """Why a loop cannot be linearised."""


def linear_loop(
    controller: Any,
    plant: Any,
    window: Callable[[int], Window],
    state: Callable[[int], np.ndarray],
    settling: tuple[float, float] = SETTLING,
) -> LinearLoop:
    """The loop around a reference, once it has settled. Both must begin a flight anew afterwards.

    window, state: of the reference at control instant k, Window and (13,). settling: s, at least and at most.
    Raises UnknownLoopError where plant or controller keep what they remember to themselves.
    """
    if not isinstance(plant, SimulatedPlant) or type(plant).advance is not SimulatedPlant.advance:
        raise UnknownLoopError(f"{type(plant).__name__} keeps its inner states to itself")
    if not (in_calls(controller) and in_calls(inner := innermost(controller))):
        raise UnknownLoopError(f"{type(inner if in_calls(controller) else controller).__name__} steps in Python")
    for carried in (False, True):
        try:
            flown = _Flown(controller, plant, window, state, settling, carried=carried)
            if not flown.settled and not carried:  # it may be that it is not stable
                continue
            phases, body, readings = flown.phases()
        except ModelDomainError as error:
            raise UnknownLoopError(str(error)) from None
        if not all(np.isfinite(part).all() for phase in phases for part in phase):
            raise UnknownLoopError("its derivatives are not finite")
        if not any(phase.B.any() for phase in phases):
            raise UnknownLoopError("the rotors follow no command, such as one beyond their limits")
        if any(phase.C.any() for phase in phases):
            break
    else:
        raise UnknownLoopError("no command follows the state, such as of rotors at their limits")
    places = np.arange(len(phases[0].A))
    direct = (places >= readings) & (places < readings + 3)
    return LinearLoop(phases, controller.control_period, (places < body) & ~direct, direct)


class _Flown:
    """A flight along a reference without noise. settled: whether its error has come to rest, near the reference.
    carried: whether the vehicle is put where the reference is at every instant."""

    def __init__(
        self,
        controller: Any,
        plant: Any,
        window: Callable[[int], Window],
        state: Callable[[int], np.ndarray],
        settling: tuple[float, float],
        *,
        carried: bool,
    ) -> None:
        self._controller = controller
        self._plant = plant
        self._window = window
        self._state = state
        self._k = 0
        self._period = controller.control_period
        self._x = state(0)
        self._carried = carried
        self._estimates = isinstance(plant, World) and plant.estimates
        self._noise = plant.begin(self._x, self._period, 1.0, Silence())
        self._drawn = _drawn(plant, self._period)
        self._timed = np.concatenate([np.zeros(0, bool), *map(_times, self._drawn)])  # when something is, no noise
        measured = plant.measured.copy() if self._estimates else self._x
        controller.reset(measured, window(0))
        self._told = Measurement(0.0, measured, None, None)
        least, most = (max(math.ceil(time / self._period), 2) for time in settling)
        self.settled = False
        for i in range(1, most + 1):
            before = self._error
            self._enter(self._step())
            self._go_on()
            still = np.abs(self._error - before).max() < STILL * self._period or least == most
            near = np.abs(self._error).max() < FAR
            self.settled = bool(i >= least and still and near)
            if self.settled or not near:
                break

    @property
    def _error(self) -> np.ndarray:
        return self._x - self._state(self._k)

    def phases(self) -> tuple[list[Phase], int, int]:
        """Of the next instants, until the loop is the same again; and where the memory and the readings begin."""
        running = self._controller.running
        calls = []
        for o in running.control_step.calls:
            of_c = o.kind in ("finite", "near")
            learns = o.kind == "python" and (o.when is running.inputs.accelerometer_valid or o.every > 1)
            if not (of_c or o.decides or learns):  # nothing is learned meanwhile
                calls.append(o)
        calls = calls_to_command(calls, running.control_step)
        sensors = []
        for part in self._drawn:
            if not isinstance(part, Held) and part.tick > TICK:
                sensors.append(part.tick)
        ratios = [Fraction(self._period / tick).limit_denominator(MOST_PHASES) for tick in sensors]
        read = math.lcm(*(ratio.denominator for ratio in ratios))
        count = math.lcm(read, *(o.every for o in calls))
        if count > MOST_PHASES:
            raise UnknownLoopError(f"its rates are the same again only after {count} instants")
        if read * len(self._plant.inner) > MOST_NUMBERS:
            numbers = len(self._plant.inner)
            over = f" at each of {read} instants that differ" if read > 1 else ""
            raise UnknownLoopError(f"the world has {numbers} inner states{over}; at most {MOST_NUMBERS} are linearised")
        memory = Remembered(running.control_step, calls)
        known = dict[Any, Phase]()
        phases = []
        if (numbers := len(memory.values) + len(self._plant.inner)) > MOST_NUMBERS:
            raise UnknownLoopError(f"it has {numbers} inner states; at most {MOST_NUMBERS} are linearised")
        for _ in range(count):
            k = running.k
            begun = memory.values
            guess = [part.now.copy() for part in memory.planned]
            u = self._step()
            ended = memory.values
            self._enter(u)
            key = (k % read, *(k % o.every == 0 for o in calls))
            if key not in known:
                known[key] = self._phase(calls, memory, k, begun, guess)
                memory.values = ended
            phases.append(known[key])
            self._go_on()
        inner = N_TANGENT + len(self._plant.inner)
        return phases, inner + 3 + N_TANGENT * self._estimates, inner

    def _step(self) -> np.ndarray:
        u, _ = self._controller.step(self._told, self._window(self._k))
        if not np.isfinite(u).all():
            raise UnknownLoopError("its commands are not finite")
        return u

    def _enter(self, u: np.ndarray) -> None:
        """Tell the plant's function all of the next period, without noise."""
        self._function = self._plant.prepared(self._period)
        arguments = self._function.arguments
        arguments["x"][:] = self._x
        arguments["inner"][:] = self._plant.inner
        arguments["u"][:] = u
        noise = self._plant.noise(self._function).reshape(-1)
        self._noise.standard_normal(out=noise)
        noise[~self._timed] = 0.0

    def _go_on(self) -> None:
        """A period of the plant."""
        self._function()
        results = self._function.results
        plant = self._plant
        plant.settle(results)
        plant.time += self._period
        self._k += 1
        self._x = self._state(self._k) if self._carried else results["x_next"].copy()
        measured = results["measured"].copy() if self._estimates else self._x
        speed = getattr(plant, "rotor_speed", None)
        self._told = Measurement(plant.time, measured, results["specific_force"].copy(), speed)

    def _phase(
        self, calls: list[Call], memory: Remembered, k: int, begun: np.ndarray, guess: list[np.ndarray]
    ) -> Phase:
        """Of the instant k, before which the memory was `begun` and the MPC's last solution `guess`, and of the period
        that `_enter` prepared."""
        running = self._controller.running
        inputs_of_plant = self._function.arguments
        results = self._function.results
        inputs = running.inputs
        window = running.inputs.window
        command = running.control_step.command
        turning = np.array(getattr(self._plant, "rotor_places", []), int)
        sensors = [inputs.specific_force, inputs.rotor_speed] if len(turning) else [inputs.specific_force]
        readings = [reading for reading in sensors if memory.reads(reading)]
        read = [inputs.state, *readings]
        m = len(begun)

        def instant(values: np.ndarray) -> np.ndarray:
            """What is given and remembered -> what is sent and remembered."""
            _scatter(read, values[: len(values) - m])
            memory.values = values[len(values) - m :]
            for planned, value in zip(memory.planned, guess, strict=True):
                planned.restore(value)
            run(calls, k, window)
            return np.concatenate([command, memory.values])

        point = np.concatenate([*read, begun])
        first = instant(point)
        by_told = _derivative(instant, point, _lift(point, 0))
        if not np.allclose(instant(point), first, rtol=REPEATS, atol=REPEATS):
            raise UnknownLoopError("its calls in Python remember what they were given")
        arguments = [inputs_of_plant[name] for name in ("x", "inner", "u")]
        after = [
            results[name] for name in ("x_next", "inner_next", "specific_force", "measured")[: 3 + self._estimates]
        ]

        def fly(values: np.ndarray) -> np.ndarray:
            """State, inner states and command -> the same after the period, and readings."""
            _scatter(arguments, values)
            self._function()
            return np.concatenate(after)

        point = np.concatenate(arguments)
        first = fly(point)
        if results["doubt"].any() or not np.isfinite(first).all():
            raise UnknownLoopError("the plant's equations are in doubt there")
        onto = _lift(first, 0, *[len(first) - N_STATE] * self._estimates)
        by_plant = _derivative(fly, point, _lift(point, 0))
        fly(point)
        by_plant = (onto / (onto**2).sum(axis=0)).T @ by_plant

        inner = N_TANGENT + len(inputs_of_plant["inner"])
        n = len(command)
        places = [np.arange(N_TANGENT) + (inner + 3) * self._estimates]
        for reading in readings:
            places.append(inner + np.arange(3) if reading is inputs.specific_force else N_TANGENT + turning)
        body = len(by_plant)
        places = [*places, len(by_plant) + np.arange(m)]
        by_all = np.zeros((n + m, body + m))
        by_all[:, np.concatenate(places)] = by_told
        A = np.zeros((body + m, body + m))
        B = np.zeros((body + m, n))
        A[:body, :inner] = by_plant[:, :inner]
        A[body:] = by_all[n:]
        B[:body] = by_plant[:, inner:]
        return Phase(A, B, by_all[:n])


def _scatter(arrays: Iterable[np.ndarray], values: np.ndarray) -> None:
    """Write values (m,) into arrays, one after another."""
    first = 0
    for array in arrays:
        array[...] = values[first : first + array.size].reshape(array.shape)
        first += array.size


def _lift(values: np.ndarray, *places: int) -> np.ndarray:
    """How small deviations move numbers (m,): those of the states (13,) that begin at some places as rotations."""
    columns = np.eye(len(values))
    for first in places:
        attitude = slice(first + ATTITUDE.start, first + ATTITUDE.stop)
        columns[attitude, attitude] = np.array(left_matrix(ca.DM(values[attitude]))) / 2
    return np.delete(columns, [first + ATTITUDE.start for first in places], axis=1)


def _derivative(f: Callable[[np.ndarray], np.ndarray], point: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Derivatives of f at a point (m,) along columns (m, d), by central differences; many at once of numbers that are
    copied to others and do nothing else, as in a history."""
    sizes = DIFFERENCE * np.maximum(1.0, np.abs(columns.T @ point))
    base = f(point)
    kicks = sizes * np.linspace(1.0, 2.0, len(sizes))  # each tells by its size where it went
    moved = f(point + columns @ kicks) - base
    derivatives = (np.abs(moved[:, None] - kicks) < COPIED * kicks).astype(float)
    pending = [np.flatnonzero(derivatives.any(axis=0))]
    single = [*np.flatnonzero(~derivatives.any(axis=0))]
    while pending:
        group = pending.pop()
        moved = f(point + columns[:, group] @ kicks[group]) - base
        if np.abs(moved - derivatives[:, group] @ kicks[group]).max(initial=0.0) < COPIED * DIFFERENCE:
            continue
        if len(group) > FEW:
            pending += np.array_split(group, 2)
        else:
            single += [*group]
    for i in single:
        for size in sizes[i] * SMALLER:  # a variance of 1e-6 is none any longer after a change by 1e-5
            move = size * columns[:, i]
            derivatives[:, i] = (f(point + move) - f(point - move)) / (2 * size)
            if np.isfinite(derivatives[:, i]).all():
                break
    return derivatives


def _drawn(plant: SimulatedPlant, period: float) -> list[Drawn]:
    """What is drawn in a control period, in its order."""
    parts = [drawn for _, drawn in plant.own_noise(np.random.default_rng(0), period)]
    if isinstance(plant, World):
        clock = plant.clock(period)
        parts += [drawing for effect in plant.effects for drawing in effect.sizes(clock, plant.vehicle).drawn]
    return parts


def _times(drawn: Drawn) -> np.ndarray:
    """Which numbers of a control period are times, (k,)."""
    ticks = isinstance(drawn, Ticking)
    if ticks:
        return np.arange(drawn.size) % (1 + drawn.numbers) == 0
    return np.zeros(drawn.size, bool)
