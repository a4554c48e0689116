"""Files of other programs: logs, read into flights; and paths to be flown."""

BRINGS = {
    "commands": {"import": "quadexp.plugins.logs.commands:import_"},
    "groups": {"import": "listed"},
    "parts": {"from_file": "quadexp.plugins.logs.from_file"},
    "services": {"recorded_lines": "quadexp.plugins.logs.recorded_lines:recorded_lines"},
    "readers": {  # the most general last: to it any text is a table
        "ardupilot": "quadexp.plugins.logs.importers.readers.ardupilot",
        "betaflight": "quadexp.plugins.logs.importers.readers.betaflight",
        "rosbag": "quadexp.plugins.logs.importers.readers.rosbag",
        "ulog": "quadexp.plugins.logs.importers.readers.ulog",
        "csv": "quadexp.plugins.logs.importers.readers.csv",
    },
}
