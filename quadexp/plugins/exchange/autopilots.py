"""Parameters of autopilots: thrust curve, hover, control allocation; and of PX4's own simulation, SIH.

f, T(1), sigma, c1, c2: known.py. d: linear drag (1/s), m: mass, n: number of rotors, s_i: signs of reaction torques.
FLU here, FRD there: x, -y, -z.

    PX4         u = THR_MDL_FAC s^2 + (1 - THR_MDL_FAC) s, solved for the signal s of a wished thrust u
                THR_MDL_FAC = f, MPC_THR_HOVER = g / (n sigma (c1 + c2)), CA_ROTORi_PX, PY, PZ = x, -y, -z,
                CA_ROTORi_CT = T(1), CA_ROTORi_KM = -c_tau s_i
    PX4 SIH     T = T_MAX s, Q = Q_MAX s, drag -KDV v along all axes:
                T_MAX = T(1), Q_MAX = c_tau T(1), L_ROLL = |y|, L_PITCH = |x|, KDV = m (d_x + d_y) / 2, T_TAU = lag;
                as it is linear in s, with THR_MDL_FAC 0 and THR of hover as a share of T(1)
    ArduPilot   thrust = (1 - e) s + e s^2 between MOT_SPIN_MIN and MOT_SPIN_MAX: MOT_THST_EXPO = f for 0 and 1
    Betaflight  output of a wished thrust x, e = thrust_linear / 100: x (1 + e (1 - x)^2), from 2026.6 on
                x (1 + e (1 - x) (1 + e (1 - 2x))); the e with the least departure of the thrust from x
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from quadexp.errors import UsageError
from quadexp.plugins.exchange.document import Target, Written
from quadexp.plugins.exchange.known import Known, Quantity, of_file
from quadexp.plugins.exchange.simulators import MOMENTS, linear_force

X_LAYOUT = ("fr", "bl", "fl", "br")  # of PX4's quadrotor x, whose SIH has these spins built in
X_SPINS = (-1, -1, 1, 1)
FRD = np.diag([1.0, -1.0, -1.0])  # of FLU
INTEGER = 6  # type of a QGroundControl parameter file
REAL = 9  # likewise
SECOND_ORDER = (2026, 6)  # first Betaflight with the other curve
FIRST = (4, 0)  # Betaflight with thrust_linear
LARGEST_LINEAR = 150  # thrust_linear
THRUSTS = np.linspace(0.1, 1.0, 200)  # shares of full thrust over which Betaflight's curve is fitted
SPIN_MIN = 0.15  # ArduPilot's default
SPIN_MAX = 0.95  # likewise
LOG_SCALE = "the signal s, 0 to 1, is that of the flights' log: the same limits of the motors' outputs must be set"


def _qgc(numbers: dict[str, Quantity]) -> str:
    """A parameter file as QGroundControl loads it."""
    rows = ["# Vehicle-Id Component-Id Name Value Type"]
    for name, quantity in numbers.items():
        whole = isinstance(quantity.value, int)
        value = str(quantity.value) if whole else f"{quantity.value:.9g}"
        rows.append(f"1\t1\t{name}\t{value}\t{INTEGER if whole else REAL}")
    return "\n".join(rows) + "\n"


def _setting(value: int | float, why: str) -> Quantity:
    return Quantity(value, "1", "set here", note=why)


def _share(known: Known, most: float = 1.0, least: float = 0.0) -> tuple[Quantity, list[str]]:
    """f inside what the autopilot allows, and what is lost by that."""
    share = known.quantity(lambda p: p.share, "1")
    if least <= share.value <= most:
        return share, []
    bound = float(np.clip(share.value, least, most))
    lost = f"the curve needs a share of the square of {share.value:.4g}, allowed are {least:g} to {most:g}"
    return share.changed(bound, f"{share.value:.4g} is out of range"), [lost]


def _hover(known: Known) -> Quantity:
    return known.quantity(lambda p: p.gravity / (p.n_rotors * p.sigma * (p.c1 + p.c2)), "share of full thrust")


def _rotors(known: Known, order: list[int]) -> dict[str, Quantity]:
    """Geometry of the control allocation, FRD."""
    numbers = {"CA_AIRFRAME": _setting(0, "multirotor"), "CA_ROTOR_COUNT": _setting(len(order), "")}
    thrust = known.quantity(lambda p: p.full_thrust, "N")
    for i, rotor in enumerate(order):
        position = FRD @ known.vehicle.rotor_position[rotor] + 0.0
        torque = -known.vehicle.torque_coefficient * known.vehicle.rotor_spin[rotor]
        numbers |= {
            f"CA_ROTOR{i}_P{axis}": of_file(float(value), "m") for axis, value in zip("XYZ", position, strict=True)
        }
        numbers[f"CA_ROTOR{i}_CT"] = thrust
        numbers[f"CA_ROTOR{i}_KM"] = of_file(torque, "m")
    return numbers


def px4(known: Known) -> Written:
    """Thrust curve, hover and allocation of a vehicle that flies PX4; rotors in the order of the flights' motors."""
    known.require_commands("px4")
    share, lost = _share(known)
    numbers = {"THR_MDL_FAC": share, "MPC_THR_HOVER": _hover(known)}
    numbers |= _rotors(known, list(range(known.vehicle.n_rotors)))
    lost += [LOG_SCALE, "mass, inertia and drag: PX4 has no model of them outside its simulation"]
    return Written(_qgc(numbers), numbers, lost)


