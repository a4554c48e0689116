"""Settings of a controller chosen by flights: a space of settings, an objective over flights, a budget of flights."""
