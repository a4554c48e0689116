"""A controller on a vehicle: as C without a library, checked against the bench; and the ways to a flight stack."""
