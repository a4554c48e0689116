"""What is done to signals between a log and a flight: one clock, time offsets, ground phases, derivatives."""

from quadexp.flight.signal.crop import airborne, crop
from quadexp.flight.signal.derivative import Derivative, derivative
from quadexp.flight.signal.offset import Offset, estimate_offset
from quadexp.flight.signal.resample import Resampled, continuous, resample
from quadexp.flight.signal.stream import Stream, increasing

__all__ = [
    "Derivative",
    "Offset",
    "Resampled",
    "Stream",
    "airborne",
    "continuous",
    "crop",
    "derivative",
    "estimate_offset",
    "increasing",
    "resample",
]
