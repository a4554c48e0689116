"""One step of recursive least squares on the blade-element model (Lei & Li 2017, equations 22-26), in CasADi.

Given the induced velocities the specific force is linear in theta = (C_d0, C_la, C_Dx, C_Dy, C_Dz), so one row of
regressors per body axis is the derivative of the dynamics' own force:

    Y = F(v, w, V_I, theta) / m = Phi theta,     Phi = dF/dtheta / m                       (3, 5)

and on every axis, with the coefficients that its force depends on, x (C_d0, C_la, C_Dx), y (C_d0, C_la, C_Dy), z (C_la,
C_Dz):

    P <- (lambda P^-1 + (1 - lambda) P_0^-1)^-1
    e = y - Phi^T theta,   K = P Phi / (Phi^T P Phi + sigma^2)                              (24)
    theta <- theta + K e,   P <- (I - K Phi^T) P

The paper has sigma = 1 m/s^2 and lambda = 1. lambda < 1 forgets by exponential resetting (Lai & Bernstein 2023, IEEE
Control Systems Letters 7; forgetting towards a given density in Kulhavy & Zarrop 1993, Int. J. Control 58): P <= P_0
always, also in directions that nothing excites, in which P / lambda grows without bound.

V_I is not measured: it solves (14) and (17) with the coefficients in use. That makes F_z depend on C_la through V_I as
well; with gauss_newton the gain is taken from the whole derivative

    dF_z/dC_la + (dF_z/dV_I) (dV_I/dC_la)

which removes the bias of C_Dz that results from the partial derivative (and not from the accelerometer's bias).
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca

from quadexp.physics.blade_element import ADOPTED, PRINTED, aerodynamic_wrench, rotor_flow
from quadexp.physics.expression import Expression
from quadexp.physics.induced_velocity import balance, safe_newton
from quadexp.physics.rotor import C_D0, C_DX, C_DY, C_DZ, C_LA, THETA
from quadexp.physics.vehicle import Vehicle

AXES = ((C_D0, C_LA, C_DX), (C_D0, C_LA, C_DY), (C_LA, C_DZ))  # coefficients that the force along x, y, z depends on
ITERATIONS = 16  # of the safeguarded Newton method, from its upper bound


def rls_step_function(
    vehicle: Vehicle, *, gauss_newton: bool = False, printed_coefficients: bool = False
) -> ca.Function:
    """One update of the three estimators.

    Inputs: v (3,) body FLU (m/s); w (n,) (rad/s); y (3,) specific force (m/s^2); used (5,) coefficients in use;
    theta_x, theta_y, theta_z, P_x, P_y, P_z of the axes and prior_x, prior_y, prior_z, the diagonals of P_0; sigma
    (m/s^2); forgetting lambda; lift_weight, the share of the z axis in C_la.
    Outputs: the new theta_* and P_*; raw (5,), combined by (25), (26); error (3,), e (m/s^2); induced (n,) (m/s);
    regressors (3, 5) (m/s^2); weight beta_x.
    """
    n = vehicle.n_rotors
    v, w, y = ca.SX.sym("v", 3), ca.SX.sym("w", n), ca.SX.sym("y", 3)
    used, coefficients = ca.SX.sym("used", len(THETA)), ca.SX.sym("coefficients", len(THETA))
    sigma, forgetting, lift_weight = (ca.SX.sym(name) for name in ("sigma", "forgetting", "lift_weight"))
    thetas = [ca.SX.sym(f"theta_{a}", len(at)) for a, at in zip("xyz", AXES, strict=True)]
    covariances = [ca.SX.sym(f"P_{a}", len(at), len(at)) for a, at in zip("xyz", AXES, strict=True)]
    priors = [ca.SX.sym(f"prior_{a}", len(at)) for a, at in zip("xyz", AXES, strict=True)]

    terms = PRINTED if printed_coefficients else ADOPTED
    flow = rotor_flow(vehicle, v)
    equation = balance(vehicle.rotor_geometry, used[C_LA], w, flow.in_plane_squared, flow.axial, terms)
    induced = ca.SX.sym("V_I", n)
    force, _ = aerodynamic_wrench(vehicle, coefficients, v, w, induced, terms=terms)
    regressors = ca.jacobian(force, coefficients) / vehicle.mass
    gain_regressors = regressors
    if gauss_newton:
        d_induced = -ca.jacobian(equation.value(induced), used[C_LA]) / equation.slope(induced)
        through = ca.substitute(ca.jacobian(force[2], induced), coefficients, used)
        gain_regressors = ca.SX(regressors)
        gain_regressors[2, C_LA] += ca.mtimes(through, d_induced) / vehicle.mass
    regressors, gain_regressors = ca.substitute(
        [regressors, gain_regressors], [induced], [safe_newton(equation, ITERATIONS)]
    )

    new_thetas, new_covariances, errors = [], [], []
    for axis, at in enumerate(AXES):
        phi, direction = regressors[axis, at].T, gain_regressors[axis, at].T
        theta, P = thetas[axis], covariances[axis]
        kept = forgetting * ca.DM.eye(len(at)) + (1 - forgetting) * P / ca.repmat(priors[axis], 1, len(at))
        P = ca.mtimes(P, ca.inv_minor(kept))
        P = (P + P.T) / 2
        spread = ca.mtimes(P, direction)
        gain = spread / (ca.dot(direction, spread) + sigma**2)
        errors.append(y[axis] - ca.dot(phi, theta))
        new_thetas.append(theta + gain * errors[-1])
        new_covariances.append(P - ca.mtimes(gain, spread.T))

    speed = ca.fabs(v[0]) + ca.fabs(v[1])
    weight = ca.if_else(speed > 0, ca.fabs(v[0]) / (speed + (speed <= 0)), 0.5)
    raw = _combine(new_thetas, weight, lift_weight)
    return ca.Function(
        "rls_step",
        [v, w, y, used, *thetas, *covariances, *priors, sigma, forgetting, lift_weight],
        ca.cse(
            [
                *new_thetas,
                *new_covariances,
                raw,
                ca.vertcat(*errors),
                safe_newton(equation, ITERATIONS),
                ca.densify(regressors),
                weight,
            ]
        ),
        ["v", "w", "y", "used", *(f"theta_{a}" for a in "xyz"), *(f"P_{a}" for a in "xyz")]
        + [*(f"prior_{a}" for a in "xyz"), "sigma", "forgetting", "lift_weight"],
        [*(f"new_theta_{a}" for a in "xyz"), *(f"new_P_{a}" for a in "xyz")]
        + ["raw", "error", "induced", "regressors", "weight"],
    )


def _combine(thetas: Sequence[Expression], weight: Expression, lift_weight: Expression) -> Expression:
    """theta (5,) from the three axes, C_d0 by (25) and C_la by (26): beta_x = weight, beta_la,z = lift_weight."""
    x, y, z = thetas
    profile_drag = weight * x[0] + (1 - weight) * y[0]
    lift_slope = lift_weight * z[0] + (1 - lift_weight) * (weight * x[1] + (1 - weight) * y[1])
    return ca.vertcat(profile_drag, lift_slope, x[2], y[2], z[1])
