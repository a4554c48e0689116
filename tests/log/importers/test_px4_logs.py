"""What PX4 logs of real vehicles are like: they import with what they have, and nothing sound is blocked."""

from __future__ import annotations

import numpy as np
import pytest

from quadexp.log.check import check_flight
from quadexp.log.importers import Options, import_log
from tests.log.importers import logs
from tests.log.importers.px4_logs import default_rates
from tests.log.importers.vehicles import quad_x

pytest.importorskip("pyulog", reason="the extra [logs] is not installed")


@pytest.fixture(scope="module")
def truth():
    return logs.truth(24.0, 250.0)


def blocking(flight):
    return [one.message for one in check_flight(flight) if one.blocks]


def test_default_rates_are_sound(truth, tmp_path):
    """Position at 10 Hz beside an IMU at 250 Hz: neither unit, frame, clock nor offset is complained about."""
    flight, notes = import_log(default_rates(tmp_path / "a.ulg", truth), quad_x(), Options())
    assert not blocking(flight) and not any("left out" in note for note in notes)
    k = np.round(flight.t * 250).astype(int)
    np.testing.assert_allclose(flight.stack(["p_x", "p_y", "p_z"]), truth.p[k], atol=0.05)
    np.testing.assert_allclose(flight.stack(["v_x", "v_y", "v_z"]), truth.v[k], atol=0.1)


def test_a_position_that_the_estimator_disowns_is_left_out(truth, tmp_path):
    flight, notes = import_log(default_rates(tmp_path / "a.ulg", truth, xy_valid=False), quad_x(), Options())
    assert "p_x" not in flight.columns and "v_x" not in flight.columns
    assert {"q_w", "w_x", "acc_x", "motor_command_3"} <= set(flight.columns)
    assert [note for note in notes if note.startswith("position") and "xy_valid" in note]
    assert not blocking(flight)


def test_a_position_valid_for_a_part_gives_that_part(truth, tmp_path):
    valid = np.arange(len(truth.t[::25])) >= 100  # from 10 s on
    flight, notes = import_log(default_rates(tmp_path / "a.ulg", truth, xy_valid=valid), quad_x(), Options())
    assert flight.metadata["source"]["cropped"][0] == pytest.approx(10.0, abs=0.1)
    k = np.round((flight.t + 10.0) * 250).astype(int)
    np.testing.assert_allclose(flight.stack(["p_x", "p_y", "p_z"]), truth.p[k], atol=0.05)
    assert any("not valid in 100 of" in note for note in notes) and not blocking(flight)


def test_a_setpoint_for_a_part_does_not_cut_the_flight(truth, tmp_path):
    path = default_rates(tmp_path / "a.ulg", truth, setpoint=(8.0, 14.0))
    flight, notes = import_log(path, quad_x(), Options())
    assert flight.t[-1] > 23 and "ref_p_x" not in flight.columns
    assert any(note.startswith("reference_position") and "left out" in note for note in notes)
    whole, _ = import_log(default_rates(tmp_path / "b.ulg", truth, setpoint=(0.0, 30.0)), quad_x(), Options())
    assert "ref_p_x" in whole.columns


def test_outputs_beyond_the_rotors_are_no_rotors(truth, tmp_path):
    """Gimbal and landing gear move too; the type of the vehicle says how many rotors there are."""
    flight, _ = import_log(default_rates(tmp_path / "a.ulg", truth, outputs=8), quad_x(), Options())
    assert [name for name in flight.columns if name.startswith("motor_command")] == [
        f"motor_command_{i}" for i in range(4)
    ]
