"""One setting for a vehicle that nobody measured: delays, errors of its model and wind are estimated in flight."""

BRINGS = {
    "parts": {"auto": "quadexp.plugins.auto.part"},
    "alternatives": {"show --beliefs": "quadexp.plugins.auto.commands:show_beliefs"},
    "services": {"restless": "quadexp.plugins.auto.restless:restless"},
}
