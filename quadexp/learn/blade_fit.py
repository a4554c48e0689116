"""Blade-element coefficients from all samples of a flight, with confidence intervals (Gauss-Newton least squares).

    y = F(v, w, V_I(v, w, C_la), theta) / m + b + e         body FLU, m/s^2

theta = (C_d0, C_la, C_Dx, C_Dy, C_Dz) is common to all axes, b is the accelerometer's bias on each axis: neglecting a
bias of .001 m/s^2 changes C_la by more than the interval due to noise alone. The derivative is total, through the
induced velocity V_I,

    X = [ (dF/dtheta + dF/dV_I dV_I/dC_la) / m,  I ]

and theta is found by Gauss-Newton steps. The initial values are a prior with a standard deviation of a hundred times
themselves (1 m/s^2 for b), which matters only for a coefficient that the flight does not determine; its interval is
then that wide. The variance is that of quadexp.learn.regression, with the scores X'e summed over blocks longer than
their correlation time,

    V = H^-1 ( G/(G - p) sum_g s_g s_g' / sigma^4 + P_0^-1 ) H^-1,     H = X'X / sigma^2 + P_0^-1

and at least that of independent errors, H^-1. Intervals use Student's t with G - p degrees of freedom. They account for
noise, also correlated, and for the bias, but not for errors of the rotor geometry.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np

from quadexp.errors import DataError
from quadexp.learn.regression import LEAST_BLOCKS, blocks_of, half_width
from quadexp.learn.rls_step import ITERATIONS
from quadexp.physics.blade_element import ADOPTED, PRINTED, aerodynamic_wrench, rotor_flow
from quadexp.physics.induced_velocity import balance, safe_newton
from quadexp.physics.rotor import C_LA, THETA, BladeCoefficients
from quadexp.physics.vehicle import Vehicle

COUNT = len(THETA) + 3  # unknowns, including the bias
LEAST_SAMPLES = 2 * (COUNT + LEAST_BLOCKS)
PRIOR_SPREAD = 100.0  # standard deviation of the prior, relative to the initial values
PRIOR_OFFSET = 1.0  # m/s^2
LIFT_RANGE = (0.05, 20.0)  # search range of C_la, relative to its initial value; V_I has no solution for C_la <= 0
MOST_STEPS = 60
CONVERGED = 1e-4  # step size in standard errors


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
    *,
    stretch: np.ndarray | None = None,
    printed_coefficients: bool = False,
) -> BladeFit:
    """Fit one flight.

    velocity: air-relative, (k, 3) body FLU (m/s). rotor_speed: (k, n) (rad/s), all turning. specific_force: (k, 3) body
    FLU (m/s^2). initial: start of the search. stretch: (k,), number of the uninterrupted stretch of each sample, None
    for one. printed_coefficients: the paper's misprinted cross terms. Raises DataError for too few samples, and where
    the search does not converge.
    """
    k = len(velocity)
    if k < LEAST_SAMPLES:
        raise DataError(f"blade element: {k} samples, at least {LEAST_SAMPLES} are needed for intervals")
    function = _force_function(vehicle, printed_coefficients)
    first = np.r_[initial.parameters(), np.zeros(3)]
    spread = np.r_[PRIOR_SPREAD * np.maximum(np.abs(first[:5]), 1e-3), np.full(3, PRIOR_OFFSET)]
    low, high = LIFT_RANGE[0] * first[C_LA], LIFT_RANGE[1] * first[C_LA]

    def at(c: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Errors (k, 3) and X (k, 3, 8)."""
        force, slope = function(velocity.T, rotor_speed.T, c[:5])
        slopes = np.array(slope).reshape(3, k, 5).transpose(1, 0, 2)
        design = np.concatenate([slopes, np.broadcast_to(np.eye(3), (k, 3, 3))], axis=2)
        return specific_force - np.array(force).T - c[5:], design

    def cost(c: np.ndarray, left: np.ndarray, noise: float) -> float:
        return float(np.sum(left**2) / noise**2 + np.sum(((c - first) / spread) ** 2))

    c = first.copy()
    left, design = at(c)
    for _ in range(MOST_STEPS):
        noise = max(float(np.sqrt(np.mean(left**2))), 1e-9)
        information = np.einsum("kai,kaj->ij", design, design) / noise**2 + np.diag(1 / spread**2)
        slope = np.einsum("kai,ka->i", design, left) / noise**2 + (first - c) / spread**2
        step = np.linalg.solve(information, slope)
        size = float(np.sqrt(step @ information @ step))  # in standard errors
        share, before = 1.0, cost(c, left, noise)
        for _ in range(20):
            tried = c + share * step
            tried[C_LA] = np.clip(tried[C_LA], low, high)
            left, design = at(tried)
            if cost(tried, left, noise) <= before * (1 + 1e-12):
                break
            share /= 2
        c = tried
        if size < CONVERGED:
            break
    else:
        raise DataError("blade element: the fit does not converge on this flight")

    noise = max(float(np.sqrt(np.mean(left**2))), 1e-9)
    information = np.einsum("kai,kaj->ij", design, design) / noise**2 + np.diag(1 / spread**2)
    scores = np.einsum("kai,ka->ki", design, left)
    runs = np.zeros(k, int) if stretch is None else stretch
    groups = blocks_of(scores, runs, np.zeros(k, int))
    count = int(groups.max()) + 1
    sums = np.stack([np.bincount(groups, column, count) for column in scores.T], axis=1) / noise**2
    plain = np.linalg.inv(information)
    scatter = count / max(count - COUNT, 1) * sums.T @ sums + np.diag(1 / spread**2)
    variance = np.maximum(np.diag(plain @ scatter @ plain), np.diag(plain))
    half = half_width(np.sqrt(variance), count - COUNT)
    return BladeFit(c[:5], c[5:], half[:5], noise, count)


@lru_cache(maxsize=8)
def _force_function(vehicle: Vehicle, printed_coefficients: bool) -> ca.Function:
    """(v (3,), w (n,), theta (5,)) -> specific force (3,) and its total derivative (3, 5).

    With the balance g(V_I, theta) = 0, dV_I/dtheta = -(dg/dtheta) / (dg/dV_I): the iterations are not differentiated.
    """
    n = vehicle.n_rotors
    v, w, theta, induced = (ca.SX.sym(name, size) for name, size in (("v", 3), ("w", n), ("theta", 5), ("V_I", n)))
    terms = PRINTED if printed_coefficients else ADOPTED
    flow = rotor_flow(vehicle, v)
    equation = balance(vehicle.rotor_geometry, theta[C_LA], w, flow.in_plane_squared, flow.axial, terms)
    force, _ = aerodynamic_wrench(vehicle, theta, v, w, induced, terms=terms)
    through = -ca.jacobian(equation.value(induced), theta) / ca.repmat(equation.slope(induced), 1, 5)
    slope = ca.jacobian(force, theta) + ca.mtimes(ca.jacobian(force, induced), through)
    solved = ca.substitute(
        [force / vehicle.mass, ca.densify(slope) / vehicle.mass], [induced], [safe_newton(equation, ITERATIONS)]
    )
    return ca.Function("specific_force", [v, w, theta], ca.cse(solved))
