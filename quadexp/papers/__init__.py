"""What belongs to one publication alone."""
