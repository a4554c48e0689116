"""What is done to signals between a log and a flight: one clock, time offsets, derivatives, windows."""

from quadexp.log.signal.derivative import Derivative, derivative
from quadexp.log.signal.resample import Resampled, continuous, resample
from quadexp.log.signal.stream import Stream, increasing, runs

__all__ = ["Derivative", "Resampled", "Stream", "continuous", "derivative", "increasing", "resample", "runs"]
