"""A sweep as one file: what a reviewer needs to fly it again; whether its files are what was written; what to cite."""

BRINGS = {
    "commands": {"archive": "quadexp.plugins.archive.command:archive"},
    "alternatives": {
        "show --cite": "quadexp.plugins.archive.command:cite",
        "results --verify": "quadexp.plugins.archive.command:verify",
    },
}
