"""Public benchmarks: other people's flights and their protocol, the published figures beside those of this program."""

BRINGS = {
    "commands": {"reproduce": "quadexp.plugins.public.commands:reproduce"},
    "benchmarks": {"nanodrone": "quadexp.plugins.public.nanodrone_report:reproduce"},
}
