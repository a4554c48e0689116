"""Numbers out: what is known of a vehicle, as other programs read it; and vehicles from their files.

known.py: the numbers, with units, intervals and origin. One file a kind of target: autopilots.py, simulators.py,
descriptions.py (SDF, URDF, MJCF), equations.py. document.py: what stands at the top of every file. vehicles.py reads.
"""

_HERE = "quadexp.plugins.exchange"

BRINGS = {
    "commands": {"export": f"{_HERE}.commands:export"},
    "exports": {
        "px4": f"{_HERE}.autopilots:PX4",
        "px4_sih": f"{_HERE}.autopilots:PX4_SIH",
        "ardupilot": f"{_HERE}.autopilots:ARDUPILOT",
        "betaflight": f"{_HERE}.autopilots:BETAFLIGHT",
        "sdf": f"{_HERE}.descriptions:SDF",
        "rotorpy": f"{_HERE}.simulators:ROTORPY",
        "crazyflow": f"{_HERE}.simulators:CRAZYFLOW",
        "gym_pybullet": f"{_HERE}.descriptions:GYM_PYBULLET",
        "mjcf": f"{_HERE}.descriptions:MJCF",
        "agilicious": f"{_HERE}.simulators:AGILICIOUS",
        "casadi": f"{_HERE}.equations:CASADI",
        "c": f"{_HERE}.equations:C",
    },
    "advice": {"formats": ", then quadexp export {}, which makes other formats of it"},
    "alternatives": {"new --from": f"{_HERE}.new_vehicle:new_from"},
}
