"""Trajectories (flat outputs over time), and the state and input references that follow from them."""
