"""Sweeps: every cell flown once, by any engine, and one table of results at the end."""
