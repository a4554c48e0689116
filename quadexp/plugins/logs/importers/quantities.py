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
# Where a rotor can be, front to back, then left or right.
PLACES = ("front_right", "back_right", "back_left", "front_left", "front", "right", "back", "left")
ON_AXIS = 0.2  # of the larger of |x| and |y|: a rotor that is no farther beside an axis lies on it


def place_of(x: float, y: float) -> str:
    """The name of the place of a rotor at x, y (FLU); "" in the middle."""
    reach = ON_AXIS * max(abs(x), abs(y))
    words = []
    if abs(x) > reach:
        words.append("front" if x > 0 else "back")
    if abs(y) > reach:
        words.append("left" if y > 0 else "right")
    return "_".join(words)


def columns_of(quantity: str, width: int) -> tuple[str, ...]:
    """Names of the flight's columns that a stream of `width` values fills."""
    names = QUANTITIES[quantity].columns
    return tuple(names[0].format(i) for i in range(width)) if quantity in ROTORS else names