def px4_sih(known: Known) -> Written:
    """The vehicle in PX4's simulation SIH, whose motors are linear."""
    known.require_commands("px4_sih")
    order = known.place("px4_sih", X_LAYOUT, X_SPINS)
    known.same_arms("px4_sih")
    numbers = {"THR_MDL_FAC": _setting(0.0, "SIH is linear in the signal"), "MPC_THR_HOVER": _hover(known)}
    numbers |= _rotors(known, order)
    numbers["SIH_MASS"] = of_file(known.vehicle.mass, "kg")
    inertia = FRD @ known.vehicle.inertia_matrix @ FRD
    for name, place in MOMENTS.items():
        numbers[f"SIH_{name.upper()}"] = of_file(float(inertia[place]), "kg m^2")
    numbers["SIH_T_MAX"] = known.quantity(lambda p: p.full_thrust, "N")
    numbers["SIH_Q_MAX"] = known.quantity(lambda p: p.torque_coefficient * p.full_thrust, "N m")
    numbers["SIH_L_ROLL"] = of_file(abs(known.vehicle.rotor_position[0][1]), "m")
    numbers["SIH_L_PITCH"] = of_file(abs(known.vehicle.rotor_position[0][0]), "m")
    drag = known.quantity(lambda p: p.mass * (p.d_x + p.d_y) / 2, "N s/m")
    numbers["SIH_KDV"] = drag.not_negative()
    numbers["SIH_KDW"] = Quantity(0.0, "N m s", "not known")
    lag = known.quantity(lambda p: p.lag, "s")
    if lag.value:
        numbers["SIH_T_TAU"] = lag
    per_mass = numbers["SIH_KDV"].value / known.vehicle.mass
    lost = [
        "rotors in SIH's order: front right, back left, front left, back right",
        "SIH's motors are linear: its commands are not those of the vehicle, its thrusts are",
        f"drag by axis: one for all, d_z = {known.facts['d_z'].value:.3g} 1/s is not in it",
        *known.departure(lambda velocity, thrust: linear_force(velocity, [per_mass] * 3)),
    ]
    return Written(_qgc(numbers), numbers, lost)


