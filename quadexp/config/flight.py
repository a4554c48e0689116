"""The settings that decide a flight: vehicle, plant, trajectory, controller.

A class `...Keys` declares the settings of an object of the program, which inherits them: `class MPCSettings(MPCKeys)`.
A class `...Config` is a node of the configuration: such settings, with the keys that say what is made and how.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from quadexp.config.settings import Setting, Settings, Triple

# Settings that several objects have.
Backend = Annotated[
    Literal["auto", "compiled", "interpreted"],
    Setting("C code compiled once and kept, CasADi's interpreter, or compiled where there is a compiler"),
]
Name = Annotated[str, Setting("name in tables and figures")]
SPEED = Setting(
    "the column `speed` of tables: nominal speed (circle, lemniscate), whose peak is said by `quadexp simulate`, or"
    " asked peak speed (random, waypoints without t), less where the vehicle's limits come first",
    "(0, 60]",
    "m/s",
)
MARGIN = Setting(
    "share of the room between hover and the limits of thrusts, and of the largest body rate, that the reference leaves"
    " unused",
    "[0, 0.9]",
)
RADIUS = Setting("radius of the circle, half width of the lemniscate", "(0, 1000]", "m")
DURATION = Setting("length of the flight", "(0, 3600]", "s")
PAYLOAD = Setting("point mass carried at the centre; controllers do not know of it", "[0, 100]", "kg")
FORCE_NOISE = Setting("white noise of the force", "[0, 10]", "N/sqrt(Hz)")
TORQUE_NOISE = Setting("white noise of the torque", "[0, 10]", "N m/sqrt(Hz)")
RESIDUAL = Setting("what the MPC believes beyond the rigid body")
SEEDS = "[0, 4294967295]"


# --------------------------------------------------------------------------------------------------------- vehicle
@dataclass(frozen=True)
class RotorConfig(Settings):
    """Shape of every rotor, and the air; see quadexp/physics/rotor.py."""

    prefix: ClassVar[str] = "vehicle.rotor."

    radius: Annotated[float, Setting("radius of the rotor disc", "[0.001, 10]", "m")]
    chord: Annotated[float, Setting("chord of a blade", "(0, 1]", "m")]
    twist: Annotated[float, Setting("pitch angle of a blade, constant over the radius", "(0, 1.57]", "rad")]
    air_density: Annotated[float, Setting("density of the air", "(0, 10]", "kg/m^3")]
    reference_area: Annotated[float, Setting("area that the airframe's drag coefficients refer to", "(0, 100]", "m^2")]
    blades: Annotated[int, Setting("blades of a rotor", "[1, 20]")] = 2


@dataclass(frozen=True)
class VehicleConfig(Settings):
    """Physical parameters of a multirotor; see quadexp/physics/vehicle.py."""

    prefix: ClassVar[str] = "vehicle."

    name: Name
    mass: Annotated[float, Setting("mass, without a payload", "(0, 100]", "kg")]
    inertia: Annotated[tuple[Triple, Triple, Triple], Setting("inertia matrix, rows, kg m^2")]
    rotor_position: Annotated[
        tuple[Triple, ...],
        Setting("a point for each rotor, m; their order is that of the inputs u_0, u_1, ..."),
    ]
    rotor_spin: Annotated[
        tuple[float, ...],
        Setting(
            "sign of each rotor's reaction torque about +z_body: -1 for one that turns counter-clockwise", "[-1, 1]"
        ),
    ]
    torque_coefficient: Annotated[float, Setting("reaction torque per thrust", "[0, 1]", "m")]
    thrust_min: Annotated[float, Setting("least thrust that can be commanded", "[0, 1000]", "N per rotor")]
    thrust_max: Annotated[float, Setting("largest thrust that can be commanded", "(0, 1000]", "N per rotor")]
    rate_max: Annotated[float, Setting("largest body rate that a reference may ask for", "(0, 100]", "rad/s")]
    gravity: Annotated[float, Setting("acceleration of free fall", "(0, 100]", "m/s^2")] = 9.81
    rotor: Annotated[RotorConfig | None, Setting("shape of the rotors, for blade-element models")] = None
    thrust_coefficient: Annotated[
        float | None,
        Setting(
            "k of the thrust map u = k w^2 between thrust and rotor speed; null where nobody needs it",
            "(0, 1]",
            "N s^2",
        ),
    ] = None


# ----------------------------------------------------------------------------------------------------------- plant
@dataclass(frozen=True, kw_only=True)
class PlantConfig(Settings):
    """What every plant has. kind: which plant of quadexp/world/ (set by the schema)."""

    prefix: ClassVar[str] = "plant."

    name: Name
    kind: str
    step: Annotated[
        float, Setting("largest integration step; a control period is divided evenly", "[1e-5, 0.02]", "s")
    ] = 1e-3
    backend: Backend = "auto"


@dataclass(frozen=True)
class SimplifiedKeys(Settings):
    """What acts on the vehicle besides its rotors and gravity, with the values of Torrente et al. 2021: their noise is
    an amplitude per step of 0.5 ms; as a spectral density it is amplitude * sqrt(0.0005 s)."""

    prefix: ClassVar[str] = "plant."

    linear_drag: Annotated[Triple, Setting("drag force per velocity", "[0, 100]", "N s/m")] = (0.3, 0.3, 0.0)
    quadratic_drag: Annotated[Triple, Setting("drag force per velocity squared", "[0, 100]", "N s^2/m^2")] = (
        0.08,
        0.08,
        0.08,
    )
    motor_loss: Annotated[
        float, Setting("share of the thrust that is lost at full thrust; grows with the thrust", "[0, 1)")
    ] = 0.1 / 1.3**2
    motor_noise_density: Annotated[
        float,
        Setting(
            "white noise on the normalised thrust at full thrust; goes with the thrust's root", "[0, 1]", "1/sqrt(Hz)"
        ),
    ] = 4.47213595499958e-4
    force_noise_density: Annotated[float, FORCE_NOISE] = 1.118033988749895e-4
    torque_noise_density: Annotated[float, TORQUE_NOISE] = 1.118033988749895e-4
    payload: Annotated[float, PAYLOAD] = 0.0


@dataclass(frozen=True, kw_only=True)
class SimplifiedPlantConfig(SimplifiedKeys, PlantConfig):
    """Torrente's simplified simulation; see quadexp/world/simplified.py."""

    kind: str = "simplified"


