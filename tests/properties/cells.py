"""Cells drawn from everything that can be composed, and flights as fingerprints; for children of the tests too.

A cell is a mapping from a group to the overrides of it. Of a pair the second is the first with some groups drawn anew,
so that both have much in common that a process keeps.
"""

import hashlib
import json
from collections.abc import Iterator

import numpy as np
import scipy.spatial  # noqa: F401 - imported once, for all children, as rollout is

from quadexp.errors import QuadexpError
from quadexp.experiment import rollout  # noqa: F401
from quadexp.experiment.evaluate import fly_one
from quadexp.parts.schema import Config

Cell = dict[str, tuple[str, ...]]

# A vehicle with the plants and the controllers that only it flies.
MPC = ("nominal_mpc", "perfect_mpc", "nominal_mpc_tuned", "online_mpc", "sun_mpc", "sun_nmpc")
LAWS = ("dfbc", "dfbc_tuned", "geometric", "pid", "sun_dfbc", "raptor", "rotorpy_se3")
LEARNED = ("gp_mpc", "linear_drag_mpc", "neural_mpc", "streaming_gp_mpc")  # of models of vehicle=torrente
BLADE = ("rls_feedback", "oracle_feedback", "literal_feedback", "static_feedback", "rls_mpc")
SCHEDULE = "plant.schedule=[{t: 0.1, payload: 0.3}, {t: 0.2, lift_scale: [0.9, 1, 1, 1]}]"
FAMILIES = (
    ("torrente", (("simplified",), ("ideal",), ("simplified", "plant.lift=0.1")), LEARNED),
    ("torrente", (("simplified",), ("from_model", "plant.model={models}/gp")), LEARNED),
    ("sun", (("sun",), ("ideal",)), ()),
    ("lei_li", (("blade_element",), ("blade_element", SCHEDULE), ("blade_element", "plant.motor_lag=0.03")), BLADE),
    ("lei_li", (("blade_element_propeller",), ("blade_element_drag",), ("simplified",)), BLADE),
    ("hummingbird", (("rotorpy",), ("rotorpy", "plant.motor_lag=0.02")), ()),
    ("cf2x_L250", (("drone_models",), ("simplified",)), ()),
    ("cf21B_500", (("drone_models_brushless",),), ()),
)
COMPILED = ("nominal_mpc", "gp_mpc", "dfbc", "geometric")  # with few structures: each takes seconds to compile
GRIDS = (("horizon=0.4",), ("horizon=0.2", "rate=100"), ("horizon=0.4", "dead_time=0.03"))
GRIDS += (("horizon=0.4", "motor_lag=0.03"), ("horizon=0.4", "feedforward=false"))
SHORT = "trajectory.duration=0.4"
TRAJECTORIES = (  # circle and lemniscate take four seconds at least
    ("ellipse", "trajectory.speed=3", "trajectory.acceleration=6", SHORT),
    ("ellipse", "trajectory.speed=2", "trajectory.acceleration=5", "trajectory.ratio=2", SHORT),
    ("hover", SHORT), ("step", "trajectory.step_time=0.1", SHORT), ("rectangle", SHORT), ("lei_li_circle", SHORT),
    ("random", "trajectory.keypoints=4", "trajectory.extent=0.3", "trajectory.speed=3"),
)  # fmt: skip
# Groups around them, of which a cell has up to four.
AROUND: dict[str, tuple[tuple[str, ...], ...]] = {
    "observer": (
        ("disturbance",), ("wind", "observer.least_bandwidth=0"), ("disturbance", "observer.scale_walk=0.1"),
        ("disturbance", "observer.torque_bandwidth=0"), ("disturbance", "observer.source=velocity"),
    ),
    "adaptive": (("l1",), ("l1", "adaptive.unmatched=false")),
    "rate_loop": (("indi",), ("indi", "rate_loop.rate=200")),
    "delay": (("strapdown", "delay.time=0.02"), ("prediction", "delay.time=0.02")),
    "truth": (("nominal", "truth.mass=1.05"), ("nominal", "truth.inertia=[0.9,1,1]"), ("nominal", "truth.drag=1.5")),
    "payload": (("fixed", "payload.mass=0.01"), ("slung", "payload.mass=0.01", "payload.stretch=0.1")),
    "wind": (("constant",), ("dryden",), ("gust", "wind.onset=0.1"), ("gusty",)),
    "external": (("push", "external.onset=0.1"),),
    "link": (("latency",), ("radio",), ("onboard",)),
    "actuator": (("lag_30ms",), ("spread",), ("speed_lag_30ms",), ("first_order",), ("thrust_scale",)),
    "battery": (("sag",), ("quick_sag",)),
    "health": (("rotor_loss", "health.losses=[{rotor: 1, t: 0.2, factor: 0.9}]"),),
    "ground": (("cheeseman_bennett", "ground.rotor_radius=0.1"),),
    "sensor": (("imu_mocap",), ("imu_gnss",), ("lei_li",)),
    "estimator": (("late",), ("late",), ("late_noisy",), ("noisy",)),
}  # fmt: skip
NEEDS = {"imu_mocap": "eskf", "imu_gnss": "eskf"}


