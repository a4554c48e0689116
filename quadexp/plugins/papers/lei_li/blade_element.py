"""The blade-element model (Lei & Li 2017): its residual, and its coefficients from a recorded flight (section 3).

The residual has the forces and torques of rotors and airframe minus those of the nominal rigid body,

    y = [F / m - (0, 0, sum u) / m_nominal,  Gamma - G u]        F, Gamma: quadexp.physics.blade_element, (4)-(17)

The command u (N) is a static thrust, so w = sqrt(u / k_T,static); at V = 0 with the true coefficients y is zero. The
induced velocity is computed by a few Newton steps at every evaluation: held constant over a horizon it would be wrong
within a tenth of a second. Its derivative is that of the equation g = 0 it solves, dV_I/dz = -g_z / g_V, not of the
steps. Below the idle speed the residual keeps its value there, so that it stays differentiable for u -> 0.

A flight is identified recursively, and from all samples; it needs rotor speeds and specific force. The recursive
estimator (rls.py) processes the samples as it would in flight, which gives a time series of estimates. The result with
its 95 % intervals is the fit of all samples at once: the final recursive estimate depends on its initial values,
neglects the accelerometer's bias and, as published, the dependence of the induced velocity on C_la; an interval about
it contains the truth in 0 to 15 of 40 flights.

The fit of all samples is Gauss-Newton least squares,

    y = F(v, w, V_I(v, w, C_la), theta) / m + b + e         body FLU, m/s^2

theta = (C_d0, C_la, C_Dx, C_Dy, C_Dz) is common to all axes, b is the accelerometer's bias on each axis: neglecting a
bias of 0.001 m/s^2 changes C_la by more than the interval due to noise alone. The derivative is total, through the
induced velocity V_I,

    X = [ (dF/dtheta + dF/dV_I dV_I/dC_la) / m,  I ]

and theta is found by Gauss-Newton steps. The initial values are a prior with a standard deviation of a hundred times
themselves (1 m/s^2 for b), which matters only for a coefficient that the flight does not determine; its interval is
then that wide. The variance is that of quadexp.models.regression, with the scores X'e summed over blocks longer than
their correlation time,

    V = H^-1 ( G/(G - p) sum_g s_g s_g' / sigma^4 + P_0^-1 ) H^-1,     H = X'X / sigma^2 + P_0^-1

and at least that of independent errors, H^-1. Intervals use Student's t with G - p degrees of freedom. They account for
noise, also correlated, and for the bias, but not for errors of the rotor geometry.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.errors import DataError
from quadexp.log.schema import Flight
from quadexp.models.regression import LEAST_BLOCKS, half_width, over_blocks
from quadexp.models.residual import AXES, Residual, feature_names, symbolic_residual
from quadexp.names import named
from quadexp.physics.blade_element import ADOPTED, CrossTerms, aerodynamic_wrench, rotor_flow, static_rotor_speed
from quadexp.physics.expression import Expression, symbols
from quadexp.physics.induced_velocity import balance, newton, safe_newton, starting_point
from quadexp.physics.rotation import along_z
from quadexp.physics.rotor import C_LA, IDLE_SPEED, THETA, BladeCoefficients
from quadexp.physics.state import STATE_COLUMNS, root_mean_square
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.logs.samples import READINGS, check_columns
from quadexp.plugins.papers.lei_li.rls import ITERATIONS as SAFE_ITERATIONS
from quadexp.plugins.papers.lei_li.rls import SLOWEST, RLSSettings, recursion, standard_errors

ITERATIONS = 4  # Newton steps; three reach 1e-9 m/s in cruise, idling rotors and steep descents need a fourth

COUNT = len(THETA) + 3  # unknowns, including the bias
LEAST_SAMPLES = 2 * (COUNT + LEAST_BLOCKS)
PRIOR_SPREAD = 100.0  # standard deviation of the prior, relative to the initial values
PRIOR_OFFSET = 1.0  # m/s^2
LIFT_RANGE = (0.05, 20.0)  # search range of C_la, relative to its initial value; V_I has no solution for C_la <= 0
MOST_STEPS = 60  # of a bisection: 2^-60 of the bracket is below the rounding
CONVERGED = 1e-4  # step size in standard errors
FIRST_VALUES = BladeCoefficients(lift_slope=1.66, profile_drag=0.11, body_drag=(0.005, 0.005, 0.01))  # half of Table 1
OFFLINE = RLSSettings.scaled(gauss_newton=True)


def blade_element_residual(
    vehicle: Vehicle, coefficients: BladeCoefficients, source: str = "", *, iterations: int = ITERATIONS
) -> Residual:
    """Residual with theta = (C_d0, C_la, C_Dx, C_Dy, C_Dz) as runtime parameters, (5,).

    vehicle: with rotor and thrust_coefficient. coefficients: initial values. source: for the record.
    iterations: Newton steps for V_I.
    Raises UsageError where the vehicle has no rotor geometry.
    """
    z, theta = symbols(ca.SX, z=len(feature_names(vehicle.n_rotors)), theta=len(THETA))
    y, dy_dz = blade_element_correction(vehicle, z, theta, iterations=iterations)
    return symbolic_residual("blade_element", y, z, theta, coefficients.parameters(), source=source, slope=dy_dz)


def blade_element_correction(
    vehicle: Vehicle,
    z: Expression,
    theta: Expression,
    *,
    lift_scale: Expression = 1.0,
    payload: Expression = 0.0,
    rotor_local_velocity: bool = False,
    terms: CrossTerms = ADOPTED,
    iterations: int = ITERATIONS,
    rotor_speed_min: float = IDLE_SPEED,
) -> tuple[Expression, Expression]:
    """y (6,) and dy/dz (6, 6 + n) as SX expressions.

    z: features (6 + n,). theta: (5,). lift_scale: factor on every rotor's C_la, scalar or (n,). payload: kg.
    """
    rotor = vehicle.rotor_geometry
    thrust_coefficient = vehicle.static_thrust_coefficient
    velocity = z[:3]
    rate = z[3:6] if rotor_local_velocity else None
    command = ca.fmax(z[6:], thrust_coefficient * rotor_speed_min**2)
    w = static_rotor_speed(command, thrust_coefficient)
    flow = rotor_flow(vehicle, velocity, rate)
    lift_slope = theta[C_LA] * lift_scale
    equation = balance(rotor, lift_slope, w, flow.in_plane_squared, flow.axial, terms)
    solution = newton(equation, starting_point(equation), iterations)

    induced = ca.SX.sym("V_I", vehicle.n_rotors)
    force, torque = aerodynamic_wrench(
        vehicle, theta, velocity, w, induced, rate=rate, lift_scale=lift_scale, terms=terms
    )
    acceleration = force / (vehicle.mass + payload) - along_z(ca.sum1(command) / vehicle.mass)
    y = ca.vertcat(acceleration, torque - ca.sparsify(ca.DM(vehicle.allocation[1:])) @ command)
    dg_dz = ca.jacobian(equation.value(induced), z)
    slope = equation.slope(induced)
    d_induced = -(ca.diag(1 / slope) @ dg_dz)
    dy_dz = ca.jacobian(y, z) + ca.jacobian(y, induced) @ d_induced
    y, dy_dz = ca.substitute([y, dy_dz], [induced], [solution])
    return y, dy_dz


@dataclass(frozen=True)
class BladeFit:
    """theta: (5,). offset: b (3,) m/s^2. half_width: (5,), of the 95 % intervals. noise: sigma, m/s^2. blocks: G."""

    theta: np.ndarray
    offset: np.ndarray
    half_width: np.ndarray
    noise: float
    blocks: int

    def interval(self, name: str) -> tuple[float, float]:
        """Ends of the 95 % interval of a coefficient, by its name in quadexp.physics.rotor.THETA."""
        i = THETA.index(name)
        return float(self.theta[i] - self.half_width[i]), float(self.theta[i] + self.half_width[i])


def fit_blade_element(
    vehicle: Vehicle,
    velocity: np.ndarray,
    rotor_speed: np.ndarray,
    specific_force: np.ndarray,
    initial: BladeCoefficients,
    stretch: np.ndarray | None = None,
) -> BladeFit:
    """Fit one flight.

    velocity: air-relative, (k, 3) body FLU (m/s). rotor_speed: (k, n) (rad/s), all turning. specific_force: (k, 3) body
    FLU (m/s^2). initial: start of the search. stretch: (k,), number of the uninterrupted stretch of each sample, None
    for one. Raises DataError for too few samples, and where the search does not converge.
    """
    k = len(velocity)
    if k < LEAST_SAMPLES:
        raise DataError(f"blade element: {k} samples, at least {LEAST_SAMPLES} are needed for intervals")
    function = _force_function(vehicle)
    first = np.r_[initial.parameters(), np.zeros(3)]
    spread = np.r_[PRIOR_SPREAD * np.maximum(np.abs(first[:5]), 1e-3), np.full(3, PRIOR_OFFSET)]
    low = LIFT_RANGE[0] * first[C_LA]
    high = LIFT_RANGE[1] * first[C_LA]

    def at(c: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Errors (k, 3) and X (k, 3, 8)."""
        force, slope = function(velocity.T, rotor_speed.T, c[:5])
        slopes = np.array(slope).reshape(3, k, 5).transpose(1, 0, 2)
        design = np.concatenate([slopes, np.broadcast_to(np.eye(3), (k, 3, 3))], axis=2)
        return specific_force - np.array(force).T - c[5:], design

    def cost(c: np.ndarray, error: np.ndarray, noise: float) -> float:
        return float(np.sum(error**2) / noise**2 + np.sum(((c - first) / spread) ** 2))

    def linearised(error: np.ndarray, design: np.ndarray) -> tuple[float, np.ndarray]:
        """sigma and H."""
        noise = max(root_mean_square(error), 1e-9)
        return noise, np.einsum("kai,kaj->ij", design, design) / noise**2 + np.diag(1 / spread**2)

    c = first.copy()
    error, design = at(c)
    for _ in range(MOST_STEPS):
        noise, information = linearised(error, design)
        slope = np.einsum("kai,ka->i", design, error) / noise**2 + (first - c) / spread**2
        step = np.linalg.solve(information, slope)
        size = float(np.sqrt(step @ information @ step))  # in standard errors
        share = 1.0
        before = cost(c, error, noise)
        for _ in range(20):
            tried = c + share * step
            tried[C_LA] = np.clip(tried[C_LA], low, high)
            error, design = at(tried)
            if cost(tried, error, noise) <= before * (1 + 1e-12):
                break
            share /= 2
        c = tried
        if size < CONVERGED:
            break
    else:
        raise DataError("blade element: the fit does not converge on this flight")

    noise, information = linearised(error, design)
    scores = np.einsum("kai,ka->ki", design, error) / noise**2
    runs = np.zeros(k, int) if stretch is None else stretch
    covariance, count = over_blocks(scores, information, runs, np.zeros(k, int), prior=np.diag(1 / spread**2))
    variance = np.maximum(np.diag(covariance), np.diag(np.linalg.inv(information)))
    half = half_width(np.sqrt(variance), count - COUNT)
    return BladeFit(c[:5], c[5:], half[:5], noise, count)


