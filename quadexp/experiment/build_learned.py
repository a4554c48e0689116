"""From a configuration to the MPC whose model adapts in flight."""

from __future__ import annotations

from typing import Any

from quadexp.config.learned import AdaptKeys, OnlineMPCConfig
from quadexp.errors import UsageError
from quadexp.physics.vehicle import Vehicle


def online_mpc(config: OnlineMPCConfig, settings: Any, vehicle: Vehicle, model: Any) -> Any:
    """The controller; model: the checkpoints of its residuals (build.ModelFile), None where none needs one."""
    from quadexp.air.adapting import from_zero
    from quadexp.control.mpc.online_mpc import AdaptingController
    from quadexp.experiment.build import residual_parts

    *known, last = config.residual
    files = list(model.files) if model else []
    own = files[len(known) :]
    adapting = _adapting(last, config.adapt, vehicle, own[0] if own else None)
    if config.adapt.start == "zero":
        adapting = from_zero(adapting)
    fixed = residual_parts(known, vehicle, model) if known else []
    return AdaptingController(
        vehicle,
        fixed,
        adapting,
        settings,
        config.adapt,
        reference_period=config.reference_period,
        backend=config.backend,
    )


def _adapting(kind: str, adapt: AdaptKeys, vehicle: Vehicle, file: Any) -> Any:
    from quadexp.air.adapting import adapting_drag, adapting_network, adapting_process, adapting_terms
    from quadexp.air.neural import Network
    from quadexp.experiment.build import load_checkpoint, residual_from_file

    if adapt.fit_prior and kind != "gaussian_process":
        raise UsageError(f"controller.adapt.fit_prior: a Gaussian process has a fitted signal variance, {kind} has none")
    if kind == "terms":
        return adapting_terms(vehicle, adapt.deviation)
    residual, checkpoint = residual_from_file(kind, vehicle, file), load_checkpoint(vehicle, file)
    if kind == "linear_drag":
        return adapting_drag(vehicle, residual, adapt.deviation)
    if kind == "neural":
        network = Network(checkpoint.features, checkpoint.outputs, checkpoint.weights, checkpoint.biases)
        return adapting_network(residual, network, adapt.deviation)
    return adapting_process(residual, checkpoint.outputs, None if adapt.fit_prior else adapt.deviation)
