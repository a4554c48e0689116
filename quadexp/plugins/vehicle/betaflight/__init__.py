"""A flight through Betaflight: its unchanged simulation build, a process of its own, between controller and plant."""
