"""Simulated truth: what really happens to the vehicle, noise included."""

from quadexp.plant.base import Plant
from quadexp.plant.simplified import PlantEffects, SimplifiedPlant

__all__ = ["Plant", "PlantEffects", "SimplifiedPlant"]
