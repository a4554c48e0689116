"""From a configuration to the MPC whose model adapts in flight."""

from __future__ import annotations

from typing import Any

from quadexp.config.learned import OnlineMPCConfig
from quadexp.errors import UsageError
from quadexp.physics.vehicle import Vehicle


def online_mpc(
    config: OnlineMPCConfig, settings: Any, vehicle: Vehicle, known: list[Any], last: tuple[Any, Any] | None
) -> Any:
    """The controller.

    known: the residuals that do not adapt. last: the residual that adapts, and the checkpoint it is from; None for
    terms. Raises UsageError where the settings ask for what this model does not have.
    """
    from quadexp.air.adapting import adapting_terms, from_zero
    from quadexp.control.mpc.online_mpc import AdaptingController

    kind, adapt = config.residual[-1], config.adapt
    if adapt.fit_prior and kind != "gaussian_process":
        raise UsageError(f"controller.adapt.fit_prior: {kind} has no fitted signal variance, a Gaussian process has")
    if adapt.fitc and kind != "gaussian_process":
        raise UsageError(f"controller.adapt.fitc: {kind} has no inducing points, a Gaussian process has")
    if last is None:
        adapting = adapting_terms(vehicle, adapt.deviation)
    else:
        residual, checkpoint = last
        adapting = checkpoint.adapting(vehicle, residual, None if adapt.fit_prior else adapt.deviation)
    if adapt.start == "zero":
        adapting = from_zero(adapting)
    period = config.reference_period
    return AdaptingController(
        vehicle, known, adapting, settings, adapt, reference_period=period, backend=config.backend
    )
