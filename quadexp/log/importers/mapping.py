"""A mapping: which columns of a log are what, in which unit, frame and order. YAML that a user writes in a few lines:

    world: ENU                  # of the log; ENU, NWU, NED, ..., or axes such as "y x -z"
    body: FLU
    time: {column: t, unit: s}
    position: {columns: [x, y, z], unit: m}
    attitude: {columns: [qx, qy, qz, qw], order: xyzw, direction: body_to_world}
    rate: {columns: [gx, gy, gz], unit: deg/s}
    acceleration: {columns: [ax, ay, az], unit: g, kind: specific_force, mounting: [0.5, -7.8, 0]}
    motor_command: {columns: [m1, m2, m3, m4], range: [0, 65535], layout: [front_right, ...]}
    rotor_speed: {columns: [e1, e2, e3, e4], unit: erpm, pole_pairs: 7}
    crop: {height: 0.5, margin: 1.5}
    corrections: [{rate: {unit: deg/s}}, {body: FRD}]

Every key may be left out but `time`. corrections: made one after the other on what the other keys give, each as if that
were a log in SI units, ENU and FLU of which its lines are the mapping. mounting: roll, pitch and yaw (deg) of the sensor in the body, after `frame`:
v_body = R_z(yaw) R_y(pitch) R_x(roll) v_sensor. Read by mapping_reader.py.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from quadexp.log.importers.raw import Crop


@dataclass(frozen=True)
class Clock:
    """column, and factor to seconds."""

    column: str
    factor: float


@dataclass(frozen=True)
class Entry:
    """One quantity. factor: to SI (times `scale`). axes: (3, 3) to ENU or FLU. in_body: whether that is FLU.

    order: of a quaternion's columns, or "rpy" for angles. inverse: the log's attitude turns world into body vectors.
    coordinate: the acceleration is that of the motion, without gravity. low, high: values of commands 0 and 1.
    """

    columns: tuple[str, ...]
    factor: np.ndarray
    axes: np.ndarray = field(default_factory=lambda: np.eye(3))
    in_body: bool = False
    clock: Clock | None = None
    order: str = "wxyz"
    inverse: bool = False
    world: np.ndarray = field(default_factory=lambda: np.eye(3))
    coordinate: bool = False
    low: float = 0.0
    high: float = 1.0
    mounting: np.ndarray = field(default_factory=lambda: np.eye(3))


@dataclass(frozen=True)
class Mapping:
    """name, the kind of file ("text" or "hdf5"), its clock, an entry for every quantity it has, and corrections."""

    name: str
    format: str
    clock: Clock
    entries: dict[str, Entry]
    layout: tuple[str, ...] | None
    crop: Crop
    signature: tuple[str, ...] = ()
    corrections: tuple[Mapping, ...] = ()

    @property
    def columns(self) -> list[str]:
        """All columns that are read."""
        clocks = [self.clock, *(entry.clock for entry in self.entries.values() if entry.clock)]
        return [*(c.column for c in clocks), *(name for e in self.entries.values() for name in e.columns)]
