"""The look of all figures, and writing them."""

BRINGS = {"services": {"drawing": "quadexp.plugins.drawing.style"}}
