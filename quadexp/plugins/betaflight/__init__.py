"""Logs of Betaflight."""
