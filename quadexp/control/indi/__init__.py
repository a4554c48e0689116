"""Incremental nonlinear dynamic inversion: an inner loop that rejects torques nobody models (Sun et al. 2022)."""
