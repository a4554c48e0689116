"""Whether a recorded flight is what it says: units, frames, signs, clock, sensors, commands; and what the columns of an
unknown table are."""

BRINGS = {
    "commands": {"check": "quadexp.plugins.check.commands:check"},
    "services": {
        "check_flight": "quadexp.plugins.check.quality:check_flight",
        "inspect_flight": "quadexp.plugins.check.quality:inspect_flight",
        "describe_log": "quadexp.plugins.check.describe:describe_log",
    },
}
