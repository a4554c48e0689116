"""Columns of flights with a filter for navigation, and with a load on a cable."""

from __future__ import annotations

from quadexp.log.schema import BIAS, Columns, besides, each

VARIANCE = {
    **each("p", "m^2", "world", "position"),
    **each("v", "m^2/s^2", "world", "velocity"),
    **each("theta", "rad^2", "body", "attitude"),
    **each("bias_a", "m^2/s^4", "body", "the accelerometer's bias"),
    **each("bias_g", "rad^2/s^2", "body", "the gyroscope's bias"),
}
FLIGHT: Columns = {
    **besides("est_", BIAS, "{}, as the filter has it"),
    **besides("est_var_", VARIANCE, "variance of the error of {}, as the filter has it"),
    **each("load", "m", "world", "position of the payload on its cable"),
}
COLUMNS = {"flight": FLIGHT}
