"""Sensors as vehicles have them: each reading with noise, drift, rate and age of its own.

    accelerometer   f + vibration, behind a low pass        body, m/s^2;  white noise, bias, bias with a random walk
    gyroscope       w, behind a low pass                    body, rad/s;  the same
    rotor_speed     W (1 + sigma n), quantised              rad/s
    pose            p + e_p,  q o [1, e_a / 2] / |..|,  v + e_v          e: white noise and a Gauss-Markov process
    battery         the voltage + sigma n, quantised        V; no controller is told it, a flight logs it

How readings drift, wait and get lost: channel.py. Low pass, of first order: history.py. What telegrams leave of a
speed, and vibration at the rotors' frequencies: physics/telegram.py.
An estimator with a delay of its own makes what is told of the state older by that.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, pairwise
from typing import Any, Literal

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.errors import UsageError
from quadexp.parts.sensor_sheet import SensorSheet, Stated
from quadexp.parts.settings import Setting, Triple, declared, key
from quadexp.physics.rotation import left_matrix
from quadexp.physics.state import ATTITUDE, POSITION, RATE, VELOCITY
from quadexp.physics.telegram import dshot_speed, in_steps, vibration
from quadexp.physics.vehicle import Vehicle
from quadexp.world.channel import DRIFT, Channel
from quadexp.world.effect import Clock, Effect, Readings, Sizes, Start, Told
from quadexp.world.history import History, angles, forces_at_steps, low_passed, mean_forces
from quadexp.world.inertial import BIAS_COLUMNS
from quadexp.world.streams import part_stream

ZERO = (0.0, 0.0, 0.0)
STATE = ("position", "velocity", "attitude", "pose")  # quantities, but for the body rates
BIASED = {"accelerometer": BIAS_COLUMNS[:3], "gyroscope": BIAS_COLUMNS[3:]}
RATES = "[0, 8000]"
AGES = "[0, 0.5]"
RATE_HZ = Setting("readings a second; 0: one at every control instant", RATES, "Hz")
AGE = Setting("age at which a reading is told", AGES, "s")
JITTER = Setting("what a reading may take longer, uniform from reading to reading", AGES, "s")
DROP = Setting("share of the readings that get lost", "[0, 1)")
CUTOFF = Setting("cut-off of the low pass before the readings; 0: none", "[0, 10000]", "Hz")
BIAS_STD = "standard deviation of the bias that is drawn for a flight, each axis"
DRIFT_STD = "standard deviation of the correlated error, each axis"
DRIFT_TIME = Setting("over which that error is correlated", "(0, 1e6]", "s")


@dataclass(frozen=True, kw_only=True)
class Sensors(Effect):
    """Accelerometer, gyroscope, speeds of the rotors, position, velocity, attitude, voltage.

    Inner states: of each channel that does something, see channel.py; then the force of the accelerometer's last low
    pass or reading (3,), the gyroscope's low pass (3,), angles of the rotors (n,) (rad), what is told of speeds and
    voltage, as far as they are needed. Parameters: of the channels.
    """

    prefix = "sensor."

    accelerometer_bias: Triple = key(ZERO, "constant error of the specific force", "[-100, 100]", "m/s^2")
    accelerometer_noise: Triple = key(
        ZERO, "standard deviation of the white noise on the specific force", "[0, 100]", "m/s^2"
    )
    accelerometer_bias_std: float = key(0.0, BIAS_STD, "[0, 10]", "m/s^2")
    accelerometer_bias_walk: float = key(0.0, "random walk of the bias", "[0, 10]", "m/s^3/sqrt(Hz)")
    accelerometer_rate: float = key(0.0, RATE_HZ)
    accelerometer_delay: float = key(0.0, AGE)
    accelerometer_cutoff: float = key(0.0, CUTOFF)
    accelerometer_vibration: Triple = key(
        ZERO, "amplitude at the frequency of each rotor in hover, as a rotor's unbalance makes it", "[0, 1000]", "m/s^2"
    )
    gyroscope_noise: float = key(0.0, "standard deviation of the white noise, each axis", "[0, 10]", "rad/s")
    gyroscope_bias_std: float = key(0.0, BIAS_STD, "[0, 1]", "rad/s")
    gyroscope_bias_walk: float = key(0.0, "random walk of the bias", "[0, 1]", "rad/s^2/sqrt(Hz)")
    gyroscope_rate: float = key(0.0, RATE_HZ)
    gyroscope_delay: float = key(0.0, AGE)
    gyroscope_cutoff: float = key(0.0, CUTOFF)
    rotor_speed_noise: float = key(0.0, "standard deviation of the white noise over the speed", "[0, 1]")
    rotor_speed_rate: float = key(0.0, RATE_HZ)
    rotor_speed_delay: float = key(0.0, AGE)
    rotor_speed_jitter: float = key(0.0, JITTER)
    rotor_speed_drop: float = key(0.0, DROP)
    rotor_speed_step: float = key(0.0, "smallest difference that a telegram can tell; 0: any", "[0, 1000]", "rad/s")
    rotor_speed_pole_pairs: int = key(
        0, "of the motors, whose period is told in telegrams of bidirectional DShot; 0: in none", "[0, 50]"
    )
    rotor_speed_of: tuple[int, ...] | None = key(
        None, "rotors that are measured, from 0; null: all; controllers are told speeds where all are", "[0, 99]"
    )
    position_noise: Triple = key(ZERO, "standard deviation of the white noise, world", "[0, 100]", "m")
    position_drift: float = key(0.0, DRIFT_STD, "[0, 100]", "m")
    position_drift_time: float = key(30.0, DRIFT_TIME)
    velocity_noise: float = key(0.0, "standard deviation of the white noise, each axis", "[0, 100]", "m/s")
    velocity_drift: float = key(0.0, DRIFT_STD, "[0, 100]", "m/s")
    velocity_drift_time: float = key(1.0, DRIFT_TIME)
    attitude_noise: float = key(0.0, "standard deviation of the white noise, about each body axis", "[0, 1]", "rad")
    attitude_drift: float = key(0.0, DRIFT_STD, "[0, 1]", "rad")
    attitude_drift_time: float = key(10.0, DRIFT_TIME)
    attitude_age: Literal["pose", "fresh"] = key(
        "pose", "attitude that is told: as old as position and velocity, or that of now, as of a filter on board"
    )
    pose_rate: float = key(0.0, RATE_HZ)
    pose_delay: float = key(0.0, AGE)
    pose_jitter: float = key(0.0, JITTER)
    pose_drop: float = key(0.0, DROP)
    battery_noise: float = key(0.0, "standard deviation of the white noise on the voltage", "[0, 10]", "V")
    battery_step: float = key(0.0, "smallest difference of the voltage that is told; 0: any", "[0, 1]", "V")
    sheet_factor: float = key(
        1.0, "by which the noise, drift and delay that controllers are told of the sensors are wrong", "[0.01, 100]"
    )

    stage = "sensor"

    later: float = 0.0  # s, by which an estimator makes the state older, and whether the body rates too
    later_rates: bool = False

    # ------------------------------------------------------------------------------------------------ which sensors act
    def _set(self, *quantities: str) -> bool:
        """Whether a key of one of these quantities is not at its default."""
        return any(
            getattr(self, name) != about.default
            for name, about in declared(type(self)).items()
            if name.startswith(quantities)
        )

    @property
    def idle(self) -> bool:
        """See Part."""
        return not self._set("accelerometer", "gyroscope", "rotor_speed", *STATE, "battery")

    @property
    def names_world(self) -> bool:
        """See Part: an accelerometer's noise and constant bias are no imperfection of the world."""
        plain = replace(self, accelerometer_noise=ZERO, accelerometer_bias=ZERO)
        return not plain.idle

    @property
    def tells_state(self) -> bool:
        return bool(self.later) or self._set("gyroscope", *STATE)

    @property
    def loop_delay(self) -> float:
        """The age of the attitude, on which a loop's margins depend most."""
        return self.later + (self.pose_delay + self.pose_jitter / 2 if self.attitude_age == "pose" else 0.0)

    def recorded(self) -> dict[str, Any]:
        """See Part: without what is exact, so that records of earlier versions are those of today."""
        always = ("name", "accelerometer_bias", "accelerometer_noise")
        keys = declared(type(self))
        kept = super().recorded().items()
        return {name: value for name, value in kept if name in always or getattr(self, name) != keys[name].default}

    def among(self, effects: Sequence[Effect]) -> Effect:
        estimators = [effect for effect in effects if effect.stage == "estimator"]
        later = sum(effect.loop_delay for effect in estimators)
        if not later or not self._set("gyroscope", *STATE):
            return self
        fresh = any(getattr(effect, "gyro", "late") == "fresh" for effect in estimators)
        return replace(self, later=later, later_rates=not fresh)

    def channels(self, vehicle: Vehicle) -> dict[str, Channel]:
        """Those that do something, by name."""
        return {channel.name: channel for channel in self._channels(vehicle.n_rotors)}

    def _channels(self, rotors: int) -> Iterator[Channel]:
        if self._set("accelerometer"):
            noise, bias = (np.array(each) for each in (self.accelerometer_noise, self.accelerometer_bias))
            yield self._channel("accelerometer", 3, noise, bias, self.accelerometer_delay)
        if self._set("gyroscope") or (self.later and self.later_rates):
            delay = self.gyroscope_delay + self.later * self.later_rates
            yield self._channel("gyroscope", 3, np.full(3, self.gyroscope_noise), np.zeros(3), delay)
        if self._set("rotor_speed"):
            noise = np.full(rotors, self.rotor_speed_noise)
            yield self._channel(
                "rotor_speed", rotors, noise, np.zeros(rotors), self.rotor_speed_delay, add=self._counted
            )
        if self._set(*STATE) or self.later:
            yield self._pose("pose")
            if self.attitude_age == "fresh":
                yield self._pose("attitude")
        if self._set("battery"):
            yield self._channel("battery", 1, np.array([self.battery_noise]), np.zeros(1), 0.0, add=self._volts)

    def _channel(self, name: str, size: int, noise: np.ndarray, bias: np.ndarray, delay: float, **more: Any) -> Channel:
        """A channel whose drift is a bias with a random walk."""
        more |= {way: getattr(self, f"{name}_{way}", 0.0) for way in ("rate", "jitter", "drop")}
        first, walk = (getattr(self, f"{name}_{drift}", 0.0) for drift in ("bias_std", "bias_walk"))
        more |= {"first": np.full(size, first), "decay": np.ones(size)}
        gain = np.full(size, walk * math.sqrt(DRIFT))
        return Channel(name=name, size=size, noise=noise, bias=bias, gain=gain, delay=delay, **more)

    def _pose(self, name: str) -> Channel:
        """A channel whose drifts are Gauss-Markov processes."""
        noise, deviations, decays = list[float](), list[float](), list[float]()
        for quantity in self._quantities(name):
            white, deviation = (getattr(self, f"{quantity}_{kind}") for kind in ("noise", "drift"))
            noise += white if isinstance(white, tuple) else [white] * 3
            deviations += [deviation] * 3
            decays += [math.exp(-DRIFT / getattr(self, f"{quantity}_drift_time"))] * 3
        decay, first = np.array(decays), np.array(deviations)
        ways = {way: getattr(self, f"pose_{way}") for way in ("rate", "jitter", "drop")} if name == "pose" else {}
        delay = self.later + (self.pose_delay if name == "pose" else 0.0)
        return Channel(
            name=name,
            size=4 if name == "attitude" else len(noise) + ("attitude" in self._quantities(name)),
            noise=np.array(noise),
            bias=np.zeros(len(noise)),
            first=first,
            decay=decay,
            gain=first * np.sqrt(1 - decay**2),
            delay=delay,
            **ways,
            add=_pose_with if name == "pose" else lambda q, slow, random: _turned(q, slow + random),
        )

    # ------------------------------------------------------------------------------------------------- see Effect
    def _kept(self, vehicle: Vehicle) -> dict[str, int]:
        """Inner states behind those of the channels, and how many each has."""
        channels, n = self.channels(vehicle), vehicle.n_rotors
        kept = {"force": 3 * ("accelerometer" in channels and bool(self.accelerometer_cutoff or self._late_force))}
        kept["rates"] = 3 * ("gyroscope" in channels and bool(self.gyroscope_cutoff))
        kept["angles"] = n * any(self.accelerometer_vibration)
        return kept | {"speeds": n * ("rotor_speed" in channels), "voltage": int("battery" in channels)}

    @property
    def _late_force(self) -> bool:
        return bool(self.accelerometer_delay or self.accelerometer_rate)

    def _inner(self, clock: Clock, vehicle: Vehicle) -> dict[str, slice]:
        """Where the inner states of each channel stand, then what is kept besides."""
        sizes = {name: channel.sizes(clock).inner for name, channel in self.channels(vehicle).items()}
        return _slices(sizes | self._kept(vehicle))

    def sizes(self, clock: Clock, vehicle: Vehicle) -> Sizes:
        """Raises UsageError for a rotor that the vehicle does not have."""
        if max(self.rotor_speed_of or (0,)) >= vehicle.n_rotors:
            raise UsageError(
                f"sensor.rotor_speed_of={list(self.rotor_speed_of or ())}: vehicle={vehicle.name} has rotors 0 to"
                f" {vehicle.n_rotors - 1}"
            )
        channels = self.channels(vehicle).values()
        drawn = {name: numbers for channel in channels for name, numbers in channel.drawn(clock).items()}
        inner = sum(place.stop - place.start for place in self._inner(clock, vehicle).values())
        parameters = sum(channel.sizes(clock).parameters for channel in channels)
        return Sizes(inner, parameters, tuple(drawn.values()), tuple(drawn))

    def start(self, rng: np.random.Generator, start: Start) -> tuple[Any, Any]:
        vehicle, x = start.vehicle, start.x
        force = np.array([0.0, 0.0, start.thrust.sum() / vehicle.mass])
        speed = np.sqrt(start.thrust / (vehicle.thrust_coefficient or math.inf))
        fresh = self.attitude_age == "fresh"
        pose = np.concatenate([x[POSITION], [] if fresh else x[ATTITUDE], x[VELOCITY]])
        exact = {"accelerometer": force, "gyroscope": x[RATE], "rotor_speed": speed, "pose": pose}
        exact |= {"attitude": x[ATTITUDE], "battery": np.zeros(1)}
        inner, parameters = list[np.ndarray](), list[np.ndarray]()
        for name, channel in self.channels(vehicle).items():
            own, numbers = channel.start(part_stream(rng, name), start.clock, exact[name])
            inner.append(own)
            parameters.append(numbers)
        angles = 2 * math.pi * part_stream(rng, "angles").random(vehicle.n_rotors)
        kept = {"force": force, "rates": x[RATE], "angles": angles, "speeds": speed, "voltage": np.zeros(1)}
        inner += [kept[name][:size] for name, size in self._kept(vehicle).items()]
        return np.concatenate([[], *inner]), np.concatenate([[], *parameters])

    def columns(self, clock: Clock, vehicle: Vehicle) -> Mapping[str, int]:
        """True biases; what is told of speeds and voltage, and when what is told of each sensor was taken."""
        places, found = self._inner(clock, vehicle), dict[str, int]()
        for name, channel in self.channels(vehicle).items():
            first = places[name].start
            if channel.waits:
                found[f"taken_{name}"] = first + channel.taken
            if channel.drifts and name in BIASED:
                found |= {column: first + i for i, column in enumerate(BIASED[name])}
        measured = range(vehicle.n_rotors) if self.rotor_speed_of is None else self.rotor_speed_of
        if self._set("rotor_speed"):
            found |= {f"est_rotor_speed_{i}": places["speeds"].start + i for i in measured}
        return found | ({"est_battery_voltage": places["voltage"].start} if self._set("battery") else {})

    def stated(self, sheet: SensorSheet, vehicle: Vehicle) -> SensorSheet:
        """What is set, wrong by sheet_factor. An age of zero of the pose is nobody's statement, and an estimator's
        delay is none of the sensors'."""
        channels, changed = self.channels(vehicle), dict[str, Stated | None]()
        ages: dict[str, float | None] = {
            "accelerometer": self.accelerometer_delay,
            "gyroscope": None if self.later_rates else self.gyroscope_delay,
            "rotor_speed": self.rotor_speed_delay + self.rotor_speed_jitter / 2,
            "pose": self.pose_delay + self.pose_jitter / 2 or None,
            "attitude": None if self.later else 0.0,
        }
        for name, age in ages.items():
            if channel := channels.get(name):
                for quantity, place in self._quantities(name).items():
                    noise, drift = (float(numbers[place].max()) for numbers in (channel.noise, channel.first))
                    changed[quantity] = Stated(noise, drift, channel.rate, age).scaled(self.sheet_factor)
        if self.rotor_speed_of is not None and {*self.rotor_speed_of} != {*range(vehicle.n_rotors)}:
            changed["rotor_speed"] = None
        return replace(sheet, **changed)

    def measure(self, at: Readings, told: Told) -> tuple[ca.MX, Told]:
        vehicle, clock = at.vehicle, at.clock
        channels, places = self.channels(vehicle), self._inner(clock, vehicle)
        inner = {name: at.inner[place] for name, place in places.items()}
        parameters = _split(at.parameters, {name: one.sizes(clock).parameters for name, one in channels.items()})
        draws = _split(at.draws, {name: one.sizes(clock).draws for name, one in channels.items()})
        exact, kept = self._exact(at, told, inner)
        readings = {}
        for name, channel in channels.items():
            own = at._replace(inner=inner[name], parameters=parameters[name], draws=draws[name])
            inner[name], readings[name] = channel.measure(own, exact[name])
        state = told["state"]
        if "pose" in readings:
            pose = readings["pose"]
            attitude = readings.get("attitude", pose[3:-3])
            state = ca.vertcat(pose[:3], attitude, pose[-3:], state[RATE])
        if "gyroscope" in readings:
            state = ca.vertcat(state[: RATE.start], readings["gyroscope"])
        force = readings.get("accelerometer", told["specific_force"])
        kept |= {"speeds": readings.get("rotor_speed"), "voltage": readings.get("battery")}
        after = [inner[name] for name in channels] + [kept[name] for name, n in self._kept(vehicle).items() if n]
        return ca.vertcat(*after), told | {"state": state, "specific_force": force}

    def _exact(
        self, at: Readings, told: Told, inner: Mapping[str, ca.MX]
    ) -> tuple[dict[str, Callable[[Any], ca.MX]], dict[str, ca.MX]]:
        """What exact sensors read at a time (s) since the period began, by channel, and what is kept besides after it.

        Raises UsageError where neither airframe nor effects have the quantity.
        """
        clock, states = at.clock, History(at.states, at.clock)
        kept: dict[str, Any] = {"force": told["specific_force"]}

        def force(time: Any) -> ca.MX:
            return told["specific_force"]

        if self._kept(at.vehicle)["force"]:
            means = mean_forces(at.states, at.vehicle.gravity, clock)
            if self.accelerometer_cutoff:
                forces = low_passed(means, inner["force"], self.accelerometer_cutoff, clock)
                kept["force"] = forces.values[:, -1]
            else:
                forces = forces_at_steps(means, inner["force"], told["specific_force"], clock)
            force = forces.at
        if any(self.accelerometer_vibration):
            speeds = History(self._speeds(at, "accelerometer_vibration"), clock)
            turned = angles(speeds.values, inner["angles"], clock)
            kept["angles"] = ca.fmod(turned.values[:, -1], 2 * math.pi)
            shaking = self._shaking(turned, speeds, at.vehicle)
            still, force = force, lambda time: still(time) + shaking(time)
        rates = History(at.states[RATE, :], clock)
        if self.gyroscope_cutoff:
            means = (rates.values[:, :-1] + rates.values[:, 1:]) / 2
            rates = low_passed(means, inner["rates"], self.gyroscope_cutoff, clock)
            kept["rates"] = rates.values[:, -1]
        exact: dict[str, Callable[[Any], ca.MX]] = {"accelerometer": force, "gyroscope": rates.at}
        exact["pose"] = lambda time: _pose_of(states.state_at(time), self.attitude_age == "fresh")
        exact["attitude"] = lambda time: states.state_at(time)[ATTITUDE]
        if self._set("rotor_speed"):
            exact["rotor_speed"] = History(self._speeds(at, "rotor_speed"), clock).at
        if self._set("battery"):
            exact["battery"] = History(self._column(at, ["battery_voltage"], "battery", "a battery"), clock).at
        return exact, kept

    def _shaking(self, angle: History, speed: History, vehicle: Vehicle) -> Callable[[Any], ca.MX]:
        hover = math.sqrt(vehicle.hover_thrust / vehicle.static_thrust_coefficient)
        amplitude, cutoff = ca.DM(self.accelerometer_vibration), self.accelerometer_cutoff
        return lambda time: vibration(angle.at(time), speed.at(time), hover, amplitude, cutoff)

    def _speeds(self, at: Readings, keys: str) -> ca.MX:
        """Speeds of the rotors (n, steps + 1) (rad/s)."""
        names = [f"rotor_speed_{i}" for i in range(at.vehicle.n_rotors)]
        return self._column(at, names, keys, "vehicle.thrust_coefficient, and an actuator or a plant with rotor speeds")

    def _column(self, at: Readings, names: Sequence[str], keys: str, needed: str) -> ca.MX:
        try:
            return at.columns(names)
        except KeyError:
            raise UsageError(f"sensor={self.name}: sensor.{keys}..: needs {needed}") from None

    def _volts(self, voltage: Any, slow: Any, random: Any) -> Any:
        return in_steps(voltage + random, self.battery_step)

    def _counted(self, speed: Any, slow: Any, random: Any) -> Any:
        """Speeds (n,) as telegrams have them."""
        speed = speed * (1 + slow + random)
        pairs = self.rotor_speed_pole_pairs
        return in_steps(dshot_speed(speed, pairs) if pairs else speed, self.rotor_speed_step)

    def _quantities(self, name: str) -> dict[str, slice]:
        """Quantities of a channel, and which of its errors are theirs."""
        if name != "pose":
            return {name: slice(0, None)}
        names = ("position", "velocity") if self.attitude_age == "fresh" else ("position", "attitude", "velocity")
        return {quantity: slice(3 * i, 3 * i + 3) for i, quantity in enumerate(names)}


def _slices(sizes: Mapping[str, int]) -> dict[str, slice]:
    """Where each of some parts of a vector stands."""
    ends = [0, *accumulate(sizes.values())]
    return {name: slice(*pair) for name, pair in zip(sizes, pairwise(ends), strict=True)}


def _split(vector: ca.MX, sizes: Mapping[str, int]) -> dict[str, ca.MX]:
    return {name: vector[place] for name, place in _slices(sizes).items()}


def _pose_of(x: ca.MX, fresh: bool) -> ca.MX:
    """Position, attitude unless it is told fresh, and velocity of a state."""
    return ca.vertcat(x[POSITION], x[:0] if fresh else x[ATTITUDE], x[VELOCITY])


def _pose_with(pose: Any, slow: Any, random: Any) -> Any:
    error = slow + random
    if pose.numel() == error.numel():
        return pose + error
    return ca.vertcat(pose[:3] + error[:3], _turned(pose[3:7], error[3:6]), pose[7:] + error[6:])


def _turned(q: Any, error: Any) -> Any:
    """q o [1, e / 2], of unit length."""
    turned = ca.mtimes(left_matrix(q), ca.vertcat(1, error / 2))
    return turned / ca.norm_2(turned)
