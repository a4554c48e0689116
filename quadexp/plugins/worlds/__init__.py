"""More of the world: navigation by a Kalman filter, Dryden turbulence, a battery, a slung load, the ground."""

BRINGS = {
    "groups": {"battery": "world actuator", "ground": "world health"},
    "parts": {"worlds": "quadexp.plugins.worlds"},
    "modules": {"quadexp.world.ground": "quadexp.plugins.worlds.ground"},
    "columns": {"worlds": "quadexp.plugins.worlds.columns:COLUMNS"},
}
