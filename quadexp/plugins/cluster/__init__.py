"""Sweeps on a cluster: Dask, and queueing systems."""

BRINGS: dict[str, dict[str, str]] = {}
