"""What a controller believes about the air beyond the rigid body.

A residual is one CasADi function of body-frame quantities and runtime parameters:

    y, dy/dz = r(z, theta)
    z = [v_body (3, m/s), w (3, rad/s), u (n, N)]            (6 + n,)
    y = [a_body (3, m/s^2), tau_body (3, N m)]               (6,)

so that v' = R (T e_z / m + a_body) + g and J w' = tau + tau_body - w x J w. The Jacobian comes with it, because a
learned model knows a cheaper one than automatic differentiation finds. theta is an input of every compiled function:
new coefficients never recompile anything.
"""
