"""What is known of a vehicle: numbers with units, 95 % intervals and origin.

Of a rotor at signal s and battery voltage V, with the curve of quadexp.plugins.identification.thrust_curve:

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
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from quadexp.errors import UsageError
from quadexp.models.base import Model
from quadexp.models.regression import half_width
from quadexp.physics.state import root_mean_square
from quadexp.physics.vehicle import Vehicle

AXES = "xyz"
IDENTIFIED = "identified"
FROM_FILE = "from the vehicle file"
GIVEN = "given"
UNKNOWN = "not known"
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

    def not_negative(self) -> Quantity:
        """A drag, or 0 where it would push, with what was identified as a note."""
        if self.value >= 0:
            return self
        half = "" if self.half_width is None else f" +- {self.half_width:.3g}"
        return self.changed(0.0, f"{self.value:.6g}{half} would push: written as 0")

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
        return self.mass * self.gravity / self.n_rotors

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
    model: Model | None
    signal: str
    k_of: str
    voltage: float | None
    facts: dict[str, Fact]
    together: dict[tuple[str, str], float]

    def value(self, formula: Formula) -> Any:
        return formula(Reading(self._values(), self.k_of))

    def _values(self) -> dict[str, Any]:
        return {name: fact.value for name, fact in self.facts.items()}

    def quantity(self, formula: Formula, unit: str) -> Quantity:
        """The formula of the facts, a number or an array, with interval and origin."""
        values = self._values()
        reading = Reading(values, self.k_of)
        value = formula(reading)
        uncertain = [name for name in sorted(reading.names) if self.facts[name].freedom]
        slopes = {}
        for name in uncertain:
            step = SLOPE_STEP * self.facts[name].error or 1e-12
            above = formula(Reading({**values, name: values[name] + step}, self.k_of))
            below = formula(Reading({**values, name: values[name] - step}, self.k_of))
            slopes[name] = (above - below) / (2 * step)
        origin = self._origin(reading.names)
        if not uncertain:
            return Quantity(value, unit, origin)
        variance = np.zeros(np.shape(value))
        for name in uncertain:
            for other in uncertain:
                variance = variance + slopes[name] * slopes[other] * self._covariance(name, other)
        freedom = min(self.facts[name].freedom for name in uncertain)
        return Quantity(value, unit, origin, half_width(np.sqrt(np.maximum(variance, 0)), freedom))

    def times_mass(self, name: str, unit: str) -> Quantity:
        """A fact that is per mass, times the mass."""
        return self.quantity(lambda p: p.mass * getattr(p, name), unit)

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
        spins_in_order = [int(self.vehicle.rotor_spin[i]) for i in order]
        if spins_in_order != list(spins):
            raise UsageError(
                f"--to {target}: rotors {', '.join(quadrants)} have reaction torques of the signs {list(spins)} there, "
                f"vehicle={self.vehicle.name} has {spins_in_order}: they turn the other way"
            )
        return order

    def same_arms(self, target: str) -> None:
        """All rotors at one distance from the x axis, and at one from the y axis."""
        arms = np.abs(np.array(self.vehicle.rotor_position, float)[:, :2])
        if not np.allclose(arms, arms[0], rtol=1e-3):
            raise UsageError(f"--to {target}: has one arm along x and one along y, the rotors are at {arms.tolist()}")

    # How a target's force compares with that of the model.
    def departure(self, force: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> list[str]:
        """A line: how far a target's specific force is from the whole model's, offsets aside, at random states inside
        the range of its fit and at no rates; none without a model.

        force: of velocity (k, 3) (m/s) and thrusts per mass (k, n) (m/s^2), beyond the rotors' thrust, (k, 3) (m/s^2).
        """
        if self.model is None:
            return []
        rng = np.random.default_rng(0)
        low, high = np.transpose([self.model.feature_range[f"v_{axis}"] for axis in AXES])
        velocity = rng.uniform(low, high, (STATES, 3))
        thrust = self.vehicle.hover_thrust * rng.uniform(*THRUSTS, (STATES, self.vehicle.n_rotors))
        features = np.hstack([velocity, np.zeros_like(velocity), thrust])
        ours = self.model.residual(self.vehicle)(features)[:, :3]
        ours -= [self.facts[f"offset_{axis}"].value for axis in AXES]
        per_mass = thrust / self.vehicle.mass
        theirs = force(velocity, per_mass)
        theirs[:, 2] += (self.facts["sigma"].value - 1) * per_mass.sum(axis=1)
        difference = root_mean_square(theirs - ours)
        ours[:, 2] += per_mass.sum(axis=1)
        share = 100 * difference / root_mean_square(ours)
        return [f"specific force here: {share:.3g} % (rms) from that of the whole model, over the range of its fit"]


def known_of(
    vehicle: Vehicle, model: Model | None = None, *, voltage: float | None = None, motor_lag: float | None = None
) -> Known:
    """All that is known. voltage: V at which the numbers hold; None: the curve's reference. motor_lag: time constant
    (s); None: the curve's.

    Raises UsageError for a voltage that nothing depends on.
    """
    curve = getattr(model, "thrust", None)
    at = _voltage(curve, voltage)
    k_of = ""
    facts = _of_vehicle(vehicle)
    together: dict[tuple[str, str], float] = {}
    if vehicle.thrust_coefficient is not None:
        facts["thrust_coefficient"] = Fact(vehicle.thrust_coefficient, FROM_FILE)
        k_of = "corrected" if curve is None else "file"
    if model is not None:
        facts |= _of_air(model, vehicle.mass)
    if curve is not None:
        of_curve, together = _of_curve(curve, at)
        facts |= of_curve
        if curve.signal == "rotor_speed" and curve.powers.tolist() == [2]:
            k_of = "curve"
        if curve.lag:
            facts["lag"] = Fact(curve.lag, IDENTIFIED)
    if motor_lag is not None:
        facts["lag"] = Fact(motor_lag, GIVEN)
    return Known(vehicle, model, curve.signal if curve else "", k_of, at, facts, together)


def _voltage(curve: Any, voltage: float | None) -> float | None:
    """At which a curve holds; None where there is none, or it does not use the voltage."""
    if curve is not None and curve.reference_voltage:
        return float(curve.reference_voltage if voltage is None else voltage)
    if voltage is not None:
        raise UsageError(f"--voltage {voltage:g}: nothing that is known here depends on the battery's voltage")
    return None


def _of_vehicle(vehicle: Vehicle) -> dict[str, Fact]:
    """Numbers of the vehicle file; the air and the motors' lag are not known from there."""
    names = ("mass", "gravity", "n_rotors", "torque_coefficient", "thrust_max")
    facts = {name: Fact(getattr(vehicle, name), FROM_FILE) for name in names}
    facts |= {f"{kind}_{axis}": Fact(0.0, UNKNOWN) for kind in ("d", "offset") for axis in AXES}
    return facts | {"sigma": Fact(1.0, ""), "lag": Fact(0.0, UNKNOWN)}