def ardupilot(known: Known) -> Written:
    """Thrust curve and hover; for ends a, b of the spin MOT_THST_EXPO is f (b - a) / (1 - f + f (a + b))."""
    known.require_commands("ardupilot")
    share, lost = _share(known, least=-1.0)
    numbers = {"MOT_THST_EXPO": share, "MOT_THST_HOVER": _hover(known)}
    f = share.value
    hover = numbers["MOT_THST_HOVER"].value
    a = SPIN_MIN
    b = SPIN_MAX
    low = (1 - f) * a + f * a * a
    high = (1 - f) * b + f * b * b
    expo = f * (b - a) / (1 - f + f * (a + b))
    lost += [
        "both numbers hold for MOT_SPIN_MIN 0 and MOT_SPIN_MAX 1",
        f"with {a:g} and {b:g}, the defaults, they are {expo:.4g} and {(hover - low) / (high - low):.4g}",
        f"the thrust at MOT_SPIN_MIN {a:g}, {100 * low:.3g} % of the full one, is not in its model",
        LOG_SCALE,
        "mass, inertia and drag: the firmware has no model of them",
    ]
    text = "".join(f"{name},{quantity.value:.9g}\n" for name, quantity in numbers.items())
    return Written(text, numbers, lost)


def betaflight(known: Known, firmware: str | None) -> Written:
    """thrust_linear, whole percent; the firmware has two forms of it."""
    known.require_commands("betaflight")
    version = _version(firmware)
    f = known.value(lambda p: p.share)
    departures = [_departure(e / 100, f, version) for e in range(LARGEST_LINEAR + 1)]
    best = int(np.argmin(departures))
    origin = known.quantity(lambda p: p.share, "1").origin
    note = "nearest to a straight line; whole percent, without an interval"
    numbers = {"thrust_linear": Quantity(best, "%", origin, note=note)}
    lost = [
        f"thrust is linear within {100 * departures[best]:.2f} % of full thrust (rms)",
        f"with thrust_linear 0 it is within {100 * departures[0]:.2f} %",
        f"for Betaflight {firmware}: the curve is another one {'before' if version >= SECOND_ORDER else 'from'} 2026.6",
        LOG_SCALE,
        "motor_poles, mass, inertia, drag, reaction torque: not identified, or no place in the firmware",
    ]
    return Written(f"set thrust_linear = {best}\nsave\n", numbers, lost)


def _version(firmware: str | None) -> tuple[int, ...]:
    if firmware is None:
        raise UsageError("--to betaflight: add --firmware VERSION, such as 4.5 or 2026.6: its curve changed in 2026.6")
    if not re.fullmatch(r"\d+(\.\d+){1,2}", firmware):
        raise UsageError(f"--firmware {firmware}: must be a version such as 4.5 or 2026.6")
    version = tuple(map(int, firmware.split(".")))
    if version < FIRST:
        raise UsageError(f"--firmware {firmware}: thrust_linear is there from {FIRST[0]}.{FIRST[1]} on")
    return version


def motor_output(thrust: Any, e: float, version: tuple[int, ...]) -> Any:
    """Betaflight's output, 0 to 1, for a wished share of full thrust."""
    rest = 1 - thrust
    if version >= SECOND_ORDER:
        return thrust * (1 + e * rest * (1 + e * (rest - thrust)))
    return thrust * (1 + e * rest**2)


def _departure(e: float, f: float, version: tuple[int, ...]) -> float:
    """rms of the thrust from the wished one, shares of full thrust."""
    output = motor_output(THRUSTS, e, version)
    thrust = (1 - f) * output + f * output**2
    return float(np.sqrt(np.mean((thrust - THRUSTS) ** 2)))


PX4_SIH = Target(
    "px4_sih",
    px4_sih,
    ".params",
    "Parameters for PX4's simulation SIH (QGroundControl's format)",
    frozenset({"voltage", "motor_lag"}),
)
ARDUPILOT = Target("ardupilot", ardupilot, ".param", "Parameters for ArduCopter", frozenset({"voltage"}))
BETAFLIGHT = Target(
    "betaflight",
    betaflight,
    ".txt",
    "Lines for Betaflight's command line",
    frozenset({"voltage", "firmware"}),
    asks=("firmware",),
)
PX4 = Target("px4", px4, ".params", "Parameters for PX4 (QGroundControl's format)", frozenset({"voltage"}))
