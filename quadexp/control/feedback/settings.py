"""Settings of the feedback controller, with the values of Lei & Li 2017, and its variants."""

from __future__ import annotations

from dataclasses import dataclass, replace

from quadexp.config.lei_li import FeedbackKeys


@dataclass(frozen=True)
class FeedbackSettings(FeedbackKeys):
    """Gains, observer and safety options (see FeedbackKeys for each with its unit and range).

    *_proportional, *_derivative: diagonals of K_p (1/s^2) and K_d (1/s). cone: keep the desired thrust in the cone that
    a multirotor can hold: an upward demand of at least thrust_share_min m g, tilted by at most tilt_max.
    """

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
