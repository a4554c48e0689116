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
Name = Annotated[str, Setting("name in tables and figures", names=True)]
SPEED = Setting(
    "nominal speed (circle, lemniscate; `quadexp simulate` prints the peak speed), or largest speed of the path"
    " (random,"
    " waypoints without t), reduced where the vehicle's limits do not allow it; the column `speed` of tables",
    "(0, 60]",
    "m/s",
)
MARGIN = Setting(
    "control authority that the reference leaves unused, as a share: of the range between the hover thrust and the"
    " thrust"
    " limits, and of the largest body rate",
    "[0, 0.9]",
)
RADIUS = Setting("radius of the circle, half width of the lemniscate", "(0, 1000]", "m")
DURATION = Setting("length of the flight", "(0, 3600]", "s")
PAYLOAD = Setting(
    "point mass at the centre of mass, unknown to controllers that are not told the plant's equations", "[0, 100]", "kg"
)
FORCE_NOISE = Setting("spectral density of the white noise on the force, each axis", "[0, 10]", "N/sqrt(Hz)")
TORQUE_NOISE = Setting("spectral density of the white noise on the torque, each axis", "[0, 10]", "N m/sqrt(Hz)")
RESIDUAL = Setting("model that is added to the rigid body in the prediction")
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
        Setting("position of every rotor in the body frame, m, in the order of the inputs u_0, u_1, ..."),
    ]
    rotor_spin: Annotated[
        tuple[float, ...],
        Setting(
            "sign of each rotor's reaction torque about +z_body; -1 for a rotor that turns counter-clockwise seen from"
            " above",
            "[-1, 1]",
        ),
    ]
    torque_coefficient: Annotated[float, Setting("reaction torque of a rotor divided by its thrust", "[0, 1]", "m")]
    thrust_min: Annotated[float, Setting("least thrust that can be commanded", "[0, 1000]", "N per rotor")]
    thrust_max: Annotated[float, Setting("largest thrust that can be commanded", "(0, 1000]", "N per rotor")]
    rate_max: Annotated[float, Setting("largest body rate that a reference may ask for", "(0, 100]", "rad/s")]
    gravity: Annotated[float, Setting("gravitational acceleration", "(0, 100]", "m/s^2")] = 9.81
    rotor: Annotated[RotorConfig | None, Setting("shape of the rotors, for blade-element models")] = None
    thrust_coefficient: Annotated[
        float | None,
        Setting(
            "k of the static thrust curve u = k w^2 (w: rotor speed); null where no model needs it",
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

    linear_drag: Annotated[Triple, Setting("linear drag coefficients, body axes", "[0, 100]", "N s/m")] = (
        0.3,
        0.3,
        0.0,
    )
    quadratic_drag: Annotated[Triple, Setting("quadratic drag coefficients, body axes", "[0, 100]", "N s^2/m^2")] = (
        0.08,
        0.08,
        0.08,
    )
    motor_loss: Annotated[
        float,
        Setting(
            "thrust lost by the motors at full thrust, as a share; the loss is proportional to the thrust squared",
            "[0, 1)",
        ),
    ] = 0.1 / 1.3**2
    motor_noise_density: Annotated[
        float,
        Setting(
            "spectral density of the white noise on the normalised thrust, at full thrust; proportional to the root of"
            " the thrust",
            "[0, 1]",
            "1/sqrt(Hz)",
        ),
    ] = 4.47213595499958e-4
    force_noise_density: Annotated[float, FORCE_NOISE] = 1.118033988749895e-4
    torque_noise_density: Annotated[float, TORQUE_NOISE] = 1.118033988749895e-4
    payload: Annotated[float, PAYLOAD] = 0.0
    lift: Annotated[
        float,
        Setting("k of the force k (v_x^2 + v_y^2) along z_body, v the velocity in body axes", "[0, 100]", "N s^2/m^2"),
    ] = 0.0


@dataclass(frozen=True, kw_only=True)
class SimplifiedPlantConfig(SimplifiedKeys, PlantConfig):
    """Torrente's simplified simulation; see quadexp/world/simplified.py."""

    kind: str = "simplified"


@dataclass(frozen=True, kw_only=True)
class FromModelPlantConfig(PlantConfig):
    """A model identified from flights as the truth; see quadexp/world/from_model.py. model: its checkpoint folder."""

    kind: str = "from_model"
    model: Annotated[str, Setting("checkpoint folder of the model that is taken as the truth")]
    residual: Annotated[
        Literal["best", "linear", "quadratic", "blade_element", "gaussian_process"],
        Setting(
            "which model of an identified vehicle; best: the one that identification chose; not used where the"
            " checkpoint is a Gaussian process"
        ),
    ] = "best"
    force_noise_density: Annotated[float, FORCE_NOISE] = 0.0
    torque_noise_density: Annotated[float, TORQUE_NOISE] = 0.0


# ------------------------------------------------------------------------------------------------------ trajectory
@dataclass(frozen=True, kw_only=True)
class TrajectoryConfig(Settings):
    """What every trajectory has. kind: which one of quadexp/reference/ (set by the schema).

    allow_infeasible: fly a reference although it asks for more than the vehicle has.
    lost_distance: a flight ends as lost when the vehicle is further (m) from the reference. lost_box: or when it leaves
    the box around the whole reference, widened by this (m).
    """

    prefix: ClassVar[str] = "trajectory."

    name: Name
    kind: str
    allow_infeasible: Annotated[
        bool,
        Setting(
            "also fly a reference that needs more collective thrust than the vehicle has; trajectory=random: at the"
            " asked"
            " speed, without regard to the vehicle's limits"
        ),
    ] = False
    lost_distance: Annotated[
        float,
        Setting("a flight ends as lost when the vehicle is further than this from the reference", "(0, 1e6]", "m"),
    ] = 10.0
    lost_box: Annotated[
        float | None,
        Setting(
            "a flight also ends as lost when the vehicle leaves the box around the whole reference, widened by this on"
            " every side; null: no box",
            "(0, 1e6]",
            "m",
        ),
    ] = None


@dataclass(frozen=True, kw_only=True)
class PathKeys(Settings):
    """What a path is made from; see quadexp/reference/."""

    prefix: ClassVar[str] = "trajectory."


@dataclass(frozen=True, kw_only=True)
class CircleKeys(PathKeys):
    """A closed path at one height with Torrente's speed profile."""

    speed: Annotated[float, SPEED]
    acceleration: Annotated[
        float, Setting("acceleration from rest to the nominal speed, and deceleration at the end", "(0, 50]", "m/s^2")
    ] = 1.0
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
class EllipseKeys(PathKeys):
    """An ellipse flown at a constant angular rate, from the first instant on; see quadexp/reference/ellipse.py."""

    speed: Annotated[float, Setting("V: speed at the ends of the minor axis, where it begins", "(0, 60]", "m/s")] = 10.0
    acceleration: Annotated[
        float, Setting("a: centripetal acceleration at the ends of the major axis", "(0, 1000]", "m/s^2")
    ] = 20.0
    ratio: Annotated[float, Setting("n: major axis divided by the minor one", "[1, 100]")] = 1.0
    plane: Annotated[Literal["horizontal", "vertical"], Setting("plane of the ellipse")] = "horizontal"
    heading: Annotated[
        Literal["auto", "centre", "constant"],
        Setting(
            "towards the centre, or along x; auto: towards the centre in the horizontal plane, constant in the vertical"
            " one, where y_body stays across the plane through inverted flight"
        ),
    ] = "auto"
    height: Annotated[float, Setting("height of the centre, world", "[-1000, 1000]", "m")] = 5.0
    duration: Annotated[float, DURATION] = 20.0


@dataclass(frozen=True, kw_only=True)
class EllipseConfig(EllipseKeys, TrajectoryConfig):
    """An ellipse in a horizontal or vertical plane, at speed from the start."""

    kind: str = "ellipse"


@dataclass(frozen=True, kw_only=True)
class RandomKeys(PathKeys):
    """A random closed path."""

    speed: Annotated[float, SPEED]
    margin: Annotated[float, MARGIN] = 0.25
    seed: Annotated[int, Setting("seed of the random path", SEEDS)] = 0
    keypoints: Annotated[int, Setting("number of random points that the path passes through", "[4, 200]", "points")] = (
        10
    )
    extent: Annotated[float, Setting("edge of the cube that the keypoints are drawn in", "(0, 1000]", "m")] = 6.0
    clearance: Annotated[float, Setting("height of the lowest keypoint, world", "[-1000, 1000]", "m")] = 1.0


@dataclass(frozen=True, kw_only=True)
class RandomConfig(RandomKeys, TrajectoryConfig):
    """A smooth random path through a few keypoints, as fast as `speed` and the vehicle's limits allow."""

    kind: str = "random"


@dataclass(frozen=True, kw_only=True)
class HoverKeys(PathKeys):
    """A held point."""

    position: Annotated[Triple, Setting("position to hold, world", "[-1e6, 1e6]", "m")] = (0.0, 0.0, 1.0)
    yaw: Annotated[float, Setting("heading", "[-7, 7]", "rad")] = 0.0
    duration: Annotated[float, DURATION] = 5.0


@dataclass(frozen=True, kw_only=True)
class HoverConfig(HoverKeys, TrajectoryConfig):
    """Hovering at a point."""

    kind: str = "hover"


@dataclass(frozen=True, kw_only=True)
class StepKeys(PathKeys):
    """A step of the set-point."""

    start: Annotated[
        Triple, Setting("set-point before the step, where the flight starts, world", "[-1e6, 1e6]", "m")
    ] = (0.0, 0.0, 1.0)
    target: Annotated[Triple, Setting("set-point after the step, world", "[-1e6, 1e6]", "m")] = (1.0, 0.0, 1.0)
    step_time: Annotated[float, Setting("time of the step", "[0, 3600]", "s")] = 1.0
    duration: Annotated[float, DURATION] = 5.0


@dataclass(frozen=True, kw_only=True)
class StepConfig(StepKeys, TrajectoryConfig):
    """A step of the set-point."""

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
        tuple[str, ...], Setting("checkpoint folders that are tried, in this order, when `model` is not given")
    ] = ()


@dataclass(frozen=True, kw_only=True)
class MPCKeys(Settings):
    """Horizon, weights and iteration limits of model predictive control, with the values of Torrente et al. 2021; see
    quadexp/control/mpc/settings.py."""

    prefix: ClassVar[str] = "controller."

    horizon: Annotated[float, Setting("length of the prediction horizon", "(0, 10]", "s")] = 1.0
    nodes: Annotated[int, Setting("number of intervals of the horizon", "[2, 200]", "nodes")] = 10
    first_node: Annotated[
        float,
        Setting(
            "length of the first interval, from which the others grow; 0: equal intervals, as published. A short first"
            " interval reduces the tracking error and the margin for delays that the controller does not know",
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
            "known delay between a command and its thrust; the state is predicted over it with the commands already"
            " sent."
            " Includes the time constant of any lag that motor_lag does not model",
            "[0, 0.5]",
            "s",
        ),
    ] = 0.0
    motor_lag: Annotated[
        float,
        Setting(
            "known time constant of the rotor thrusts, which then are states of the model; 0: no lag", "[0, 0.5]", "s"
        ),
    ] = 0.0
    motor_lead: Annotated[
        float,
        Setting(
            "time constant of the rotors' first-order lag that is inverted behind the MPC, which plans without it;"
            " cheaper than motor_lag; 0: none",
            "[0, 0.5]",
            "s",
        ),
    ] = 0.0
    rate: Annotated[float, Setting("control rate", "[1, 1000]", "Hz")] = 50.0
    position_weight: Annotated[
        Triple, Setting("weight of the squared position error, world axes, m^-2", "[0, 1e6]")
    ] = (
        10.0,
        10.0,
        10.0,
    )
    attitude_weight: Annotated[
        tuple[float, float, float, float],
        Setting(
            "weight of the squared components of the attitude error, a quaternion with w first; see attitude_error",
            "[0, 1e6]",
        ),
    ] = (0.0, 0.1, 0.1, 0.1)
    attitude_error: Annotated[
        Literal["plain", "body", "world"],
        Setting(
            "plain: q - q_ref as in the paper's code, so that the effect of unequal weights depends on the heading;"
            " body:"
            " the rotation q_ref^-1 o q, whose weights act on roll, pitch and yaw errors; world: q o q_ref^-1, whose"
            " weights act on turns about the world's axes"
        ),
    ] = "plain"
    velocity_weight: Annotated[
        Triple, Setting("weight of the squared velocity error, world axes, s^2 m^-2", "[0, 1e6]")
    ] = (
        0.05,
        0.05,
        0.05,
    )
    rate_weight: Annotated[Triple, Setting("weight of the squared body rate error, s^2", "[0, 1e6]")] = (
        0.05,
        0.05,
        0.05,
    )
    input_weight: Annotated[float, Setting("weight of the squared thrust error divided by thrust_max", "(0, 1e6]")] = (
        0.1
    )
    terminal_weight: Annotated[
        float,
        Setting(
            "factor on the weights of the state at the last node; 0: no terminal cost, as in the paper's code",
            "[0, 1e6]",
        ),
    ] = 0.0
    feedforward: Annotated[
        bool, Setting("compute the reference attitude, rates and thrusts with the controller's model of the air")
    ] = True
    initial_iterations: Annotated[
        int,
        Setting(
            "largest number of SQP iterations before the first input: 20 with full steps, then with a line search until"
            " converged; every later control step makes one iteration",
            "[1, 1000]",
        ),
    ] = 400
    distance_limit: Annotated[
        float,
        Setting("largest position error that the MPC acts on; a larger one is reduced to this length", "(0, 1e6]", "m"),
    ] = 10.0


@dataclass(frozen=True, kw_only=True)
class PredictiveConfig(MPCKeys, ControllerConfig):
    """What every MPC has, whatever its model of the air."""

    kind: str = "mpc"
    backend: Backend = "auto"
    allow_unstable: Annotated[
        bool, Setting("fly although the plant's own lag or delay makes the loop unstable at hover")
    ] = False


@dataclass(frozen=True, kw_only=True)
class MPCConfig(PredictiveConfig):
    """Model predictive control; see quadexp/control/mpc/settings.py. residual: its model of the air."""

    residual: Annotated[Literal["none", "linear_drag", "gaussian_process", "neural", "plant"], RESIDUAL]
