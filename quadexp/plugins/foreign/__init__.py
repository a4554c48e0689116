"""Plants and controllers of other programs: RotorPy, drone-models, RAPTOR."""

BRINGS = {"parts": {"foreign": "quadexp.plugins.foreign"}}
