"""What is done to signals between a log and a flight: one clock, time offsets, ground phases, derivatives."""

from quadexp.log.signal.crop import crop
from quadexp.log.signal.derivative import Derivative, derivative
from quadexp.log.signal.offset import Offset, estimate_offset
from quadexp.log.signal.resample import Resampled, continuous, resample
from quadexp.log.signal.stream import Stream, increasing

__all__ = [
    "Derivative",
    "Offset",
    "Resampled",
    "Stream",
    "continuous",
    "crop",
    "derivative",
    "estimate_offset",
    "increasing",
    "resample",
]
