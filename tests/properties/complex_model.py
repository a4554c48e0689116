"""Rigid body, drag, Gaussian process and blade element once more, in plain numpy that accepts complex numbers.

Nothing of quadexp's equations is used. With a step of 1e-30 i the imaginary part of f(x + i h) / h is the derivative to
the last digit (Squire and Trapp 1998), so values and Jacobians are checked by one independent computation.
"""

from collections.abc import Callable

import numpy as np

STEP = 1e-30


def derivative(f: Callable, x: np.ndarray) -> np.ndarray:
    """df/dx by complex step, (m, n)."""
    columns = [f(x + 1j * STEP * direction).imag / STEP for direction in np.eye(len(x))]
    return np.stack(columns, axis=1)


def rotation(q):
    """R(q) from the product q v q* / q*q, column by column."""

    def product(a, b):
        vector = a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])
        return np.concatenate([[a[0] * b[0] - a[1:] @ b[1:]], vector])

    conjugate = q * [1, -1, -1, -1]
    columns = [product(product(q, np.r_[0, e]), conjugate)[1:] for e in np.eye(3)]
    return np.stack(columns, axis=1) / (q @ q)


def rigid_body(vehicle, x, u, air):
    """x' under rotor thrusts u and the air's [acceleration, torque]."""
    q, v, w = x[3:7], x[7:10], x[10:13]
    force = np.array([0, 0, 1]) * u.sum() / vehicle.mass + air[:3]
    torque = np.array([0j, 0j, 0j]) + air[3:]
    for place, spin, thrust in zip(vehicle.rotor_position, vehicle.rotor_spin, u, strict=True):
        torque = torque + np.cross(place, thrust * np.array([0, 0, 1]))
        torque = torque + np.array([0, 0, vehicle.torque_coefficient * spin * thrust])
    J = np.array(vehicle.inertia)
    turn = np.concatenate([[-q[1:] @ w], q[0] * w + np.cross(q[1:], w)]) / 2
    fall = np.array([0, 0, -vehicle.gravity])
    return np.concatenate([v, turn, rotation(q) @ force + fall, np.linalg.solve(J, torque - np.cross(w, J @ w))])


def features(x, u):
    return np.concatenate([rotation(x[3:7]).T @ x[7:10], x[10:13], u])


def rk4(f, x, h):
    a = f(x)
    b = f(x + h * a / 2)
    c = f(x + h * b / 2)
    d = f(x + h * c)
    return x + h * (a + 2 * b + 2 * c + d) / 6


def no_air(z):
    return np.zeros(6)


def linear_drag(theta) -> Callable:
    drag, intercept, gain = theta[:3], theta[3:6], theta[6]

    def air(z):
        return np.concatenate([-drag * z[:3] + intercept + np.array([0, 0, gain]) * z[6:].sum(), np.zeros(3)])

    return air


def gaussian_process(outputs, mean_parameters) -> Callable:
    """Sum of squared-exponential kernels on a linear-drag mean."""
    names = {name: i for i, name in enumerate(("v_x", "v_y", "v_z", "w_x", "w_y", "w_z", "u_0", "u_1"))}
    rows = {name: i for i, name in enumerate(("a_x", "a_y", "a_z", "tau_x", "tau_y", "tau_z"))}
    mean = linear_drag(np.asarray(mean_parameters))

    def air(z):
        y = mean(z) + 0j
        for output in outputs:
            phi = np.array([z[6:].sum() if f == "thrust" else z[names[f]] for f in output.features])
            distance = (phi - output.inducing) / output.lengthscale
            y[rows[output.output]] += np.exp(-(distance**2).sum(axis=1) / 2) @ output.alpha
        return y

    return air


def blade_element(vehicle, blade) -> Callable:
    """Wrench less the nominal one at static speeds; V_I by complex Newton iteration from a real solution."""
    rotor, c_d = vehicle.rotor, np.array(blade.body_drag)
    s, r, th = rotor.blades * rotor.air_density * rotor.chord / 2, rotor.radius, rotor.twist
    K = 2 * rotor.air_density * np.pi * r**2

    def air(z):
        v, u = z[:3], z[6:]
        w = np.sqrt(u / vehicle.thrust_coefficient)
        squared, axial = v[0] ** 2 + v[1] ** 2, -v[2]
        a = s * blade.lift_slope * (r**3 * th * w**2 / 3 + r * th * squared / 2)
        b = s * blade.lift_slope * r**2 * w / 2
        V = 1.0 + np.abs(axial) + np.sqrt(a.real / K) + 0j * w
        for _ in range(60):
            through = V - axial
            speed = np.sqrt(squared + through**2)
            V = V - (K * V * speed - a + b * through) / (K * (speed + V * through / speed) + b)
        through = V - axial
        thrust = a - b * through
        hub = s * (r**2 * blade.profile_drag * w / 2 - blade.lift_slope * r * th * through / 6)
        hub = hub + s * blade.lift_slope * through**2 / (2 * w)
        torque = (
            s * r**2 * blade.profile_drag * (r**2 * w**2 + 3 * squared) / 4 + (thrust * through + hub * squared) / w
        )
        drag = rotor.reference_area * rotor.air_density / 2 * np.sqrt(v @ v) * c_d * v
        force = np.array([-v[0] * hub.sum(), -v[1] * hub.sum(), thrust.sum()]) - drag
        x, y, _ = np.array(vehicle.rotor_position).T
        moment = np.array([y @ thrust, -x @ thrust, np.array(vehicle.rotor_spin) @ torque])
        nominal = np.array([y @ u, -x @ u, vehicle.torque_coefficient * np.array(vehicle.rotor_spin) @ u])
        acceleration = (force - np.array([0, 0, 1]) * u.sum()) / vehicle.mass
        return np.concatenate([acceleration, moment - nominal])

    return air
