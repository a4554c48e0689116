"""One setting for a vehicle that nobody measured: what is late, off, or blown, assumed as far as the evidence goes."""

BRINGS = {
    "parts": {"auto": "quadexp.plugins.auto.part"},
    "services": {"beliefs": "quadexp.plugins.auto.beliefs", "restless": "quadexp.plugins.auto.restless:restless"},
}
