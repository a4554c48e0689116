"""What rotors make of moving air: blade elements, induced velocity, and models that are sums of such terms.

blade_element.py, induced_velocity.py: equations. terms.py: the sums. common_scale.py: one scale of the thrust for
flights under a thrust curve. drag_choice.py, recorded_verdict.py: which sum predicts recorded flights.
"""

_HERE = "quadexp.plugins.aerodynamics"

BRINGS = {
    "services": {"common_scale": f"{_HERE}.common_scale:common_scale", "recorded_verdict": f"{_HERE}.recorded_verdict"}
}
