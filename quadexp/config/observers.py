"""Settings of the observers: what a controller is told of forces, torques and wind that its model does not know."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from quadexp.config.remedies import RemedyConfig
from quadexp.config.settings import Setting, Settings, Triple


@dataclass(frozen=True)
class ObserverKeys(Settings):
    """What every observer has."""

    prefix = "observer."

    torque_bandwidth: Annotated[
        float,
        Setting("bandwidth of the estimated torque, from the measured body rates; 0: no torque", "[0, 1000]", "rad/s"),
    ] = 15.0
    torque_limit: Annotated[
        float, Setting("largest estimated torque on an axis, over its inertia", "(0, 1e6]", "rad/s^2")
    ] = 100.0
    targets: Annotated[
        bool,
        Setting(
            "recompute attitudes and thrusts of the reference so that they hold the path under what is estimated; an"
            " MPC with weights on them keeps an offset otherwise"
        ),
    ] = True
    dead_time: Annotated[
        float | None,
        Setting(
            "delay between a command and its thrust with which the delivered thrusts are computed where rotor speeds"
            " are not measured; null: the controller's",
            "[0, 0.5]",
            "s",
        ),
    ] = None
    motor_lag: Annotated[
        float | None,
        Setting("time constant of the rotors, likewise; null: the controller's", "[0, 0.5]", "s"),
    ] = None


@dataclass(frozen=True)
class DisturbanceObserverKeys(ObserverKeys):
    """Force and torque beyond the model; see quadexp/control/observers/disturbance.py."""

    source: Annotated[
        Literal["accelerometer", "velocity"],
        Setting("what the force is found from: the accelerometer, or the velocity where there is none"),
    ] = "accelerometer"
    force_bandwidth: Annotated[float, Setting("bandwidth of the estimated force", "(0, 1000]", "rad/s")] = 25.0
    force_noise: Annotated[
        float,
        Setting(
            "standard deviation of the accelerometer's readings from the model; only its ratio to the initial one"
            " matters, for how fast the first estimates are",
            "(0, 1000]",
            "m/s^2",
        ),
    ] = 0.1
    force_initial: Annotated[
        float, Setting("standard deviation of the force over the mass when a flight begins", "[0, 1000]", "m/s^2")
    ] = 3.0
    force_limit: Annotated[float, Setting("largest estimated force over the mass", "(0, 1000]", "m/s^2")] = 15.0
    scale_walk: Annotated[
        float,
        Setting(
            "how fast the thrust scale changes, which is estimated beside the force: standard deviation that it gains"
            " in a second; 0: it is not estimated",
            "[0, 1]",
        ),
    ] = 0.0
    scale_initial: Annotated[
        float, Setting("standard deviation of the thrust scale when a flight begins", "[0, 1]")
    ] = 0.3
    air_walk: Annotated[
        float,
        Setting(
            "how fast the scale of the air's force (of drag) changes, likewise; for controllers that know drag;"
            " 0: it is not estimated",
            "[0, 10]",
        ),
    ] = 0.0
    air_initial: Annotated[float, Setting("standard deviation of the air's scale when a flight begins", "[0, 10]")] = (
        1.0
    )


@dataclass(frozen=True, kw_only=True)
class DisturbanceObserverConfig(DisturbanceObserverKeys, RemedyConfig):
    """A disturbance observer."""

    remedy = "quadexp.control.observers.disturbance:with_disturbance_observer"


@dataclass(frozen=True)
class WindObserverKeys(ObserverKeys):
    """Wind from the drag that it causes; see quadexp/control/observers/wind.py."""

    noise: Annotated[
        Triple,
        Setting(
            "standard deviation of the accelerometer's readings from the model, body axes; a large one on z, where"
            " thrust that comes late or is scaled would be taken for wind",
            "(0, 1000]",
            "m/s^2",
        ),
    ] = (0.1, 0.1, 3.0)
    force_bandwidth: Annotated[
        float,
        Setting("bandwidth of the force that the wind leaves unexplained; 0: none", "[0, 1000]", "rad/s"),
    ] = 25.0
    wind_walk: Annotated[
        float, Setting("how fast the wind changes: standard deviation that it gains in a second", "[0, 100]", "m/s")
    ] = 1.5
    wind_initial: Annotated[
        float, Setting("standard deviation of the wind when a flight begins, and the largest later", "(0, 100]", "m/s")
    ] = 4.0
    wind_limit: Annotated[float, Setting("largest estimated wind", "(0, 100]", "m/s")] = 25.0
    scale_walk: Annotated[
        float,
        Setting(
            "how fast the thrust scale changes: standard deviation that it gains in a second; 0: it is not estimated",
            "[0, 1]",
        ),
    ] = 0.005
    scale_initial: Annotated[
        float, Setting("standard deviation of the thrust scale when a flight begins", "[0, 1]")
    ] = 0.05
    least_bandwidth: Annotated[
        float,
        Setting(
            "bandwidth of the estimated wind below which the vehicle's drag is too little to measure it, and the"
            " controller is refused",
            "[0, 1000]",
            "rad/s",
        ),
    ] = 1.0


@dataclass(frozen=True, kw_only=True)
class WindObserverConfig(WindObserverKeys, RemedyConfig):
    """A wind observer."""

    remedy = "quadexp.control.observers.wind:with_wind_observer"
