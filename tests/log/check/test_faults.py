"""Every fault is reported by its name on a simulated and on a real flight; clean flights are not complained about."""

from __future__ import annotations

import numpy as np
import pytest

from quadexp.experiment.evaluate import fly_one
from quadexp.log.check import check_flight, check_flights
from quadexp.log.schema import Flight
from quadexp.parts.compose import compose
from tests.log.imitated import imitated

from .faults import FAULTS, NANOBENCH, inject, nanobench

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
REPEATED = {
    "velocity_axes_swapped",
    "accelerometer_axis_flipped",
    "block_written_twice",
    "time_back",
    "frozen_position",
}
needs_nanobench = pytest.mark.skipif(not NANOBENCH.is_dir(), reason="../shared/data/nanobench is not here")


@pytest.fixture(scope="module")
def flights():
    flown = {"simulated": fly_one(compose([*NOMINAL, "trajectory=circle", "trajectory.speed=8", "sensor=lei_li"]))}
    if NANOBENCH.is_dir():
        flown["real"] = nanobench(REAL)
    return flown


def serious(findings):
    return [one for one in findings if one.severity != "info"]


CASES = [
    *(
        pytest.param("simulated", name, id=f"simulated-{name}", marks=[pytest.mark.slow] if name in REPEATED else [])
        for name in FAULTS
    ),
    *(
        pytest.param(
            "real", name, id=f"real-{name}", marks=[needs_nanobench, *([] if name in COMMON else [pytest.mark.slow])]
        )
        for name in FAULTS
    ),
]


@pytest.mark.parametrize(("source", "name"), CASES)
def test_fault_is_named_and_nothing_else(name, source, flights, vehicle):
    limits = vehicle if source == "simulated" else None
    found = serious(check_flight(inject(flights[source], name), limits))
    named = [one for one in found if one.name == FAULTS[name][0]]
    assert named, [one.message for one in found]
    assert found[0].name == FAULTS[name][0], [one.message for one in found]
    others = {one.name for one in found} - {FAULTS[name][0]}
    assert not others & {"units", "sign_flip", "axis_swap", "ned_not_converted", "frame_velocity", "inconsistent"}


@pytest.mark.parametrize("source", ["simulated", pytest.param("real", marks=needs_nanobench)])
def test_clean(source, flights):
    assert not serious(check_flight(flights[source]))


@pytest.mark.parametrize(
    "name", [*CLEAN_QUICK, *(pytest.param(n, marks=pytest.mark.slow) for n in CLEAN if n not in CLEAN_QUICK)]
)
def test_clean_simulated_flights(name, vehicle):
    flight = fly_one(compose(list(CLEAN[name])))
    assert not serious(check_flight(flight)), name


@needs_nanobench
@pytest.mark.parametrize("name", ["B2_circle_fast_rep2", "B9_trefoil_fast_rep14", "B9_trefoil_slow_rep12"])
def test_clean_real_flights(name):
    assert {one.name for one in serious(check_flight(nanobench(name)))} <= {"saturation"}  # they were at full command


@needs_nanobench
@pytest.mark.slow
def test_traps_of_the_folder():
    names = ["B9_trefoil_slow_rep12", "B9_trefoil_slow_rep7", "B3_figure8_fast_rep1"]
    log = {name: nanobench(name) for name in names}
    log["B2_circle_medium_rep3"] = nanobench("B2_circle_medium_rep3")
    log["B7_oval_slow_rep1"] = nanobench("B7_oval_slow_rep1", crop=False)
    found = {name: {one.name for one in findings if one.blocks} for name, findings in check_flights(log).items()}
    assert found["B9_trefoil_slow_rep12"] == set() and found["B3_figure8_fast_rep1"] == set()
    assert found["B9_trefoil_slow_rep7"] == {"duplicate"}
    assert found["B7_oval_slow_rep1"] == {"no_flight"}
    assert {"impossible_command", "acceleration_outlier"} <= found["B2_circle_medium_rep3"]
    assert not found["B2_circle_medium_rep3"] & {"units", "sign_flip", "axis_swap", "inconsistent"}


@pytest.mark.parametrize("source", ["simulated", pytest.param("real", marks=needs_nanobench)])
def test_a_duplicate_cropped_and_thinned(source, flights):
    """Every other row of the middle, on another clock."""
    whole = flights[source]
    part = {name: values[len(values) // 5 : -len(values) // 5 : 2] for name, values in whole.columns.items()}
    part["t"] = part["t"] - 3.2171
    found = check_flights({"a": whole, "b": Flight(part, {"recorded": True})})
    assert [one.name for one in found["b"] if "duplicate" in one.name] == ["duplicate"]
    assert "duplicate" not in {one.name for one in found["a"]}


def test_two_flights_of_one_path_are_no_duplicates(flights):
    again = fly_one(compose([*NOMINAL, "trajectory=circle", "trajectory.speed=8", "sensor=lei_li", "seed=1"]))
    found = check_flights({"a": flights["simulated"], "b": again})
    assert "duplicate" not in {one.name for one in found["b"]}


def test_two_faults_at_once_are_both_named(flights):
    both = inject(inject(flights["simulated"], "acceleration_in_g"), "gyro_axes_swapped")
    assert {one.name for one in check_flight(both) if one.blocks} == {"units", "axis_swap"}


@pytest.mark.parametrize(("speed", "asks"), [(0.3, True), (8.0, False)])
def test_it_asks_where_the_data_do_not_decide(speed, asks):
    """A gyro whose y is reversed: where nothing pushes sideways, the accelerometer's may be reversed as well."""
    flight = imitated(5, "torrente", duration=12, speed=speed, busy=min(1.0, speed))
    (found,) = [one for one in check_flight(inject(flight, "gyro_axis_flipped")) if one.blocks]
    assert found.correction == {"rate": {"frame": "body x -y z"}}
    assert ("decide between" in found.advice) == asks == ("log units" in found.measured)


def test_without_some_streams(flights):
    """A log without velocity or without an accelerometer still shows its faults."""
    columns = flights["simulated"].columns
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