@dataclass(frozen=True, kw_only=True)
class FromModelPlantConfig(PlantConfig):
    """A model identified from flights as the truth; see quadexp/world/from_model.py. model: its checkpoint folder."""

    kind: str = "from_model"
    model: Annotated[str, Setting("checkpoint folder of the model that is the truth")]
    residual: Annotated[
        Literal["best", "linear", "quadratic", "blade_element", "gaussian_process"],
        Setting("which of an identified vehicle's models, best: its own choice; ignored for a Gaussian process"),
    ] = "best"
    force_noise_density: Annotated[float, FORCE_NOISE] = 0.0
    torque_noise_density: Annotated[float, TORQUE_NOISE] = 0.0


# ------------------------------------------------------------------------------------------------------ trajectory
@dataclass(frozen=True, kw_only=True)
class TrajectoryConfig(Settings):
    """What every trajectory has. kind: which one of quadexp/reference/ (set by the schema).

    allow_infeasible: fly a reference although it asks for more than the vehicle has.
    lost_distance: further than this from the reference (m) a flight is over.
    """

    prefix: ClassVar[str] = "trajectory."

    name: Name
    kind: str
    allow_infeasible: Annotated[
        bool,
        Setting(
            "fly a reference that asks for more collective thrust than the vehicle has; trajectory=random: at the asked"
            " speed whatever the limits"
        ),
    ] = False
    lost_distance: Annotated[
        float, Setting("further than this from the reference a flight is over", "(0, 1e6]", "m")
    ] = 10.0


@dataclass(frozen=True, kw_only=True)
class PathKeys(Settings):
    """What a path is made from; see quadexp/reference/."""

    prefix: ClassVar[str] = "trajectory."


