"""Numbers, tables and figures from flights and results."""
