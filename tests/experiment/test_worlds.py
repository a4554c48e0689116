"""Flights in worlds, from their configuration to their row: what is built, named, refused and logged."""

import numpy as np
import pytest

from quadexp.errors import UsageError
from quadexp.experiment.build import build_controller, build_plant, build_vehicle, build_world, unshared
from quadexp.experiment.evaluate import InfeasibleError, fly_one, generator
from quadexp.experiment.identity import flight_entropy, flight_record
from quadexp.log.store import write_flight
from quadexp.loop import controller
from quadexp.parts.cells import varied
from quadexp.parts.compose import compose, expand
from quadexp.parts.schema import WORLD, world_parts
from quadexp.physics.state import POSITION, STATE_COLUMNS
from quadexp.report.metrics import flight_metrics
from quadexp.report.notes import notes
from quadexp.report.summary import summarise
from quadexp.world.effect import STAGES
from quadexp.world.world import World
from tests.deleted import needs

SHORT = ["trajectory=hover", "trajectory.duration=0.4"]
ESTIMATE = ["estimator.position_noise=0.02", "estimator.delay=0.01"]


def test_groups_are_in_the_order_of_the_stages():
    """A payload is part of the truth, or acts from outside."""
    assert tuple(group for group in WORLD if group != "payload") == STAGES


def test_without_any_part_the_plant_is_the_same_object():
    config = compose(SHORT)
    vehicle = build_vehicle(config.vehicle)
    assert config.world == "clean" and not world_parts(config)
    assert build_world(config, vehicle) is build_plant(vehicle, config.plant)
    assert set(flight_record(config)) == {"vehicle", "plant", "sensor", "trajectory", "controller", "model", "seed"}


@pytest.mark.parametrize(
    ("given", "name"),
    [
        (["wind=constant"], "wind=constant"),
        (["link=latency", "wind=constant"], "wind=constant,link=latency"),
        (["estimator.delay=0.01"], "estimator=none"),
        (["wind=constant", "wind=none"], "clean"),
    ],
)
def test_a_world_has_a_name(given, name):
    assert compose(given).world == name


def test_parts_change_neither_the_noise_nor_each_other():
    clean, windy = compose(SHORT), compose([*SHORT, "wind=constant", *ESTIMATE])
    assert flight_entropy(clean) == flight_entropy(windy)
    assert flight_record(windy).keys() - flight_record(clean).keys() == {"wind", "estimator"}


@pytest.mark.parametrize(
    "plant", [["plant=simplified"], ["vehicle=lei_li", "plant=blade_element", "plant.step=1e-3", "plant.method=rk4"]]
)
def test_hover_in_a_wind(tmp_path, plant):
    """It is blown away a little and hovers: the controller leans against the wind, and the row says where it was."""
    flight = fly_one(compose([*SHORT, "trajectory.duration=6", "wind=constant", "wind.velocity=[2,0,0]", *plant]))
    speed = np.linalg.norm(flight.stack(["v_x", "v_y", "v_z"])[-1])
    assert flight.outcome == "ok" and speed < 0.02 and 0.001 < flight["p_x"][-1] < 0.5
    assert flight.metadata["row"]["plant"].endswith("/wind=constant") and flight.metadata["world"] == "wind=constant"
    assert summarise(write_flight(tmp_path / "a.parquet", flight))["world"]["name"] == "wind=constant"


def test_metrics_are_of_the_truth():
    """Also where the estimate is off by a metre: the controller holds the estimate where the truth should be."""
    flight = fly_one(compose([*SHORT, "estimator.position_noise=0.05"]))
    told = flight.stack(["est_p_x", "est_p_y", "est_p_z"])
    true, wanted = (flight.stack([f"{kind}p_{axis}" for axis in "xyz"]) for kind in ("", "ref_"))
    assert np.abs(told - true)[1:].max() > 0.05
    row = flight_metrics(flight, 0.0, 20.0)
    assert row["mean_error"] == pytest.approx(np.linalg.norm(true - wanted, axis=1).mean(), rel=1e-12)