@lru_cache(maxsize=8)
def _force_function(vehicle: Vehicle) -> ca.Function:
    """(v (3,), w (n,), theta (5,)) -> specific force (3,) and its total derivative (3, 5)."""
    n = vehicle.n_rotors
    v, w, theta, induced = symbols(ca.SX, v=3, w=n, theta=5, V_I=n)
    flow = rotor_flow(vehicle, v)
    equation = balance(vehicle.rotor_geometry, theta[C_LA], w, flow.in_plane_squared, flow.axial)
    force, _ = aerodynamic_wrench(vehicle, theta, v, w, induced)
    slope = ca.jacobian(force, theta) + ca.jacobian(force, induced) @ equation.derivative(induced, theta)
    results = [force / vehicle.mass, ca.densify(slope) / vehicle.mass]
    solution = safe_newton(equation, SAFE_ITERATIONS)
    return ca.Function("specific_force", [v, w, theta], ca.cse(ca.substitute(results, [induced], [solution])))


@dataclass(frozen=True)
class Identification:
    """Estimates over time. name: of the flight. t: (k,) s. theta: clipped, raw: not clipped, standard_error: (k, 5).

    standard_error: from the recursion's covariance, including its initial value; not an interval. error: (k, 3),
    measured minus predicted specific force (m/s^2). noise: standard deviation of the readings, from the errors of the
    second half (m/s^2). clips: number of clipped samples per coefficient, (5,). skipped: number of samples with a
    stopped rotor. fit: of all samples, with intervals; None for the reason in `note`.
    """

    name: str
    t: np.ndarray
    theta: np.ndarray
    raw: np.ndarray
    standard_error: np.ndarray
    error: np.ndarray
    noise: float
    clips: np.ndarray
    skipped: int
    fit: BladeFit | None = None
    note: str = ""

    def columns(self) -> dict[str, np.ndarray]:
        """The time series as named columns, for a table of kind "estimates"."""
        columns = {"t": self.t}
        for prefix, values in (("", self.theta), ("raw_", self.raw), ("std_", self.standard_error)):
            columns |= {f"{prefix}{name}": values[:, i].copy() for i, name in enumerate(THETA)}
        return columns | {f"error_{axis}": self.error[:, i].copy() for i, axis in enumerate(AXES)}

    def metadata(self) -> dict[str, Any]:
        """Metadata of the table; the estimates are those of the fit to all samples where there is one."""
        recursion = named(THETA, self.raw[-1].tolist())
        clips = named(THETA, self.clips.tolist())
        record: dict[str, Any] = {"flight": self.name, "estimates": recursion, "recursion": recursion}
        if self.fit is not None:
            record["estimates"] = named(THETA, self.fit.theta.tolist())
            record["interval_95"] = {name: list(self.fit.interval(name)) for name in THETA}
            record["accelerometer_offset"] = self.fit.offset.tolist()
            record["blocks"] = self.fit.blocks
        noise = self.noise if self.fit is None else self.fit.noise
        return record | {"note": self.note, "noise": noise, "clips": clips, "skipped": self.skipped}

    def lines(self) -> list[str]:
        """The estimates with their 95 % intervals and the final recursive estimates, one line per coefficient."""
        record = self.metadata()
        lines = [f"{self.name}: {len(self.t)} samples, noise {record['noise']:.3g} m/s^2"]
        if self.fit is not None:
            offset = ", ".join(f"{value:.4f}" for value in self.fit.offset)
            lines.append(f"  all samples at once, with the accelerometer bias ({offset} m/s^2)")
        for name, value in record["estimates"].items():
            about = ", no interval"
            if self.fit is not None:
                low, high = self.fit.interval(name)
                about = f"   95 % interval {low:.5f} to {high:.5f}   recursion ends at {record['recursion'][name]:.5f}"
            clips = record["clips"][name]
            lines.append(f"  {name:<5} {value:9.5f}{about}" + (f"   clipped on {clips} samples" if clips else ""))
        if self.note:
            lines.append(f"  no intervals: {self.note}")
        if self.skipped:
            lines.append(f"  {self.skipped} samples skipped: a rotor was stopped")
        return lines


