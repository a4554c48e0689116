"""Gaussian processes as a model of the air."""

BRINGS = {"models": {"gaussian_process": "quadexp.plugins.gaussian_process.gaussian_process"}}