def test_the_accelerometers_noise_is_that_of_the_time():
    """What it adds at 50 Hz is what it adds at 100 Hz at these instants."""

    def added(rate):
        sensors = (["sensor=lei_li"], [])
        noisy, exact = (fly_one(compose([*SHORT, f"controller.rate={rate}", *sensor])) for sensor in sensors)
        return (noisy.stack(["acc_x", "acc_y", "acc_z"]) - exact.stack(["acc_x", "acc_y", "acc_z"]))[1:]

    assert added(50) == pytest.approx(added(100)[1::2], abs=1e-12) and np.ptp(added(50), axis=0).min() > 0.05


def test_a_plant_that_only_advances_is_refused_in_one_line(tmp_path):
    (tmp_path / "plant").mkdir()
    (tmp_path / "plant" / "still.yaml").write_text("_target_: still_plant.StillPart\n")
    (tmp_path / "still_plant.py").write_text(
        "from quadexp.world.base import PlantPart\n"
        "class StillPart(PlantPart):\n    def build(self, given): return Still(given.vehicle)\n"
        "class Still:\n    def __init__(self, vehicle):\n        self.vehicle = vehicle\n"
        "    def reset(self): pass\n    def advance(self, x, u, duration, rng): return x, x[:3]\n"
        "    def residual(self): raise NotImplementedError\n"
    )
    config = compose([*SHORT, "plant=still", "wind=constant", "link=latency"], tmp_path)
    with pytest.raises(
        UsageError, match=r"^wind=constant,link=latency: needs a plant that is a SimulatedPlant .*still"
    ):
        fly_one(config)
    assert fly_one(compose([*SHORT, "plant=still"], tmp_path)).outcome == "ok"


def test_who_knows_the_plant_says_what_it_does_not_know():
    flight = fly_one(compose([*SHORT, "controller=perfect_mpc", "wind=constant", "link=latency"]))
    assert flight.metadata["residual"]["source"] == "plant equations; does not know: wind, link"
    (line,) = notes([flight.metadata["row"]])
    assert (
        line
        == "perfect_mpc: knows the plant's equations, and nothing of the world around it (wind=constant,link=latency)"
    )
    clean = fly_one(compose([*SHORT, "controller=perfect_mpc"]))
    assert clean.metadata["residual"]["source"] == "plant equations" and not notes([clean.metadata["row"]])


@pytest.mark.parametrize(
    ("world", "stable"),
    [
        (["link=latency", "link.latency=0.01"], True),
        (["link=latency", "link.latency=0.03"], False),
        (["link=latency", "link.latency=0.005", "estimator.delay=0.02"], False),
        (["link=latency", "link.latency=0.03", "controller.dead_time=0.03"], True),
    ],
)
@needs("margins", "worlds")
def test_known_delays_are_held_against_the_margins(world, stable):
    """The margin of the precise grid is 17 ms; link and estimator count together, and what the controller predicts."""
    from quadexp.plugins.margins.texts import world_note

    overrides = [*SHORT, "horizon=precise", "controller=nominal_mpc", *world]
    if not stable:
        with pytest.raises(InfeasibleError, match="not stable at hover"):
            fly_one(compose(overrides))
    margins = fly_one(compose([*overrides, "controller.allow_unstable=true"])).metadata["margins"]
    assert (margins["delay"] > 0) == (margins["growth"] < 0) == stable and bool(world_note(margins)) != stable


def test_a_sweep_over_worlds_names_them():
    cells = expand(["wind=none,constant", "estimator.delay=0.0,0.01", "seed=0,1"])
    assert {cell.config.world for cell in cells} == {
        "clean", "wind=constant", "estimator=none", "wind=constant,estimator=none",
    }  # fmt: skip
    assert set(varied(cells)) == {"estimator.delay=0", "estimator.delay=0.01"}


