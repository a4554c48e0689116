"""A turned accelerometer is offered its correction, which mends the import; real faults keep their names."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadexp.log.schema import Flight
from quadexp.plugins.check.quality import check_flight
from quadexp.plugins.logs.units import mounting_matrix
from tests.cli.command import run
from tests.log.imitated import VEHICLES, imitated, random_mounting, vehicle_named
from tests.plugins.check.faults import ACC, P, V, W, changed, inject, put, rotation, take, times, turned
from tests.plugins.logs.importers.logs import MAPPING, imported

ANGLES = (3.0, 5.0, 8.0, 11.0, 15.0)
FOREIGN = {"units", "axis_swap", "sign_flip", "frame_acceleration", "gravity_removed", "inconsistent",
           "ned_not_converted"}  # fmt: skip
CASES = [(VEHICLES[i % 4], seed, ANGLES[i % 5]) for i, seed in enumerate(range(20, 32))]


def angles_of(findings, blocks: bool = False) -> list[float]:
    """Roll, pitch, yaw that the finding offers: in the mapping's words, and as the option."""
    (found,) = [one for one in findings if one.name == "mounting"]
    assert found.blocks == blocks and "acc_*" in found.where
    angles = found.correction["acceleration"]["mounting"]
    assert f"--mounting={','.join(f'{x:g}' for x in angles)}" in found.advice
    return angles


@pytest.mark.parametrize(
    ("vehicle", "seed", "degrees"), [*CASES[:3], *(pytest.param(*case, marks=pytest.mark.slow) for case in CASES[3:])]
)
def test_a_turned_accelerometer_is_offered_its_correction(vehicle, seed, degrees):
    """The turn that is offered is the true one but for 1.5 degrees about x and y; undone, nothing is left to say.

    The attitude itself is off by 0.3 degrees an axis, and the bias of the accelerometer makes as much.
    """
    mount = random_mounting(seed, degrees)
    flight = imitated(seed, vehicle, mounting=mount, turned_gyro=bool(seed % 2))
    found = check_flight(flight, vehicle_named(vehicle))
    assert not {one.name for one in found} & FOREIGN
    up = np.array([0.0, 0.0, 1.0])
    if not seed % 2 and np.degrees(np.arccos(mount.apply(up) @ up)) < 1.0:
        return  # about z alone, which a specific force along z does not see
    matrix = mounting_matrix(angles_of(found))
    assert np.degrees(np.arccos(np.clip((matrix @ mount.inv().apply(up)) @ up, -1, 1))) < 1.5
    mended = changed(turned(matrix, *((ACC, W) if seed % 2 else (ACC,))), flight)
    assert not [one.message for one in check_flight(mended, vehicle_named(vehicle)) if one.severity != "info"]


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_no_turn_is_offered_where_there_is_none(vehicle):
    assert not [one.message for one in check_flight(imitated(40, vehicle), vehicle_named(vehicle))]


def world_frame(c):
    put(c, ACC, rotation(c).apply(take(c, ACC)))


