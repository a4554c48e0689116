"""What recorded flights tell of a vehicle: identified, validated, flown again."""

BRINGS = {
    "commands": {
        "identify": "quadexp.plugins.identification.commands:identify",
        "validate": "quadexp.plugins.identification.commands:validate",
        "replay-test": "quadexp.plugins.identification.replay_command:replay_test",
    },
    "parts": {"from_model": "quadexp.plugins.identification.from_model"},
    "models": {
        "vehicle_model": "quadexp.plugins.identification.vehicle_model",
        "rotor_force": "quadexp.plugins.identification.rotor_force",
    },
    "services": {
        "recorded_rows": "quadexp.plugins.identification.collected:recorded_rows",
        "delivered_rows": "quadexp.plugins.identification.collected:delivered_rows",
    },
    "reads": {"validate": "vehicle"},
    "kinds": {"estimates": "identify a table of estimates"},
    "advice": {"model": ", or `quadexp identify FLIGHT... --out {}`"},
}