def test_a_world_with_another_plant_is_another_world():
    """Plants and worlds that were made before are found again, each with its own settings."""
    made = [build_world(config, build_vehicle(config.vehicle)) for config in (
        compose(["wind=constant", f"wind.velocity=[{v},0,0]"]) for v in (1, 2, 1)
    )]  # fmt: skip
    assert made[0] is made[2] and made[0] is not made[1] and all(isinstance(one, World) for one in made)
    told = [
        build_controller(
            config, build_vehicle(config.vehicle), build_world(config, build_vehicle(config.vehicle)), None
        )
        for config in (compose(["controller=perfect_mpc", f"wind={w}"]) for w in ("none", "constant"))
    ]
    assert told[0] is not told[1]


def test_a_loop_of_ones_own_in_a_world():
    """The same flight as `simulate`: what is measured goes to the controller, the noise comes from `begin`."""
    settings = [*SHORT, "wind=constant", *ESTIMATE]
    flown = fly_one(compose(settings))
    loop = controller(*settings)
    plant, x = loop.plant, loop.start
    with pytest.raises(UsageError, match=r"^a flight in a world begins with plant\.begin"):
        plant.advance(x, np.full(4, 2.0), loop.period, np.random.default_rng(0))
    noise = plant.begin(x, loop.period, 1.0, generator(compose(settings)))
    for k, t in enumerate(loop.times):
        assert np.array_equal(x, flown.state[k])
        x, _ = plant.advance(x, loop.step(plant.measured, t), loop.period, noise)


IN_MOTION = ["trajectory=ellipse", "trajectory.speed=5", "trajectory.acceleration=8"]
INTERPRETED = ["controller.backend=interpreted", "plant.backend=interpreted"]
OBSERVED = ["controller=nominal_mpc", "observer=disturbance"]
HUMMINGBIRD, LEI_LI = ["vehicle=hummingbird"], ["vehicle=lei_li", "plant=blade_element"]


@pytest.mark.parametrize(
    "settings",
    [
        "controller=pid",
        "controller=dfbc observer=disturbance",
        "controller=geometric controller.force_adaptation=8 controller.torque_adaptation=60 adaptive=l1",
        "controller=nominal_mpc delay=strapdown delay.time=0.03 rate_loop=indi",
        "controller=perfect_mpc observer=wind controller.dead_time=0.02",
        "controller=rls_feedback vehicle=lei_li plant=blade_element",
        "controller=rls_mpc vehicle=lei_li plant=blade_element",
    ],
)
def test_a_controller_s_second_flight_is_its_first(settings):
    """Filters, integrals, estimates and what was found begin anew; the same object flies both."""
    given = ["trajectory=ellipse", "trajectory.speed=3", *["trajectory.acceleration=4", "trajectory.duration=2.5"]]
    config = compose([*given, "estimator=late_noisy", *settings.split(), *INTERPRETED])
    first, second = (fly_one(config) for _ in range(2))
    for name, values in first.columns.items():
        assert name == "solve_time" or np.array_equal(values, second[name], equal_nan=True), name


@pytest.mark.parametrize(
    ("first", "then"),
    [
        # What is assumed of the plant is flown itself where it is the true one; its payload grows in flight.
        (["controller=perfect_mpc"], ["controller=perfect_mpc", "truth.mass=1.05"]),
        # The margins of a loop are those without what its observer found in the flight before.
        (["external=push", "external.onset=0", "external.force=[4,2,-5]", *OBSERVED], ["link=latency", *OBSERVED]),
    ],
    ids=["assumed plant", "margins under an observer"],
)
def test_a_flight_is_the_same_after_another(first, then):
    given = [*LEI_LI, *IN_MOTION, "trajectory.duration=0.3", "plant.schedule=[{t: 0.1, payload: 0.4}]"]
    given += ["controller.allow_unstable=true", *INTERPRETED]
    other, config = compose([*given, *first]), compose([*given, *then])
    with unshared():
        alone = fly_one(config)
    with unshared():
        fly_one(other)
        after = fly_one(config)
    assert after.metadata["margins"] == alone.metadata["margins"]
    np.testing.assert_array_equal(after.stack(STATE_COLUMNS), alone.stack(STATE_COLUMNS))


