"""Recorded flights: read, check, collect, identify a vehicle, validate models."""

BRINGS = {
    "commands": {
        "import": "quadexp.plugins.logs.commands:import_",
        "check": "quadexp.plugins.logs.commands:check",
        "identify": "quadexp.plugins.logs.learn_commands:identify",
        "validate": "quadexp.plugins.logs.learn_commands:validate",
        "replay-test": "quadexp.plugins.logs.replay_command:replay_test",
    },
    "parts": {"from_model": "quadexp.plugins.logs.from_model"},
    "models": {
        "vehicle_model": "quadexp.plugins.logs.vehicle_model",
        "rotor_force": "quadexp.plugins.logs.rotor_force",
    },
    "readers": {  # the most general last: to it any text is a table
        "ardupilot": "quadexp.plugins.logs.importers.readers.ardupilot",
        "betaflight": "quadexp.plugins.logs.importers.readers.betaflight",
        "rosbag": "quadexp.plugins.logs.importers.readers.rosbag",
        "ulog": "quadexp.plugins.logs.importers.readers.ulog",
        "csv": "quadexp.plugins.logs.importers.readers.csv",
    },
    "services": {
        "recorded_flights": "quadexp.plugins.logs.recorded",
        "timing_of_recorded": "quadexp.plugins.logs.delays:timing_by_accelerometer",
    },
}
