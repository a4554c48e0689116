"""A turned accelerometer is offered its correction and is called nothing else; real faults keep their names."""

from __future__ import annotations

import numpy as np
import pytest

from quadexp.log.check import check_flight
from quadexp.log.schema import Flight
from tests.log.check.faults import ACC, P, V, W, changed, inject, put, rotation, take, times, turned
from tests.log.imitated import VEHICLES, imitated, random_mounting, vehicle_named

ANGLES = (3.0, 5.0, 8.0, 11.0, 15.0)
FOREIGN = {
    "units",
    "axis_swap",
    "sign_flip",
    "frame_acceleration",
    "gravity_removed",
    "inconsistent",
    "ned_not_converted",
}
CASES = [(VEHICLES[i % 4], seed, ANGLES[i % 5]) for i, seed in enumerate(range(20, 32))]


def angles_of(flight: Flight, vehicle: str) -> list[float]:
    """Roll, pitch, yaw that the finding offers for the accelerometer."""
    found = [one for one in check_flight(flight, vehicle_named(vehicle)) if one.name == "mounting"]
    assert len(found) == 1 and not found[0].blocks and "acc_*" in found[0].where, [one.message for one in found]
    text = found[0].advice.split("mounting: [")[1].split("]")[0]
    assert f"--mounting={text.replace(' ', '')}" in found[0].advice
    return [float(word) for word in text.split(",")]


@pytest.mark.parametrize(
    ("vehicle", "seed", "degrees"), [*CASES[:4], *(pytest.param(*case, marks=pytest.mark.slow) for case in CASES[4:])]
)
def test_a_turned_accelerometer_is_offered_its_correction(vehicle, seed, degrees):
    """The turn that is offered is the true one but for 1.5 degrees about x and y; undone, nothing is left to say.

    The attitude itself is off by 0.3 degrees an axis, and the bias of the accelerometer makes as much.
    """
    from quadexp.log.units import mounting_matrix

    mount = random_mounting(seed, degrees)
    flight = imitated(seed, vehicle, mounting=mount, turned_gyro=bool(seed % 2))
    assert not {one.name for one in check_flight(flight, vehicle_named(vehicle))} & FOREIGN
    up = np.array([0.0, 0.0, 1.0])
    if not seed % 2 and np.degrees(np.arccos(mount.apply(up) @ up)) < 1.0:
        return  # about z alone, which a specific force along z does not see
    matrix = mounting_matrix(angles_of(flight, vehicle))
    apart = np.degrees(np.arccos(np.clip((matrix @ mount.inv().apply(up)) @ up, -1, 1)))
    assert apart < 1.5
    mended = changed(turned(matrix, *((ACC, W) if seed % 2 else (ACC,))), flight)
    assert not [one.message for one in check_flight(mended, vehicle_named(vehicle)) if one.severity != "info"]


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_no_turn_is_offered_where_there_is_none(vehicle):
    for seed in (40, 41):
        assert not [one.message for one in check_flight(imitated(seed, vehicle), vehicle_named(vehicle))]


def world_frame(c):
    put(c, ACC, rotation(c).apply(take(c, ACC)))


feet = times(P + V, 1 / 0.3048)


@pytest.mark.parametrize(
    ("degrees", "vehicle"),
    [(8.0, "crazyflie"), *(pytest.param(*one, marks=pytest.mark.slow) for one in
                           ((8.0, "torrente"), (0.0, "crazyflie"), (0.0, "torrente")))],
)  # fmt: skip
@pytest.mark.parametrize(
    ("fault", "name"),
    [
        (world_frame, "frame_acceleration"), (feet, "units"), ("acceleration_in_g", "units"),
        ("gyro_axes_swapped", "axis_swap"), ("ned_everything", "ned_not_converted"),
        ("ned_position_and_velocity", "ned_not_converted"), ("frd_imu", "frd_not_converted"),
        ("gravity_removed", "gravity_removed"), ("conjugated", "quaternion_conjugate"),
    ],
)  # fmt: skip
def test_faults_keep_their_names_on_a_turned_sensor(fault, name, degrees, vehicle):
    seed = {"torrente": 50, "crazyflie": 51}[vehicle]
    flight = imitated(seed, vehicle, duration=15, mounting=random_mounting(seed, degrees))
    flight = changed(fault, flight) if callable(fault) else inject(flight, fault)
    assert {one.name for one in check_flight(flight, vehicle_named(vehicle)) if one.blocks} == {name}


def test_a_large_turn_blocks_and_is_named_with_its_numbers():
    """35 degrees of yaw in a board with gyro: no mount that was never calibrated, and no convention of axes."""
    from scipy.spatial.transform import Rotation

    flight = imitated(60, "torrente", mounting=Rotation.from_euler("Z", 35, degrees=True), turned_gyro=True)
    (found,) = [one for one in check_flight(flight, vehicle_named("torrente")) if one.blocks]
    assert found.name == "mounting" and "w_*, acc_*" in found.where
    assert float(found.advice.split("[")[1].split("]")[0].split(",")[2]) == pytest.approx(35, abs=1)


def test_a_repair_that_leaves_much_names_no_fault():
    """Noise twice as large as the motion: there is a misfit, and nothing that explains it."""
    flight = imitated(61, "crazyflie", noise=1.0)
    rng = np.random.default_rng(0)
    columns = {key: values.copy() for key, values in flight.columns.items()}
    for name in ACC:
        columns[name] = columns[name] + np.interp(columns["t"], columns["t"][::40], rng.normal(0, 1.5, 50))
    assert not {one.name for one in check_flight(Flight(columns, flight.metadata)) if one.blocks} - {"inconsistent"}
