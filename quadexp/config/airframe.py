"""Settings of what the flown airframe has, or what acts on it, that controllers do not know of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

from quadexp.config.settings import Setting, Settings, Triple
from quadexp.config.world import WorldPartConfig

FACTOR = "[0.1, 10]"
POINT = "[-10, 10]"
ZERO = (0.0, 0.0, 0.0)


# ----------------------------------------------------------------------------------------------------------- truth
@dataclass(frozen=True)
class TruthKeys(Settings):
    """The true vehicle, by factors of the one that controllers believe in."""

    prefix: ClassVar[str] = "truth."

    mass: Annotated[float, Setting("factor on the mass", FACTOR)] = 1.0
    inertia: Annotated[Triple, Setting("factors on the moments of inertia about x, y, z", FACTOR)] = (1.0, 1.0, 1.0)
    center_of_mass: Annotated[
        Triple, Setting("where the true centre of mass lies from the believed one, body; rotors stay", "[-1, 1]", "m")
    ] = ZERO
    thrust_coefficient: Annotated[float, Setting("factor on the thrust that a rotor gives at a command", FACTOR)] = 1.0
    torque_coefficient: Annotated[float, Setting("factor on the reaction torque per thrust", "[0, 10]")] = 1.0
    drag: Annotated[
        float,
        Setting("factor on the plant's drag coefficients and lift; for plant=simplified and its presets", "[0, 10]"),
    ] = 1.0


@dataclass(frozen=True, kw_only=True)
class TruthConfig(TruthKeys, WorldPartConfig):
    """What is wrong with the believed vehicle; see quadexp/world/true_vehicle.py."""

    effect = "quadexp.world.true_vehicle:TrueVehicle"

    @property
    def idle(self) -> bool:
        """See WorldPartConfig."""
        factors = (self.mass, *self.inertia, self.thrust_coefficient, self.torque_coefficient, self.drag)
        return set(factors) == {1.0} and not any(self.center_of_mass)


# --------------------------------------------------------------------------------------------------------- payload
@dataclass(frozen=True)
class PayloadKeys(Settings):
    """A point mass that the vehicle carries."""

    prefix: ClassVar[str] = "payload."

    mass: Annotated[float, Setting("mass of the payload", "[0.001, 100]", "kg")] = 0.2
    point: Annotated[
        Triple, Setting("where it is fixed, or its cable, from the true vehicle's centre of mass, body", POINT, "m")
    ] = ZERO


@dataclass(frozen=True, kw_only=True)
class FixedPayloadConfig(PayloadKeys, WorldPartConfig):
    """A payload fixed to the airframe; see quadexp/world/true_vehicle.py."""

    effect = "quadexp.world.true_vehicle:FixedPayload"


@dataclass(frozen=True)
class SlungLoadKeys(PayloadKeys):
    """A point mass on a cable."""

    length: Annotated[float, Setting("length of the cable, unstretched", "[0.05, 100]", "m")] = 1.0
    stretch: Annotated[
        float, Setting("share of its length that the payload at rest stretches the cable", "[1e-5, 0.5]")
    ] = 0.002
    damping: Annotated[float, Setting("damping ratio of the oscillation along the cable", "[0, 2]")] = 0.1
    drag: Annotated[float, Setting("drag of the payload per velocity squared", "[0, 100]", "N s^2/m^2")] = 0.0


@dataclass(frozen=True, kw_only=True)
class SlungLoadConfig(SlungLoadKeys, WorldPartConfig):
    """A payload slung on a cable; see quadexp/world/slung_load.py."""

    effect = "quadexp.world.slung_load:SlungLoad"


# -------------------------------------------------------------------------------------------------------- external
@dataclass(frozen=True)
class DisturbanceKeys(Settings):
    """A force and a torque from outside."""

    prefix: ClassVar[str] = "external."

    force: Annotated[Triple, Setting("force at the centre of mass, world", "[-1000, 1000]", "N")] = ZERO
    torque: Annotated[Triple, Setting("torque, body", "[-1000, 1000]", "N m")] = ZERO
    onset: Annotated[float, Setting("when they begin to act", "[0, 14400]", "s")] = 0.0
    duration: Annotated[float | None, Setting("how long they act; null: to the end", "(0, 14400]", "s")] = None


@dataclass(frozen=True, kw_only=True)
class DisturbanceConfig(DisturbanceKeys, WorldPartConfig):
    """A disturbance, constant or for a while; see quadexp/world/disturbance.py."""

    effect = "quadexp.world.disturbance:Disturbance"


# ---------------------------------------------------------------------------------------------------------- ground
@dataclass(frozen=True)
class GroundKeys(Settings):
    """The ground beneath the rotors."""

    prefix: ClassVar[str] = "ground."

    height: Annotated[float, Setting("height of the ground, world", "[-1000, 1000]", "m")] = 0.0
    height_max: Annotated[
        float, Setting("height of a rotor over the ground above which the ground has no effect", "(0, 1000]", "m")
    ] = 2.0
    rotor_radius: Annotated[
        float | None, Setting("radius of a rotor; null: vehicle.rotor.radius", "[0.001, 10]", "m")
    ] = None


@dataclass(frozen=True, kw_only=True)
class GroundConfig(GroundKeys, WorldPartConfig):
    """Ground effect after Cheeseman and Bennett; see quadexp/world/ground.py."""

    effect = "quadexp.world.ground:GroundEffect"
