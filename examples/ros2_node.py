"""A controller as a node of ROS 2: odometry in, rotor thrusts and body rates out.

    python examples/ros2_node.py controller=gp_mpc model=models/gp trajectory=circle trajectory.speed=4

odometry   nav_msgs/Odometry: pose in a world east north up, twist in the body forward left up (REP 103, 105)
thrusts    std_msgs/Float64MultiArray: of the rotors, in the vehicle file's order (N)
rates      geometry_msgs/TwistStamped: angular: body rates that an MPC predicts (rad/s); linear.z: collective thrust (N)

The path begins with the first odometry and goes on by its stamps. Without an installation of ROS: pip install ros-rclpy
ros-nav-msgs ros-rmw-fastrtps-cpp, and RMW_IMPLEMENTATION=rmw_fastrtps_cpp. It has met a simulated vehicle only.
"""

import sys

import numpy as np
import rclpy
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from std_msgs.msg import Float64MultiArray

import quadexp as qx
from quadexp.physics.rotation import air_velocity
from quadexp.physics.state import ATTITUDE, N_STATE, POSITION, RATE, VELOCITY


def state_of(message):
    """(13,) of an Odometry message."""
    pose, twist = message.pose.pose, message.twist.twist
    x = np.empty(N_STATE)
    x[POSITION] = pose.position.x, pose.position.y, pose.position.z
    q = pose.orientation
    x[ATTITUDE] = q.w, q.x, q.y, q.z
    to_body = np.array([q.w, -q.x, -q.y, -q.z])  # by which a velocity of the body becomes one of the world
    x[VELOCITY] = air_velocity(to_body, np.array([twist.linear.x, twist.linear.y, twist.linear.z]))
    x[RATE] = twist.angular.x, twist.angular.y, twist.angular.z
    return x


class ControllerNode(Node):
    """done: whether the path has ended."""

    def __init__(self, settings):
        super().__init__("quadexp")
        self.loop = qx.controller(*settings)  # compiles on first use
        self.thrusts = self.create_publisher(Float64MultiArray, "thrusts", 1)
        self.rates = self.create_publisher(TwistStamped, "rates", 1)
        self.create_subscription(Odometry, "odometry", self.on_odometry, 1)
        self.began, self.done = None, False

    def on_odometry(self, message):
        stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        if self.began is None:
            self.began = stamp
        instant = round((stamp - self.began) / self.loop.period)
        if instant >= len(self.loop.times):
            self.done = True
            return
        measurement = qx.Measurement(float(self.loop.times[instant]), state_of(message), None, None)
        thrusts = self.loop.step(measurement)
        if self.loop.failed:  # hand over to what brings the vehicle down
            raise SystemExit(f"the control step failed at t={measurement.t:.2f} s")
        self.thrusts.publish(Float64MultiArray(data=thrusts.tolist()))
        if self.loop.rates is not None:
            command = TwistStamped(header=message.header)
            angular = command.twist.angular
            angular.x, angular.y, angular.z = self.loop.rates.tolist()
            command.twist.linear.z = float(thrusts.sum())
            self.rates.publish(command)


if __name__ == "__main__":
    rclpy.init()
    node = ControllerNode(sys.argv[1:])
    while rclpy.ok() and not node.done:
        rclpy.spin_once(node, timeout_sec=0.1)
    rclpy.try_shutdown()
