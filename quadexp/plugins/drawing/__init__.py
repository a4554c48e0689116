"""How figures look and are written, whoever draws them."""

BRINGS = {"services": {"drawing": "quadexp.plugins.drawing.style"}}
