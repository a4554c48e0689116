"""A controller on a vehicle: as C without a library, checked against the bench; and the ways to a flight stack."""

BRINGS = {
    "commands": {
        "export-controller": "quadexp.plugins.vehicle.commands:export_controller",
        "fly": "quadexp.plugins.vehicle.commands:fly",
    },
    "parts": {"exported": "quadexp.plugins.vehicle.exported"},
    "reads": {"export-controller": "FLIGHT", "fly": "FLIGHT"},
}
