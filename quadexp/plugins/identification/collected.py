"""Rows of `quadexp collect` for which recorded flights, or the timing of simulated ones, have to be understood."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from quadexp.errors import UsageError
from quadexp.experiment.collect_settings import CollectConfig
from quadexp.experiment.identity import digest
from quadexp.log.schema import Flight
from quadexp.models.checkpoint import load_model
from quadexp.models.dataset import ResidualDataset, residual_dataset
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.identification.delays import timing_by_accelerometer
from quadexp.plugins.identification.recorded import logged_thrust, recorded_dataset
from quadexp.plugins.identification.rotor_thrust import fit_timing, mean_thrust
from quadexp.plugins.identification.thrust_curve import ThrustCurve

OF_TIMING = ("vehicle", "plant", "truth", "link", "actuator", "health", "sensor", "estimator")  # decide lag and delays
NOISY = "warning: the target is the derivative of an estimated velocity, with its filter and noise"


def recorded_rows(
    settings: CollectConfig, vehicle: Vehicle, flights: Sequence[Flight], names: Sequence[str]
) -> tuple[ResidualDataset, list[str]]:
    """Rows of recorded flights, with notes on them."""
    if settings.identified is None:
        curve = logged_thrust(flights, vehicle)
    else:
        curve = identified_thrust(settings.identified, vehicle)
    target = "specific_force" if settings.target == "auto" else settings.target
    dataset = recorded_dataset(flights, vehicle, curve, target=target, frame=settings.frame, names=names)
    return dataset, [NOISY] if target == "velocity" else []


def identified_thrust(path: str, vehicle: Vehicle) -> ThrustCurve:
    """The curve of an identified vehicle. Raises UsageError where the checkpoint is of something else."""
    model = load_model(path, vehicle=vehicle, unknown=True)
    if not hasattr(model, "thrust"):
        said = f"collect.identified={path}: has no thrust curve"
        raise UsageError(f"{said}; give a folder written by `quadexp identify`")
    curve: ThrustCurve = model.thrust
    return curve


def delivered_rows(
    settings: CollectConfig, vehicle: Vehicle, flights: Sequence[Flight], dataset: ResidualDataset,
    names: Sequence[str], noise_of: Callable[[ResidualDataset], dict[str, Any] | None],
) -> tuple[ResidualDataset, list[str], dict[str, Any]]:  # fmt: skip
    """Transitions of simulated flights under the thrusts that the rotors delivered, notes, and what was found.

    dataset: the same under the thrusts that were commanded. noise_of: the known noise of rows.
    """
    groups: dict[str, list[int]] = {}  # flights that have lag and delays in common
    for i, flight in enumerate(flights):
        world = flight.metadata.get("config") or {}
        groups.setdefault(digest({group: world.get(group) for group in OF_TIMING}), []).append(i)
    timings = []
    for group in groups.values():
        index = dataset.columns["flight"]
        tables = [dataset.rows(index == i).columns for i in group]
        noise = noise_of(dataset.rows(np.isin(index, group)))
        of_group = [flights[i] for i in group]
        known = timing_by_accelerometer(of_group, vehicle, of_estimate=settings.state == "estimate")
        timings.append((group, fit_timing(of_group, vehicle, tables, noise=noise, known=known)))
    if all(fit.timing.is_ideal for _, fit in timings):
        return dataset, [], {}
    thrusts = [np.empty(0)] * len(flights)
    lines = []
    for group, fit in timings:
        for i in group:
            thrusts[i] = mean_thrust(flights[i], vehicle, fit.timing)
        shown = ", ".join(map(str, group[:4])) + (" .." if len(group) > 4 else "")
        of = "" if len(group) == len(flights) else f"flight{'s' if len(group) > 1 else ''} {shown}: "
        lines.append(f"{of}{fit.line}")
    dataset = residual_dataset(flights, vehicle, frame=settings.frame, names=names, thrusts=thrusts)
    return (
        dataset,
        lines,
        {"timing": [{"flights": [names[i] for i in group], **fit.as_dict()} for group, fit in timings]},
    )
