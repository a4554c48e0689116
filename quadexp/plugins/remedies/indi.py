"""The INDI rate loop around a controller (Sun et al. 2022, (32)-(35)).

The thrusts u that a controller wants mean a collective thrust and an angular acceleration. The torque that the rotors
give, measured by their speeds W = sqrt(t / c_t), and the angular acceleration that came of it are known up to now; the
increment of the one is J times the wanted increment of the other, whatever else turns the vehicle:

    [T; J alpha + w x J w] = G u
    tau = G_tau c_t W_f^2 + I_p s (W_f - W_f,-1) / dt + J (alpha - (w_f - w_f,-1) / dt)               (32)-(34)
    [T; tau] = G c_t W_c^2 + [0, 0, 0, I_p s (W_c - W)] / T_s                                               (35)

_f: through the same second-order Butterworth low pass; s: signs of the reaction torques; T_s: spin_up_time, or dt as
printed. (34) and (35) are printed without c_t. Without I_p (35) is linear in W_c^2. With the transfer functions H of
the filter and M of the motors, a torque d_tau that nobody models, and J / k assumed D times too large,

    alpha / alpha_wanted = D M / (1 + (D - 1) H M),    alpha / d_tau = J^-1 (1 - H M) / (1 + (D - 1) H M)

so that a constant d_tau and a wrong J leave no steady error of alpha, as long as both filters are the same.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.control.inputs import Circumstances, Inputs
from quadexp.control.layer import Layer, LayerPart
from quadexp.control.wrapped import layers
from quadexp.errors import UsageError
from quadexp.models.build_context import BuildContext
from quadexp.parts.settings import Backend, key, keyed
from quadexp.physics.expression import Expression, named_function, named_symbols
from quadexp.physics.state import RATE
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.laws.allocation import allocation
from quadexp.plugins.laws.dfbc import TILT_FIRST, WRENCH_WEIGHT, Wrench
from quadexp.plugins.remedies.delay_line import delayed, kept_size, later_speeds

NEWTON_STEPS = 5  # of (35) with I_p, from the filtered speeds; quadratic convergence


def indi_function(vehicle: Vehicle, keys: INDI) -> ca.Function:
    """wanted (n,) (N), rate (3,) (rad/s), delivered (n,) (N), memory (2, 3 + n), before (3 + n,) -> thrust (n,) (N),
    memory_next, filtered (3 + n,): rates and roots of the thrusts, `before` of the next instant.

    Raises UsageError where the cut-off is not below half the rate, or rotor_inertia lacks what it needs.
    """
    n = vehicle.n_rotors
    dt = 1.0 / keys.rate
    if not keys.cutoff < keys.rate / 2:
        raise UsageError(f"rate_loop.cutoff={keys.cutoff:g}: must be below half of rate_loop.rate={keys.rate:g} Hz")
    b, a = _low_pass(keys)
    shapes = {"wanted": n, "rate": 3, "delivered": n, "memory": (3 + n, 2), "before": 3 + n}
    inputs = named_symbols(ca.MX, shapes)
    wanted, rate, delivered, memory, before = inputs.values()

    root = ca.sqrt(ca.fmax(delivered, 0))  # sqrt(c_t) W
    now = ca.vertcat(rate, root)
    filtered = b[0] * now + memory[:, 0]  # transposed direct form
    first = b[1] * now - a[1] * filtered + memory[:, 1]
    second = b[2] * now - a[2] * filtered
    memory_next = ca.horzcat(first, second)

    G = ca.DM(vehicle.allocation)
    J = ca.DM(vehicle.inertia_matrix)
    meant = G @ wanted
    torque = meant[1:] - ca.cross(rate, J @ rate)  # J alpha
    torque += G[1:, :] @ filtered[3:] ** 2 - J @ ((filtered[:3] - before[:3]) / dt)
    wrench = ca.vertcat(meant[0], torque)
    if keys.rotor_inertia:
        spin = _spin(vehicle, keys)
        wrench[3] += ca.dot(spin, filtered[3:] - before[3:]) / dt
        wrench = _without_spin_up(vehicle, spin / (keys.spin_up_time or dt), wrench, root, filtered[3:])
    thrust = allocation(vehicle, keys.allocation, keys.wrench_weight)(wrench)
    return named_function("indi", inputs, {"thrust": thrust, "memory_next": memory_next, "filtered": filtered})


def settled_memory(keys: INDI, values: np.ndarray) -> np.ndarray:
    """The filter's memory, (2, 3 + n), after these values, (3 + n,), have been there for long."""
    b, a = _low_pass(keys)
    return np.stack([(1 - b[0]) * values, (b[2] - a[2]) * values])


def _spin(vehicle: Vehicle, keys: INDI) -> ca.DM:
    """Torque about z_body per change of sqrt(thrust) per second, (n,). Raises UsageError where it is not known."""
    if vehicle.thrust_coefficient is None or vehicle.n_rotors != 4:
        raise UsageError(
            f"rate_loop.rotor_inertia={keys.rotor_inertia:g}: needs vehicle.thrust_coefficient and four rotors;"
            f" vehicle={vehicle.name} does not have both"
        )
    return ca.DM(keys.rotor_inertia * np.array(vehicle.rotor_spin) / np.sqrt(vehicle.thrust_coefficient))


