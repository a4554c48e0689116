"""Settings of a controller by flights: the same budget for every controller."""

BRINGS = {
    "commands": {"tune": "quadexp.plugins.tune.commands:tune"},
    "api": {"tune": "quadexp.plugins.tune.api:tune", "Tuning": "quadexp.plugins.tune.api:Tuning"},
    "columns": {"tune": "quadexp.plugins.tune.columns:COLUMNS"},
    "kinds": {"tuning": "tune a table of trials"},
    "tables": {"tuning": "quadexp.plugins.tune.api:Tuning"},
    "reads": {"tune": "FLIGHT ENGINE evaluate.metric evaluate.log_period sweep"},
}
