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
        "recorded_flights": "quadexp.plugins.identification.recorded",
        "rotor_thrust": "quadexp.plugins.identification.rotor_thrust",
        "timing_of_recorded": "quadexp.plugins.identification.delays:timing_by_accelerometer",
    },
    "reads": {"validate": "vehicle"},
}
