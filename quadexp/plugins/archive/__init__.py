"""A sweep as one file: what a reviewer needs to fly it again."""

BRINGS = {"commands": {"archive": "quadexp.plugins.archive.command:archive"}}
