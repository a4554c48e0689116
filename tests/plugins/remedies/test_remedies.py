"""Remedies as a configuration puts them together: every combination flies or is refused in one line."""

import random
from functools import cache
from itertools import product

import numpy as np
import pytest

from quadexp.control.compiled_loop import goes_in_c
from quadexp.errors import UsageError
from quadexp.experiment.build import build_vehicle, build_world, check_remedies
from quadexp.experiment.evaluate import fly_one
from quadexp.loop import controller as python_loop
from quadexp.parts.compose import compose
from quadexp.parts.schema import controller_name

WORLD = ["trajectory=hover", "trajectory.duration=0.3", "external=push", "external.force=[0.5,-0.3,-0.4]"]
WORLD += ["external.torque=[0.01,-0.01,0.002]", "estimator=late", "estimator.gyro=fresh"]
LEI_LI = ["vehicle=lei_li", "plant=blade_element"]
FEW = ["controller.nodes=3", "controller.horizon=0.3"]  # quick to build
CONTROLLERS = {
    "nominal_mpc": FEW,
    "perfect_mpc": FEW,
    "online_mpc": FEW,
    "rls_mpc": [*LEI_LI, *FEW],
    "dfbc": [],
    "geometric": [],
    "pid": [],
    "rls_feedback": LEI_LI,
}
GROUPS = {
    "observer": ("none", "disturbance", "wind"),
    "adaptive": ("none", "l1"),
    "rate_loop": ("none", "indi"),
    "delay": ("none", "strapdown", "prediction"),
}


def overrides(controller, parts):
    given = [f"controller={controller}", "controller.backend=interpreted", *CONTROLLERS[controller], *WORLD]
    given += [f"{group}={option}" for group, option in parts.items() if option != "none"]
    given.append("controller.allow_unstable=true")  # a few of these loops swing at hover
    given += ["delay.time=0.01"] if parts["delay"] in ("strapdown", "prediction") else []
    both = parts["rate_loop"] != "none" and parts["observer"] != "none"
    return given + (["observer.torque_bandwidth=0"] if both else [])


def commands(flight):
    return np.stack([flight.columns[f"u_{i}"] for i in range(4)])


def combinations(count):
    every = [dict(zip(GROUPS, options, strict=True)) for options in product(*GROUPS.values())]
    return random.Random(1).sample([(name, parts) for name in CONTROLLERS for parts in every], count)


def flown_or_refused(controller, parts):
    """The flight, or None where the combination is refused in one line that names an option or key of it."""
    config = compose(overrides(controller, parts))
    names = [controller, *(option for option in parts.values() if option != "none")]
    assert controller_name(config) == "+".join(names)
    try:
        flight = fly_one(config)
    except UsageError as error:
        said = str(error)
        assert "\n" not in said and said.startswith(f"controller={controller}: ")
        assert any(f"{group}={option}" in said or f"{group}." in said for group, option in parts.items())
        return None
    assert flight.metadata["row"]["controller"] == "+".join(names)
    assert flight.outcome == "ok" and all(np.isfinite(column[1:]).all() for column in flight.columns.values())
    return flight


@pytest.mark.parametrize("remedy", ["strapdown", "prediction"])
def test_a_delay_remedy_around_a_controller_that_asks_for_no_reference(remedy):
    parts = dict.fromkeys(GROUPS, "none") | {"delay": remedy}
    found = flown_or_refused("rls_feedback", parts)
    assert np.abs(commands(found) - without_remedies("rls_feedback")).max() > 1e-6


@pytest.mark.parametrize("remedy", ["adaptive=l1", "observer=disturbance", "controller=online_mpc"])
def test_a_lag_that_is_inverted_is_as_well_known_as_one_that_is_planned_with(remedy):
    """Of motors that lag by 30 ms no more is taken for a force, or learned, with the one than with the other."""
    given = ["controller=perfect_mpc", remedy, "trajectory=lemniscate", "trajectory.speed=5", "horizon=robust"]
    given += ["trajectory.acceleration=2.5", "actuator=lag_30ms", "controller.backend=interpreted"]
    column = {"adaptive=l1": "l1_force_z", "observer=disturbance": "observer_force_z"}.get(remedy, "innovation_z")
    flights = [fly_one(compose([*given, f"motor={motor}"])) for motor in ("states", "lead")]
    planned, inverted = (np.std(flight.columns[column][50:]) for flight in flights)
    assert inverted < 1.3 * planned


@cache
def without_remedies(controller):
    return commands(flown_or_refused(controller, dict.fromkeys(GROUPS, "none")))


@pytest.mark.usefixtures("unmeasured")
@pytest.mark.parametrize(("controller", "parts"), combinations(12), ids=lambda one: one if isinstance(one, str) else "")
def test_a_combination_flies_and_does_something_or_is_refused(controller, parts):
    flight = flown_or_refused(controller, parts)
    if flight is not None and any(option != "none" for option in parts.values()):
        found, bare = commands(flight), without_remedies(controller)
        assert found.shape != bare.shape or np.abs(found - bare).max() > 1e-4  # an inner loop has a rate of its own


SCALES = ["observer=disturbance", "observer.scale_walk=0.005", "observer.air_walk=0.01", "controller=nominal_mpc"]


@pytest.mark.parametrize(
    ("given", "needed"),
    [
        (["actuator=lag_30ms"], "observer.scale_walk"),
        (["actuator=lag_30ms", "observer.scale_walk=0"], "observer.air_walk"),
        (["actuator=lag_30ms", "observer.scale_walk=0", "observer.air_walk=0"], None),
        (["actuator=lag_30ms", "observer.motor_lag=0.03"], None),
        (["actuator=lag_30ms", "vehicle=quad_bench"], None),
        ([], None),
    ],
    ids=lambda x: " ".join(x) if isinstance(x, list) else "",
)
def test_a_scale_needs_the_thrusts_of_its_time(given, needed):
    """From rotor speeds, from what is given, or because motors do not lag; checked before anything flies."""
    config = compose([*SCALES, *given])
    vehicle = build_vehicle(config.vehicle)
    plant = build_world(config, vehicle)
    if needed is None:
        check_remedies(config, vehicle, plant)
        return
    with pytest.raises(UsageError, match=f"^{needed}: a scale is found from rotor speeds"):
        check_remedies(config, vehicle, plant)
    with pytest.raises(UsageError, match=needed):
        fly_one(config)


@pytest.mark.parametrize("observer", ["disturbance", "wind"])
def test_an_observer_of_rotors_that_lag_flies_in_c(observer: str) -> None:
    """Their thrusts are states behind those of the reference in the plan."""
    lagging = ["motor=states", "timing.motor_lag=0.03", "controller.input_hold=deviation"]
    loop = python_loop("controller=perfect_mpc", *FEW, *lagging, f"observer={observer}", "trajectory=hover")
    assert goes_in_c(loop.controller) == (loop.controller.backend == "compiled")
