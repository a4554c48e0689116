"""A battery as an equivalent circuit: a source, a series resistance and one RC pair.

    E(z)  = N (-1.031 exp(-35 z) + 3.685 + 0.2156 z - 0.1178 z^2 + 0.3201 z^3)    open-circuit voltage of N cells, V
    z'    = -I / (3600 Q)                     state of charge z, 0 .. 1; capacity Q (Ah)
    V_1'  = (R_1 I - V_1) / tau_1             voltage of the RC pair, tau_1 = R_1 C_1
    V     = E(z) - V_1 - R_0 I                at the terminals

and what the rotors make of it:

    P     = sum_i p_h (T_i / T_h)^(3/2)       W; T_h, p_h: thrust and power of one rotor in hover; I = P / V
    T_i   = u_i (V / V_ref)^k                 thrust at a fixed throttle (k = 2: rotor speed in proportion to V)
    T_i   = min(u_i, u_max (V / V_ref)^k)     where the flight stack compensates: more throttle, up to the full one

E(z): Chen & Rincon-Mora 2006, "Accurate electrical battery model capable of predicting runtime and I-V performance",
equation (2), a polymer lithium-ion cell; circuit: there, with one of its two RC pairs. Power: actuator disc, P ~
T^(3/2). Thrust and power depend on V and V on the power; `operating_point` solves that by Halley's method. With
T_i = u_i r^k the rotors' power is r^(3k/2) times that of the commands, so that no power of a thrust is taken there.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

from quadexp.compile.symbolic import ca
from quadexp.physics.expression import Expression

LEAST_SLOPE = 0.05  # of the balance; it tends to 0 where the battery has no more power to give
Exponent = float | Expression  # a whole number costs no exponential function


class OperatingPoint(NamedTuple):
    """voltage: at the terminals (V). current: A. thrust: delivered, (n,) (N)."""

    voltage: Expression
    current: Expression
    thrust: Expression


def open_circuit_voltage(charge: Expression, cells: Expression) -> Expression:
    """E (V) of cells in series at a state of charge, 0 .. 1."""
    z = charge
    return cells * (-1.031 * ca.exp(-35 * z) + 3.685 + 0.2156 * z - 0.1178 * z**2 + 0.3201 * z**3)


def open_circuit_tangent(charge: Expression, cells: Expression) -> tuple[Expression, Expression]:
    """a (V) and b (V) of the tangent a + b z to E at a state of charge."""
    z = type(charge).sym("z")
    voltage = open_circuit_voltage(z, cells)
    at, slope = ca.substitute([voltage, ca.jacobian(voltage, z)], [z], [charge])
    return at - slope * charge, slope


def charge_after(charge: Expression, current: Expression, capacity: Expression, elapsed: Expression) -> Expression:
    """State of charge after a current (A) has flowed for a time (s); capacity: Ah."""
    return charge - current * elapsed / (3600 * capacity)


def mean_share(time_constant: Expression, elapsed: Expression) -> Expression:
    """s of the mean of V_1 over a time (s), s V_1 + (1 - s) R_1 I, of a held current and V_1 at its beginning."""
    return -time_constant / elapsed * ca.expm1(-elapsed / time_constant)


def rotor_power(thrust: Expression, hover_thrust: Expression, hover_power: Expression) -> Expression:
    """Electrical power of every rotor, (n,) (W), of thrusts (n,) (N); hover_thrust (N) and hover_power (W): of one."""
    share = ca.fmax(thrust, 0) / hover_thrust
    return hover_power * share * ca.sqrt(share)


def sagging_thrust(command: Expression, ratio: Expression, exponent: Exponent) -> Expression:
    """Thrust (n,) (N) at a fixed throttle; command: that at V_ref, (n,) (N). ratio: V / V_ref. exponent: k."""
    return command * _power(ratio, exponent)


def sagging_power(power: Expression, ratio: Expression, exponent: Exponent) -> Expression:
    """Power of all rotors (W) at the sagging thrust; power: of every command, (n,) (W), see rotor_power."""
    return ca.sum1(power) * _power(ratio, 1.5 * exponent)


def compensated_thrust(
    command: Expression, ratio: Expression, exponent: Exponent, thrust_max: Expression
) -> Expression:
    """Thrust (n,) (N) where the flight stack compensates the voltage; thrust_max: at full throttle and V_ref (N)."""
    most = thrust_max * _power(ratio, exponent)
    return ca.fmin(command, most)


def compensated_power(power: Expression, ratio: Expression, exponent: Exponent, power_max: Expression) -> Expression:
    """Power of all rotors (W) at the compensated thrust; power: of every command, (n,); power_max: of thrust_max."""
    most = power_max * _power(ratio, 1.5 * exponent)
    return ca.sum1(ca.fmin(power, most))


def _power(ratio: Expression, exponent: Exponent) -> Expression:
    """ratio^exponent, ratio above 0, such that its derivative takes no other power; products of a whole exponent."""
    if isinstance(exponent, int | float) and float(exponent).is_integer():
        return math.prod([ratio] * int(exponent))
    return ca.exp(exponent * ca.log(ratio))


def operating_point(
    source: Expression,
    resistance: Expression,
    guess: Expression,
    thrust_at: Callable[[Expression], Expression],
    power_at: Callable[[Expression], Expression],
) -> OperatingPoint:
    """Where source and load agree, V = source - resistance P(V) / V.

    source: E - V_1 (V). resistance: R_0 (Ohm). guess: V, of the step before. thrust_at: voltage -> thrusts (n,) (N).
    power_at: voltage -> power of all rotors and the electronics (W). Where the battery cannot give the power there is
    no such point, and the voltage that is returned falls from step to step.

    One step of Halley's method, of third order: from a voltage that is off by 0.3 V to 1e-7 V, and exact at the next.
    """
    symbol = type(guess).sym("V")
    gap = symbol - source + resistance * power_at(symbol) * (1 / symbol)
    slope = ca.jacobian(gap, symbol)
    bend = ca.jacobian(slope, symbol)
    slope = ca.fmax(slope, LEAST_SLOPE)
    divisor = ca.fmax(slope**2 - gap * bend / 2, slope**2 / 2)  # the change is at most twice Newton's
    change = gap * slope / divisor
    voltage = ca.fmax(ca.substitute(symbol - change, symbol, guess), 1e-3)
    current = power_at(voltage) / voltage
    return OperatingPoint(source - resistance * current, current, thrust_at(voltage))
