"""Flights from configurations: their noise is paired, and the same bits come from every way to fly them."""

import hashlib
import json
from dataclasses import asdict

import numpy as np
import pytest

from quadexp.errors import UsageError
from quadexp.experiment import rollout
from quadexp.experiment.build import build_vehicle, unshared
from quadexp.experiment.collect import Setpoints, collect_flights, setpoints
from quadexp.experiment.evaluate import InfeasibleError, drawing_from, fly_one, generator
from quadexp.experiment.identity import digest, flight_entropy, flight_record
from quadexp.log.schema import Flight
from quadexp.parts.compose import compose
from quadexp.physics.state import STATE_COLUMNS
from quadexp.reference.base import Trajectory

INTERPRETED = ["controller.backend=interpreted", "plant.backend=interpreted"]
SHORT = ["trajectory=step", "trajectory.duration=1", "trajectory.step_time=0.2", *INTERPRETED]


def same_flight(a, b):
    """Every column but the measured time, to the last bit."""
    assert list(a.columns) == list(b.columns)
    for name in a.columns:
        if name != "solve_time":
            np.testing.assert_array_equal(a[name], b[name], err_msg=name)


class TestFlight:
    def test_controllers_meet_the_same_noise(self):
        draws = [
            generator(compose(["seed=4", f"controller={name}"])).standard_normal(20)
            for name in ("nominal_mpc", "perfect_mpc", "gp_mpc")
        ]
        np.testing.assert_array_equal(draws[0], draws[1])
        np.testing.assert_array_equal(draws[0], draws[2])
        # Two controllers then differ by what they know and not by luck: another seed changes both alike.
        errors = {
            name: [
                fly_one(compose([*SHORT, f"controller={name}", f"seed={s}"])).metadata["row"]["rmse"] for s in (0, 1)
            ]
            for name in ("nominal_mpc", "perfect_mpc")
        }
        differences = [a - b for a, b in zip(*errors.values(), strict=True)]
        assert abs(differences[0] - differences[1]) < 0.05 * abs(differences[0]) + 1e-6

    def test_the_record_says_who_flew(self):
        metadata = fly_one(compose([*SHORT, "controller=perfect_mpc"])).metadata
        assert metadata["residual"]["name"] == "plant" and metadata["controller"] == "perfect_mpc"
        assert metadata["row"]["backend"] == "interpreted" and metadata["model"] == ""
        assert metadata["vehicle"]["name"] == "torrente" and len(metadata["config_hash"]) == 20

    def test_thrust_that_nobody_has_is_refused_with_where_and_how_much(self):
        with pytest.raises(
            InfeasibleError, match=r"takes \d+(\.\d+)? N of collective thrust at t=\d+\.\d\d s"
        ) as caught:
            fly_one(compose(["trajectory.speed=30"]))
        assert isinstance(caught.value, UsageError)


class TestCollect:
    def test_setpoints_jump_and_stay(self):
        points = setpoints(6.0, 1.0, 4.0, 10.0, np.random.default_rng(0))
        assert isinstance(points, Trajectory) and points.duration == 10.0
        output = points.flat_output(np.array([0.0, points.times[1] - 1e-6, points.times[1], 1e3]))
        np.testing.assert_array_equal(output.position[0, 0], output.position[1, 0])
        np.testing.assert_array_equal(output.position[2, 0], points.points[1])
        assert np.all(output.position[:, 1:] == 0)
        assert points.points[:, 2].min() >= 1.0 and np.abs(points.points[:, :2]).max() <= 3.0

    def test_points_given_by_hand(self):
        points = Setpoints(np.array([[0.0, 0, 1], [1.0, 0, 1]]), np.array([0.0, 2.0]), 4.0)
        np.testing.assert_array_equal(points.flat_output(np.array([1.9, 2.0])).position[:, 0, 0], [0.0, 1.0])

    @pytest.mark.parametrize("mode", ["random", "setpoints"])
    def test_it_stops_at_the_simulated_time(self, mode):
        overrides = [f"collect.mode={mode}", "collect.duration=12", "collect.flight_duration=6", *INTERPRETED]
        flights = collect_flights(compose(overrides))
        seconds = sum(flight.t[-1] for flight in flights)
        assert len(flights) >= 2 and seconds >= 12 - 1e-6
        assert seconds - flights[-1].t[-1] < 12
        assert all(np.isfinite(flight.stack(STATE_COLUMNS)).all() for flight in flights)
        names = [flight.metadata["name"] for flight in flights]
        assert names[:2] == ["flight_000", "flight_001"] and len(set(names)) == len(names)

    def test_a_speed_that_cannot_be_had(self):
        with pytest.raises(Exception, match=r"none of 50 random paths .* lower collect.speed_max"):
            collect_flights(compose(["collect.speed_min=30", "collect.speed_max=40", *INTERPRETED]))