def _of_air(model: Any, mass: float) -> dict[str, Fact]:
    """Linear drag of every kind of model, and the coefficients of a blade-element model per rotor speed."""
    drag = model.linear_drag
    facts: dict[str, Fact] = {}
    for i, axis in enumerate(AXES):
        facts[f"d_{axis}"] = Fact(drag.drag[i], IDENTIFIED, drag.drag_error[i], drag.freedom[i])
        facts[f"offset_{axis}"] = Fact(drag.intercept[i], IDENTIFIED, drag.intercept_error[i], drag.freedom[3 + i])
    if drag.thrust_gain:
        facts["sigma"] = Fact(1 + mass * drag.thrust_gain, IDENTIFIED, mass * drag.thrust_gain_error, drag.freedom[6])
    if not hasattr(model, "models"):
        return facts
    air = model.model()  # which identification chose
    facts |= {f"offset_{axis}": _term(air, axis, "offset") for axis in "xy"}
    scale = _term(air, "z", "thrust")
    facts["sigma"] = scale._replace(value=1 + scale.value)
    if is_per_speed(air):
        facts |= {name: _term(air, "z", name) for name in ("climb", "advance")}
        facts |= {f"hub_{axis}": _term(air, axis, "hub") for axis in "xy"}
        facts |= {f"body_{axis}": _term(air, axis, "body") for axis in AXES}
    return facts


def _term(air: Any, axis: str, term: str) -> Fact:
    """Coefficient of a model of terms; 0 where it has none."""
    value, error = air.coefficient(axis, term)
    i = AXES.index(axis)
    if term in air.terms[i]:
        return Fact(value, IDENTIFIED, error, air.freedom[i])
    return Fact(0.0, "")


def is_per_speed(air: Any) -> bool:
    """Whether a model's drag is per rotor speed, with the loss of thrust in climb: the blade element without radius."""
    return air.kind == "blade_element" and "climb" in air.terms[2]


def _of_curve(curve: Any, at: float | None) -> tuple[dict[str, Fact], dict[tuple[str, str], float]]:
    """c1 and c2 at a voltage, and their covariance. An older checkpoint has none: then there is no interval of two."""
    ratio = 1.0 if at is None else at / curve.reference_voltage
    scales = ratio ** (curve.powers * curve.voltage_exponent)
    values = curve.coefficients * scales
    covariance = np.diag(curve.errors**2) if curve.covariance is None else curve.covariance
    slopes = values * curve.powers * np.log(ratio)  # dc/dg
    covariance = covariance * np.outer(scales, scales) + np.outer(slopes, slopes) * curve.voltage_exponent_error**2
    freedom = 0 if curve.covariance is None and len(values) > 1 else curve.freedom
    facts = {"c1": Fact(0.0, ""), "c2": Fact(0.0, "")}
    for i, power in enumerate(curve.powers.astype(int)):
        facts[f"c{power}"] = Fact(float(values[i]), IDENTIFIED, float(np.sqrt(covariance[i, i])), freedom)
    return facts, {("c1", "c2"): float(covariance[0, 1])} if len(values) > 1 else {}
