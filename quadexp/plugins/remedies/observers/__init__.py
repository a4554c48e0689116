"""Observers: estimates of what the model of a controller does not know, and which it is given before each step."""
