"""Columns of flights of Lei & Li's system, and of estimates of its coefficients."""

from __future__ import annotations

from quadexp.log.schema import Column, Columns, besides, each

COEFFICIENTS = {
    "C_d0": Column("1", "", "profile drag coefficient of the blades"),
    "C_la": Column("1/rad", "", "lift slope of the blades"),
    **{f"C_D{i}": Column("1", "body", "drag coefficient of the airframe") for i in "xyz"},
}
FLIGHT: Columns = {
    **besides("", COEFFICIENTS, "{}, in use"),
    "clips": Column("1", "", "entries of the estimate clipped so far"),
    "reopened": Column("1", "", "times the estimator found a change so far"),
    "phi_d": Column("rad", "FRD in NED", "desired roll angle"),
    "theta_d": Column("rad", "FRD in NED", "desired pitch angle"),
    "error_eta": Column("rad", "", "norm of the Euler angles' distance to the desired ones"),
    "cone": Column("1", "", "1 where the desired thrust was moved into the cone"),
    "floored": Column("1", "", "rotors commanded at the least speed"),
    "limited": Column("1", "", "rotors commanded at the largest thrust"),
}
ESTIMATES: Columns = {
    "t": Column("s", "", "time since the start of the flight"),
    **besides("", COEFFICIENTS, "{}, in use"),
    **besides("raw_", COEFFICIENTS),
    **besides("std_", COEFFICIENTS, "the recursion's own deviation of the {}; no interval"),
    **each("error", "m/s^2", "body", "specific force less its prediction"),
}
COLUMNS = {"flight": FLIGHT, "estimates": ESTIMATES}
