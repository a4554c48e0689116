"""What a controller measures with; the sensors that are not here are perfect."""

from quadexp.sensor.accelerometer import Accelerometer

__all__ = ["Accelerometer"]
