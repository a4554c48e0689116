"""What is known of a vehicle: numbers with units, 95 % intervals and origin.

Of a rotor at signal s and battery voltage V, with the thrust curve of `identify` (quadexp.models.thrust_curve):

    r     = (V / V_ref)^g                    1 where the curve does not use the voltage
    a     = c1 s + c2 s^2                    thrust per vehicle mass, m/s^2; c1, c2: the curve's times r, r^2
    sigma = 1 + term `thrust`                what the model of the air says of the curve's scale
    T     = m sigma a                        N
    f     = c2 / (c1 + c2)                   T / T(1) = (1 - f) s + f s^2
    k     = m sigma c2                       of a curve on rotor speeds, T = k w^2, N s^2; else the vehicle file's
    kappa = sqrt(k / (m sigma))              sqrt(a) = kappa w, which turns coefficients per sqrt(a) into those per w

Without a curve the thrusts are those of the vehicle file, T = sigma k w^2. A quantity of a target is a formula of
these; its interval follows from theirs by its slope (delta method), its origin from what the formula reads.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from quadexp.errors import UsageError
from quadexp.models.base import Model
from quadexp.models.regression import half_width
from quadexp.models.residual import feature_names
from quadexp.physics.state import root_mean_square
from quadexp.physics.vehicle import Vehicle

AXES = "xyz"
IDENTIFIED, FROM_FILE, GIVEN, UNKNOWN = "identified", "from the vehicle file", "given", "not known"
SLOPE_STEP = 1e-3  # of a standard error, for slopes of formulas
STATES = 500  # random states at which a target is compared with the model
THRUSTS = (0.3, 1.9)  # their range, per thrust in hover


class Fact(NamedTuple):
    """A number that is known, or not. origin: "" where nothing says that it is another than it always is. error:
    standard error. freedom: of Student's t; 0: no interval."""

    value: Any
    origin: str
    error: float = 0.0
    freedom: float = 0.0


class Quantity(NamedTuple):
    """A number of a target. half_width: of the 95 % interval; None: there is none. note: what was done to it."""

    value: Any
    unit: str
    origin: str
    half_width: Any = None
    note: str = ""

    @property
    def interval(self) -> str:
        """As text; several numbers have one each."""
        if self.half_width is None:
            return ""
        pairs = zip(np.ravel(self.value), np.ravel(self.half_width), strict=True)
        return " ".join(f"[{value - half:.6g}, {value + half:.6g}]" for value, half in pairs)

    def at_least(self, least: float, why: str) -> Quantity:
        """The quantity, or the bound with what was identified as a note; of one number."""
        if self.value >= least:
            return self
        half = "" if self.half_width is None else f" +- {self.half_width:.3g}"
        note = f"{self.value:.6g}{half} {why}: written as {least:g}"
        return self.changed(least, note)

    def times(self, factor: float, unit: str, name: str) -> Quantity:
        """The quantity times a number of the vehicle file, by its name."""
        half = None if self.half_width is None else abs(factor) * self.half_width
        return Quantity(factor * self.value, unit, f"{self.origin}, times {name} {FROM_FILE}", half, self.note)

    def changed(self, value: Any, note: str) -> Quantity:
        """Another value, which has no interval."""
        return self._replace(value=value, half_width=None, note=note)


def of_file(value: Any, unit: str) -> Quantity:
    """A number of the vehicle file."""
    return Quantity(value, unit, FROM_FILE)


class Reading:
    """The facts as attributes, and what follows from them; `names` are those that were read.

    k_of: where k is from: "curve", "file", "corrected" (the file's, times sigma), or "" where it is not known.
    """

    def __init__(self, values: dict[str, Any], k_of: str) -> None:
        self._values = values
        self._k_of = k_of
        self.names: set[str] = set()

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or name not in self._values:
            raise AttributeError(name)
        self.names.add(name)
        return self._values[name]

    @property
    def k(self) -> Any:
        """Thrust per rotor speed squared (N s^2)."""
        if self._k_of == "curve":
            return self.mass * self.sigma * self.c2
        return self.thrust_coefficient * (self.sigma if self._k_of == "corrected" else 1.0)

    @property
    def kappa(self) -> Any:
        """sqrt(a) per rotor speed (sqrt(m))."""
        if self._k_of == "curve":
            return np.sqrt(self.c2)
        if self._k_of == "corrected":
            return np.sqrt(self.thrust_coefficient / self.mass)
        return np.sqrt(self.thrust_coefficient / (self.mass * self.sigma))

    @property
    def hover_thrust(self) -> Any:
        """Of a rotor (N)."""
        return self.mass * self.gravity / self.rotors

    @property
    def hover_speed(self) -> Any:
        """Of a rotor (rad/s)."""
        return np.sqrt(self.hover_thrust / self.k)

    @property
    def full_thrust(self) -> Any:
        """Of a rotor at full command (N)."""
        return self.mass * self.sigma * (self.c1 + self.c2)

    @property
    def share(self) -> Any:
        """f, the share of the square in the thrust curve."""
        return self.c2 / (self.c1 + self.c2)


