"""From configurations to flights, data sets and results."""
