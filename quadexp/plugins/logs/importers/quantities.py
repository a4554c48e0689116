"""What a log can hold: quantities, the columns of a flight that they fill, and where its rotors are."""

from __future__ import annotations

from typing import NamedTuple


class Quantity(NamedTuple):
    """columns: of a flight; {} stands for the number of a rotor. dimension: of its units. keys: that it alone has."""

    columns: tuple[str, ...]
    dimension: str
    keys: tuple[str, ...] = ()

    @property
    def is_vector(self) -> bool:
        return len(self.columns) == 3


def _vector(name: str, axes: str = "xyz") -> tuple[str, ...]:
    return tuple(f"{name}_{axis}" for axis in axes)


QUANTITIES: dict[str, Quantity] = {
    "position": Quantity(_vector("p"), "length"),
    "attitude": Quantity(_vector("q", "wxyz"), "angle", ("order", "direction", "angles", "turn")),
    "velocity": Quantity(_vector("v"), "velocity"),
    "rate": Quantity(_vector("w"), "rate", ("mounting", "offset")),
    "acceleration": Quantity(_vector("acc"), "acceleration", ("kind", "mounting", "offset")),
    "motor_command": Quantity(("motor_command_{}",), "none", ("range", "layout")),
    "rotor_speed": Quantity(("rotor_speed_{}",), "rotor_speed", ("layout", "pole_pairs")),
    "rotor_thrust": Quantity(("u_{}",), "force", ("layout",)),
    "thrust_acceleration": Quantity(("thrust_acceleration",), "acceleration"),
    "battery_voltage": Quantity(("battery_voltage",), "voltage"),
    "wind": Quantity(_vector("wind"), "velocity"),
    "reference_position": Quantity(_vector("ref_p"), "length"),
    "reference_velocity": Quantity(_vector("ref_v"), "velocity"),
    "reference_attitude": Quantity(_vector("ref_q", "wxyz"), "angle", ("order", "direction")),
}
ROTORS = ("motor_command", "rotor_speed", "rotor_thrust")
# Where the places of a rotor are, as signs of x and y in FLU.
PLACES = {
    "front_right": (1, -1), "back_right": (-1, -1), "back_left": (-1, 1), "front_left": (1, 1),
    "front": (1, 0), "right": (0, -1), "back": (-1, 0), "left": (0, 1),
}  # fmt: skip


def columns_of(quantity: str, width: int) -> tuple[str, ...]:
    """Names of the flight's columns that a stream of `width` values fills."""
    names = QUANTITIES[quantity].columns
    return tuple(names[0].format(i) for i in range(width)) if quantity in ROTORS else names
