"""Every cell of a sweep flown once, on this machine or on a cluster, and one table of results."""
