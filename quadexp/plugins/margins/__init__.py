"""What delay and lag a loop tolerates, found before it flies."""

BRINGS = {
    "services": {
        "loop_margins": "quadexp.plugins.margins.loop_margins:loop_margins",
        "instability": "quadexp.plugins.margins.loop_margins:instability",
        "margins": "quadexp.plugins.margins.requests:margins",
    },
    "reads": {"show --margins": "FLIGHT"},
}
