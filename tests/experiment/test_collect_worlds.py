"""Data sets of flights in worlds: what was delivered, given and known, in several worlds, up to the checkpoint."""

import numpy as np
import pytest

from quadexp.errors import UsageError
from quadexp.experiment.collect import collect_dataset, collect_flights
from quadexp.log.store import read_flight
from quadexp.models.checkpoint import load_model
from quadexp.models.dataset import read_dataset
from quadexp.parts.compose import compose, session
from quadexp.requests import fit
from tests.deleted import needs

SHORT = ["controller.backend=interpreted", "plant.backend=interpreted", "collect.duration=10"]
LAG = ["actuator=first_order", "actuator.time_constant_up=0.03", "actuator.time_constant_down=0.03"]


def collected(path, *overrides):
    report = collect_dataset(compose([*SHORT, *overrides]), path)
    return read_dataset(path), report


@pytest.fixture(scope="module")
def lagging(tmp_path_factory):
    """A data set with a lag of 30 ms, and the same flights with the commands as thrusts."""
    folder = tmp_path_factory.mktemp("lagging")
    return collected(folder / "a.parquet", *LAG), collected(folder / "b.parquet", *LAG, "collect.thrust=commanded")


@needs("worlds", "identification")
def test_a_lag_goes_into_the_data_set_and_its_report(lagging):
    (data, report), (commanded, plain) = lagging
    (timing,) = data.metadata["timing"]
    assert timing["lag_up"] == pytest.approx(0.03, rel=0.05) and timing["lag_of"] == "rotor_speed"
    assert timing["flights"] == [f"flight_{i:03d}" for i in range(report["flights"])]
    assert any("motor lag 30." in line or "motor lag 29." in line for line in report["lines"])
    assert "timing" not in commanded.metadata and not any("lag" in line for line in plain["lines"])
    # what linear drag and thrust leave of a_z: the noise of the plant and its quadratic drag, not the lag
    assert left(data) < 0.5 * left(commanded)


def test_the_rotors_of_a_flight_begin_as_its_data_believe(lagging):
    """In the first 100 ms, three time constants, about as much is left as later on."""
    (data, _), _ = lagging
    remains, first = remaining(data), data.matrix(["t"])[:, 0] < 0.1
    assert first.sum() > 5 and np.std(remains[first]) < 1.5 * np.std(remains[~first])


def left(data):
    """rms of `remaining`."""
    return np.std(remaining(data))


def remaining(data):
    """What v_z, its square and the thrust leave of a_z (m/s^2)."""
    v, thrust = data.matrix(["v_z"])[:, 0], data.matrix(["thrust"])[:, 0]
    terms = np.stack([np.ones_like(v), v, v * np.abs(v), thrust, thrust**2], axis=1)
    target = data.matrix(["a_z"])[:, 0]
    return target - terms @ np.linalg.lstsq(terms, target, rcond=None)[0]


@needs("worlds", "identification")
def test_a_checkpoint_says_what_its_data_were(lagging, tmp_path):
    """Timing and known noise are in the model."""
    (data, report), _ = lagging
    fit("drag", report["path"], ["drag.holdout=0.4"], tmp_path / "drag", figures=False)
    known = data.metadata["known_noise"]
    assert known["a_x"] == pytest.approx(1.118033988749895e-4 / np.sqrt(0.02), rel=1e-3)
    stored = load_model(tmp_path / "drag").dataset
    assert stored["known_noise"] == known and stored["timing"] == data.metadata["timing"]


def test_the_accelerometers_target_takes_rotor_speeds_where_they_were_logged(tmp_path):
    """The reading less the thrust by the speeds is the drag, however the rotors lag: drag explains most of it."""
    world = [*LAG, "vehicle.thrust_coefficient=1e-5", "collect.target=specific_force", "plant.motor_noise_density=0"]
    data, _ = collected(tmp_path / "rows.parquet", *world)
    assert data.metadata["thrust"]["signal"] == "rotor_speed"
    assert left(data) < 0.1


def test_rows_are_of_what_the_controller_was_told(tmp_path):
    """Noise of the estimate is in the targets, known, and not in those of the truth."""
    world = ["estimator.velocity_noise=0.03", "collect.duration=6"]
    told, _ = collected(tmp_path / "told.parquet", *world)
    truth, _ = collected(tmp_path / "truth.parquet", *world, "collect.state=truth")
    noise = np.sqrt(2) * 0.03 / 0.02
    assert told.metadata["known_noise"]["a_x"] == pytest.approx(noise, rel=0.01)
    assert truth.metadata["known_noise"]["a_x"] < 0.01
    rows = min(told.n_rows, truth.n_rows)
    apart = (told.matrix(["a_x"]) - truth.matrix(["a_x"]))[:rows]
    assert apart.std() == pytest.approx(noise, rel=0.1)


@needs("worlds", "identification")
def test_a_sweep_flies_in_its_worlds_in_turn(tmp_path):
    """Each world's timing is found by itself; the paths are those of one world."""
    sweep = ["wind=constant", "wind.velocity=[0,0,0],[4,0,0]", "link=latency", "link.latency=0,0.02"]
    with session() as composer:
        worlds = [cell.config for cell in composer.expand([*SHORT, *sweep, "collect.duration=24"])]
    report = collect_dataset(worlds[0], tmp_path / "rows.parquet", worlds=worlds, save_flights=tmp_path)
    flights = [read_flight(tmp_path / f"flight_{i:03d}.parquet") for i in range(report["flights"])]
    wind = [flight["wind_x"][0] if "wind_x" in flight.columns else 0.0 for flight in flights[:4]]
    assert wind == [0.0, 0.0, 4.0, 4.0]
    for one, other in zip(flights, collect_flights(worlds[0]), strict=False):
        both = min(len(one), len(other))
        assert np.array_equal(one["ref_p_x"][:both], other["ref_p_x"][:both])
    data = read_dataset(tmp_path / "rows.parquet")
    delays = {tuple(one["flights"]): one["delay"] for one in data.metadata["timing"]}
    assert sorted(delays.values()) == pytest.approx([0.0, 0.02], abs=1e-3) and len(data.metadata["worlds"]) == 4


def test_a_sweep_of_something_else_is_refused():
    with session() as composer:
        worlds = [cell.config for cell in composer.expand([*SHORT, "controller=nominal_mpc,perfect_mpc"])]
    with pytest.raises(UsageError, match="the flights differ in `controller`"):
        collect_flights(worlds[0], worlds=worlds)