Formula = Callable[[Any], Any]


@dataclass(frozen=True)
class Known:
    """vehicle: of the configuration. model: of a checkpoint; None: the vehicle alone. signal: of the thrust curve, ""
    without one. k_of: see Reading. voltage: V, None where nothing depends on it. together: covariance of pairs."""

    vehicle: Vehicle
    model: Model | None = None
    signal: str = ""
    k_of: str = ""
    voltage: float | None = None
    facts: dict[str, Fact] = field(default_factory=dict)
    together: dict[tuple[str, str], float] = field(default_factory=dict)

    def value(self, formula: Formula) -> Any:
        return formula(self._reading({name: fact.value for name, fact in self.facts.items()}))

    def _reading(self, values: dict[str, Any]) -> Reading:
        return Reading(values, self.k_of)

    def quantity(self, formula: Formula, unit: str) -> Quantity:
        """The formula of the facts, a number or an array, with interval and origin."""
        values = {name: fact.value for name, fact in self.facts.items()}
        reading = self._reading(values)
        value = formula(reading)
        uncertain = [name for name in sorted(reading.names) if self.facts[name].freedom]
        slopes = {}
        for name in uncertain:
            step = SLOPE_STEP * self.facts[name].error or 1e-12
            ends = [formula(self._reading({**values, name: values[name] + side * step})) for side in (1, -1)]
            slopes[name] = (np.asarray(ends[0], float) - np.asarray(ends[1], float)) / (2 * step)
        origin = self._origin(reading.names)
        if not uncertain:
            return Quantity(value, unit, origin)
        variance = np.zeros(np.shape(value))
        for name in uncertain:
            for other in uncertain:
                variance = variance + slopes[name] * slopes[other] * self._covariance(name, other)
        freedom = min(self.facts[name].freedom for name in uncertain)
        return Quantity(value, unit, origin, half_width(np.sqrt(np.maximum(variance, 0)), freedom))

    def _covariance(self, name: str, other: str) -> float:
        if name == other:
            return self.facts[name].error ** 2
        return self.together.get((name, other), self.together.get((other, name), 0.0))

    def _origin(self, names: set[str]) -> str:
        """Where the facts are from; those of the vehicle file are named beside what is identified."""
        kinds = {self.facts[name].origin for name in names}
        if UNKNOWN in kinds:
            return UNKNOWN
        if IDENTIFIED not in kinds:
            return GIVEN if GIVEN in kinds else FROM_FILE
        of_file = sorted(name for name in names if self.facts[name].origin == FROM_FILE)
        return f"{IDENTIFIED}, with {', '.join(of_file)} {FROM_FILE}" if of_file else IDENTIFIED

    # What a target needs; each raises UsageError where it is not known.
    def require_commands(self, target: str) -> None:
        """A curve on motor commands (0 to 1), which an autopilot's thrust curve is."""
        if self.signal != "motor_command":
            has = f"the curve is on {self.signal}" if self.signal else "there is no thrust curve"
            raise UsageError(
                f"--to {target}: needs a thrust curve on motor commands (0 to 1), {has}: "
                "`quadexp identify` finds it from flights with motor_command_0, motor_command_1, ..."
            )

    def require_speeds(self, target: str) -> None:
        """k, thrust per rotor speed squared."""
        if not self.k_of:
            raise UsageError(
                f"--to {target}: needs the thrust per rotor speed squared, which is not known: neither does "
                f"vehicle={self.vehicle.name} have thrust_coefficient, nor is there a thrust curve on rotor speeds, "
                "c_2 w^2, of `quadexp identify`"
            )

    def place(self, target: str, quadrants: tuple[str, ...], spins: tuple[int, ...]) -> list[int]:
        """Indices of the rotors in a target's order: front or back (f, b), left or right (l, r), with its spins."""
        position = np.array(self.vehicle.rotor_position, float)
        order = []
        for quadrant in quadrants:
            x = 1 if quadrant[0] == "f" else -1
            y = 1 if quadrant[1] == "l" else -1
            order += np.flatnonzero((position[:, 0] * x > 0) & (position[:, 1] * y > 0)).tolist()
        if sorted(order) != list(range(4)) or self.vehicle.n_rotors != 4:
            raise UsageError(
                f"--to {target}: has four rotors in an x ({', '.join(quadrants)}), vehicle={self.vehicle.name} has "
                f"{self.vehicle.n_rotors} at {position[:, :2].tolist()}"
            )
        found = [int(self.vehicle.rotor_spin[i]) for i in order]
        if found != list(spins):
            raise UsageError(
                f"--to {target}: rotors {', '.join(quadrants)} have reaction torques of the signs {list(spins)} there, "
                f"vehicle={self.vehicle.name} has {found}: they turn the other way"
            )
        return order

    def same_arms(self, target: str) -> None:
        """All rotors at one distance from the x axis, and at one from the y axis."""
        arms = np.abs(np.array(self.vehicle.rotor_position, float)[:, :2])
        if not np.allclose(arms, arms[0], rtol=1e-3):
            raise UsageError(f"--to {target}: has one arm along x and one along y, the rotors are at {arms.tolist()}")

    # How a target's force compares with that of the model.
    def departure(self, force: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> str:
        """A line: how far a target's specific force is from the model's at random states inside the range of its fit; ""
        without a model.

        force: of velocity (k, 3) (m/s) and thrusts per mass (k, n) (m/s^2), beyond the rotors' thrust, (k, 3) (m/s^2).
        """
        if self.model is None:
            return ""
        rng = np.random.default_rng(0)
        ranges = self.model.feature_range
        velocity = np.stack([rng.uniform(*ranges[f"v_{axis}"], STATES) for axis in AXES], axis=1)
        thrust = self.vehicle.hover_thrust * rng.uniform(*THRUSTS, (STATES, self.vehicle.n_rotors))
        ours = self.model_force(velocity, thrust)
        theirs = force(velocity, thrust / self.vehicle.mass)
        sigma = self.value(lambda p: p.sigma)
        theirs[:, 2] += sigma * thrust.sum(axis=1) / self.vehicle.mass
        share = root_mean_square(theirs - ours) / root_mean_square(ours)
        return f"specific force here: {100 * share:.3g} % (rms) from that of the whole model, over the range of its fit"

    def model_force(self, velocity: np.ndarray, thrust: np.ndarray) -> np.ndarray:
        """Specific force, (k, 3) body (m/s^2), of the whole model without its offsets, at no rates.

        velocity: (k, 3) (m/s). thrust: of the curve, (k, n) (N)."""
        assert self.model is not None
        features = np.zeros((len(velocity), len(feature_names(self.vehicle.n_rotors))))
        features[:, :3] = velocity
        features[:, 6:] = thrust
        force = self.model.residual(self.vehicle)(features)[:, :3]
        force -= [self.facts[f"offset_{axis}"].value for axis in AXES]
        force[:, 2] += thrust.sum(axis=1) / self.vehicle.mass
        return force


def known_of(
    vehicle: Vehicle, model: Model | None = None, *, voltage: float | None = None, motor_lag: float | None = None
) -> Known:
    """All that is known. voltage: V at which the numbers hold; None: the curve's reference. motor_lag: s, time constant;
    None: the curve's.

    Raises UsageError for a voltage that nothing depends on.
    """
    file = {
        "mass": vehicle.mass, "gravity": vehicle.gravity, "rotors": vehicle.n_rotors, "c_tau": vehicle.torque_coefficient,
        "thrust_max": vehicle.thrust_max,
    }  # fmt: skip
    facts = {name: Fact(value, FROM_FILE) for name, value in file.items()}
    facts["sigma"] = Fact(1.0, "")
    for axis in AXES:
        facts[f"d_{axis}"] = Fact(0.0, UNKNOWN)
        facts[f"offset_{axis}"] = Fact(0.0, UNKNOWN)
    curve = getattr(model, "thrust", None)
    k_of = ""
    if vehicle.thrust_coefficient is not None:
        facts["thrust_coefficient"] = Fact(vehicle.thrust_coefficient, FROM_FILE)
        k_of = "corrected" if curve is None else "file"
    known = Known(vehicle, model, facts=facts, k_of=k_of)
    if model is not None:
        known = _of_air(known, model)
    if curve is not None:
        known = _of_curve(known, curve, voltage)
    if voltage is not None and known.voltage is None:
        raise UsageError(f"--voltage {voltage:g}: nothing that is known here depends on the battery's voltage")
    lag = Fact(0.0, UNKNOWN)
    if motor_lag is not None:
        lag = Fact(motor_lag, GIVEN)
    elif curve is not None and curve.lag:
        lag = Fact(curve.lag, IDENTIFIED)
    return _with(known, lag=lag)


def _with(known: Known, **facts: Fact) -> Known:
    return replace(known, facts=known.facts | facts)


def _of_air(known: Known, model: Any) -> Known:
    """Linear drag of every kind of model, and the coefficients of a blade-element model per rotor speed."""
    drag = model.linear_drag
    facts: dict[str, Fact] = {}
    for i, axis in enumerate(AXES):
        facts[f"d_{axis}"] = Fact(drag.drag[i], IDENTIFIED, drag.drag_error[i], drag.freedom[i])
        facts[f"offset_{axis}"] = Fact(drag.intercept[i], IDENTIFIED, drag.intercept_error[i], drag.freedom[3 + i])
    mass = known.vehicle.mass
    if drag.thrust_gain:
        facts["sigma"] = Fact(1 + mass * drag.thrust_gain, IDENTIFIED, mass * drag.thrust_gain_error, drag.freedom[6])
    if hasattr(model, "models"):
        facts |= _of_terms(model.model())
    return _with(known, **facts)


def _of_terms(air: Any) -> dict[str, Fact]:
    """The terms of the model that identification chose."""

    def fact(axis: str, term: str, base: float = 0.0) -> Fact:
        value, error = air.coefficient(axis, term)
        if term not in air.terms[AXES.index(axis)]:
            return Fact(base, "")
        return Fact(base + value, IDENTIFIED, error, air.freedom[AXES.index(axis)])

    facts = {"sigma": fact("z", "thrust", base=1.0)}
    facts |= {f"offset_{axis}": fact(axis, "offset") for axis in "xy"}
    if is_per_speed(air):
        facts |= {"climb": fact("z", "climb"), "advance": fact("z", "advance")}
        facts |= {"hub_x": fact("x", "hub"), "hub_y": fact("y", "hub")}
        facts |= {f"body_{axis}": fact(axis, "body") for axis in AXES}
    return facts


def is_per_speed(air: Any) -> bool:
    """Whether a model's drag is per rotor speed, with the loss of thrust in climb: the blade element without radius."""
    return air.kind == "blade_element" and "climb" in air.terms[2]


def _of_curve(known: Known, curve: Any, voltage: float | None) -> Known:
    """c1, c2 at the voltage; k of a curve on rotor speeds."""
    at = None
    if curve.reference_voltage:
        at = curve.reference_voltage if voltage is None else voltage
    ratio = 1.0 if at is None else at / curve.reference_voltage
    facts = {"c1": Fact(0.0, ""), "c2": Fact(0.0, "")}
    powers = [int(power) for power in curve.powers]
    scales = [ratio ** (power * curve.voltage_exponent) for power in powers]
    covariance = np.diag(curve.errors**2) if curve.covariance is None else curve.covariance
    covariance = covariance * np.outer(scales, scales)
    if curve.voltage_exponent_error and ratio != 1:  # dc/dg = c power ln(V / V_ref)
        slope = curve.coefficients * scales * powers * np.log(ratio)
        covariance = covariance + np.outer(slope, slope) * curve.voltage_exponent_error**2
    for i, power in enumerate(powers):
        value = float(curve.coefficients[i] * scales[i])
        facts[f"c{power}"] = Fact(value, IDENTIFIED, float(np.sqrt(covariance[i, i])), curve.freedom)
    together = {("c1", "c2"): float(covariance[0, 1])} if powers == [1, 2] else {}
    on_speeds = curve.signal == "rotor_speed" and powers == [2]
    k_of = "curve" if on_speeds else known.k_of
    return replace(_with(known, **facts), signal=curve.signal, voltage=at, together=together, k_of=k_of)
