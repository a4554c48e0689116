"""Control laws in closed form."""