@dataclass(frozen=True, kw_only=True)
class CircleKeys(PathKeys):
    """A closed path at one height with Torrente's speed profile."""

    speed: Annotated[float, SPEED]
    acceleration: Annotated[float, Setting("of the run up to the nominal speed and back", "(0, 50]", "m/s^2")] = 1.0
    radius: Annotated[float, RADIUS] = 5.0
    height: Annotated[float, Setting("height of the path, world", "[-1000, 1000]", "m")] = 1.0


@dataclass(frozen=True, kw_only=True)
class CircleConfig(CircleKeys, TrajectoryConfig):
    """A circle, started and ended at rest; speed is the nominal (cruising) speed."""

    kind: str = "circle"


@dataclass(frozen=True, kw_only=True)
class LemniscateConfig(CircleKeys, TrajectoryConfig):
    """A lemniscate (r cos th, r sin th cos th), started and ended at rest."""

    kind: str = "lemniscate"


@dataclass(frozen=True, kw_only=True)
class RandomKeys(PathKeys):
    """A random closed path."""

    speed: Annotated[float, SPEED]
    margin: Annotated[float, MARGIN] = 0.25
    seed: Annotated[int, Setting("draws the path", SEEDS)] = 0
    keypoints: Annotated[int, Setting("points that the path goes through", "[4, 200]", "points")] = 10
    extent: Annotated[float, Setting("edge of the cube that the keypoints are drawn in", "(0, 1000]", "m")] = 6.0
    clearance: Annotated[float, Setting("height of the lowest keypoint, world", "[-1000, 1000]", "m")] = 1.0


@dataclass(frozen=True, kw_only=True)
class RandomConfig(RandomKeys, TrajectoryConfig):
    """A smooth random path through a few keypoints, as fast as `speed` and the vehicle's limits allow."""

    kind: str = "random"


@dataclass(frozen=True, kw_only=True)
class HoverKeys(PathKeys):
    """A held point."""

    position: Annotated[Triple, Setting("where to stay, world", "[-1e6, 1e6]", "m")] = (0.0, 0.0, 1.0)
    yaw: Annotated[float, Setting("heading", "[-7, 7]", "rad")] = 0.0
    duration: Annotated[float, DURATION] = 5.0


@dataclass(frozen=True, kw_only=True)
class HoverConfig(HoverKeys, TrajectoryConfig):
    """Staying at a point."""

    kind: str = "hover"


@dataclass(frozen=True, kw_only=True)
class StepKeys(PathKeys):
    """A jump of the set-point."""

    start: Annotated[Triple, Setting("where the flight starts, world", "[-1e6, 1e6]", "m")] = (0.0, 0.0, 1.0)
    target: Annotated[Triple, Setting("where the set-point jumps to, world", "[-1e6, 1e6]", "m")] = (1.0, 0.0, 1.0)
    step_time: Annotated[float, Setting("when it jumps", "[0, 3600]", "s")] = 1.0
    duration: Annotated[float, DURATION] = 5.0


@dataclass(frozen=True, kw_only=True)
class StepConfig(StepKeys, TrajectoryConfig):
    """A jump of the set-point."""

    kind: str = "step"


@dataclass(frozen=True, kw_only=True)
class FileKeys(PathKeys):
    """A path from a file."""

    path: Annotated[
        str,
        Setting(
            "sampled track: CSV with the columns t, p_x, p_y, p_z, optionally yaw, or TUM; waypoints: CSV with the"
            " columns x, y, z, optionally t and yaw"
        ),
    ]
    speed: Annotated[float | None, SPEED] = None
    margin: Annotated[float, MARGIN] = 0.25


@dataclass(frozen=True, kw_only=True)
class FileConfig(FileKeys, TrajectoryConfig):
    """A sampled track from a CSV (t, p_x, p_y, p_z, optionally yaw) or TUM file, or minimum-snap polynomials through
    the waypoints of a CSV (x, y, z, optionally t and yaw; 2 are enough)."""

    kind: str = "file"


# ------------------------------------------------------------------------------------------------------ controller
@dataclass(frozen=True, kw_only=True)
class ControllerConfig(Settings):
    """What every controller has. models: where to look for a checkpoint when `model` is not given, in this order."""

    prefix: ClassVar[str] = "controller."

    name: Name
    kind: str
    models: Annotated[
        tuple[str, ...], Setting("where a checkpoint is looked for, in this order, when `model` is not given")
    ] = ()


