"""More of the world: navigation by a Kalman filter, Dryden turbulence, a battery, a slung load, the ground."""

BRINGS = {
    "parts": {"worlds": "quadexp.plugins.worlds"},
    "columns": {"worlds": "quadexp.plugins.worlds.columns:COLUMNS"},
}
