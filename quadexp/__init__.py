"""quadexp: an experiment pipeline for aerodynamics-aware quadrotor trajectory tracking."""

__version__ = "0.1.0"
