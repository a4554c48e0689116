"""Flights on the plants of other programs: what was promised of them, and who flies them."""

import pytest

from quadexp.errors import UsageError
from quadexp.experiment.build import build_controller, build_trajectory, build_vehicle, build_world
from quadexp.experiment.collect import collect_dataset
from quadexp.experiment.evaluate import fly_one
from quadexp.parts.compose import compose
from quadexp.requests import fit
from tests.experiment.test_compiled_flight import both, compiled

HUMMINGBIRD = ["vehicle=hummingbird", "plant=rotorpy"]
CRAZYFLIE = ["vehicle=cf2x_L250", "plant=drone_models", "trajectory.speed=4"]
BRUSHLESS = ["vehicle=cf21B_500", "plant=drone_models_brushless", "trajectory.speed=4"]
SHORT = ["trajectory=hover", "trajectory.duration=1"]
INTERPRETED = ["controller.backend=interpreted", "plant.backend=interpreted"]


def mean_error(*overrides: str) -> float:
    """mm; the flight went to its end."""
    flight = fly_one(compose([*overrides, *INTERPRETED]))
    assert flight.outcome == "ok", flight.metadata["cause"]
    return 1e3 * flight.metadata["row"]["mean_error"]


def test_a_perfect_model_of_the_hummingbird_flies_it_within_a_fifth_of_a_millimetre():
    """RotorPy's motors lag by 5 ms, which the controller is not given here."""
    assert mean_error(*HUMMINGBIRD, "controller=perfect_mpc", "horizon=precise") < 0.2


@pytest.mark.slow
@pytest.mark.parametrize("speed", [4, 11])
def test_a_controller_that_knows_the_lag_too_is_closer_on_a_circle(speed):
    world = [*HUMMINGBIRD, "controller=perfect_mpc", "horizon=precise", f"trajectory.speed={speed}"]
    assert mean_error(*world, "controller.motor_lag=0.005") < 0.5 * mean_error(*world)


def test_a_crazyflie_that_nobody_told_of_its_motors_stays_on_the_ground():
    """Its motors lag by 136 ms; what makes the loop stable is said, and is true."""
    with pytest.raises(UsageError) as refused:
        fly_one(compose(CRAZYFLIE))
    assert "motors that lag by 136 ms" in str(refused.value) and "is not stable at hover" in str(refused.value)
    assert "timing.motor_lag=0.136 at this rate and horizon" in str(refused.value)
    assert mean_error(*CRAZYFLIE, "controller.motor_lag=0.136") < 150
    with pytest.raises(UsageError, match="lag by 136 ms"):
        collect_dataset(compose(CRAZYFLIE), None)
    assert fly_one(compose([*CRAZYFLIE, *INTERPRETED, "controller.allow_unstable=true"])).outcome == "lost"


@pytest.mark.slow
@pytest.mark.parametrize("world", [CRAZYFLIE, BRUSHLESS])
def test_a_perfect_model_of_a_crazyflie_flies_it_within_a_millimetre(world):
    lag = {"cf2x_L250": 0.136, "cf21B_500": 0.062}[world[0].partition("=")[2]]
    assert mean_error(*world, "controller=perfect_mpc", f"controller.motor_lag={lag}") < 0.5


def test_faster_motors_need_no_word_at_the_published_horizon_but_at_a_stiffer_one():
    """62 ms: less than the published grid tolerates, more than the precise one."""
    mean_error(*BRUSHLESS)
    with pytest.raises(UsageError, match=r"or controller\.rate=100 controller\.horizon=0\.6;"):
        fly_one(compose([*BRUSHLESS, "horizon=precise"]))
    mean_error(*BRUSHLESS, "horizon=precise", "controller.rate=100")


@pytest.mark.parametrize(
    ("controller", "largest"),
    [
        ("nominal_mpc", 0.1),
        ("static_feedback", 0.1),
        ("rls_mpc", 20),
        ("rls_feedback", 500),
        ("literal_feedback", 1000),
    ],
)
def test_controllers_that_need_no_model_hover_with_the_hummingbird(controller, largest):
    """Those that identify begin with half of the blades' lift, and move before they know better."""
    assert mean_error(*HUMMINGBIRD, *SHORT, f"controller={controller}") < largest


def test_a_blade_element_controller_says_what_a_crazyflie_lacks():
    with pytest.raises(UsageError, match=r"needs vehicle\.rotor"):
        fly_one(compose([*CRAZYFLIE, "controller=rls_mpc", "controller.motor_lag=0.136"]))


@pytest.mark.slow
@compiled
@pytest.mark.parametrize("wind", [[], ["wind=constant", "wind.velocity=[3,-1,0]", "link=latency", "link.latency=0.01"]])
@pytest.mark.parametrize("world", [HUMMINGBIRD, BRUSHLESS])
def test_they_are_flown_in_c_as_in_python(world, wind, monkeypatch):
    config = compose([*world, *wind, "trajectory.speed=4"])
    vehicle = build_vehicle(config.vehicle)
    plant = build_world(config, vehicle)
    controller = build_controller(config, vehicle, plant, None)
    found = both(monkeypatch, plant, controller, build_trajectory(config.trajectory, vehicle))
    assert found.periods_in_c > 500 and "rotor_speed_3" in found.flight.columns


@pytest.mark.slow
@pytest.mark.parametrize(
    ("world", "told", "largest"), [(HUMMINGBIRD, [], 25), (CRAZYFLIE, ["controller.motor_lag=0.136"], 3)]
)
def test_learned_models_fly_what_they_learned_from(world, told, largest, tmp_path):
    """With gp=blade_element the GP is the better one on RotorPy's air; a Crazyflie's drag is linear."""
    data = tmp_path / "data.parquet"
    collect_dataset(compose([*world, *told, "collect.duration=120", "collect.speed_max=5"]), data)
    fit("gp", data, [world[0], "gp=blade_element"], tmp_path / "gp", figures=False)
    flown = {
        name: mean_error(*world, *told, "trajectory.speed=4", f"controller={name}", f"model={tmp_path / 'gp'}")
        for name in ("linear_drag_mpc", "gp_mpc")
    }
    nominal = mean_error(*world, *told, "trajectory.speed=4", "controller=nominal_mpc")
    assert flown["gp_mpc"] < largest and max(flown.values()) < nominal / 3
    if world is HUMMINGBIRD:
        assert flown["gp_mpc"] < flown["linear_drag_mpc"]
