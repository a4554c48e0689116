"""Blade-element forces with lumped coefficients: the regression for rotors whose shape nobody measured.

From quadexp.physics.blade_element (Lei & Li 2017, equations 9, 10, 14, 15), with s = N_b rho c / 2, climb v_z = -V_z,
flow through the rotor u_k = V_k + v_z, and the airframe's drag (6), the specific force is

    f_z     = (s C_la / m) [ r^3 th/3 sum w^2 + A r th n V_h^2 - r^2/2 sum w (V + v_z) ] - rho S C_Dz/(2m) ||v|| v_z
    f_{x,y} = -(v_i/m) [ s r^2 C_d0/2 sum w - s B r th C_la sum u + s C_la/2 sum u^2/w ] - rho S C_Di/(2m) ||v|| v_i

In air at rest V_k = nu w_k (Remark 4). With y_k = V_k + v_z - nu w_k, what flows through the rotor beyond that,

    f_z     = [k_T,static/m] sum w^2 - [k_3/m] sum w y + [k_2/m] n V_h^2 - [k_4/m] v_z ||v||
    f_{x,y} = -[h_1/m] v_i sum w - [h_2/m] v_i sum y - [h_3/m] v_i sum y^2/w - [k_4/m] v_i ||v||

    k_T,static = s C_la (r^3 th/3 - r^2 nu/2)        k_3 = s C_la r^2/2        k_2 = s C_la A r th
    h_1 = s (r^2 C_d0/2 - B r th C_la nu + C_la nu^2/2)        h_2 = s C_la (nu - B r th)        h_3 = s C_la/2
    k_4 = rho S C_D/2, per axis

which is the blade-element model exactly, with lumped coefficients. The rotor speeds themselves are not needed:
w = sqrt(a / k), a the thrust curve's acceleration of a rotor and k = k_T,static/m. Logged as rotor speed it is that
exactly; from a command it is the best that there is. So the terms of quadexp.learn.terms carry, with k in 1/m
(sqrt(k) turns w in rad/s into sqrt(m/s^2)),

    thrust     correction of the curve's scale           hub         h_1 / (m sqrt(k))
    inflow     k_3 / (m sqrt(k))                         hub_inflow  h_2 / m
    advance    k_2 / m                                   hub_square  h_3 sqrt(k) / m
    body       k_4 / m

V_k follows from momentum theory (17) at the rotor's thrust, kappa V sqrt(V_h^2 + u^2) = T/m, kappa = 2 rho pi r^2/m:
one number of the rotor, its radius, is needed. The thrust in it is the model's own, so the four z coefficients are
found by Gauss-Newton through V (quadexp.learn.lumped_fit). With kappa alone the curve's static thrust is taken for
it instead; then y is split into climb and V' = V - V_hover, whose coefficients answer for that (`WITH_RADIUS`).
Without a radius V' is left out and its mean goes into climb and advance, and hub_climb, -v_i n v_z, stands for both
terms in y (`WITHOUT_RADIUS`). The rotors' own velocities (omega x r_k) cancel from the sums to first order.
Offsets as in body_drag.
"""

from __future__ import annotations

import math

from quadexp.physics.rotor import BladeCoefficients, RotorGeometry
from quadexp.physics.rotor_coefficients import motor_coefficients, static_coefficients
from quadexp.physics.vehicle import Vehicle

AIR_DENSITY = 1.2  # kg/m^3, where the vehicle does not say
HUB = ("hub", "hub_climb", "body", "offset")
WITHOUT_RADIUS = (HUB, HUB, ("thrust", "climb", "advance", "body"))
HUB_INFLOW = ("hub", "hub_inflow", "hub_square", "body", "offset")
SELF_CONSISTENT = (HUB_INFLOW, HUB_INFLOW, ("thrust", "inflow", "advance", "body"))
WITH_RADIUS = (HUB, HUB, ("thrust", "climb", "advance", "induced", "body"))


def momentum_of(vehicle: Vehicle | None, mass: float | None, radius: float | None) -> float:
    """kappa = 2 rho pi r^2 / m (1/m), 0 where radius or mass is unknown; radius (m) goes before the vehicle's own."""
    geometry = vehicle.rotor_geometry if vehicle and vehicle.rotor else None
    mass = mass or (vehicle.mass if vehicle else None)
    if radius is None:
        return geometry.momentum_factor / mass if geometry and mass else 0.0
    density = geometry.air_density if geometry else AIR_DENSITY
    return 2 * density * math.pi * radius**2 / mass if mass else 0.0


def lumped_terms(momentum: float) -> tuple[tuple[str, ...], ...]:
    """Names of the terms, axis by axis."""
    return WITH_RADIUS if momentum else WITHOUT_RADIUS


def lumped_coefficients(
    geometry: RotorGeometry, blade: BladeCoefficients, mass: float, static_thrust: float
) -> dict[tuple[str, str], float]:
    """What the module's table gives for a known rotor: (axis, term) -> value; for tests, and to read a fit.

    static_thrust: m times the thrust curve's c_2 (N s^2), which need not be k_T,static: `thrust` makes up for it.
    """
    s, r, twist, lift = geometry.blade_density, geometry.radius, geometry.twist, blade.lift_slope
    static = static_coefficients(geometry, blade)
    nu = static.inflow
    root = mass * math.sqrt(static_thrust / mass)
    climb = s * lift * r**2 / 2
    hub = motor_coefficients(geometry, blade).hub + s * lift * nu * (nu / 2 - r * twist / 6)
    found = {("z", "inflow"): climb / root, ("z", "thrust"): static.thrust / static_thrust - 1}
    found["z", "advance"] = s * lift * r * twist / 2 / mass
    for i, axis in enumerate("xyz"):
        found[axis, "body"] = geometry.air_density * geometry.reference_area * blade.body_drag[i] / 2 / mass
    for axis in "xy":
        found[axis, "hub"] = hub / root
        found[axis, "hub_inflow"] = s * lift * (nu - r * twist / 6) / mass
        found[axis, "hub_square"] = s * lift / 2 * root / mass**2
    return found
