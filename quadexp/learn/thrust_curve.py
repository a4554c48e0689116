"""Thrust of the rotors per mass, from whatever the log says of them.

    motor_command s' = s (V / V_ref)^g     a_i = c_1 s'_i + c_2 s'_i^2    m/s^2    (V_ref = 0: the voltage is not used)
    rotor_speed w                      a_i = c_2 w_i^2  (+ c_1 w_i)
    thrust_acceleration a_log          a = c_1 a_log + b, shared equally by the rotors
    u, static thrust in N              a_i = c_1 u_i    (c_1 is 1/mass where the thrust map is right)

    f_z = sum_i a_i + b - d_z v_z + e

The drag along z is fitted with the curve: a vehicle that climbs commands more thrust, and a curve fitted alone takes a
part of d_z for its own. The exponent g is 1 (NanoBench), or is fitted: what the battery reads is not what the motors
get. The intercept b is fitted with the logged acceleration only, unless asked for: beside c_1 and
c_2, over the narrow band of commands that a flight uses, it takes their place. It counts as thrust.
Command with battery voltage: NanoBench (Ullah & Baca, arXiv 2603.09908).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from quadexp.errors import DataError, UsageError
from quadexp.learn.regression import CONDITION_LIMIT, Regression, half_width, regress
from quadexp.learn.samples import Samples, rotor_columns
from quadexp.learn.thrust_design import default_voltage, scaled_signal, thrust_design
from quadexp.log.schema import Flight

# Powers of the signal in the curve, and whether an intercept belongs to it.
POWERS = {"motor_command": (1, 2), "rotor_speed": (2,), "thrust_acceleration": (1,), "u": (1,)}
INTERCEPT = ("thrust_acceleration",)
DRAG_Z = "d_z"
EXPONENT_RANGE = (0.0, 3.0)
MOST_ROWS = 40_000  # of the search for the exponent


@dataclass(frozen=True)
class ThrustCurve:
    """Mass-normalised thrust of a rotor over its signal.

    signal: a name in quadexp.learn.samples.SIGNALS. reference_voltage: V, 0 where the voltage is not used;
    voltage_exponent: g, its error 0 where it was set.
    powers: (q,) exponents. coefficients, errors: (q,), or (n, q) with one row a rotor; m/s^2 per signal^power.
    intercept, intercept_error: m/s^2, of the sum over all rotors. rotors: n. freedom: of Student's t for intervals.
    drag_z, drag_z_error: fitted with it, 1/s (0: not fitted). signal_range: smallest and largest signal of the fit.
    residual_std: root mean square of what it and d_z leave on z, m/s^2. loss: "squares" or "huber".
    """

    signal: str
    powers: np.ndarray
    coefficients: np.ndarray
    errors: np.ndarray
    reference_voltage: float = 0.0
    voltage_exponent: float = 1.0
    voltage_exponent_error: float = 0.0
    intercept: float = 0.0
    intercept_error: float = 0.0
    rotors: int = 4
    drag_z: float = 0.0
    drag_z_error: float = 0.0
    freedom: int = 1
    condition: float = 1.0
    residual_std: float = 0.0
    signal_range: np.ndarray | None = None
    loss: str = "squares"

    def rotor_acceleration(self, flight: Flight) -> np.ndarray:
        """What every rotor's thrust adds, (k, n) (m/s^2); row k from row k's signal."""
        columns = rotor_columns(flight, self.signal)
        if not columns:
            raise DataError(f"the flight has no column {self.signal}_0, which this thrust curve needs")
        voltage = flight["battery_voltage"] if self.reference_voltage else None
        return self.of_signal(flight.stack(columns).astype(float), voltage)

    def collective(self, flight: Flight) -> np.ndarray:
        """Thrust of all rotors per mass along body z, (k,) (m/s^2)."""
        return self.rotor_acceleration(flight).sum(axis=1)

    def of_signal(self, signal: np.ndarray, voltage: np.ndarray | None = None) -> np.ndarray:
        """The same from the signal itself, (k, n), and the voltage (k,) (V)."""
        scaled = scaled_signal(signal, voltage, self.reference_voltage, self.voltage_exponent)
        if self.signal == "thrust_acceleration":
            scaled = np.repeat(scaled / self.rotors, self.rotors, axis=1)
        elif scaled.shape[1] != self.rotors:
            raise DataError(f"{scaled.shape[1]} rotors in the flight, the thrust curve is of {self.rotors}")
        per_rotor = np.broadcast_to(self.coefficients, (self.rotors, len(self.powers)))
        terms = [per_rotor[:, j] * scaled**power for j, power in enumerate(self.powers)]
        return np.sum(terms, axis=0) + self.intercept / self.rotors

    @property
    def has_intercept(self) -> bool:
        """Whether an intercept was fitted."""
        return self.intercept_error > 0

    @property
    def slope_range(self) -> tuple[float, float]:
        """Least and largest da/ds over the range of the fit; a curve that falls there is wrong."""
        low, high = self.signal_range if self.signal_range is not None else (0.0, 1.0)
        grid = np.linspace(low, high, 200)
        rows = np.atleast_2d(self.coefficients)
        slope = sum(rows[:, [j]] * power * grid ** (power - 1) for j, power in enumerate(self.powers))
        return float(np.min(slope)), float(np.max(slope))

    def __str__(self) -> str:
        scaled = f"{self.signal} V/{self.reference_voltage:g}" if self.reference_voltage else self.signal
        terms = []
        if self.reference_voltage and (self.voltage_exponent != 1 or self.voltage_exponent_error):
            half = half_width(self.voltage_exponent_error, self.freedom)
            scaled = f"{self.signal} (V/{self.reference_voltage:g})^g"
            terms.append(f"g {self.voltage_exponent:.3g} +- {half:.2g}")
        for row, error in zip(np.atleast_2d(self.coefficients), np.atleast_2d(self.errors), strict=True):
            half = half_width(error, self.freedom)
            terms.append(
                ", ".join(f"c_{p:g} {c:.6g} +- {h:.2g}" for p, c, h in zip(self.powers, row, half, strict=True))
            )
        if self.has_intercept:
            terms.append(f"b {self.intercept:.4g} +- {half_width(self.intercept_error, self.freedom):.2g}")
        return f"on {scaled}: {'; '.join(terms)}"


def fit_thrust_samples(
    samples: Samples,
    *,
    reference_voltage: float | None = None,
    voltage_exponent: float | None = 1.0,
    powers: Sequence[int] | None = None,
    intercept: bool | None = None,
    per_rotor: bool = False,
    drag: bool = True,
    rotors: int | None = None,
    loss: str = "squares",
    condition_limit: float = CONDITION_LIMIT,
    intervals: bool = True,
) -> tuple[ThrustCurve, Regression]:
    """Fit the curve to the specific force along body z; also the regression.

    samples: of `gather`, with the signal that `choose_signal` takes. reference_voltage: V, 0 leaves the voltage out,
    None takes a round number near the median (4 for one cell) where it is logged beside motor commands.
    voltage_exponent: g, None to fit it. powers, intercept: None for the module's. per_rotor: a curve for each rotor.
    drag: fit d_z beside it. rotors: how many share thrust_acceleration (4). loss, condition_limit: see `regress`.
    intervals: False where only the coefficients matter; their errors are then those of independent samples, g's is 0.
    Returns the regression with its columns in the order of `thrust_design`, then d_z.
    Raises DataError where a voltage is missing or the data does not hold the curve, UsageError for a curve per rotor of
    a signal that is one for all.
    """
    kind = samples.kind
    if per_rotor and kind == "thrust_acceleration":
        raise UsageError("a thrust curve per rotor needs a signal per rotor; thrust_acceleration is one for all")
    powers = tuple(powers or POWERS[kind])
    intercept = kind in INTERCEPT if intercept is None else intercept
    if reference_voltage is None:
        reference_voltage = default_voltage(samples)
    if reference_voltage and samples.voltage is None:
        raise DataError(f"{samples.names[0]}: column 'battery_voltage' is missing, the reference voltage has no use")
    fit_exponent = voltage_exponent is None and bool(reference_voltage)

    def fitted(g: float, slope: np.ndarray | None = None) -> Regression:
        scaled = scaled_signal(samples.signal, samples.voltage, reference_voltage, g)
        design, names = thrust_design(scaled, powers, intercept=intercept, per_rotor=per_rotor)
        for name, column in (("g", slope), (DRAG_Z, -samples.velocity[:, 2] if drag else None)):
            if column is not None:
                design, names = np.column_stack([design, column]), [*names, name]
        return regress(
            design, samples.force[:, 2], names, samples.segment, samples.flight,
            what=f"thrust curve on {kind}", loss=loss, condition_limit=condition_limit, intervals=intervals,
        )  # fmt: skip

    n = samples.signal.shape[1] if kind != "thrust_acceleration" else (rotors or 4)
    q = len(powers) * (n if per_rotor else 1)
    g = 1.0 if voltage_exponent is None else float(voltage_exponent)
    g_error = 0.0
    if fit_exponent:
        what = {"intercept": intercept, "per_rotor": per_rotor, "drag": drag}
        g = _search_exponent(_left_by_exponent(samples, reference_voltage, powers, **what))
    found = fitted(g)
    if fit_exponent and intervals:
        found, g_error = _exponent_error(g, found, fitted, samples, reference_voltage, powers, n, per_rotor)
    shape = (n, len(powers)) if per_rotor else (len(powers),)
    value, error = found.coefficients, found.errors
    scaled = scaled_signal(samples.signal, samples.voltage, reference_voltage, g)
    curve = ThrustCurve(
        kind, np.array(powers, float), value[:q].reshape(shape), error[:q].reshape(shape), float(reference_voltage),
        g, g_error, float(value[q]) if intercept else 0.0, float(error[q]) if intercept else 0.0, n,
        float(value[-1]) if drag else 0.0, float(error[-1]) if drag else 0.0, found.freedom, found.condition,
        float(np.sqrt(np.mean(found.residual**2))), np.array([scaled.min(), scaled.max()]), loss,
    )  # fmt: skip
    return curve, found


def _left_by_exponent(
    samples: Samples,
    reference_voltage: float,
    powers: Sequence[int],
    *,
    intercept: bool,
    per_rotor: bool,
    drag: bool,
) -> Callable[[float], float]:
    """Sum of squares that least squares leaves of a thinned set of rows, as a function of g.

    The voltage is common to the rotors, (s r^g)^p = s^p r^(g p), so that only one power a row depends on g.
    """
    some = samples.thinned(MOST_ROWS)
    plain, _ = thrust_design(some.signal, powers, intercept=intercept, per_rotor=per_rotor)
    ratio = np.log(scaled_signal(np.ones((len(some), 1)), some.voltage, reference_voltage)[:, 0])
    each = np.tile(powers, some.signal.shape[1] if per_rotor else 1)
    design = np.column_stack([plain, -some.velocity[:, 2]]) if drag else plain.copy()
    target = some.force[:, 2]

    def left(g: float) -> float:
        scale = np.exp(g * ratio)
        for j, power in enumerate(each):
            design[:, j] = plain[:, j] * scale**power
        residual = target - design @ np.linalg.lstsq(design, target, rcond=None)[0]
        return float(residual @ residual)

    return left


def _search_exponent(left: Callable[[float], float]) -> float:
    """The g that leaves least."""
    from scipy.optimize import minimize_scalar

    return float(minimize_scalar(left, bounds=EXPONENT_RANGE, method="bounded", options={"xatol": 1e-7}).x)


def _exponent_error(
    g: float,
    first: Regression,
    fitted: Callable[..., Regression],
    samples: Samples,
    reference_voltage: float,
    powers: Sequence[int],
    rotors: int,
    per_rotor: bool,
) -> tuple[Regression, float]:
    """The regression at g with the errors that it has where g is fitted too, and g's standard error.

    They come from the regression linearised in g, with da/dg among its columns.
    """
    scaled = scaled_signal(samples.signal, samples.voltage, reference_voltage, g)
    rows = first.coefficients[: len(powers) * (rotors if per_rotor else 1)].reshape(-1, len(powers))
    slope = sum(rows[:, j] * p * scaled**p for j, p in enumerate(powers)).sum(axis=1)
    relative_voltage = scaled_signal(np.ones((len(samples), 1)), samples.voltage, reference_voltage)[:, 0]
    joint = fitted(g, slope * np.log(relative_voltage))
    keep = np.array([name != "g" for name in joint.names])
    linearised = Regression(
        first.names, first.coefficients, joint.covariance[np.ix_(keep, keep)], joint.plain[np.ix_(keep, keep)],
        first.residual, joint.blocks, joint.condition,
    )  # fmt: skip
    return linearised, float(joint.errors[~keep][0])


def thrust_columns(curve: ThrustCurve, samples: Samples, *, drag: bool) -> np.ndarray:
    """The regressors that a curve was fitted with, d_z's at the end, (k, p)."""
    scaled = scaled_signal(samples.signal, samples.voltage, curve.reference_voltage, curve.voltage_exponent)
    powers, each = tuple(curve.powers.astype(int).tolist()), curve.coefficients.ndim == 2
    design, _ = thrust_design(scaled, powers, intercept=curve.has_intercept, per_rotor=each)
    return np.column_stack([design, -samples.velocity[:, 2]]) if drag else design
