"""Thrust curve: thrust of a rotor per vehicle mass, from the rotor signal that the log has.

    motor_command s' = s (V / V_ref)^g     a_i = c_1 s'_i + c_2 s'_i^2    m/s^2    (V_ref = 0: the voltage is not used)
    rotor_speed w                      a_i = c_2 w_i^2  (+ c_1 w_i)
    thrust_acceleration a_log          a = c_1 a_log + b, shared equally by the rotors
    u, static thrust in N              a_i = c_1 u_i    (c_1 is 1/mass where the thrust map is right)

    f_z = sum_i a_i + b - d_z v_z + e

The drag along z is fitted together with the curve: a climbing vehicle commands more thrust, so a curve fitted alone
would absorb part of d_z. The exponent g is 1 (NanoBench) or fitted, since the motor voltage is not the battery's
reading. By default the intercept b is fitted for the logged acceleration only: over the narrow band of commands of a
flight it cannot be distinguished from c_1 and c_2. It counts as thrust. Command with battery voltage: NanoBench (Ullah
& Baca, arXiv 2603.09908).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, NamedTuple

import msgspec
import numpy as np

from quadexp.errors import DataError
from quadexp.log.schema import Flight
from quadexp.models.base import Record, Rotors, Shape
from quadexp.models.regression import Regression, half_width
from quadexp.physics.state import root_mean_square
from quadexp.plugins.aerodynamics.blocks import regress
from quadexp.plugins.logs.samples import SIGNALS, Samples, late_signal, rotor_columns

# Powers of the signal in the curve, and the signals with an intercept by default.
POWERS = {"motor_command": (1, 2), "rotor_speed": (2,), "thrust_acceleration": (1,), "u": (1,)}
INTERCEPT = ("thrust_acceleration",)
DRAG_Z = "d_z"
EXPONENT_RANGE = (0.0, 3.0)  # from a thrust that does not depend on the voltage to its cube, the power's
SEARCH_SAMPLES = 40_000  # used by the search for the exponent; more are thinned evenly


class ThrustCurve(Record, frozen=True):
    """Thrust of a rotor per vehicle mass as a function of its signal.

    signal: a name in plugins.logs.samples.SIGNALS. powers: exponents. coefficients, errors: the same for all rotors,
    m/s^2 per signal^power. reference_voltage: V, 0 where the voltage is not used. voltage_exponent: g;
    voltage_exponent_error: 0 where g was not fitted. intercept, intercept_error: m/s^2, sum over all rotors. drag_z,
    drag_z_error: d_z, 1/s (0: not fitted). freedom: degrees of freedom of Student's t. condition: condition number.
    residual_std: root mean square residual along z, m/s^2. signal_range: smallest and largest signal of the fit. loss:
    "squares" or "huber". delay, lag: dead time and time constant of the thrust behind its signal (s). covariance: of
    the coefficients, (p, p); None in older files.
    """

    signal: Annotated[str, msgspec.Meta(pattern=f"^({'|'.join(SIGNALS)})$")]
    powers: Annotated[np.ndarray, Shape("powers")]
    coefficients: Annotated[np.ndarray, Shape("powers")]
    errors: Annotated[np.ndarray, Shape("powers")]
    reference_voltage: float = 0.0
    voltage_exponent: float = 1.0
    voltage_exponent_error: float = 0.0
    intercept: float = 0.0
    intercept_error: float = 0.0
    rotors: Rotors = 4
    drag_z: float = 0.0
    drag_z_error: float = 0.0
    freedom: int = 1
    condition: float = 1.0
    residual_std: float = 0.0
    signal_range: Annotated[np.ndarray | None, Shape("2")] = None
    loss: str = "squares"
    delay: float = 0.0
    lag: float = 0.0
    covariance: Annotated[np.ndarray | None, Shape("powers powers")] = None

    def rotor_acceleration(self, flight: Flight) -> np.ndarray:
        """Acceleration that each rotor's thrust gives, (k, n) (m/s^2), sample by sample.

        Raises DataError where the flight lacks the signal or its voltage.
        """
        columns = rotor_columns(flight, self.signal)
        if not columns:
            raise DataError(f"the flight has no column {self.signal}_0, which this thrust curve needs")
        voltage = flight["battery_voltage"] if self.reference_voltage else None
        signal = flight.stack(columns).astype(float)
        if self.delay or self.lag:
            segment = np.asarray(flight.columns.get("segment", np.zeros(len(flight))))
            held = np.zeros(len(flight), bool)
            signal = late_signal(np.asarray(flight.t, float), segment, signal, self.delay, self.lag, held=held)
        return self.of_signal(signal, voltage)

    def of_signal(self, signal: np.ndarray, voltage: np.ndarray | None) -> np.ndarray:
        """The same from the signal, (k, n), and the voltage, (k,) (V)."""
        scaled = scaled_signal(signal, voltage, self.reference_voltage, self.voltage_exponent)
        if self.signal == "thrust_acceleration":
            scaled = np.repeat(scaled / self.rotors, self.rotors, axis=1)
        elif scaled.shape[1] != self.rotors:
            raise DataError(f"{scaled.shape[1]} rotors in the flight, the thrust curve has {self.rotors}")
        terms = [c * scaled**power for c, power in zip(self.coefficients, self.powers, strict=True)]
        return np.sum(terms, axis=0) + self.intercept / self.rotors

    def collective(self, signal: np.ndarray) -> np.ndarray:
        """Acceleration of all rotors at the same signal, at the reference voltage: (k,) m/s^2 of (k,)."""
        columns = 1 if self.signal == "thrust_acceleration" else self.rotors
        voltage = np.full(len(signal), self.reference_voltage)
        return self.of_signal(np.tile(signal[:, None], columns), voltage).sum(axis=1)

    @property
    def has_intercept(self) -> bool:
        """Whether an intercept was fitted."""
        return self.intercept_error > 0

    @property
    def slope_range(self) -> tuple[float, float]:
        """Least and largest da/ds over the range of the fit; a negative one indicates a wrong curve."""
        low, high = (0.0, 1.0) if self.signal_range is None else self.signal_range
        grid = np.linspace(low, high, 200)
        slope = sum(c * p * grid ** (p - 1) for c, p in zip(self.coefficients, self.powers, strict=True))
        return float(np.min(slope)), float(np.max(slope))

    def __str__(self) -> str:
        scaled = f"{self.signal} V/{self.reference_voltage:g}" if self.reference_voltage else self.signal
        terms = []
        if self.reference_voltage and (self.voltage_exponent != 1 or self.voltage_exponent_error):
            half = half_width(self.voltage_exponent_error, self.freedom)
            scaled = f"{self.signal} (V/{self.reference_voltage:g})^g"
            terms.append(f"g {self.voltage_exponent:.3g} +- {half:.2g}")
        curve = zip(self.powers, self.coefficients, half_width(self.errors, self.freedom), strict=True)
        terms.append(", ".join(f"c_{p:g} {c:.6g} +- {half:.2g}" for p, c, half in curve))
        if self.has_intercept:
            terms.append(f"b {self.intercept:.4g} +- {half_width(self.intercept_error, self.freedom):.2g}")
        text = f"on {scaled}: {'; '.join(terms)}"
        if self.delay:
            text += f"; commands {1e3 * self.delay:.3g} ms late"
        if self.lag:
            text += f"; motor lag {1e3 * self.lag:.3g} ms"
        return text


def scaled_signal(
    signal: np.ndarray, voltage: np.ndarray | None, reference_voltage: float, exponent: float
) -> np.ndarray:
    """s (V / V_ref)^g, (k, n); without a reference voltage the signal itself."""
    if not reference_voltage:
        return signal
    if voltage is None:
        raise DataError("the thrust curve uses the battery voltage, the flight has no column 'battery_voltage'")
    return signal * ((voltage / reference_voltage) ** exponent)[:, None]


class CurveDesign(NamedTuple):
    """Columns of the regression of the specific force along z: sum_i s'_i^p of every power, 1 if there is an intercept,
    -v_z if the drag is fitted. reference_voltage: V."""

    powers: tuple[int, ...]
    intercept: bool
    reference_voltage: float
    drag: bool = True

    @property
    def names(self) -> list[str]:
        """Of the columns."""
        names = [f"c_{power}" for power in self.powers]
        if self.intercept:
            names.append("b_z")
        if self.drag:
            names.append(DRAG_Z)
        return names

    def columns(self, samples: Samples, exponent: float) -> np.ndarray:
        """(k, p)."""
        scaled = scaled_signal(samples.signal, samples.voltage, self.reference_voltage, exponent)
        columns = [np.sum(scaled**power, axis=1) for power in self.powers]
        if self.intercept:
            columns.append(np.ones(len(samples)))
        if self.drag:
            columns.append(-samples.velocity[:, 2])
        return np.column_stack(columns)

    def least_exponent(self, samples: Samples) -> float:
        """The exponent with the least sum of squared residuals."""
        from scipy.optimize import minimize_scalar

        target = samples.force[:, 2]

        def squares(exponent: float) -> float:
            columns = self.columns(samples, exponent)
            residual = target - columns @ np.linalg.lstsq(columns, target, rcond=None)[0]
            return float(residual @ residual)

        return float(minimize_scalar(squares, bounds=EXPONENT_RANGE, method="bounded", options={"xatol": 1e-7}).x)


@dataclass(frozen=True)
class CurveSettings:
    """How a thrust curve is fitted.

    reference_voltage: V; 0: the voltage is not used; None: 4 V per cell for motor commands, by the median voltage.
    voltage_exponent: g, None to fit it. powers: None for those of POWERS.
    """

    reference_voltage: float | None = None
    voltage_exponent: float | None = 1.0
    powers: tuple[int, ...] | None = None

    def voltage_for(self, samples: Samples) -> float:
        """The reference voltage, V. Raises DataError where it needs a voltage that the samples lack."""
        if self.reference_voltage is None:
            if samples.kind != "motor_command" or samples.voltage is None:
                return 0.0
            return 4.0 * max(1, round(float(np.median(samples.voltage)) / 3.8))
        if self.reference_voltage and samples.voltage is None:
            raise DataError(f"{samples.names[0]}: column 'battery_voltage' is missing, which a reference voltage needs")
        return float(self.reference_voltage)


def fit_thrust_samples(
    samples: Samples, settings: CurveSettings, *, drag: bool = True, intervals: bool = True
) -> tuple[ThrustCurve, Regression]:
    """Fit the curve to the specific force along body z; returns it with its regression.

    samples: from `gather`. drag: fit d_z too. intervals: False computes errors for independent samples only, and none
    for g. The regression's columns are those of `CurveDesign`.
    Raises DataError where a voltage is missing or the data do not determine the curve.
    """
    kind = samples.kind
    powers = tuple(settings.powers or POWERS[kind])
    design = CurveDesign(powers, kind in INTERCEPT, settings.voltage_for(samples), drag)
    reference = design.reference_voltage
    fit_exponent = settings.voltage_exponent is None and bool(reference)
    exponent = 1.0 if settings.voltage_exponent is None else settings.voltage_exponent
    if fit_exponent:
        exponent = design.least_exponent(samples.thinned(SEARCH_SAMPLES))

    def fit(columns: np.ndarray, names: list[str]) -> Regression:
        return regress(
            columns, samples.force[:, 2], names, samples.segment, samples.flight,
            what=f"thrust curve on {kind}", intervals=intervals,
        )  # fmt: skip

    columns = design.columns(samples, exponent)
    regression = fit(columns, design.names)
    if samples.later is not None and intervals:  # one standard error of the delay
        later = fit(design.columns(replace(samples, signal=samples.later), exponent), design.names)
        behind = later.coefficients - regression.coefficients
        regression = replace(regression, covariance=regression.covariance + np.outer(behind, behind))
    scaled = scaled_signal(samples.signal, samples.voltage, reference, exponent)
    count = len(powers)
    exponent_error = 0.0
    if fit_exponent and intervals:  # the regression linearised in g, with da/dg as a further column
        assert samples.voltage is not None
        terms = [c * p * scaled**p for c, p in zip(regression.coefficients, powers, strict=False)]
        by_exponent = np.sum(terms, axis=0).sum(axis=1) * np.log(samples.voltage / reference)
        at = count + design.intercept
        joint = fit(np.insert(columns, at, by_exponent, axis=1), np.insert(design.names, at, "g").tolist())
        exponent_error = float(joint.errors[at])
        others = np.arange(len(joint.names)) != at
        regression = replace(
            regression, covariance=joint.covariance[np.ix_(others, others)], condition=joint.condition,
            freedom=joint.freedom + 1,  # without g
        )  # fmt: skip
    value = regression.coefficients
    error = regression.errors
    curve = ThrustCurve(
        kind,
        np.array(powers, float),
        value[:count],
        error[:count],
        reference_voltage=reference,
        voltage_exponent=float(exponent),
        voltage_exponent_error=exponent_error,
        intercept=float(value[count]) if design.intercept else 0.0,
        intercept_error=float(error[count]) if design.intercept else 0.0,
        rotors=4 if kind == "thrust_acceleration" else samples.signal.shape[1],  # which share a logged acceleration
        drag_z=float(value[-1]) if drag else 0.0,
        drag_z_error=float(error[-1]) if drag else 0.0,
        freedom=int(regression.freedom),
        condition=regression.condition,
        residual_std=root_mean_square(regression.residual),
        signal_range=np.array([scaled.min(), scaled.max()]),
        delay=samples.delay,
        lag=samples.lag,
        covariance=regression.covariance[:count, :count],
    )
    return curve, regression


def thrust_columns(curve: ThrustCurve, samples: Samples) -> np.ndarray:
    """The regressors of a curve, with that of d_z as the last column, (k, p)."""
    design = CurveDesign(tuple(curve.powers.astype(int).tolist()), curve.has_intercept, curve.reference_voltage)
    return design.columns(samples, curve.voltage_exponent)
