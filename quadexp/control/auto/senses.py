"""What is measured in flight beside the delays: what pushes, how strongly it changes, and how noisy readings are.

push      e = f - T_z e_z / m - a_air: a random walk on each axis, of one of the strengths WALKS; the likeliest
          counts, its likelihood forgotten in FORGETTING
noise     of e, and of the told position and attitude, white: minus the covariance of successive differences
          E[(e_1 - e_0) (e_2 - e_1)] = -sigma^2
torque    w+ = w + T (J^-1 (tau - w x J w) + b) with the likeliest thrusts: b
"""

from __future__ import annotations

import math

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.physics.rotation import product
from quadexp.physics.state import ATTITUDE, POSITION, RATE, VELOCITY

WALKS = (0.02, 0.1, 0.5, 1.5)  # m/s^2 in a root of a second
FORGETTING = 4.0  # s
TEMPER = 15.0  # 1/s: of likelihoods, whose readings are correlated
AVERAGED = 5.0  # s, at most
WARM = 0.5  # s, from which on a measured noise counts
UNSURE = 0.28  # m/s^2: of the model on z, where the thrust is


def sense_sizes() -> dict[str, int]:
    """Names and sizes of what is remembered, see bank.Layout."""
    walks = 3 * len(WALKS)
    sizes = {"walk": walks, "walk_variance": walks, "walk_likelihood": walks, "torque": 4}
    return sizes | {"reading": 3, "change": 3, "noise": 3, "drift": 6, "pose_noise": 2}


def sensed(
    kept: dict[str, ca.MX], x: ca.MX, f: ca.MX, lifted: ca.MX, y: ca.MX, turning: ca.MX, likely: ca.MX, gains: ca.MX,
    noise: ca.MX, period: float,
) -> dict[str, ca.MX]:  # fmt: skip
    """What is remembered after a period.

    x, f: told state (13,) and reading without bias (3,). lifted: what the likeliest thrust leaves of z (m/s^2).
    y: of the model, (6,). turning: gyroscopic acceleration (2,). likely: accelerations of the likeliest thrusts (3, 2),
    see bank. gains: (2,), of the torque. noise: of a reading by its data sheet (m/s^2).
    """
    count = kept["count"]
    e = ca.vertcat(f[:2] - y[:2], lifted)
    change = e - kept["reading"]
    least = ca.vertcat(noise, noise, ca.sqrt(noise**2 + UNSURE**2)) ** 2
    measured = kept["noise"] + (count > 2) * (-change * kept["change"] - kept["noise"]) / ca.fmin(
        count + 5, AVERAGED / period
    )
    variance = ca.if_else(count > WARM / period, ca.fmax(measured, least), least)

    walk, P, likelihood = (ca.reshape(kept[name], 3, -1) for name in ("walk", "walk_variance", "walk_likelihood"))
    P = P + ca.DM(np.tile(np.square(WALKS) * period, (3, 1)))
    S = P + ca.repmat(variance, 1, len(WALKS))
    nu = ca.repmat(e, 1, len(WALKS)) - walk
    walk = walk + P / S * nu
    likelihood = math.exp(-period / FORGETTING) * likelihood - TEMPER * period / 2 * (nu**2 / S + ca.log(S))

    predicted = kept["torque"][:2] + period * (kept["torque"][2:] + turning + likely[:2, 1])
    off = x[RATE][:2] - predicted
    torque = ca.vertcat(predicted + gains[0] * off, kept["torque"][2:] + gains[1] * off)

    last, q = kept["x"], x[ATTITUDE] * ca.sign(ca.dot(x[ATTITUDE], kept["x"][ATTITUDE]))
    back = ca.vertcat(last[ATTITUDE][0], -last[ATTITUDE][1:])
    moved = x[POSITION] - last[POSITION] - period * (x[VELOCITY] + last[VELOCITY]) / 2
    drift = ca.vertcat(moved, 2 * product(back, q)[1:] - period * (x[RATE] + last[RATE]) / 2)
    both = -drift * kept["drift"]
    pose = ca.vertcat(ca.sum1(both[:3]), ca.sum1(both[3:])) / 3
    pose = kept["pose_noise"] + (count > 2) * (pose - kept["pose_noise"]) / ca.fmin(count + 1, AVERAGED / period)
    after = {"walk": ca.vec(walk), "walk_variance": ca.vec((1 - P / S) * P), "walk_likelihood": ca.vec(likelihood)}
    return after | {
        "torque": torque,
        "reading": e,
        "change": change,
        "noise": measured,
        "drift": drift,
        "pose_noise": pose,
    }