def identify_flight(
    flight: Flight, vehicle: Vehicle, settings: RLSSettings | None = None, *, name: str | None = None
) -> Identification:
    """Run the recursive estimator over a flight, and fit all its samples at once.

    The first sample is skipped, because in a simulated flight it has no reading yet.
    vehicle: with rotor and thrust coefficient. settings: of the recursion, None for OFFLINE.
    Raises DataError where rotor speeds or specific force are missing, or not finite.
    """
    rotors = [f"rotor_speed_{i}" for i in range(vehicle.n_rotors)]
    name = name or str(flight.metadata.get("name", "flight"))
    check_columns(flight, name, [*rotors, *READINGS, *STATE_COLUMNS], first=1)
    speed = flight.stack(rotors)[1:]
    force = flight.stack(READINGS)[1:]
    velocity = flight.air_velocity[1:]

    settings = settings or OFFLINE
    kept = recursion(vehicle, FIRST_VALUES, settings, {"v": velocity, "w": speed, "y": force})
    if not kept["samples"][-1, 0]:
        raise DataError(f"{name}: the rotors do not turn in this flight, nothing can be identified")
    error = kept["error"]
    noise = float(np.sqrt(np.nanmean(error[len(error) // 2 :] ** 2)))
    standard_error = standard_errors(kept, settings) * noise / settings.noise
    turning = speed.min(axis=1) >= SLOWEST
    stretch = np.asarray(flight.columns.get("segment", np.zeros(len(flight))))[1:]
    fit = None
    note = ""
    try:
        fit = fit_blade_element(
            vehicle,
            velocity[turning],
            speed[turning],
            force[turning],
            FIRST_VALUES,
            np.concatenate([[0], np.cumsum(stretch[1:] != stretch[:-1])])[turning],
        )
    except DataError as reason:
        note = str(reason)
    clips = kept["clips"][-1].astype(int)
    skipped = int(kept["skipped"][-1, 0])
    return Identification(
        name, flight.t[1:], kept["used"], kept["raw"], standard_error, error, noise, clips, skipped, fit, note
    )
