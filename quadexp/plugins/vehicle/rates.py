"""Body rates for a flight stack, from what a controller commands: predicted, or those that give its torque.

Rates that a rate loop alpha = K (w* - w) turns into the angular acceleration of rotor thrusts u, in the mean over a
control period h, in which w comes nearer to w*:

    w* = w + h (1 - exp(-K h))^-1 J^-1 (tau - w x J w),    tau = G_tau u
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.control.wrapped import innermost
from quadexp.errors import UsageError
from quadexp.physics.expression import Expression
from quadexp.physics.state import RATE
from quadexp.physics.vehicle import Vehicle

Rates = Callable[[np.ndarray, np.ndarray], np.ndarray]  # state (13,), thrusts (n,) (N) -> rates (3,) (rad/s)


def rates_of(text: str, controller: Any) -> Rates:
    """Of --rates TEXT for the step that a controller has just made. Raises UsageError for another text."""
    gain = rate_gain(text)
    return predicted_rates(controller) if gain is None else inverse_rates(controller, gain)


def inverse_rates(controller: Any, gain: np.ndarray) -> Rates:
    """Those that give the torque of the thrusts. gain: K, (3,) (1/s)."""
    vehicle, period = controller.vehicle, controller.control_period
    return lambda x, thrusts: np.array(wanted_rates(vehicle, x, thrusts, gain, period)).ravel()


def predicted_rates(controller: Any, ahead: float | None = None) -> Rates:
    """Those that an MPC predicts for so long after its command begins to act (s); None: for its second node.

    Raises UsageError for a controller that predicts none."""
    core = innermost(controller)
    if not hasattr(core, "mpc") and getattr(core, "rates", None) is None:
        raise UsageError(
            "this controller predicts no body rates, as an MPC does: --rates inverse=X,Y,Z; betaflight: or inverse"
        )

    def predicted(x: np.ndarray, thrusts: np.ndarray) -> np.ndarray:
        if hasattr(core, "mpc"):
            now, later = core.mpc.prediction[0][:2, RATE]
            period = core.mpc.step.arguments["dt"][0]  # s; auto changes it in flight
        else:
            now, later, period = core.rates
        share = 1.0 if ahead is None else ahead / period
        rates: np.ndarray = now + share * (later - now)
        return rates

    return predicted


def rate_gain(text: str, own: np.ndarray | None = None) -> np.ndarray | None:
    """K of inverse=X,Y,Z (1/s), (3,); None for predicted. own: that of inverse alone, where the rate loop is known."""
    name, _, value = text.partition("=")
    if text == "predicted":
        return None
    if text == "inverse" and own is not None:
        return own
    try:
        gain = np.array([float(number) for number in value.split(",")])
    except ValueError:
        gain = np.zeros(0)
    if name != "inverse" or gain.shape != (3,) or not (np.isfinite(gain) & (gain > 0)).all():
        raise UsageError(f"--rates {text}: must be predicted, or inverse=X,Y,Z with the gains of the rate loop (1/s)")
    return gain


def wanted_rates(vehicle: Vehicle, x: Any, thrusts: Any, gain: np.ndarray, period: float) -> Expression:
    """Body rates (3,) (rad/s) with which the rate loop gives the torque of these thrusts, (n,) (N), over a period (s).

    gain: K, (3,) (1/s)."""
    J, rate = ca.DM(vehicle.inertia_matrix), ca.vertcat(x)[RATE]
    torque = ca.DM(vehicle.allocation[1:]) @ ca.vertcat(thrusts) - ca.cross(rate, J @ rate)
    share = ca.DM(-np.expm1(-gain * period))  # of the way to w* in a period
    return rate + period * (ca.inv(J) @ torque) / share
