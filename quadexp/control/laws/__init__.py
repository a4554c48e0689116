"""Control laws in closed form: geometric tracking, a flight stack's cascade, and two of other programs."""
