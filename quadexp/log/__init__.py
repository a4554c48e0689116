"""Recorded flights and the files they live in."""

from quadexp.log.schema import Flight
from quadexp.log.store import read_flight, read_table, write_flight, write_table

__all__ = ["Flight", "read_flight", "read_table", "write_flight", "write_table"]
