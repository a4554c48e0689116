"""Random vehicles, states, inputs and models, for hypothesis.

Vehicles have four to eight rotors at irregular places, a full inertia matrix of a real mass distribution, and rotors
of random shape; states tumble. A seed drawn by hypothesis fills the numbers: they are then generic, never special.
"""

from dataclasses import replace

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from quadexp.models.linear_drag import linear_drag_residual
from quadexp.models.residual import Residual, no_residual
from quadexp.physics.rotor import RotorGeometry
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.aerodynamics.blade_element import static_coefficients
from quadexp.plugins.aerodynamics.coefficients import BladeCoefficients
from quadexp.plugins.gaussian_process.posterior import OutputPosterior, gaussian_process_residual, mean_only
from quadexp.plugins.papers.lei_li.blade_element import blade_element_residual
from quadexp.plugins.papers.lei_li.plant import BladeElementEffects
from quadexp.world import PlantEffects


def few(test):
    """A quarter of the profile's examples, for tests that build or solve something large at every one."""
    return settings(max_examples=max(3, settings.default.max_examples // 4))(test)


generators = st.integers(0, 2**32 - 1).map(np.random.default_rng)
rotor_counts = st.sampled_from([4, 4, 6, 8])

GP_FEATURES = {
    "a_x": ("v_x",), "a_y": ("v_y", "w_x"), "a_z": ("v_z", "thrust"), "tau_x": ("v_y", "u_1"), "tau_z": ("w_z",),
}  # fmt: skip


@st.composite
def vehicles(draw, *, flat: bool = False, rotors: int | None = None) -> Vehicle:
    """A vehicle of 0.1 to 5 kg; flat: all rotors in the plane of the centre of mass."""
    rng, n = draw(generators), rotors or draw(rotor_counts)
    return make_vehicle(rng, n, flat=flat)


def make_vehicle(rng: np.random.Generator, n: int, *, flat: bool = False) -> Vehicle:
    """A vehicle with n rotors, spins alternating."""
    mass = float(10 ** rng.uniform(-1, 0.7))
    size = 0.2 * mass ** (1 / 3)
    turn = Rotation.from_rotvec(0.3 * rng.normal(size=3)).as_matrix()
    half = size * rng.uniform(0.3, 0.7, 3) * [1, 1, 0.6]  # a box: principal moments of a real body
    moments = (
        mass / 3 * np.array([half[1] ** 2 + half[2] ** 2, half[0] ** 2 + half[2] ** 2, half[0] ** 2 + half[1] ** 2])
    )
    inertia = turn @ np.diag(moments) @ turn.T
    angle = 2 * np.pi / n * (np.arange(n) + rng.uniform(-0.15, 0.15, n)) + rng.uniform(0, 2 * np.pi)
    arm = size * rng.uniform(0.9, 1.3, n)
    height = np.zeros(n) if flat else 0.2 * size * rng.normal(size=n)
    place = np.stack([arm * np.cos(angle), arm * np.sin(angle), height], axis=1)
    radius = 0.5 * size * rng.uniform(0.8, 1.1)
    rotor = RotorGeometry(
        radius,
        radius * rng.uniform(0.15, 0.25),
        rng.uniform(0.2, 0.35),
        rng.uniform(0.9, 1.3),
        size**2,
        int(rng.integers(2, 4)),
    )
    hover = mass * 9.81 / n
    return Vehicle(
        name="random",
        mass=mass,
        inertia=tuple(map(tuple, (inertia + inertia.T) / 2)),
        rotor_position=tuple(map(tuple, place)),
        rotor_spin=tuple(float(s) for s in np.resize([1, -1], n)),
        torque_coefficient=0.08 * size * rng.uniform(0.7, 1.3),
        thrust_min=0.0,
        thrust_max=float(hover * rng.uniform(1.6, 6.0)),
        rate_max=20.0,
        rotor=rotor,
        thrust_coefficient=static_coefficients(rotor, make_blade(rng)).thrust,
    )


def make_blade(rng: np.random.Generator) -> BladeCoefficients:
    """Coefficients around those of Lei & Li 2017, Table 1."""
    return BladeCoefficients.from_parameters(np.array([0.22, 3.32, 0.01, 0.012, 0.02]) * rng.uniform(0.6, 1.6, 5))


def make_state(rng: np.random.Generator, *, speed: float = 6.0, rate: float = 3.0) -> np.ndarray:
    """Any attitude, velocity (m/s) and rate (rad/s), (13,)."""
    q = rng.normal(size=4)
    return np.r_[rng.normal(size=3), q / np.linalg.norm(q), speed * rng.normal(size=3), rate * rng.normal(size=3)]


def make_upright_state(rng: np.random.Generator, *, speed: float = 4.0) -> np.ndarray:
    """A state of ordinary flight: tilted by some 30 degrees, any heading."""
    x = make_state(rng, speed=speed, rate=1.0)
    tilt = Rotation.from_euler("zyx", [rng.uniform(-3, 3), *rng.uniform(-0.5, 0.5, 2)])
    x[3:7] = tilt.as_quat(scalar_first=True)
    return x


def make_thrusts(rng: np.random.Generator, vehicle: Vehicle) -> np.ndarray:
    """Between 0.6 and 1.5 of hover, (n,) (N)."""
    return vehicle.hover_thrust * rng.uniform(0.6, 1.5, vehicle.n_rotors)


def make_features(rng: np.random.Generator, vehicle: Vehicle) -> np.ndarray:
    """z = [v_body, w, u], (6 + n,)."""
    return np.r_[4 * rng.normal(size=3) * [1, 1, 0.4], rng.normal(size=3), make_thrusts(rng, vehicle)]


def make_effects(rng: np.random.Generator, *, noise: bool = False, isotropic: bool = False) -> PlantEffects:
    """Drag, motor loss and lift of any size that flies.

    isotropic: the same along every horizontal direction; drag that is quadratic per axis, v_i |v_i|, never is.
    """
    linear, quadratic = rng.uniform(0, 0.4, 3), rng.uniform(0, 0.1, 3)
    if isotropic:
        linear[1], quadratic[:2] = linear[0], 0.0
    effects = PlantEffects(tuple(linear), tuple(quadratic), rng.uniform(0, 0.08), lift=rng.uniform(0, 0.02))
    quiet = dict.fromkeys(("motor_noise_density", "force_noise_density", "torque_noise_density"), 0.0)
    return effects if noise else replace(effects, **quiet)


def make_blade_effects(rng: np.random.Generator) -> BladeElementEffects:
    return BladeElementEffects(bool(rng.integers(2)), bool(rng.integers(2)))


def make_gp_outputs(rng: np.random.Generator, points: int = 8) -> list[OutputPosterior]:
    """Smooth random functions of velocity, rate and thrust."""
    return [
        mean_only(
            output,
            names,
            rng.uniform(-8, 8, (points, len(names))),
            (1.0 if output.startswith("a") else 0.01) * rng.normal(size=points),
            rng.uniform(3, 8, len(names)),
        )
        for output, names in GP_FEATURES.items()
    ]


RESIDUALS = ("none", "linear_drag", "gaussian_process", "blade_element")


def make_residual(name: str, vehicle: Vehicle, rng: np.random.Generator) -> Residual:
    """A residual of the kind for the vehicle, with random parameters."""
    if name == "none":
        return no_residual(vehicle)
    drag = (rng.uniform(0, 0.6, 3), 0.05 * rng.normal(size=3), 0.02 * rng.normal())
    if name == "linear_drag":
        return linear_drag_residual(vehicle, *drag)
    if name == "gaussian_process":
        return gaussian_process_residual(vehicle, make_gp_outputs(rng), np.r_[drag[0], drag[1], drag[2]])
    return blade_element_residual(vehicle, make_blade(rng))
