"""drone-models itself, in a process of its own: it wants to be imported before SciPy.

    python -m tests.world.drone_models_native IN.npz OUT.npz

The package warns against integrating its quaternion's derivative: `ang_vel2quat_dot` is written for w x y z, and the
model hands it x y z w. Here it gets the order that it is written for. Its rotors turn the vehicle by -J_p w_y N in roll
where their angular momentum says +J_p w_y N, as its successor crazyflow has it; this row gets the law's sign. All other
rows are as the model returns them.

In: drone (name), pos, quat (x y z w), vel, ang_vel, cmd, rotor_vel (rpm), a row each; start (17,) and held (k, 4) (rpm)
of a flight, with its control period. Out: derivatives (rows, 17), and the flight (k + 1, 17), integrated to 1e-12.
"""

import sys

import drone_models  # isort: skip
import numpy as np
from drone_models.first_principles import dynamics
from drone_models.utils.rotation import ang_vel2quat_dot
from scipy.integrate import solve_ivp


def main(given: str, out: str) -> None:
    data = np.load(given)
    model = drone_models.parametrize(dynamics, drone_model=str(data["drone"]))
    keys = model.keywords
    spin, inertia = keys["mixing_matrix"][2], keys["prop_inertia"]

    def derivative(s: np.ndarray, cmd: np.ndarray) -> np.ndarray:
        pos, quat, vel, ang_vel, rotor_vel = np.split(s, [3, 7, 10, 13])
        pos_dot, _, *others = model(pos, quat / np.linalg.norm(quat), vel, ang_vel, cmd, rotor_vel)
        others[1] = others[1] + keys["J_inv"] @ [2 * inertia * ang_vel[1] * spin @ rotor_vel * np.pi / 30, 0, 0]
        quat_dot = np.roll(ang_vel2quat_dot(np.roll(quat, 1), ang_vel), -1)
        return np.concatenate([pos_dot, quat_dot, *others])

    slopes = [derivative(s, cmd) for s, cmd in zip(data["s"], data["cmd"], strict=True)]
    flown = [data["start"]]
    for cmd in data["held"]:
        solved = solve_ivp(
            lambda t, s, cmd=cmd: derivative(s, cmd), (0, float(data["period"])), flown[-1], "DOP853",
            rtol=1e-12, atol=1e-13,
        )  # fmt: skip
        flown.append(solved.y[:, -1])
    np.savez(out, slopes=slopes, flown=flown)


if __name__ == "__main__":
    main(*sys.argv[1:])
