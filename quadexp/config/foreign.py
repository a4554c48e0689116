"""Settings of the plants whose equations are those of other programs: RotorPy and drone-models.

The defaults are the packages' own numbers for one vehicle, with the packages' own units; tests compare them with the
packages' parameter files. Both packages are under the MIT licence.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

from quadexp.config.flight import PlantConfig
from quadexp.config.settings import Setting, Settings, Triple

Pair = tuple[float, float]


@dataclass(frozen=True)
class RotorPyKeys(Settings):
    """Air and motors of RotorPy 3.0's Multirotor (Folk et al. 2023), with the numbers of its Hummingbird."""

    prefix: ClassVar[str] = "plant."

    aero: Annotated[
        bool, Setting("forces and torques of the air; false: thrust and reaction torque of the rotors alone")
    ] = True
    parasitic_drag: Annotated[
        Triple, Setting("drag of the airframe per |v| v, body axes (c_Dx, c_Dy, c_Dz)", "[0, 100]", "N s^2/m^2")
    ] = (0.5e-2, 0.5e-2, 1e-2)
    rotor_drag: Annotated[
        float, Setting("in-plane drag of a rotor per speed of rotor and air (k_d)", "[0, 1]", "kg/rad")
    ] = 1.19e-4
    inflow_drag: Annotated[
        float, Setting("thrust lost to the flow along the rotor's axis, per speed of both (k_z)", "[0, 1]", "kg/rad")
    ] = 2.32e-4
    translational_lift: Annotated[
        float, Setting("thrust gained by a rotor per square of the flow in its plane (k_h)", "[0, 1]", "kg/m")
    ] = 3.39e-3
    flapping: Annotated[
        float, Setting("flapping moment of a rotor per speed of rotor and air (k_flap)", "[0, 1]", "kg m/rad")
    ] = 0.0
    motor_lag: Annotated[float, Setting("time constant of the rotor speeds (tau_m); 0: none", "[0, 1]", "s")] = 0.005
    rotor_speed_min: Annotated[float, Setting("least rotor speed", "[0, 1e5]", "rad/s")] = 0.0
    rotor_speed_max: Annotated[float, Setting("largest rotor speed", "(0, 1e5]", "rad/s")] = 1500.0


@dataclass(frozen=True, kw_only=True)
class RotorPyPlantConfig(RotorPyKeys, PlantConfig):
    """RotorPy's equations; see quadexp/world/rotorpy.py."""

    kind: str = "rotorpy"


@dataclass(frozen=True)
class DroneModelsKeys(Settings):
    """Rotors and drag of the first-principles model of drone-models 0.1, with the numbers of its cf2x_L250."""

    prefix: ClassVar[str] = "plant."

    thrust_curve: Annotated[
        Triple, Setting("rpm2thrust: thrust of a rotor as a polynomial of its rpm, N, N/rpm, N/rpm^2", "[-1, 1]")
    ] = (0.0, -5.382196214637237e-7, 2.4582929831265485e-10)
    torque_curve: Annotated[
        Triple,
        Setting("rpm2torque: reaction torque as a polynomial of the rpm, N m, N m/rpm, N m/rpm^2", "[-1, 1]"),
    ] = (0.0, 1.410454111996297e-9, 1.4592584373980652e-12)
    spin_up: Annotated[
        Pair,
        Setting(
            "rotor_dyn_coef: rpm' per command minus rpm, and per difference of squares, 1/s, 1/(rpm s)", "[0, 1e4]"
        ),
    ] = (7.355623702172756, 0.0)
    spin_down: Annotated[Pair, Setting("the same where the command is below the speed, 1/s, 1/(rpm s)", "[0, 1e4]")] = (
        0.0,
        0.00024443862952110715,
    )
    linear_drag: Annotated[Triple, Setting("drag force per velocity, body axes (drag_matrix)", "[0, 100]", "N s/m")] = (
        0.01471782,
        0.01471782,
        0.01277641,
    )
    propeller_inertia: Annotated[
        float, Setting("of one propeller about its axis (prop_inertia)", "[0, 1]", "kg m^2")
    ] = 34.52e-9


@dataclass(frozen=True, kw_only=True)
class DroneModelsPlantConfig(DroneModelsKeys, PlantConfig):
    """drone-models' first-principles equations; see quadexp/world/drone_models.py."""

    kind: str = "drone_models"