@dataclass(frozen=True, kw_only=True)
class MPCKeys(Settings):
    """Horizon, weights and iteration limits of model predictive control, with the values of Torrente et al. 2021; see
    quadexp/control/mpc/settings.py."""

    prefix: ClassVar[str] = "controller."

    horizon: Annotated[float, Setting("length of the prediction", "(0, 10]", "s")] = 1.0
    nodes: Annotated[int, Setting("intervals of the prediction", "[2, 200]", "nodes")] = 10
    first_node: Annotated[
        float,
        Setting(
            "first interval, from which the others grow; 0: all alike, as published. A short one tracks closer and"
            " leaves less room for a delay that nobody predicts",
            "[0, 10]",
            "s",
        ),
    ] = 0.0
    input_hold: Annotated[
        Literal["command", "deviation"],
        Setting(
            "what the prediction keeps constant within an interval: the command, as published, or its deviation from"
            " the reference's thrust; then long intervals cost no accuracy on the reference"
        ),
    ] = "command"
    dead_time: Annotated[
        float,
        Setting(
            "known time between a command and its thrust, over which the state is predicted with the commands already"
            " sent; a lag that motor_lag does not model counts too",
            "[0, 0.5]",
            "s",
        ),
    ] = 0.0
    motor_lag: Annotated[
        float,
        Setting(
            "known time constant of the rotors' thrust, which is then a state of the model; 0: none", "[0, 0.5]", "s"
        ),
    ] = 0.0
    rate: Annotated[float, Setting("control steps a second", "[1, 1000]", "Hz")] = 50.0
    position_weight: Annotated[Triple, Setting("cost of the position error squared, world, m^-2", "[0, 1e6]")] = (
        10.0,
        10.0,
        10.0,
    )
    attitude_weight: Annotated[
        tuple[float, float, float, float],
        Setting("cost of the attitude error squared, a quaternion, w first: see attitude_error", "[0, 1e6]"),
    ] = (0.0, 0.1, 0.1, 0.1)
    attitude_error: Annotated[
        Literal["plain", "body"],
        Setting(
            "plain: q - q_ref, as in the paper's code, whose weights act differently at every heading; body: the"
            " rotation q_ref^-1 o q, weights of roll, pitch and yaw errors"
        ),
    ] = "plain"
    velocity_weight: Annotated[Triple, Setting("cost of the velocity error squared, world, s^2 m^-2", "[0, 1e6]")] = (
        0.05,
        0.05,
        0.05,
    )
    rate_weight: Annotated[Triple, Setting("cost of the body rate error squared, s^2", "[0, 1e6]")] = (
        0.05,
        0.05,
        0.05,
    )
    input_weight: Annotated[float, Setting("cost of the thrust error over thrust_max, squared", "(0, 1e6]")] = 0.1
    terminal_weight: Annotated[
        float, Setting("factor on the state's cost at the last node; 0: none, as in the paper's code", "[0, 1e6]")
    ] = 0.0
    feedforward: Annotated[bool, Setting("references carry what the controller knows of the air")] = True
    initial_iterations: Annotated[
        int,
        Setting(
            "SQP iterations before the first input, at most: 20 full ones, then with a line search until converged; one"
            " a step after that",
            "[1, 1000]",
        ),
    ] = 400
    distance_limit: Annotated[
        float,
        Setting("position error that the MPC acts on: from further away it comes as from there", "(0, 1e6]", "m"),
    ] = 10.0


@dataclass(frozen=True, kw_only=True)
class PredictiveConfig(MPCKeys, ControllerConfig):
    """What every MPC has, whatever it believes of the air."""

    kind: str = "mpc"
    backend: Backend = "auto"


@dataclass(frozen=True, kw_only=True)
class MPCConfig(PredictiveConfig):
    """Model predictive control; see quadexp/control/mpc/settings.py. residual: what it believes of the air."""

    residual: Annotated[Literal["none", "linear_drag", "gaussian_process", "plant"], RESIDUAL]
