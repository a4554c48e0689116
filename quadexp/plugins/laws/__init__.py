"""Laws in closed form: PX4's cascade, the geometric one, one by differential flatness."""

BRINGS = {"parts": {"laws": "quadexp.plugins.laws"}}