@pytest.mark.parametrize(
    "given",
    [
        [*HUMMINGBIRD, "actuator=lag_30ms"],
        [*HUMMINGBIRD, "battery=sag"],
        [*HUMMINGBIRD, "health=rotor_loss"],
        [*HUMMINGBIRD, "plant=rotorpy"],
        [*HUMMINGBIRD, "plant=rotorpy", "wind=constant"],
        [*LEI_LI, "plant.motor_lag=0.05"],
    ],
    ids=" ".join,
)
def test_rotors_begin_with_the_thrusts_of_a_reference_in_motion(given):
    """They turn at sqrt(T / k)."""
    config = compose([*given, *IN_MOTION, "trajectory.duration=0.1", "controller=dfbc", *INTERPRETED])
    flight = fly_one(config)
    speeds, thrusts = (flight.stack([f"{name}_{i}" for i in range(4)])[0] for name in ("rotor_speed", "ref_u"))
    k = build_vehicle(config.vehicle).static_thrust_coefficient
    assert thrusts.mean() > 1.1 * build_vehicle(config.vehicle).hover_thrust
    np.testing.assert_allclose(speeds, np.sqrt(thrusts / k), rtol=1e-9)


def test_rotors_begin_in_hover_where_a_path_begins_at_rest_but_for_rounding():
    """A random path, whose first thrusts turn it already."""
    config = compose([*HUMMINGBIRD, "actuator=lag_30ms", "trajectory=random", "seed=1", *INTERPRETED])
    flight, vehicle = fly_one(config), build_vehicle(config.vehicle)
    assert np.abs(flight.stack([f"ref_u_{i}" for i in range(4)])[0] / vehicle.hover_thrust - 1).max() > 0.1
    speeds = flight.stack([f"rotor_speed_{i}" for i in range(4)])[0]
    np.testing.assert_allclose(speeds, np.sqrt(vehicle.hover_thrust / vehicle.static_thrust_coefficient), rtol=1e-9)


def test_a_battery_begins_with_the_current_that_the_thrusts_take():
    """The voltage of the first instant is where the next one's goes on."""
    given = [*IN_MOTION, "trajectory.duration=0.1", "controller=dfbc", "battery=sag", "plant=ideal"]
    current = fly_one(compose([*given, "vehicle=sun"]))["battery_current"]
    assert current[0] == pytest.approx(current[1], rel=0.02)


@pytest.mark.parametrize("vehicle", ["sun", "torrente"])
@pytest.mark.parametrize("lag", [[], ["actuator=lag_30ms", "controller.motor_lag=0.03"]], ids=["", "lag"])
def test_a_known_delay_costs_nothing_from_the_first_instant_on(vehicle, lag):
    late = ["link=latency", "link.latency=0.04", "controller.dead_time=0.04", *lag]
    given = [f"vehicle={vehicle}", "plant=ideal", *IN_MOTION, "trajectory.duration=0.8", "controller=perfect_mpc"]
    flight = fly_one(compose([*given, *late, "controller.backend=interpreted"]))
    error = flight.stack(STATE_COLUMNS[POSITION]) - flight.stack([f"ref_{name}" for name in STATE_COLUMNS[POSITION]])
    assert np.abs(error).max() < 1e-4


def test_what_learns_from_delivered_thrusts_begins_with_those_of_a_reference_in_motion():
    late = ["link=latency", "link.latency=0.04", "controller.dead_time=0.04", "controller.feedforward=false"]
    given = ["plant=ideal", *IN_MOTION, "trajectory.duration=0.2", "controller=online_mpc", *late, *INTERPRETED]
    assert np.abs(fly_one(compose(given))["innovation_z"][1:3]).max() < 0.05
