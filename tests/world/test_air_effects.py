"""Flights in winds that change, and with a vehicle, a load, the ground or a push that the controller does not know of.

What a controller settles at in each world is a balance of forces and torques, which holds on every plant.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadexp.errors import UsageError
from quadexp.experiment.build import build_vehicle
from quadexp.experiment.evaluate import fly_one
from quadexp.parts.compose import compose
from quadexp.physics.state import ATTITUDE, POSITION, RATE, VELOCITY
from quadexp.plugins.worlds.dryden import Dryden
from quadexp.plugins.worlds.slung_load import SlungLoad
from quadexp.world import PlantEffects, SimplifiedPlant
from quadexp.world.disturbance import Disturbance
from quadexp.world.true_vehicle import with_factors, with_payload
from quadexp.world.world import World
from tests.slow import slow
from tests.world.airframes import REST, ideal

HOVER = ["trajectory=hover", "trajectory.duration=4", "controller=nominal_mpc", "plant.backend=interpreted"]
QUIET = [f"plant.{name}=0" for name in ("motor_loss", "motor_noise_density", "force_noise_density")]
PLANTS = {
    "simplified": ["vehicle=torrente", *QUIET, "plant.torque_noise_density=0"],
    "blade_element": ["vehicle=lei_li", "plant=blade_element", "plant.method=rk4", "plant.step=2.5e-3"],
}
VEHICLE = build_vehicle(compose([]).vehicle)
WINDS = [f"wind_{axis}" for axis in "xyz"]


@pytest.fixture(params=PLANTS)
def settled(request):
    """Flies a hover on one of the plants; returns the vehicle, and thrusts (n,) (N), R and flight at its end."""

    def fly(*overrides):
        config = compose([*HOVER, *PLANTS[request.param], *overrides])
        flight = fly_one(config)
        assert flight.outcome == "ok", flight.metadata["cause"]
        last = flight.t > flight.t[-1] - 1.0
        R = Rotation.from_quat(flight.state[-1, ATTITUDE], scalar_first=True)
        return build_vehicle(config.vehicle), flight.input[last].mean(axis=0), R, flight

    return fly


@pytest.mark.parametrize("factor", [0.7, 1.3])
def test_a_heavier_vehicle_hovers_on_its_weight(settled, factor):
    vehicle, u, _, _ = settled(f"truth.mass={factor}")
    assert u.sum() == pytest.approx(factor * vehicle.mass * 9.81, rel=5e-3)


def test_off_its_centre_of_mass_it_hovers_without_torque(settled):
    """The rotors' torque about the true centre of mass is zero, and far from it about the assumed one."""
    vehicle, u, _, _ = settled("truth.center_of_mass=[0.02,-0.01,0]", "truth.inertia=[1.1,0.9,1]")
    true = with_factors(vehicle, 1.0, np.ones(3), np.array([0.02, -0.01, 0.0]))
    assert np.abs(true.allocation[1:] @ u).max() < 2e-3
    assert (vehicle.allocation[1:] @ u)[:2] == pytest.approx([-0.01 * u.sum(), -0.02 * u.sum()], abs=2e-3)


def test_weak_rotors_are_asked_for_more(settled):
    vehicle, u, _, _ = settled("truth.thrust_coefficient=0.8", "truth.torque_coefficient=1.2")
    assert 0.8 * u.sum() == pytest.approx(vehicle.mass * 9.81, rel=5e-3)


def test_a_fixed_payload_is_carried_where_it_hangs(settled):
    vehicle, u, _, _ = settled("payload=fixed", "payload.mass=0.2", "payload.point=[0.05,0.03,-0.05]")
    loaded = with_payload(vehicle, 0.2, np.array([0.05, 0.03, -0.05]))
    assert u.sum() == pytest.approx((vehicle.mass + 0.2) * 9.81, rel=5e-3)
    assert np.abs(loaded.allocation[1:] @ u).max() < 2e-3


def test_a_slung_load_hangs_beneath_and_is_carried(settled):
    vehicle, u, _, flight = settled("payload=slung", "payload.mass=0.2", "payload.length=0.5")
    assert u.sum() == pytest.approx((vehicle.mass + 0.2) * 9.81, rel=5e-3)
    beneath = flight.stack(["load_x", "load_y", "load_z"])[-1] - flight.state[-1, POSITION]
    assert beneath == pytest.approx([0, 0, -0.5 * 1.002], abs=5e-3)


