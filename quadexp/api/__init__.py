"""The Python API, `import quadexp as qx`: what the commands do, as functions that return tables; see docs/api.md."""
