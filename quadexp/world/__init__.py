"""Simulated truth: what really happens to the vehicle, noise included."""

from quadexp.world.base import Plant
from quadexp.world.simplified import PlantEffects, SimplifiedPlant

__all__ = ["Plant", "PlantEffects", "SimplifiedPlant"]