feet = times(P + V, 1 / 0.3048)
KEPT = [
    (world_frame, "frame_acceleration"), (feet, "units"), ("acceleration_in_g", "units"),
    ("gyro_axes_swapped", "axis_swap"), ("ned_everything", "ned_not_converted"),
    ("ned_position_and_velocity", "ned_not_converted"), ("frd_imu", "frd_not_converted"),
    ("gravity_removed", "gravity_removed"), ("conjugated", "quaternion_conjugate"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("degrees", "vehicle"),
    [(8.0, "crazyflie"), *(pytest.param(*one, marks=pytest.mark.slow) for one in
                           ((8.0, "torrente"), (0.0, "crazyflie"), (0.0, "torrente")))],
)  # fmt: skip
@pytest.mark.parametrize(("fault", "name"), KEPT)
def test_faults_keep_their_names_on_a_turned_sensor(fault, name, degrees, vehicle):
    seed = {"torrente": 50, "crazyflie": 51}[vehicle]
    flight = imitated(seed, vehicle, duration=10, mounting=random_mounting(seed, degrees))
    flight = changed(fault, flight) if callable(fault) else inject(flight, fault)
    assert {one.name for one in check_flight(flight, vehicle_named(vehicle)) if one.blocks} == {name}


def test_a_large_turn_blocks_and_is_named_with_its_numbers():
    """35 degrees of yaw in a board with gyro: no mount that was never calibrated, and no convention of axes."""
    flight = imitated(60, "torrente", mounting=Rotation.from_euler("Z", 35, degrees=True), turned_gyro=True)
    blocking = [one for one in check_flight(flight, vehicle_named("torrente")) if one.blocks]
    assert len(blocking) == 1 and angles_of(blocking, blocks=True)[2] == pytest.approx(35, abs=1)


def test_a_repair_that_leaves_much_names_no_fault():
    """Noise twice as large as the motion: there is a misfit, and nothing that explains it."""
    flight = imitated(61, "crazyflie", noise=1.0)
    rng, t = np.random.default_rng(0), flight.t
    noise = {name: np.interp(t, t[::40], rng.normal(0, 1.5, 50)) for name in ACC}
    columns = {name: values + noise.get(name, 0.0) for name, values in flight.columns.items()}
    assert not {one.name for one in check_flight(Flight(columns, flight.metadata)) if one.blocks} - {"inconsistent"}


@pytest.mark.parametrize("seed", [90, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (91, 92))])
def test_what_the_import_offers_mends_it(tmp_path, seed):
    """Import, read the correction off the finding, import with it: by the mapping, and by the options."""
    straight = imitated(seed, "torrente", duration=15, turned_gyro=True)
    bent = imitated(seed, "torrente", duration=15, mounting=random_mounting(seed, 9.0), turned_gyro=True)
    outcome, flight = imported(tmp_path, bent, vehicle="torrente")
    assert flight is not None
    angles = angles_of(outcome.findings)
    words = MAPPING
    for last in ("acc_z", "w_z"):
        words = words.replace(f"{last}]}}", f"{last}], mounting: {angles}}}")
    by_mapping, first = imported(tmp_path, bent, words, vehicle="torrente")
    by_option, second = imported(tmp_path, bent, mounting=tuple(angles), gyro_mounting=tuple(angles))
    for outcome, one in ((by_mapping, first), (by_option, second)):
        assert "mounting" not in {finding.name for finding in outcome.findings}
        for names, size in ((ACC, 0.65), (W, 0.05)):  # the same noise was drawn in the sensor's own axes
            assert np.sqrt(np.mean((one.stack(names) - straight.stack(names)) ** 2)) < size
    assert np.abs(first.stack(ACC) - second.stack(ACC)).max() < 1e-12


def test_the_angles_are_roll_pitch_yaw_of_the_sensor(tmp_path):
    """A sensor pitched nose down by 90 degrees reads +g along its -x where the body has it along +z."""
    flight = imitated(93, "torrente", duration=5)
    columns = flight.columns | {name: np.full(len(flight), x) for name, x in zip(ACC, (-9.81, 0, 0), strict=True)}
    words = MAPPING.replace("acc_z]}", "acc_z], mounting: [0, 90, 0]}")
    _, done = imported(tmp_path, Flight(columns, {}), words, keep=True)
    assert np.allclose(done.stack(ACC), [0.0, 0.0, 9.81])


@pytest.mark.parametrize(
    ("option", "value", "text"),
    [("--mounting", "1,2", "must be roll,pitch,yaw"), ("--gyro-mounting", "1,2,nan", "in [-360, 360]")],
)
def test_options_are_checked(tmp_path, option, value, text):
    (tmp_path / "a.csv").write_text("t\n")
    code, _, error = run("import", tmp_path / "a.csv", option, value, "--out", tmp_path / "out")
    assert code == 2 and text in error and len(error.strip().splitlines()) == 1