def test_against_a_push_it_leans(settled):
    """R e_z T = m g - F, and the rotors' torque is that of the push, turned round."""
    force, torque = np.array([0.8, -0.5, 1.0]), np.array([0.01, -0.02, 0.005])
    given = [
        f"external.{name}={value.tolist()}".replace(" ", "") for name, value in (("force", force), ("torque", torque))
    ]
    vehicle, u, R, _ = settled("external=push", *given)
    assert R.apply([0, 0, u.sum()]) == pytest.approx([-0.8, 0.5, vehicle.mass * 9.81 - 1.0], rel=1e-2, abs=2e-2)
    assert vehicle.allocation[1:] @ u == pytest.approx(-torque, abs=2e-3)


def test_over_the_ground_less_thrust_is_asked_for(settled):
    """At one radius over the ground the factor is 16/15."""
    given = ["ground=cheeseman_bennett", "ground.rotor_radius=0.2", "ground.height=0.8"]
    vehicle, u, _, flight = settled(*given)
    factor = 1 / (1 - (0.2 / 4 / (flight.state[-1, 2] - 0.8)) ** 2)
    assert 1.05 < factor < 1.08
    assert factor * u.sum() == pytest.approx(vehicle.mass * 9.81, rel=5e-3)


def test_it_hovers_in_turbulence_gusts_and_a_recorded_wind(settled, tmp_path):
    """And the recorded wind of a flight, flown again, gives that flight: the two differ within the control periods."""
    _, _, _, flight = settled("wind=gust", "wind.velocity=[1,0,0]", "wind.amplitude=[0,2,0]", "wind.onset=1")
    wind = flight.stack(WINDS)
    assert np.trapezoid(wind[:, 1], flight.t) == pytest.approx(2 * 2 / 2, rel=1e-3)
    assert wind[:, 0] == pytest.approx(np.ones(len(wind))) and not wind[:, 2].any()
    rows = np.column_stack([flight.t, wind])
    np.savetxt(tmp_path / "wind.csv", rows, delimiter=",", header="t,wind_x,wind_y,wind_z", comments="", fmt="%.17g")
    _, _, _, again = settled("wind=file", f"wind.path={tmp_path / 'wind.csv'}")
    assert again.state[:, POSITION] == pytest.approx(flight.state[:, POSITION], abs=3e-3)
    _, _, _, rough = settled("wind=dryden", "wind.velocity=[2,1,0]", "wind.intensity=[0.5,0.5,0.3]")
    assert np.std(rough.stack(WINDS), axis=0).min() > 0.02


def test_winds_that_do_not_change_are_the_constant_wind(tmp_path):
    """A file of two equal rows, a gust and turbulence without amplitude: the same flight to rounding."""
    (tmp_path / "wind.csv").write_text("t,wind_x,wind_y,wind_z\n0,2,-1,0.3\n3,2,-1,0.3\n")
    base = [*HOVER, "trajectory.duration=3"]
    mean = "wind.velocity=[2,-1,0.3]"
    constant = fly_one(compose([*base, "wind=constant", mean]))
    others = (
        ["wind=file", f"wind.path={tmp_path / 'wind.csv'}"],
        ["wind=gust", mean, "wind.amplitude=[0,0,0]"],
        ["wind=dryden", mean, "wind.intensity=[0,0,0]"],
    )
    for other in others:
        flight = fly_one(compose([*base, *other]))
        assert flight.state == pytest.approx(constant.state, abs=1e-12), other
        assert flight.stack(WINDS) == pytest.approx(constant.stack(WINDS), abs=1e-14)


WEAK, MIDDLE, STRONG = (0.3, 0.2, 0.1), (1.0, 2.0, 1.5), (4.0, 3.0, 2.0)  # m/s


@pytest.mark.parametrize(
    ("step", "intensity"),
    [(2e-3, WEAK), (2e-2, STRONG), *slow((2e-3, MIDDLE), (2e-2, MIDDLE), (2e-3, STRONG), (2e-2, WEAK))],
)
def test_a_flight_meets_the_turbulence_asked_for(step, intensity):
    """Deviation along, across and vertical within 3 %, and correlation from period to period, for a wind to the north.

    Scale lengths and airspeed are such that the turbulence forgets within a few periods.
    """
    keys = {"intensity": intensity, "length": (0.5, 0.3, 0.4), "airspeed": 20.0, "velocity": (0.0, 3.0, 0.0)}
    plant = World(ideal(VEHICLE, step), [Dryden(**keys)])
    noise = plant.begin(REST, 0.02, 200.0, np.random.default_rng(3))
    u, winds = np.full(4, 2.4525), []
    for _ in range(12_000):
        plant.advance(REST, u, 0.02, noise)
        winds.append(plant.inner[-3:])
    found = (np.array(winds) - [0, 3, 0]) @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]]).T
    assert np.sqrt((found**2).mean(axis=0)) == pytest.approx(np.array(intensity), rel=0.03)
    lag = 0.02 / (np.array([0.5, 0.3, 0.4]) / 20)
    wanted = np.exp(-lag) * [1, 1 - lag[1] / 2, 1 - lag[2] / 2]
    assert (found[1:] * found[:-1]).mean(axis=0) / np.array(intensity) ** 2 == pytest.approx(wanted, abs=0.03)


