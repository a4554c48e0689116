"""Sensors as vehicles have them: each reading with noise, drift, rate and age of its own.

    accelerometer   f + vibration, behind a low pass        body, m/s^2;  white noise, bias, bias with a random walk
    gyroscope       w, behind a low pass                    body, rad/s;  the same
    rotor_speed     W (1 + sigma n), in whole steps         rad/s
    position, velocity   p + e_p,  v + e_v                  world, m, m/s;  e: white noise and a Gauss-Markov process
    attitude        q o [1, e_a / 2] / |..|                 e_a: rad, body axes;  the same
    battery         the voltage + sigma n, in whole steps   V; no controller is given it, a flight logs it

How readings drift, wait and get lost: channel.py. Low pass, of first order: physics/low_pass.py. What telegrams
leave of a speed, and vibration at the rotors' frequencies: physics/telegram.py. Position, velocity and attitude come in
one message, which is late and lost as a whole. An estimator with a delay of its own makes all of them older by that.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import accumulate, pairwise
from typing import Any

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.errors import UsageError
from quadexp.log.schema import BIAS_COLUMNS
from quadexp.parts.sensor_spec import SensorSpec, Stated
from quadexp.parts.settings import declared, keyed
from quadexp.physics.expression import unit
from quadexp.physics.low_pass import group_delay
from quadexp.physics.rotation import left_matrix
from quadexp.physics.state import ATTITUDE, POSITION, RATE, VELOCITY
from quadexp.physics.telegram import dshot_speed, in_steps, vibration
from quadexp.physics.vehicle import Vehicle
from quadexp.world.channel import DRIFT, Channel
from quadexp.world.effect import Clock, Effect, Measured, Readings, Sizes, Start
from quadexp.world.history import History
from quadexp.world.sensor_keys import ZERO, SensorKeys
from quadexp.world.streams import part_stream

POSE = {"position": POSITION, "attitude": ATTITUDE, "velocity": VELOCITY}  # what comes in one message
STATE = (*POSE, "pose", "gyroscope")  # how keys begin that change the given state
BIASES = {"accelerometer": BIAS_COLUMNS[:3], "gyroscope": BIAS_COLUMNS[3:]}
AXES = 3  # of an accelerometer or a gyroscope


@keyed
class Sensors(SensorKeys, Effect):
    """Inner states: of each channel that does something, in the order of `channels`: what it keeps of the quantity,
    which are the last force (3,) behind the low pass and before it, and the angles of the rotors (n,) (rad), or the
    low-passed rates (3,); then the channel's own. Parameters: those of the channels."""

    stage = "sensor"
    added = tuple(key for key in declared(SensorKeys) if key not in ("accelerometer_bias", "accelerometer_noise"))

    later: float = 0.0  # s, by which an estimator makes the pose older, and the body rates
    later_rates: float = 0.0

    # ------------------------------------------------------------------------------------------------ which sensors act
    def sets(self, *quantities: str) -> bool:
        """Whether a key of one of these quantities is not at its default."""
        keys = declared(type(self)).items()
        changed = [key for key, about in keys if getattr(self, key) != about.default]
        return any(key.startswith(quantities) for key in changed)

    @cached_property
    def idle(self) -> bool:
        """See Part."""
        return not self.sets("accelerometer", "rotor_speed", "battery", *STATE)

    @property
    def names_world(self) -> bool:
        """See Part: an accelerometer's noise and constant bias are no imperfection of the world."""
        return not replace(self, accelerometer_noise=ZERO, accelerometer_bias=ZERO).idle

    @property
    def tells_state(self) -> bool:
        return self.sets(*STATE)

    @property
    def loop_delay(self) -> float:
        """The age of the attitude, on which a loop's margins depend most."""
        delay = self.later
        if self.attitude_age == "pose":
            delay += self.pose_delay + self.pose_jitter / 2
        return delay

    def among(self, effects: Sequence[Effect]) -> Effect:
        estimators = [effect for effect in effects if effect.stage == "estimator"]
        if not self.tells_state or not estimators:
            return self
        late = [effect for effect in estimators if getattr(effect, "gyro", "late") == "late"]
        later = sum(effect.loop_delay for effect in estimators)
        later_rates = sum(effect.loop_delay for effect in late)
        return replace(self, later=later, later_rates=later_rates)

    def beside(self, columns: Collection[str]) -> Effect:
        """Without speeds of rotors nothing is read of them. Raises UsageError for what nothing can show."""
        turning = "rotor_speed_0" in columns
        if any(self.accelerometer_vibration) and not turning:
            raise UsageError(
                f"sensor.accelerometer_vibration={list(self.accelerometer_vibration)}: no speeds of rotors are known"
                " here: give vehicle.thrust_coefficient, and an actuator or a plant that has speeds"
            )
        if self.sets("battery") and "battery_voltage" not in columns:
            raise UsageError("sensor.battery_..: there is no battery here; `quadexp options` lists what there is")
        if turning:
            return self
        keys = declared(type(self)).items()
        exact = {name: about.default for name, about in keys if name.startswith("rotor_speed")}
        return replace(self, **exact)

    def channels(self, rotors: int) -> dict[str, Channel]:
        """Those that do something, by name."""
        channels = []
        if self.sets("accelerometer"):
            channels.append(self._channel("accelerometer", AXES))
        if self.sets("gyroscope") or self.later_rates:
            channels.append(self._channel("gyroscope", AXES, later=self.later_rates))
        if self.sets("rotor_speed"):
            channels.append(self._channel("rotor_speed", rotors, self._counted))
        for name in POSE if self.sets(*POSE, "pose") or self.later else ():
            fresh = name == "attitude" and self.attitude_age == "fresh"
            add = (lambda q, slow, random: turned(q, slow + random)) if name == "attitude" else None
            channels.append(self._channel(name, AXES, add, "attitude" if fresh else "pose", self.later))
        if self.sets("battery"):
            channel = self._channel("battery", 1, lambda v, slow, random: in_steps(v + random, self.battery_step))
            channels.append(channel)
        return {channel.name: channel for channel in channels}

    def _channel(
        self, name: str, errors: int, add: Callable[..., Any] | None = None, message: str = "", later: float = 0.0
    ) -> Channel:
        def of(quality: str, otherwise: Any = 0.0) -> Any:
            return getattr(self, f"{name}_{quality}", otherwise)

        way = {quality: getattr(self, f"{message or name}_{quality}", 0.0) for quality in ("rate", "jitter", "drop")}
        decay = math.exp(-DRIFT / of("drift_time", math.inf))
        return Channel(
            name=name,
            size=errors + (name == "attitude"),
            noise=np.broadcast_to(of("noise"), errors),
            bias=np.broadcast_to(of("bias"), errors),
            first=of("bias_std", of("drift")),
            decay=decay,
            gain=of("bias_walk") * math.sqrt(DRIFT) + of("drift") * math.sqrt(1 - decay**2),
            delay=getattr(self, f"{message or name}_delay", 0.0) + later,
            message=message or name,
            add=add or (lambda value, slow, random: (value + slow) + random),
            **way,
        )

    # ------------------------------------------------------------------------------------------------------ see Effect
    def _keeps(self, name: str, rotors: int) -> int:
        """How many numbers a channel keeps of its quantity."""
        if name == "accelerometer":
            return 2 * AXES + rotors * any(self.accelerometer_vibration)
        if name == "gyroscope":
            return AXES
        return 0

    def _places(self, clock: Clock, rotors: int) -> dict[str, slice]:
        """Where the inner states of each channel stand."""
        sizes = {}
        for name, channel in self.channels(rotors).items():
            sizes[name] = self._keeps(name, rotors) + channel.sizes(clock).inner
        return _slices(sizes)

    def sizes(self, clock: Clock, vehicle: Vehicle) -> Sizes:
        """Raises UsageError for a rotor that the vehicle does not have."""
        if max(self.rotor_speed_of or (0,)) >= vehicle.n_rotors:
            raise UsageError(
                f"sensor.rotor_speed_of={list(self.rotor_speed_of or ())}: vehicle={vehicle.name} has rotors 0 to"
                f" {vehicle.n_rotors - 1}"
            )
        total = Sizes()
        for name, channel in self.channels(vehicle.n_rotors).items():
            sizes = channel.sizes(clock)
            total = Sizes(
                total.inner + sizes.inner + self._keeps(name, vehicle.n_rotors),
                total.parameters + sizes.parameters,
                total.drawn + sizes.drawn,
                total.streams + sizes.streams,
            )
        return total

    def start(self, rng: np.random.Generator, start: Start) -> tuple[Any, Any]:
        vehicle = start.vehicle
        exact = {name: start.x[place] for name, place in POSE.items()}
        exact["accelerometer"] = np.array([0.0, 0.0, start.thrust.sum() / vehicle.mass])
        exact["gyroscope"] = start.x[RATE]
        exact["rotor_speed"] = np.sqrt(start.thrust / (vehicle.thrust_coefficient or math.inf))
        exact["battery"] = np.zeros(1)
        angles = 2 * math.pi * part_stream(rng, "angles").random(vehicle.n_rotors)
        inner = [np.empty(0)]
        parameters = [np.empty(0)]
        for name, channel in self.channels(vehicle.n_rotors).items():
            start_values, numbers = channel.start(part_stream(rng, name), start.clock, exact[name])
            kept = np.concatenate([exact[name], exact[name], angles])[: self._keeps(name, vehicle.n_rotors)]
            inner += [kept, start_values]
            parameters.append(numbers)
        return np.concatenate(inner), np.concatenate(parameters)

    def columns(self, clock: Clock, vehicle: Vehicle) -> Mapping[str, int]:
        """True biases that drift; what is given speeds and voltage; when what is given a sensor was taken."""
        n = vehicle.n_rotors
        columns = dict[str, int]()
        measured = range(n) if self.rotor_speed_of is None else self.rotor_speed_of
        places = self._places(clock, n)
        channels = self.channels(n)
        for name, channel in channels.items():
            first = places[name].start + self._keeps(name, n)
            if channel.waits:
                columns[f"taken_{name}"] = first + channel.taken
            if channel.drifts and name in BIASES:
                columns |= {column: first + i for i, column in enumerate(BIASES[name])}
            if name == "rotor_speed":
                columns |= {f"est_rotor_speed_{i}": first + channel.taken + 1 + i for i in measured}
            if name == "battery":
                columns["est_battery_voltage"] = first + channel.taken + 1
        return columns

    def stated(self, sensor_spec: SensorSpec, vehicle: Vehicle) -> SensorSpec:
        """What is set, wrong by sheet_factor; a low pass makes its readings older. An age of zero of the pose is
        nobody's statement, and an estimator's delay is none of the sensors'."""
        ages = dict.fromkeys(POSE, self.pose_delay + self.pose_jitter / 2 or None) | {
            "accelerometer": self.accelerometer_delay + group_delay(self.accelerometer_cutoff),
            "gyroscope": None if self.later_rates else self.gyroscope_delay + group_delay(self.gyroscope_cutoff),
            "rotor_speed": self.rotor_speed_delay + self.rotor_speed_jitter / 2,
        }
        if self.attitude_age == "fresh":
            ages["attitude"] = None if self.later else 0.0
        channels = self.channels(vehicle.n_rotors)
        changed: dict[str, Stated | None] = {}
        for name, channel in channels.items():
            if name in ages:
                stated = Stated(float(channel.noise.max()), channel.first, channel.rate, ages[name])
                changed[name] = stated.scaled(self.sheet_factor)
        if self.rotor_speed_of is not None and {*self.rotor_speed_of} != {*range(vehicle.n_rotors)}:
            changed["rotor_speed"] = None
        return replace(sensor_spec, **changed)

    def measure(self, at: Readings, measured: Measured) -> tuple[ca.MX, Measured]:
        rotors = at.vehicle.n_rotors
        clock = at.clock
        after = [ca.MX(0, 1)]
        channels = self.channels(rotors)
        places = self._places(clock, rotors)
        readings = dict[str, ca.MX]()
        sizes = {name: channel.sizes(clock) for name, channel in channels.items()}
        of_parameters = _slices({name: size.parameters for name, size in sizes.items()})
        of_draws = _slices({name: size.draws for name, size in sizes.items()})
        for name, channel in channels.items():
            inner = at.inner[places[name]]
            keeps = self._keeps(name, rotors)
            value_at, kept = self._exact(name, at, measured, inner[:keeps])
            parameters = at.parameters[of_parameters[name]]
            draws = at.draws[of_draws[name]]
            its_own = at._replace(inner=inner[keeps:], parameters=parameters, draws=draws)
            inner, readings[name] = channel.measure(its_own, value_at)
            after += [kept, inner]
        state = ca.vertcat(*(readings.get(name, measured["state"][place]) for name, place in POSE.items()))
        state = ca.vertcat(state, readings.get("gyroscope", measured["state"][RATE]))
        force = readings.get("accelerometer", measured["specific_force"])
        return ca.vertcat(*after), measured | {"state": state, "specific_force": force}

    def _exact(self, name: str, at: Readings, measured: Measured, kept: ca.MX) -> tuple[Callable[[Any], ca.MX], ca.MX]:
        """What an exact sensor reads at a time (s) since the period began, and what is kept of the quantity."""
        if name == "accelerometer":
            return self._force(at, measured["specific_force"], kept)
        if name == "gyroscope":
            rates = History(at.states[RATE, :], at.clock).low_passed(kept, self.gyroscope_cutoff)
            return rates.at, rates.values[:, -1]
        if name == "rotor_speed":
            return self._speeds(at).at, kept
        if name == "battery":
            return History(at.columns(["battery_voltage"]), at.clock).at, kept
        quantity = History(at.states[POSE[name], :], at.clock)
        if name == "attitude":
            return quantity.unit_at, kept
        return quantity.at, kept

    def _force(self, at: Readings, last: ca.MX, kept: ca.MX) -> tuple[Callable[[Any], ca.MX], ca.MX]:
        """Specific force and vibration; last: the force at the end of the period."""
        cutoff = self.accelerometer_cutoff
        clock = at.clock
        passed, before, turned_by = ca.vertsplit(kept, [0, AXES, 2 * AXES, kept.numel()])
        forces = History(ca.repmat(last, 1, clock.steps + 1), clock)
        if cutoff or self.accelerometer_delay or self.accelerometer_rate:
            forces = History(ca.horzcat(before, at.forces()), clock).low_passed(passed, cutoff)
        after = ca.vertcat(forces.values[:, -1], last)
        if not any(self.accelerometer_vibration):
            return forces.at, after
        speeds = self._speeds(at)
        vehicle = at.vehicle
        angles = speeds.integral(turned_by)
        amplitude = ca.DM(self.accelerometer_vibration)
        hover = math.sqrt(vehicle.hover_thrust / vehicle.static_thrust_coefficient)

        def shaken(time: Any) -> ca.MX:
            return forces.at(time) + vibration(angles.at(time), speeds.at(time), hover, amplitude, cutoff)

        return shaken, ca.vertcat(after, ca.fmod(angles.values[:, -1], 2 * math.pi))

    def _speeds(self, at: Readings) -> History:
        """Of the rotors, (n,) (rad/s)."""
        names = [f"rotor_speed_{i}" for i in range(at.vehicle.n_rotors)]
        return History(at.columns(names), at.clock)

    def _counted(self, speed: Any, slow: Any, random: Any) -> Any:
        """Speeds (n,) as telegrams have them."""
        speed = speed * (1 + slow + random)
        pairs = self.rotor_speed_pole_pairs
        if pairs:
            speed = dshot_speed(speed, pairs)
        return in_steps(speed, self.rotor_speed_step)


def _slices(sizes: Mapping[str, int]) -> dict[str, slice]:
    """Where each of some parts of a vector stands."""
    ends = [0, *accumulate(sizes.values())]
    return {name: slice(*pair) for name, pair in zip(sizes, pairwise(ends), strict=True)}


def turned(q: Any, error: Any) -> Any:
    """q o [1, e / 2], of unit length: an attitude (4,) with the small error e (3,), about body axes (rad)."""
    return unit(left_matrix(q) @ ca.vertcat(1, error / 2))
