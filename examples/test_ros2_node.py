"""The node of ros2_node.py with a simulated vehicle as its other end, where the wheels of ROS 2 are installed."""

# ruff: noqa: E402 - what needs ROS 2 is imported below the line that skips without it

from __future__ import annotations

import os
import time

import numpy as np
import pytest

os.environ.setdefault("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")
rclpy = pytest.importorskip("rclpy")
pytest.importorskip("nav_msgs")

from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from ros2_node import ControllerNode
from std_msgs.msg import Float64MultiArray

import quadexp as qx
from quadexp.physics.rotation import air_velocity
from quadexp.physics.state import ATTITUDE, POSITION, RATE, VELOCITY

SETTINGS = ("controller=perfect_mpc", "trajectory=circle", "trajectory.speed=4")
PATIENCE, STEPS = 20.0, 200  # s; control instants


def odometry(t: float, x: np.ndarray) -> Odometry:
    message = Odometry()
    message.header.stamp.sec, message.header.stamp.nanosec = int(t), round(1e9 * (t % 1))
    pose, twist = message.pose.pose, message.twist.twist
    pose.position.x, pose.position.y, pose.position.z = x[POSITION].tolist()
    q = pose.orientation
    q.w, q.x, q.y, q.z = x[ATTITUDE].tolist()
    body = air_velocity(x[ATTITUDE], x[VELOCITY])
    twist.linear.x, twist.linear.y, twist.linear.z = body.tolist()
    twist.angular.x, twist.angular.y, twist.angular.z = x[RATE].tolist()
    return message


def test_a_circle_over_ros_is_that_of_a_loop_in_python() -> None:
    rclpy.init()
    node = ControllerNode(SETTINGS)
    answers, commands = list[Float64MultiArray](), list[TwistStamped]()
    node.create_subscription(Float64MultiArray, "thrusts", answers.append, 10)
    node.create_subscription(TwistStamped, "rates", commands.append, 10)
    sends = node.create_publisher(Odometry, "odometry", 1)
    until = time.monotonic() + PATIENCE
    while sends.get_subscription_count() == 0 and time.monotonic() < until:
        rclpy.spin_once(node, timeout_sec=0.05)
    loop, direct = node.loop, qx.controller(*SETTINGS)
    x, x_direct = loop.start.copy(), direct.start.copy()
    for k, t in enumerate(loop.times[:STEPS]):
        sends.publish(odometry(10 + t, x))
        until = time.monotonic() + PATIENCE
        while not (len(answers) > k and len(commands) > k):
            assert time.monotonic() < until
            rclpy.spin_once(node, timeout_sec=0.05)
        thrusts = np.array(answers[-1].data)
        assert commands[-1].twist.linear.z == pytest.approx(thrusts.sum())
        x, _ = loop.plant.advance(x, thrusts, loop.period)
        wanted = direct.step(qx.Measurement(t, x_direct, None, None))
        x_direct, _ = direct.plant.advance(x_direct, wanted, direct.period)
        assert np.allclose(x, x_direct, rtol=0, atol=1e-9)
    rclpy.try_shutdown()