def test_turbulence_passes_at_the_airspeed():
    """Twice as fast through air whose turbulence is twice as long, it changes as much."""

    def changes(speed, length, period=4e-3):
        keys = {"intensity": (1.0, 1.0, 1.0), "velocity": (2.0, 0.0, 0.0), "length": (length, length, length)}
        plant = World(ideal(VEHICLE), [Dryden(**keys)])
        noise = plant.begin(REST, period, 1.0, np.random.default_rng(5))
        x, winds = REST.copy(), []
        x[VELOCITY] = [2.0 + speed, 0.0, 0.0]
        for _ in range(20):
            plant.advance(x, np.full(4, 2.4525), period, noise)
            winds.append(plant.inner[-3:])
        return np.array(winds)

    assert changes(8.0, 40.0) == pytest.approx(changes(4.0, 20.0), rel=1e-4)
    assert changes(0.5, 20.0) == pytest.approx(changes(0.0, 20.0))  # both below airspeed_min
    assert np.abs(changes(8.0, 20.0) - changes(4.0, 20.0)).max() > 1e-3


@pytest.mark.parametrize("length", [8.0, 0.2])
def test_a_wind_is_held_for_half_a_millisecond(length):
    """A control period of several winds is as many shorter ones: the same flight. A wind that is held for longer makes
    a gust late beside the accelerometer, which reads it at once."""
    winds = 40
    keys = {"intensity": (1.0, 2.0, 0.5), "length": (2 * length, length, 3 * length), "airspeed": 8.0}
    x, u, flown = np.r_[REST[:7], [3.0, -2.0, 1.0], np.zeros(3)], np.full(4, 2.4525), []
    for parts in (1, winds):  # of 20 ms
        effects = replace(PlantEffects.none(), linear_drag=(0.5, 0.4, 0.3))
        plant = World(SimplifiedPlant(VEHICLE, effects, step=5e-4, backend="interpreted"), [Dryden(**keys)])
        noise, now, states = plant.begin(x, 0.02 / parts, 1.0, np.random.default_rng(7)), x, []
        for i in range(10 * parts):
            now, _ = plant.advance(now, u, 0.02 / parts, noise)
            if (i + 1) % parts == 0:
                states.append([*now, *plant.inner[-3:]])
        flown.append(states)
    assert len(plant.inner) == 5 + 3 + 4 + 3  # one tick in the shorter period
    assert np.array(flown[0]) == pytest.approx(np.array(flown[1]), abs=1e-11)
    assert np.ptp(np.array(flown[0])[:, -3:], axis=0).min() > 0.02


def test_every_controller_and_world_meets_the_same_turbulence():
    given = [*HOVER, "trajectory.duration=1", "wind=dryden", "wind.airspeed=5"]
    alone = fly_one(compose(given)).stack(WINDS)
    for more in (["truth.mass=1.2"], ["payload=slung"], ["controller=perfect_mpc"], ["external=push"]):
        assert np.array_equal(fly_one(compose([*given, *more])).stack(WINDS), alone), more
    assert not np.array_equal(fly_one(compose([*given, "seed=1"])).stack(WINDS), alone)


@pytest.mark.parametrize(("step", "onset"), [(1e-3, 0.011), (1e-3, 0.0113), (5e-3, 0.0137)])
def test_a_push_for_a_while_gives_its_impulse(step, onset):
    """m v = F D and J omega = tau D, whatever the step, for a push that begins and ends within steps."""
    push = Disturbance(force=(3.0, -2.0, 1.0), torque=(0.02, 0.03, -0.01), onset=onset, duration=0.0231)
    airframe = ideal(VEHICLE, step)
    plant = World(airframe, [push])
    x, noise = REST.copy(), plant.begin(REST, 0.02, 1.0, np.random.default_rng(0))
    for _ in range(5):
        x, _ = plant.advance(x, np.zeros(4), 0.02, noise)
    fallen = x[VELOCITY] + [0, 0, 9.81 * 0.1]
    assert airframe.vehicle.mass * fallen == pytest.approx(np.array(push.force) * 0.0231, rel=1e-9)
    momentum = airframe.vehicle.inertia_matrix @ x[RATE]
    assert momentum == pytest.approx(np.array(push.torque) * 0.0231, rel=2e-2)  # but for the gyroscopic torque


