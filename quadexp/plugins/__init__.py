"""Plug-ins: what stands beside the core, in the shape of what a user brings."""