def drawn_pairs(seed: int, models: str) -> Iterator[tuple[list[str], list[str]]]:
    """Pairs of cells, as overrides. models: folder of the checkpoints."""
    rng = np.random.default_rng(seed)
    while True:
        first = drawn(rng, models)
        pair = [[one for given in cell.values() for one in given] for cell in (first, _changed(first, rng, models))]
        yield pair[0], pair[1]


def drawn(rng: np.random.Generator, models: str) -> Cell:
    """Any cell."""
    compiled = rng.random() < 0.15
    vehicle, plants, own = FAMILIES[0] if compiled else _one(FAMILIES, rng)
    backend = "auto" if compiled else "interpreted"
    cell = {"vehicle": (f"vehicle={vehicle}",), "seed": (f"seed={rng.integers(3)}",)}
    cell["plant"] = (*_overrides("plant", _one(plants, rng), models), f"plant.backend={backend}")
    controllers = COMPILED if compiled else (*own, *own, *MPC, *LAWS)
    cell["controller"] = _controller(_one(controllers, rng), backend, rng, models)
    cell["trajectory"] = _overrides("trajectory", _one(TRAJECTORIES, rng), models)
    wanted = rng.permutation([*AROUND])[: rng.integers(5)]
    around = {} if compiled else {str(group): _around(str(group), rng, models) for group in wanted}
    return cell | around | ({"estimator": ("estimator=late",)} if compiled and rng.random() < 0.5 else {})


def _changed(cell: Cell, rng: np.random.Generator, models: str) -> Cell:
    """The cell with one to three of its groups, or of those that it leaves out, as in another of the same vehicle."""
    backend = cell["plant"][-1]
    while (other := drawn(rng, models))["vehicle"] != cell["vehicle"] or other["plant"][-1] != backend:
        pass
    groups = rng.permutation([group for group in ("controller", "plant", "seed", *AROUND) if group in cell | other])
    chosen = [str(group) for group in groups[: rng.integers(1, 4)]]
    kept = {group: given for group, given in cell.items() if group not in chosen}
    return kept | {group: other[group] for group in chosen if group in other}


def _controller(name: str, backend: str, rng: np.random.Generator, models: str) -> tuple[str, ...]:
    given = [f"controller={name}"]
    if name.endswith(("mpc", "mpc_tuned")):
        grids = GRIDS[:1] if backend == "auto" or name.startswith("sun") else GRIDS
        given += [f"controller.{key}" for key in ("allow_unstable=true", "nodes=4", *_one(grids, rng))]
    if name in LEARNED:
        given += [f"model={models}/{'nn' if name == 'neural_mpc' else 'gp'}"]
    if name != "rotorpy_se3":
        given += [f"controller.backend={backend}"]
    return tuple(given)


def _around(group: str, rng: np.random.Generator, models: str) -> tuple[str, ...]:
    option = _one(AROUND[group], rng)
    needed = (f"estimator={NEEDS[option[0]]}",) if option[0] in NEEDS else ()
    return (*_overrides(group, option, models), *needed)


def _overrides(group: str, option: tuple[str, ...], models: str) -> tuple[str, ...]:
    return (f"{group}={option[0]}", *(one.replace("{models}", models) for one in option[1:]))


def _one(values, rng: np.random.Generator):
    return values[rng.integers(len(values))]


def fingerprint(config: Config) -> str:
    """Outcome and hash of all of a flight but times of day and of computing; or why it is refused."""
    try:
        flight = fly_one(config)
    except QuadexpError as error:
        return f"refused: {error}"
    content = hashlib.sha256()
    for name, values in flight.columns.items():
        content.update(b"" if name == "solve_time" else name.encode() + np.ascontiguousarray(values).tobytes())
    row = {name: value for name, value in flight.metadata["row"].items() if not name.startswith("solve_time")}
    told = {name: value for name, value in flight.metadata.items() if name != "provenance"} | {"row": row}
    content.update(json.dumps(told, default=str, sort_keys=True).encode())
    return f"{flight.outcome} {content.hexdigest()}"
