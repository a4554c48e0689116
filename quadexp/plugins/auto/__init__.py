"""One setting for a vehicle that nobody measured: delays, errors of its model and wind are estimated in flight."""

BRINGS = {"parts": {"auto": "quadexp.plugins.auto.part"}, "services": {"beliefs": "quadexp.plugins.auto.beliefs"}}
