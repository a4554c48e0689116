"""A mounting in the mapping, or of the import, turns the sensor back; decivolts and eRPM are what they say."""

from __future__ import annotations

import numpy as np
import pytest

from quadexp.log.schema import Flight
from tests.cli.command import run
from tests.log.check.faults import ACC, W
from tests.log.imitated import imitated, random_mounting
from tests.log.importers.logs import MAPPING, imported


@pytest.mark.parametrize("seed", [90, 91, 92])
def test_what_the_import_offers_mends_it(tmp_path, seed):
    """Import, read the correction off the finding, import with it: by the mapping, and by the options."""
    straight = imitated(seed, "torrente", duration=15, turned_gyro=True)
    turned = imitated(seed, "torrente", duration=15, mounting=random_mounting(seed, 9.0), turned_gyro=True)
    outcome, flight = imported(tmp_path, turned, vehicle="torrente")
    (found,) = [one for one in outcome.findings if one.name == "mounting"]
    assert flight is not None and found.severity == "warning"
    angles = found.advice.split("mounting: [")[1].split("]")[0]
    words = MAPPING.replace("acc_z]}", f"acc_z], mounting: [{angles}]}}").replace(
        "w_z]}", f"w_z], mounting: [{angles}]}}"
    )
    by_mapping, first = imported(tmp_path, turned, words, vehicle="torrente")
    values = tuple(float(word) for word in angles.split(","))
    by_option, second = imported(tmp_path, turned, mounting=values, gyro_mounting=values)
    for outcome, one in ((by_mapping, first), (by_option, second)):
        assert "mounting" not in {finding.name for finding in outcome.findings}
        for names, size in ((ACC, 0.35), (W, 0.05)):  # the same noise was drawn in the sensor's own axes
            apart = one.stack(names) - straight.stack(names)
            assert np.sqrt(np.mean(apart**2)) < size + 0.3 * (names is ACC)
    assert np.abs(first.stack(ACC) - second.stack(ACC)).max() < 1e-12


def test_the_angles_are_roll_pitch_yaw_of_the_sensor(tmp_path):
    """A sensor pitched nose down by 90 degrees reads +g along its -x where the body has it along +z."""
    flight = imitated(93, "torrente", duration=5)
    n = len(flight)
    columns = flight.columns | dict(zip(ACC, (np.full(n, -9.81), np.zeros(n), np.zeros(n)), strict=True))
    words = MAPPING.replace("acc_z]}", "acc_z], mounting: [0, 90, 0]}")
    _, done = imported(tmp_path, Flight(columns, {}), words, keep=True)
    assert np.allclose(done.stack(ACC), [0.0, 0.0, 9.81])


def test_decivolts_and_electrical_turns(tmp_path):
    """168 dV, and 7 pole pairs: 70 000 electrical turns a minute are 10 000 of the rotor, 1047.2 rad/s."""
    flight = imitated(94, "torrente", duration=6, signal="rotor_speed")
    columns = dict(flight.columns)
    for i in range(4):
        columns[f"rotor_speed_{i}"] = 7 * columns[f"rotor_speed_{i}"] * 60 / (2 * np.pi)
    columns["battery_voltage"] = 10 * columns["battery_voltage"]
    words = MAPPING.splitlines()
    words = [line for line in words if not line.startswith("motor_command")]
    names = ", ".join(f"rotor_speed_{i}" for i in range(4))
    words += [
        f"rotor_speed: {{columns: [{names}], unit: erpm, pole_pairs: 7}}",
        "battery_voltage: {column: battery_voltage, unit: dV}",
    ]
    outcome, one = imported(tmp_path, Flight(columns, {}), "\n".join(words))
    assert one is not None, outcome.cause
    assert np.allclose(one["battery_voltage"], flight["battery_voltage"])
    assert np.allclose(one["rotor_speed_2"], flight["rotor_speed_2"])


def test_options_are_checked(tmp_path):
    (tmp_path / "a.csv").write_text("t\n")
    for words, text in (
        (("--mounting", "1,2"), "must be roll,pitch,yaw"),
        (("--gyro-mounting", "1,2,nan"), "in [-360, 360]"),
    ):
        code, _, error = run("import", tmp_path / "a.csv", *words, "--out", tmp_path / "out")
        assert code == 2 and text in error and len(error.strip().splitlines()) == 1
