"""A controller in a loop of your own, as in a ROS 2 node: measured state in, rotor thrusts out, no command line.

    python examples/own_loop.py controller=gp_mpc model=models/gp trajectory=circle trajectory.speed=8

`Stack` stands for the flight stack, with a simulated plant behind it: put your estimator into `measure` and your
commands into `send`, and call the body of the loop from a timer of `loop.period`. World ENU, body FLU, quaternion body
to world with w first, SI units: quadexp/physics/state.py.
"""

import sys

import numpy as np

import quadexp as qx
from quadexp.physics.state import POSITION, RATE


class Stack:
    def __init__(self, plant, state, period):
        self.plant, self.state, self.period = plant, state, period
        self.acceleration, self.rng = None, np.random.default_rng(0)

    def measure(self, t):
        """rotor_speed: None where nobody measures it. specific_force: accelerometer, body, m/s^2."""
        return qx.Measurement(t, self.state, self.acceleration, getattr(self.plant, "rotor_speed", None))

    def send(self, thrusts, rates):
        """thrusts: (n,) N, rotor by rotor. rates: (3,) rad/s, for stacks that take rates and a collective thrust."""
        self.state, self.acceleration = self.plant.advance(self.state, thrusts, self.period, self.rng)


def main(settings):
    loop = qx.controller(*settings)  # KEY=VALUE as on the command line; compiles on first use, so before take-off
    stack, distances = Stack(loop.plant, loop.start, loop.period), []
    for t in loop.times:
        measurement = stack.measure(t)
        thrusts = loop.step(measurement)
        if loop.failed:  # hand over to what brings the vehicle down
            raise SystemExit(f"the control step failed at t={t:.2f} s")
        distances.append(np.linalg.norm(measurement.state[POSITION] - loop.reference_state(t)[POSITION]))
        stack.send(thrusts, measurement.state[RATE] if loop.rates is None else loop.rates)
    return np.array(distances)


if __name__ == "__main__":
    found = main(sys.argv[1:])
    print(f"{len(found)} steps, mean error {1e3 * found.mean():.1f} mm, largest {1e3 * found.max():.1f} mm")
