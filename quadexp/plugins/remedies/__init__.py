"""What is put around a controller: observers, L1, INDI, predictions of delays; and what learns in flight."""

BRINGS = {
    "groups": {
        "observer": "remedies motor",
        "adaptive": "remedies observer",
        "rate_loop": "remedies adaptive inner",
        "delay": "remedies rate_loop",
    },
    "parts": {"remedies": "quadexp.plugins.remedies"},
    "modules": {"quadexp.plugins.remedies.earlier": "quadexp.plugins.remedies.delay_line"},
    "templates": {"remedy": "height_integral adaptive/NAME HeightIntegral"},
    "columns": {"remedies": "quadexp.plugins.remedies.columns:COLUMNS"},
    "services": {"believed_world": "quadexp.plugins.remedies.believed_world:BelievedWorld"},
}