def test_load_and_vehicle_turn_each_other_without_gain():
    """In free fall: linear and angular momentum about the common centre stay, the cable's end far from the centre."""
    airframe = ideal(VEHICLE, 5e-4)
    vehicle, load = airframe.vehicle, SlungLoad(mass=0.4, length=0.6, point=(0.1, 0.05, -0.08), damping=0.0)
    plant, x = World(airframe, [load]), REST.copy()
    x[VELOCITY], x[RATE] = [1.5, -0.5, 0.0], [0.5, 1.0, -0.3]
    noise = plant.begin(x, 0.02, 3.0, np.random.default_rng(0))
    found = []
    for _ in range(100):
        place = plant.columns(0.02)["load_x"]
        bodies = plant.inner[place : place + 6]
        total = vehicle.mass + 0.4
        centre = (vehicle.mass * x[POSITION] + 0.4 * bodies[:3]) / total
        drift = (vehicle.mass * x[VELOCITY] + 0.4 * bodies[3:]) / total
        spin = Rotation.from_quat(x[ATTITUDE], scalar_first=True).apply(vehicle.inertia_matrix @ x[RATE])
        angular = spin + vehicle.mass * np.cross(x[POSITION] - centre, x[VELOCITY] - drift)
        angular += 0.4 * np.cross(bodies[:3] - centre, bodies[3:] - drift)
        found.append(np.r_[drift, angular])
        x, _ = plant.advance(x, np.zeros(4), 0.02, noise)
    found = np.array(found)
    assert found[:, :2] == pytest.approx(np.tile(found[0, :2], (100, 1)), abs=1e-9)
    assert found[:, 2] == pytest.approx(found[0, 2] - 9.81 * 0.02 * np.arange(100), abs=1e-9)
    assert found[:, 3:] == pytest.approx(np.tile(found[0, 3:], (100, 1)), abs=2e-3 * np.abs(found[0, 3:]).max())
    assert np.abs(x[RATE] - [0.5, 1.0, -0.3]).max() > 0.3


def test_compiled_and_interpreted_flights_are_the_same(tmp_path):
    """All of it at once."""
    (tmp_path / "wind.csv").write_text("t,wind_x,wind_y,wind_z\n0,2,-1,0.3\n1,3,-1,0.3\n")
    parts = [
        "wind=dryden", "truth.mass=1.1", "truth.thrust_coefficient=0.95", "payload=slung", "external=push",
        "external.force=[0.3,0,0]", "external.duration=0.5", "ground=cheeseman_bennett", "ground.rotor_radius=0.12",
    ]  # fmt: skip
    for more in ([], ["wind=file", f"wind.path={tmp_path / 'wind.csv'}"]):
        both = [
            fly_one(compose([*HOVER, "trajectory.duration=1", *parts, *more, f"plant.backend={backend}"]))
            for backend in ("interpreted", "compiled")
        ]
        assert both[0].state == pytest.approx(both[1].state, abs=1e-8)
        assert both[0].stack([*WINDS, "load_z"]) == pytest.approx(both[1].stack([*WINDS, "load_z"]), abs=1e-8)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["ground=cheeseman_bennett"], "ground.rotor_radius: needed, because vehicle=torrente has no"),
        (["payload=slung", "payload.length=0.05", "plant.step=0.02"], "plant.step must be at most"),
        (["truth.mass=9"], "truth: gives no vehicle that can fly: .*hovering takes"),
        (["wind=file", "wind.path=nowhere.csv"], "wind.path: there is no file 'nowhere.csv'"),
        (["wind=dryden", "wind.intensity=[1,1,1]", "wind.wind_at_6m=3"], "one of the two"),
        (["payload=slung", "payload.mass=9"], "payload: gives no vehicle that can fly: .*hovering takes"),
        (["truth.mass=0"], r"truth.mass=0.*: must be in \[0.1, 10\]"),
    ],
)
def test_wrong_requests_are_refused_before_the_flight(given, said):
    with pytest.raises(UsageError, match=said):
        fly_one(compose([*HOVER, *given]))
