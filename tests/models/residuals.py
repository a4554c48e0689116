"""One instance of every residual, for the contract and for everything that must work with any of them."""

from dataclasses import replace
from itertools import pairwise

import numpy as np

from quadexp.models.linear_drag import linear_drag_residual
from quadexp.models.residual import Residual, no_residual, sum_residual
from quadexp.physics.rotor import RotorGeometry
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.aerodynamics.blade_element import static_coefficients
from quadexp.plugins.aerodynamics.coefficients import BladeCoefficients
from quadexp.plugins.gaussian_process.posterior import OutputPosterior, gaussian_process_residual, mean_only
from quadexp.plugins.neural.neural import Network, neural_residual
from quadexp.plugins.papers.lei_li.blade_element import blade_element_residual
from quadexp.plugins.papers.lei_li.plant import BladeElementEffects, BladeElementPlant, PlantChange
from quadexp.world import PlantEffects, SimplifiedPlant

RESIDUALS = (
    "none", "linear_drag", "gp_per_axis", "gp_thrust", "gp_with_mean", "gp_weighed", "plant", "blade_element",
    "blade_element_plant", "neural", "sum",
)  # fmt: skip
BLADE = BladeCoefficients(lift_slope=3.32, profile_drag=0.22, body_drag=(0.01, 0.01, 0.02))


def with_rotors(vehicle: Vehicle) -> Vehicle:
    """The vehicle, equipped with the rotors of Lei & Li 2017."""
    rotor = RotorGeometry(0.12, 0.025, np.pi / 12, 1.205, np.pi * 0.225**2)
    return replace(vehicle, rotor=rotor, thrust_coefficient=static_coefficients(rotor, BLADE).thrust)


def network(seed: int = 6) -> Network:
    """A small network of thrust and velocity."""
    rng, sizes = np.random.default_rng(seed), (5, 7, 6, 3)
    weights = [rng.normal(size=(rows, columns)) / columns for columns, rows in pairwise(sizes)]
    biases = [rng.normal(size=rows) for rows in sizes[1:]]
    weights[-1][2], biases[-1][2] = 0.1 * weights[-1][2], 0.1 * biases[-1][2]  # N m
    return Network(("v_x", "v_y", "v_z", "w_y", "thrust"), ("a_x", "a_z", "tau_y"), tuple(weights), tuple(biases))


def interpolating(output: str, features: tuple[str, ...], points: np.ndarray, values: np.ndarray) -> OutputPosterior:
    """The exact GP (Rasmussen & Williams 2006, 2.25, 2.26) through values, (n,), at points, (n, d)."""
    length, signal, noise = np.full(points.shape[1], 4.0), 9.0, 1e-4
    distance = (points[:, None] - points) / length
    kernel = signal * np.exp(-0.5 * (distance**2).sum(axis=2)) + noise * np.eye(len(points))
    root = signal * np.linalg.inv(np.linalg.cholesky(kernel))
    alpha, factor = signal * np.linalg.solve(kernel, values), np.linalg.qr(root, mode="r")
    return OutputPosterior(output, features, points, alpha, length, signal, noise, factor, 0.0, len(points))


def weighed_outputs() -> list[OutputPosterior]:
    """GPs of drag up to 10 m/s: one that drag can stand for, one with the thrust, and one of a torque."""
    rng = np.random.default_rng(5)
    v = rng.uniform(-10, 10, (15, 2))
    v[:, 1] = 8 * v[:, 1] + 80  # N
    turn = 0.1 * np.sin(v[:, 0]) + 0.01 * v[:, 0]
    return [
        interpolating("a_x", ("v_x",), v[:, :1], -0.3 * v[:, 0] - 0.08 * v[:, 0] * np.abs(v[:, 0]) + turn),
        interpolating("a_z", ("v_z", "thrust"), v / np.array([1, 4]), -0.1 * v[:, 0] - 0.01 * v[:, 1] + turn),
        interpolating("tau_y", ("v_x", "w_y"), v / np.array([1, 20]), turn),
    ]


def make_residual(name: str, vehicle: Vehicle) -> Residual:
    """A residual with numbers of the size that fits give."""
    if name == "none":
        return no_residual(vehicle)
    if name == "linear_drag":
        return linear_drag_residual(vehicle, (0.5, 0.6, 0.1), (0.02, -0.01, 0.1), -0.015)
    if name == "plant":
        return SimplifiedPlant(vehicle, PlantEffects(lift=0.02), backend="interpreted").residual()
    if name == "blade_element":
        return blade_element_residual(with_rotors(vehicle), BLADE)
    if name == "blade_element_plant":
        effects, change = BladeElementEffects(rotor_local_velocity=True), PlantChange(0.0, payload=0.2)
        plant = BladeElementPlant(with_rotors(vehicle), BLADE, effects, schedule=[change], backend="interpreted")
        return plant.residual()
    if name == "neural":
        return neural_residual(vehicle, network())
    if name == "sum":
        return sum_residual([make_residual(part, vehicle) for part in ("linear_drag", "neural", "gp_with_mean")])
    if name == "gp_weighed":
        return gaussian_process_residual(vehicle, weighed_outputs(), (0.1, 0, 0, 0, 0.01, 0.1, -0.02), weighed=True)
    rng = np.random.default_rng(5)
    features = {"a_x": ("v_x",), "a_y": ("v_y",), "a_z": ("v_z",)}
    if name == "gp_thrust":
        features = {"a_x": ("v_x", "w_y"), "a_z": ("v_z", "thrust"), "tau_y": ("v_x", "u_1", "w_y")}
    outputs = [
        mean_only(
            output, names, rng.uniform(-10, 10, (15, len(names))), rng.normal(size=15), rng.uniform(3, 8, len(names))
        )
        for output, names in features.items()
    ]
    mean = (0.4, 0.3, 0.1, 0.0, 0.01, 0.1, -0.02) if name == "gp_with_mean" else None
    return gaussian_process_residual(vehicle, outputs, mean)
