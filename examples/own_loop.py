"""A controller in your own loop, as in a ROS 2 node: measured state in, rotor thrusts out.

    python examples/own_loop.py controller=gp_mpc model=models/gp trajectory=circle trajectory.speed=8

`Stack` represents the flight stack, here with a simulated plant: put your estimator into `measure` and your commands
into `send`, and call the body of the loop from a timer of `controller.control_period`. World ENU, body FLU,
quaternion body to world with w first, SI units: quadexp/physics/state.py.
"""

import sys

import numpy as np

from quadexp.config.compose import compose
from quadexp.control.base import Measurement
from quadexp.control.mpc.active_set import Status
from quadexp.experiment.build import build_controller, build_plant, build_trajectory, build_vehicle, find_model
from quadexp.experiment.rollout import SampledReference
from quadexp.physics.state import POSITION, RATE


class Stack:
    def __init__(self, plant, state, period):
        self.plant, self.state, self.period = plant, state, period
        self.acceleration, self.rng = None, np.random.default_rng(0)

    def measure(self, t):
        """rotor_speed: None if not measured. specific_force: accelerometer, body, m/s^2."""
        return Measurement(t, self.state, self.acceleration, getattr(self.plant, "rotor_speed", None))

    def send(self, thrusts, rates):
        """thrusts: (n,) N, rotor by rotor. rates: (3,) rad/s, for stacks that take rates and a collective thrust."""
        self.state, self.acceleration = self.plant.advance(self.state, thrusts, self.period, self.rng)


def main(overrides):
    config = compose(overrides)  # KEY=VALUE as on the command line
    vehicle = build_vehicle(config.vehicle)
    plant = build_plant(vehicle, config.plant)
    controller = build_controller(config, vehicle, plant, find_model(config))
    reference = SampledReference(build_trajectory(config.trajectory, vehicle), controller)
    start = reference.at(0)[0].copy()
    stack, distances = Stack(plant, start, controller.control_period), []
    controller.reset(start, reference.window(0))
    for k, t in enumerate(reference.t):
        measurement, window = stack.measure(t), reference.window(k)
        thrusts, record = controller.step(measurement, window)
        if record.status == Status.FAILED:  # here your fallback takes over
            raise SystemExit(f"the control step failed at t={t:.2f} s")
        mpc = getattr(controller, "mpc", None)
        rates = mpc.prediction[0][1, RATE] if mpc else measurement.state[RATE]  # rates at the next node
        distances.append(np.linalg.norm(measurement.state[POSITION] - window.state[0, POSITION]))
        stack.send(thrusts, rates)
    return np.array(distances)


if __name__ == "__main__":
    found = main(sys.argv[1:])
    print(f"{len(found)} steps, mean error {1e3 * found.mean():.1f} mm, largest {1e3 * found.max():.1f} mm")
