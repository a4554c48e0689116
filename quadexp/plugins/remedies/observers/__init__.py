"""Observers: estimates of what the model of a controller does not know, and which it is told before each step."""
