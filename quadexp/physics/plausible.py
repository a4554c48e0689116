"""Whether the numbers of a vehicle are of one vehicle.

A number in another unit is off by 10 to 10^9 and stands out in a ratio of the vehicle's own numbers. With m the mass, r
the longest arm, J a principal moment, W the weight, T and k the largest thrust and the thrust coefficient of one of n
rotors, c its torque coefficient, R its radius, A the reference area of the body's drag:

    ratio          allowed       shipped vehicles, 27 g to 1 kg
    m / r^3        5 .. 5000     77 .. 632 kg/m^3
    J / (m r^2)    0.015 .. 3    0.14 .. 1.1; all mass at the rotors: 0.5, 0.5, 1
    n T / W        .. 30         1.5 .. 10; racing quadrotors reach 15
    c / r          .. 3          0.06 .. 1.2
    sqrt(T / k) r  20 .. 800     103 .. 342 m/s; the tips of the blades are slower than sound
    R / r          0.05 .. 1.5   0.53 .. 0.59
    A / r^2        0.01 .. 30    3.1

The bounds are the range of the shipped vehicles (conf/vehicle names their sources), about ten times wider where physics
sets no end: vehicles of 20 g and of 40 kg are inside.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple, TypeVar

import numpy as np

from quadexp.errors import UsageError

LENGTHS = {"mm": 1e-3, "cm": 1e-2, "in": 0.0254}
MOMENTS = {"g m^2": 1e-3, "kg cm^2": 1e-4, "kg mm^2": 1e-6, "g cm^2": 1e-7, "g mm^2": 1e-9}


V = TypeVar("V")  # a Vehicle


class Ratio(NamedTuple):
    """value: key, number and unit, as a text. meant: another unit -> factor on the ratio, were the number in it."""

    value: str
    name: str
    number: float
    low: float
    high: float
    meant: Mapping[str, float]


def plausible(vehicle: V) -> V:
    """The same vehicle; raises UsageError where a number of it is none of a multirotor."""
    for one in _ratios(vehicle):
        if not one.low <= one.number <= one.high:
            units = [unit for unit, factor in one.meant.items() if one.low <= one.number * factor <= one.high]
            bounds = f"{one.low:g} to {one.high:g}" if one.low else f"at most {one.high:g}"
            hint = f"; was it meant in {' or '.join(units)}?" if units else ""
            raise UsageError(f"vehicle.{one.value}: {one.name} is {one.number:.3g}, multirotors have {bounds}{hint}")
    return vehicle


def _ratios(vehicle: Any) -> Iterator[Ratio]:
    mass, thrust, k, rotor = vehicle.mass, vehicle.thrust_max, vehicle.thrust_coefficient, vehicle.rotor
    arm, n = float(np.linalg.norm(vehicle.rotor_position, axis=1).max()), len(vehicle.rotor_position)
    heavy, name = mass / arm**3, "mass / arm^3 (kg/m^3)"
    if heavy < 5:
        cubes = {unit: factor**-3 for unit, factor in LENGTHS.items()}
        yield Ratio(f"rotor_position, an arm of {arm:.4g} m", name, heavy, 5, 5e3, cubes)
    yield Ratio(f"mass={mass:.4g} kg", name, heavy, 5, 5e3, {"g": 1e-3})
    for moment in (one for one in np.linalg.eigvalsh(vehicle.inertia)[::-1] if one > 0):
        own = f"inertia, a moment of {moment:.4g} kg m^2"
        yield Ratio(own, "moment / (mass arm^2)", moment / (mass * arm**2), 0.015, 3, MOMENTS)
    units = {"gram-force": 9.80665e-3, "mN": 1e-3, "N of all rotors": 1 / n}
    power = n * thrust / (mass * vehicle.gravity)
    yield Ratio(f"thrust_max={thrust:.4g} N per rotor", "thrust / weight", power, 0, 30, units)
    c = vehicle.torque_coefficient
    yield Ratio(f"torque_coefficient={c:.4g} m", "torque coefficient / arm", c / arm, 0, 3, LENGTHS)
    if k is not None:
        name, speed = "largest rotor speed times arm (m/s)", math.sqrt(thrust / k) * arm
        yield Ratio(f"thrust_coefficient={k:.4g} N s^2", name, speed, 20, 800, {"N/rpm^2": math.pi / 30})
    if rotor is not None:
        R, A, areas = rotor.radius, rotor.reference_area, {"cm^2": 1e-4, "mm^2": 1e-6}
        yield Ratio(f"rotor.radius={R:.4g} m", "radius / arm", R / arm, 0.05, 1.5, LENGTHS)
        yield Ratio(f"rotor.reference_area={A:.4g} m^2", "area / arm^2", A / arm**2, 0.01, 30, areas)
