"""Settings of the feedback controller, with the values of Lei & Li 2017, and its variants."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

from quadexp.parts.settings import Settings, Triple, key


@dataclass(frozen=True)
class FeedbackSettings(Settings):
    """Gains, observer and safety options, with the values of Lei & Li 2017.

    *_proportional, *_derivative: diagonals of K_p (1/s^2) and K_d (1/s). cone: keep the desired thrust in the cone that
    a multirotor can hold: an upward demand of at least thrust_share_min m g, tilted by at most tilt_max.
    """

    prefix: ClassVar[str] = "controller."

    rate: float = key(100.0, "control rate", "[1, 1000]", "Hz")
    position_proportional: Triple = key(
        (0.3, 0.3, 0.3), "gain on the position error", "[0, 1000]", "1/s^2", tuned="0.1..10:log"
    )
    position_derivative: Triple = key(
        (0.9, 0.9, 0.9), "gain on the velocity error", "[0, 1000]", "1/s", tuned="0.3..10:log"
    )
    attitude_proportional: Triple = key(
        (0.8, 0.8, 0.8), "gain on the error of the Euler angles", "[0, 1000]", "1/s^2", tuned="0.3..100:log"
    )
    attitude_derivative: Triple = key(
        (2.4, 2.4, 2.4), "gain on the error of the Euler rates", "[0, 1000]", "1/s", tuned="0.5..50:log"
    )
    observer_bandwidth: float = key(
        6.0, "of the high-gain observer (36) of desired angles", "(0, 1000]", "rad/s", tuned="2..60:log"
    )
    cone: bool = key(True, "limit the desired thrust by thrust_share_min and tilt_max (the paper does not)")
    thrust_share_min: float = key(0.3, "least upward component of the desired thrust", "(0, 1]", "of the weight")
    tilt_max: float = key(math.radians(60.0), "largest tilt of the desired thrust", "(0, 1.57]", "rad")
    rotor_speed_min: float = key(50.0, "least rotor speed that is commanded", "[0, 1000]", "rad/s")
    inner_iterations: int = key(
        50, "iterations of the fixed point, in variants that do not use the last sample's values", "[1, 1000]"
    )

    @property
    def control_period(self) -> float:
        """h, s."""
        return 1.0 / self.rate


@dataclass(frozen=True)
class Variant:
    """What a feedback controller compensates, and with which coefficients.

    hub, drag: hub force H and body drag D in (32), (33). thrust, torque: delta_T in (33), delta_Gamma in (40).
    allocation: coefficients of (27): "motor": k_Tm, k_Qm; "static": k_T,static, k_Q,static from the parameters;
    "vehicle": the static ones of the vehicle. parameters: "identified" in flight, "true", or "none" (not needed).
    delayed: H, delta_T and delta_Gamma of the previous sample (as printed), else of this one by a fixed point.
    """

    hub: bool = True
    drag: bool = True
    thrust: bool = True
    torque: bool = True
    allocation: str = "motor"
    parameters: str = "identified"
    delayed: bool = True


_NOTHING = Variant(hub=False, drag=False, thrust=False, torque=False)

VARIANTS: dict[str, Variant] = {
    "rls": Variant(),
    "static": replace(_NOTHING, allocation="vehicle", parameters="none"),  # Remark 7, the baseline
    "literal": _NOTHING,  # Section 5 taken literally: k_Tm is 1.74 times the thrust coefficient in hover
    "nocomp_statid": replace(_NOTHING, allocation="static"),
    "oracle": Variant(parameters="true"),
    "oracle_impl": Variant(parameters="true", delayed=False),
    "rls_noH": Variant(hub=False),
    "static_H": replace(_NOTHING, hub=True, allocation="vehicle", parameters="true"),
}
