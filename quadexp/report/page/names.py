"""What controllers and their parts are called in a sentence, and what they know."""

from __future__ import annotations

NAMES = {
    "nominal_mpc": "nominal MPC",
    "linear_drag_mpc": "linear-drag MPC",
    "gp_mpc": "GP MPC",
    "perfect_mpc": "perfect MPC",
    "rls_mpc": "RLS MPC",
    "rls_feedback": "RLS feedback",
    "static_feedback": "static feedback",
    "oracle_feedback": "oracle feedback",
}
KNOWS = {
    "nominal_mpc": "nothing of the air",
    "linear_drag_mpc": "rotor drag, linear in velocity",
    "gp_mpc": "a Gaussian process learned from flights",
    "perfect_mpc": "the plant's own equations",
    "rls_mpc": "blade-element coefficients identified in flight",
    "rls_feedback": "blade-element coefficients identified in flight",
    "static_feedback": "static thrust and torque only",
    "oracle_feedback": "the plant's own coefficients",
}
BASELINES = ("nominal_mpc", "static_feedback")  # in this order, unless told


def spoken(label: str) -> str:
    """A label in a sentence: "gp_mpc nodes=20" is "GP MPC nodes=20"."""
    controller, _, rest = label.partition(" ")
    name = NAMES.get(controller, controller.replace("_mpc", " MPC").replace("_", " "))
    return f"{name} {rest}".strip()