# As they were when the tables of README.md were flown.
ENTROPIES = {
    "trajectory.speed=8": 0x16D2F1FBD632B8FDBF87,
    "trajectory=lemniscate trajectory.speed=8": 0xFF4D67B00FDF2C5095CE,
    "vehicle=lei_li plant=blade_element sensor=lei_li trajectory=rectangle": 0x2BF4F892954397F48679,
    "trajectory=random": 0xB58D91EEE1D695E82E5A,
    "vehicle=hummingbird plant=rotorpy": 0x86E49082761C92B69AEB,
    "vehicle=cf2x_L250 plant=drone_models": 0xC0263D8BD3B3AEFC6C57,
    "vehicle=sun plant=sun trajectory=ellipse world=sun_baseline actuator.rotor_inertia=5e-6": 0xC9C3E879B0613C0EB497,
}


@pytest.mark.parametrize("overrides", ENTROPIES)
def test_a_key_that_comes_later_changes_no_noise(overrides):
    assert flight_entropy(compose(overrides.split())) == ENTROPIES[overrides]


@pytest.mark.parametrize(
    ("overrides", "key"),
    [
        (["trajectory.radius=1e-300"], "trajectory.radius=1e-300"),
        (["trajectory=lemniscate", "trajectory.radius=1e-200"], "trajectory.radius=1e-200"),
    ],
)
def test_a_path_that_is_not_finite_names_its_setting(overrides, key):
    with pytest.raises(UsageError, match=rf"the reference is not finite at t = \S+ s: {key} "):
        fly_one(compose(overrides))


def test_flights_of_one_path_have_their_reference_in_common(monkeypatch):
    """Other seeds do not change it; what is flown is the same to the last bit as alone."""
    made = []
    original = rollout.SampledReference.__init__
    monkeypatch.setattr(
        rollout.SampledReference, "__init__", lambda self, *given: (made.append(given), original(self, *given))[1]
    )
    words = ["controller=perfect_mpc", "trajectory=step", "trajectory.duration=0.5", "trajectory.step_time=0.1"]
    first, again, noisy, longer = (
        fly_one(compose([*words, *other])) for other in ([], [], ["seed=1"], ["trajectory.duration=0.7"])
    )
    assert len(made) == 2
    same_flight(first, again)
    assert not np.array_equal(first["p_x"], noisy["p_x"]) and len(longer) > len(first)
    with unshared():
        alone = fly_one(compose([*words, "seed=1"]))
    assert len(made) == 3
    same_flight(alone, noisy)


def with_former_name(record):
    return {("static_thrust" if key == "thrust_coefficient" else key): value for key, value in record.items()}


def test_the_fingerprint_is_that_of_earlier_checkpoints():
    vehicle = build_vehicle(compose(["vehicle=lei_li"]).vehicle)
    physics = {key: value for key, value in with_former_name(asdict(vehicle)).items() if key != "name"}
    assert vehicle.fingerprint == hashlib.sha256(json.dumps(physics, sort_keys=True).encode()).hexdigest()[:12]


def test_the_noise_is_that_of_earlier_flights():
    config = compose(["vehicle=lei_li", "seed=3"])
    record = flight_record(config)
    parts = []
    for group in ("vehicle", "plant", "trajectory"):
        aside = ("name", "backend", "allow_infeasible", "lost_distance", "lift", "path")  # lift came later
        parts.append({k: v for k, v in with_former_name(record[group]).items() if k not in aside and v is not None})
    assert flight_entropy(config) == int(digest(["noise", *parts, 3]), 16)


def test_a_flight_describes_its_vehicle():
    config = compose(["vehicle=lei_li"])
    metadata = {"config": {"vehicle": asdict(config.vehicle)}}
    from quadexp.plugins.logs.vehicle_of import own_vehicle

    assert own_vehicle(Flight({"t": np.zeros(1)}, metadata)) == build_vehicle(config.vehicle)


def test_draws_of_the_caller_go_on_behind_a_flight_that_raises():
    """A part that drew from numpy.random and raised left the generator as it was for the flight."""
    before, drawn = np.random.get_state()[1].tolist(), []  # noqa: NPY002
    for _ in range(2):
        with pytest.raises(UsageError), drawing_from(2**40 + 7):
            drawn.append(np.random.random())  # noqa: NPY002
            raise UsageError("of a part")
    assert drawn[0] == drawn[1] and np.random.get_state()[1].tolist() == before  # noqa: NPY002
