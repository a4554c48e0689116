"""What delay and lag a loop tolerates, found before it flies."""

BRINGS = {
    "alternatives": {"show --margins": "quadexp.plugins.margins.commands:show_margins"},
    "services": {
        "loop_margins": "quadexp.plugins.margins.loop_margins:loop_margins",
        "margin_texts": "quadexp.plugins.margins.texts",
        "instability": "quadexp.plugins.margins.loop_margins:instability",
    },
    "reads": {"show --margins": "FLIGHT"},
}
