"""`quadexp archive`: what a reviewer needs to fly a sweep again, in one file."""

BRINGS = {"commands": {"archive": "quadexp.plugins.archive.command:archive"}}
