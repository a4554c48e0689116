"""A sweep as one file: what a reviewer needs to fly it again; whether its files are what was written; what to cite."""

BRINGS = {
    "commands": {"archive": "quadexp.plugins.archive.command:archive"},
    "services": {
        "bibtex": "quadexp.plugins.archive.cite:bibtex",
        "verify_results": "quadexp.plugins.archive.verify:verify_results",
    },
}
