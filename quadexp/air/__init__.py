"""Residual models: the acceleration and torque of the air that a controller adds to the rigid body.

A residual is one CasADi function of body-frame quantities and runtime parameters:

    y, dy/dz = r(z, theta)
    z = [v_body (3, m/s), w (3, rad/s), u (n, N)]            (6 + n,)
    y = [a_body (3, m/s^2), tau_body (3, N m)]               (6,)

so that v' = R (T e_z / m + a_body) + g and J w' = tau + tau_body - w x J w. The function also returns the Jacobian,
because a learned model has a cheaper one than automatic differentiation. theta is an input of every compiled function:
new coefficients do not require recompilation.
"""
