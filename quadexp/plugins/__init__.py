"""What the core does not need: a folder a plug-in, each of which may be deleted (quadexp/plugin.py)."""
