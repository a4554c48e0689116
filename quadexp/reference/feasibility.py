"""Whether the vehicle can fly a reference.

    thrust_min <= u_i <= thrust_max (N),    |w| <= rate_max (rad/s)

Checked before flight, so that a violation is reported with its time and size.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from quadexp.physics.state import RATE
from quadexp.physics.vehicle import Vehicle
from quadexp.reference.flatness import Reference


@dataclass(frozen=True)
class Infeasibility:
    """The worst violation of a limit along a reference.

    what: "rotor 2 thrust", "body rate". value, limit: in `unit`. t: s. margin: excess over the limit, above 0.
    share: of the reference's samples that are beyond any limit.
    """

    what: str
    value: float
    limit: float
    unit: str
    t: float
    margin: float
    share: float

    def __str__(self) -> str:
        side = "above" if self.value > self.limit else "below"
        return (
            f"the reference cannot be flown: {self.what} would be {self.value:.4g} {self.unit} at t = {self.t:.2f} s,"
            f" {self.margin:.3g} {self.unit} {side} the limit of {self.limit:g} {self.unit}"
            f" ({100 * self.share:.2g} % of the reference is beyond a limit); lower trajectory.speed"
        )


def check_feasible(reference: Reference, vehicle: Vehicle) -> Infeasibility | None:
    """The largest violation relative to the limit's range, or None."""
    thrust_range = vehicle.thrust_max - vehicle.thrust_min
    rate = np.linalg.norm(reference.state[:, RATE], axis=1, keepdims=True)
    rotors = [f"rotor {i} thrust" for i in range(vehicle.n_rotors)]
    checks = (  # names, values (k, n), limit, sign of the violation, unit, range
        (rotors, reference.input, vehicle.thrust_max, 1.0, "N", thrust_range),
        (rotors, reference.input, vehicle.thrust_min, -1.0, "N", thrust_range),
        (["body rate"], rate, vehicle.rate_max, 1.0, "rad/s", vehicle.rate_max),
    )
    beyond = np.any([(sign * (values - limit) > 0).any(axis=1) for _, values, limit, sign, _, _ in checks], axis=0)
    if not beyond.any():
        return None
    names, values, limit, sign, unit, _ = max(checks, key=lambda c: (c[3] * (c[1] - c[2])).max() / c[5])
    row, column = np.unravel_index(np.argmax(sign * values), values.shape)
    value = float(values[row, column])
    return Infeasibility(
        names[column], value, limit, unit, float(reference.t[row]), sign * (value - limit), float(beyond.mean())
    )


def clipped(reference: Reference, vehicle: Vehicle) -> Reference:
    """The reference with every thrust, and every component of the body rate, brought back to the vehicle's limits."""
    state = reference.state.copy()
    state[:, RATE] = np.clip(state[:, RATE], -vehicle.rate_max, vehicle.rate_max)
    return replace(reference, state=state, input=np.clip(reference.input, vehicle.thrust_min, vehicle.thrust_max))