def _without_spin_up(
    vehicle: Vehicle, gain: ca.DM, wrench: Expression, root: Expression, start: Expression
) -> Expression:
    """The wrench that static thrusts have to give so that (35) holds; Newton's method on the roots of the thrusts.

    gain: torque per change of a root (n,). root: measured (n,).
    """
    G = ca.DM(vehicle.allocation)
    roots = ca.fmax(start, 0.05 * np.sqrt(vehicle.hover_thrust))
    last = ca.DM([[0.0]] * 3 + [[1.0]])
    for _ in range(NEWTON_STEPS):
        residual = G @ roots**2 + last * ca.dot(gain, roots - root) - wrench
        slope = 2 * (G @ ca.diag(roots)) + last @ gain.T
        roots = ca.fmax(roots - ca.solve(slope, residual), 0.0)
    return wrench - last * ca.dot(gain, roots - root)


def _low_pass(keys: INDI) -> tuple[np.ndarray, np.ndarray]:
    """Numerator and denominator, (3,) each, of the discrete Butterworth filter of second order."""
    from scipy.signal import butter  # half a second of CPU to import, for this loop alone

    b, a = butter(2, keys.cutoff, fs=keys.rate)
    return b, a


WHOLE = 1e-6  # how far a ratio of rates may be from a whole number


@keyed
class INDI(LayerPart):
    """An INDI rate loop (incremental nonlinear dynamic inversion), with the values of Sun et al. 2022: every n-th
    instant the controller inside steps, whose thrusts the loop gives to the rotors."""

    prefix = "rate_loop."

    rate: float = key(300.0, "rate of the loop, a whole multiple of the controller's rate", "[1, 10000]", "Hz")
    cutoff: float = key(12.0, "of the Butterworth filter, below half the rate", "(0, 5000]", "Hz", tuned="4..100:log")
    allocation: Literal["clip", "exact"] = key(
        "clip", "clip: each thrust clipped by itself; exact: the least weighted error within the limits"
    )
    wrench_weight: Wrench = key(TILT_FIRST, WRENCH_WEIGHT)
    rotor_inertia: float = key(
        0.0, "of a rotor about its axis, against its spin-up; needs vehicle.thrust_coefficient", "[0, 1]", "kg m^2"
    )
    spin_up_time: float = key(
        0.03,
        "of a rotor, for rotor_inertia: its time constant; 0: one period, as printed",
        "[0, 1]",
        "s",
        when="rotor_inertia",
    )
    motor_lag: float = key(0.0, "time constant of the thrusts, where rotor speeds are not measured", "[0, 1]", "s")
    dead_time: float = key(0.0, "delay of the commands, where rotor speeds are not measured", "[0, 0.5]", "s")
    backend: Backend = "auto"

    def remembers(self, inputs: Inputs) -> dict[str, int]:
        """See LayerPart: the low pass, what it gave last, rates that have been given."""
        size = 3 + inputs.vehicle.n_rotors
        sizes = {"low_pass": 2 * size, "filtered": size}
        if inputs.about.late:
            sizes["rates"] = kept_size(3, inputs.about.late, inputs.period)
        return sizes

    def start(self, inputs: Inputs, x: np.ndarray, thrust: np.ndarray) -> dict[str, np.ndarray]:
        """See LayerPart: as if rates and thrusts of the start had always been there."""
        values = np.concatenate([x[RATE], np.sqrt(thrust)])
        start = {"low_pass": settled_memory(self, values), "filtered": values}
        if inputs.about.late:
            start["rates"] = np.tile(x[RATE], kept_size(3, inputs.about.late, inputs.period) // 3)
        return start

    def after(self, vehicle: Vehicle, inputs: Inputs, memory: Any, before: Any) -> dict[str, Any]:
        """The thrusts of `indi_function`."""
        rate = inputs.state[RATE]
        late = inputs.about.late
        results = {}
        if late:
            rate, results["rates"] = delayed(rate, memory.rates, late, inputs.period)
        low_pass = ca.reshape(memory.low_pass, -1, 2)
        law = indi_function(vehicle, self)
        thrust, memory_next, filtered = law(inputs.command, rate, inputs.delivered, low_pass, memory.filtered)
        return {"command": thrust, "low_pass": ca.vec(memory_next), "filtered": filtered, **results}

    def put_around(self, controller: Any, context: BuildContext) -> Layer:
        """See Remedy; UsageError where an observer inside finds the torque that the loop removes too."""
        if any(getattr(layer, "finds_torque", False) for layer in layers(controller)):
            raise UsageError(
                f"rate_loop={self.name}: it removes an unknown torque, which the observer inside finds too and the"
                " controller would take away a second time; set observer.torque_bandwidth=0"
            )
        return self.around(controller, later_speeds(context.sensor_spec))

    def around(self, controller: Any, late: float = 0.0) -> Layer:
        """See Remedy. late: by how much the rotors' speeds are older than the rates that they are compared with (s).

        Raises UsageError where the rate is no whole multiple of the controller's, or a setting contradicts others."""
        ratio = self.rate * controller.control_period
        every = round(ratio)
        if every < 1 or abs(ratio - every) > WHOLE * ratio:
            raise UsageError(
                f"rate_loop.rate={self.rate:g}: must be a whole multiple of the controller's rate of"
                f" {1 / controller.control_period:g} Hz"
            )
        about = Circumstances(controller.control_period / every, self.dead_time, self.motor_lag, late)
        return Layer(controller, self, about, backend=self.backend)
