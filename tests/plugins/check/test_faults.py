"""Every fault is reported by its name on a simulated and on a real flight; clean flights are not complained about."""

import numpy as np
import pytest

from quadexp.experiment.evaluate import fly_one
from quadexp.log.schema import Flight
from quadexp.parts.compose import compose
from quadexp.plugins.check.quality import check_flight, check_flights
from tests.log.imitated import imitated
from tests.models.recorded_data import nanobench
from tests.plugins.check.faults import FAULTS, inject

REAL = "B3_figure8_fast_rep1"
INTERPRETED = ("controller.backend=interpreted", "plant.backend=interpreted")
NOMINAL = ("controller=nominal_mpc", *INTERPRETED)
LEI_LI = ("vehicle=lei_li", "plant=blade_element", "controller=rls_feedback", "trajectory.duration=12", *INTERPRETED)
CLEAN = {
    "circle_slow": (*NOMINAL, "trajectory=circle", "trajectory.speed=2", "sensor=lei_li"),
    "lemniscate_fast": (*NOMINAL, "trajectory=lemniscate", "trajectory.speed=12"),
    "random": (*NOMINAL, "trajectory=random", "sensor=lei_li", "seed=3"),
    "hover": (*NOMINAL, "trajectory=hover", "sensor=lei_li"),
    "rectangle": (*LEI_LI, "trajectory=rectangle", "sensor=lei_li"),
}
CLEAN_QUICK = ("circle_slow", "random", "hover")
COMMON = {  # on the real flight too; the others there are slow tests
    "acceleration_in_g", "scalar_last", "ned_position_and_velocity", "gyro_axes_swapped", "imu_50_ms_late",
    "time_jump", "command_spikes", "frozen_gyro",
}  # fmt: skip
REPEATED = {"accelerometer_axis_flipped", "block_written_twice", "time_back", "frozen_position"}


@pytest.fixture(scope="module")
def simulated():
    return fly_one(compose([*NOMINAL, "trajectory=circle", "trajectory.speed=8", "sensor=lei_li"]))


def serious(findings):
    return [one for one in findings if one.severity != "info"]


def names_it(flight, name, vehicle=None):
    """The fault is the first finding, and none of another's units, frames or signs."""
    found = [one.name for one in serious(check_flight(inject(flight, name), vehicle))]
    assert found and found[0] == FAULTS[name][0], found
    others = {"units", "sign_flip", "axis_swap", "ned_not_converted", "frame_velocity", "inconsistent"}
    assert not set(found[1:]) - {found[0]} & others


def slow_unless(names, quick):
    return [pytest.param(name, marks=[pytest.mark.slow] * (name not in quick)) for name in names]


@pytest.mark.parametrize("name", slow_unless(FAULTS, FAULTS.keys() - REPEATED))
def test_fault_is_named_and_nothing_else(name, simulated, vehicle):
    names_it(simulated, name, vehicle)


@pytest.mark.parametrize("name", slow_unless(FAULTS, COMMON))
def test_fault_of_a_real_flight_is_named_and_nothing_else(name):
    names_it(nanobench(REAL), name)


@pytest.mark.parametrize("name", slow_unless(CLEAN, CLEAN_QUICK))
def test_clean_simulated_flights(name):
    assert not serious(check_flight(fly_one(compose(list(CLEAN[name])))))


@pytest.mark.parametrize("name", [REAL, "B2_circle_fast_rep2", "B9_trefoil_fast_rep14", "B9_trefoil_slow_rep12"])
def test_clean_real_flights(name):
    assert {one.name for one in serious(check_flight(nanobench(name)))} <= {"saturation"}  # they were at full command


def test_a_duplicate_cropped_and_thinned(simulated):
    """Every other row of the middle, on another clock; another flight of the same path is none."""
    part = {n: x[len(x) // 5 : -len(x) // 5 : 2] - 3.2171 * (n == "t") for n, x in simulated.columns.items()}
    again = fly_one(compose([*NOMINAL, "trajectory=circle", "trajectory.speed=8", "sensor=lei_li", "seed=1"]))
    found = check_flights({"a": simulated, "b": Flight(part, {"recorded": True}), "c": again})
    assert ["duplicate" in {one.name for one in found[name]} for name in "abc"] == [False, True, False]


def test_two_faults_at_once_are_both_named(simulated):
    both = inject(inject(simulated, "acceleration_in_g"), "gyro_axes_swapped")
    assert {one.name for one in check_flight(both) if one.blocks} == {"units", "axis_swap"}


@pytest.mark.parametrize(("speed", "asks"), [(0.3, True), (8.0, False)])
def test_it_asks_where_the_data_do_not_decide(speed, asks):
    """A gyro whose y is reversed: where nothing pushes sideways, the accelerometer's may be reversed as well."""
    flight = imitated(5, "torrente", duration=12, speed=speed, busy=min(1.0, speed))
    (found,) = [one for one in check_flight(inject(flight, "gyro_axis_flipped")) if one.blocks]
    assert found.correction == {"rate": {"frame": "body x -y z"}}
    assert ("decide between" in found.advice) == asks == ("log units" in found.measured)


def test_without_some_streams(simulated):
    """A log without velocity or without an accelerometer still shows its faults."""
    columns = simulated.columns
    no_velocity = Flight({k: v for k, v in columns.items() if k not in ("v_x", "v_y", "v_z")}, {})
    no_imu = Flight({k: v for k, v in columns.items() if not k.startswith(("acc", "w_"))}, {})
    assert not serious(check_flight(no_velocity)) and not serious(check_flight(no_imu))
    assert [one.name for one in serious(check_flight(inject(no_velocity, "conjugated")))] == ["quaternion_conjugate"]
    assert "ned_not_converted" in {one.name for one in check_flight(inject(no_imu, "ned_position_and_velocity"))}


def test_degenerate_flights_say_no_flight():
    t = np.arange(300) / 100
    still = {"t": t} | dict.fromkeys(("p_x", "p_y", "p_z", "v_x", "v_y", "v_z"), 0 * t)
    assert [one.name for one in check_flight(Flight(still, {}))][0] == "no_flight"
    assert check_flight(Flight({"t": t[:1]}, {}))[0].name == "no_flight"
    assert check_flight(Flight({"t": t[:0]}, {}))[0].name == "no_flight"
