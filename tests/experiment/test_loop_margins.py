"""What a flight's record, its summary and the report say of the delays that the loop tolerates."""

from __future__ import annotations

import pytest

from quadexp.experiment.evaluate import fly_one
from quadexp.parts.compose import compose
from quadexp.report.page.sections import margins as margins_of
from quadexp.report.summary import flight_lines, margin_line, world_note

HOVER = ["trajectory=hover", "trajectory.duration=0.2"]


def flown(*overrides: str) -> dict:
    return fly_one(compose([*HOVER, *overrides])).metadata


@pytest.mark.parametrize(
    ("horizon", "line"),
    [
        ("published", "tolerates 67 ms of unmodelled delay, 93 ms of unmodelled lag (at hover)"),
        ("precise", "tolerates 17 ms of unmodelled delay, 51 ms of unmodelled lag (at hover)"),
        ("robust", "tolerates 47 ms of unmodelled delay, 83 ms of unmodelled lag (at hover)"),
    ],
)
def test_a_flight_says_what_its_loop_tolerates(horizon, line):
    metadata = flown("controller=nominal_mpc", f"horizon={horizon}")
    assert f"loop        {line}" in flight_lines(metadata)
    assert metadata["margins"]["world_stable"] and not world_note(metadata["margins"])
    assert margins_of([metadata, metadata, {}]) == [f"nominal_mpc: {line}"]


def test_a_predicted_dead_time_is_what_the_margins_count_from():
    margins = flown("controller=nominal_mpc", "horizon=robust", "controller.dead_time=0.02")["margins"]
    line = margin_line(margins)
    assert f"{1e3 * margins['delay']:.0f} ms of unmodelled delay" in line
    assert line.endswith("beyond the 20 ms predicted, and 20 ms less than these (at hover)")


def test_who_has_no_horizon_has_no_line():
    metadata = flown("vehicle=lei_li", "plant=blade_element", "controller=static_feedback")
    assert metadata["margins"] is None and margin_line(None) == world_note(None) == ""
    assert not any(line.startswith("loop") for line in flight_lines(metadata))
    assert margin_line({"delay": 0.0, "lag": 0.0}) == "hover is not stable, even without a delay"
    assert "over 500 ms of unmodelled lag" in margin_line({"delay": 0.1, "lag": 0.5, "early": 0.0, "dead_time": 0.0})


@pytest.mark.parametrize(("lag", "grid", "stable"), [(0.04, "precise", True), (0.2, "precise", False)])
def test_a_world_that_lags_more_than_the_loop_tolerates_is_noted(lag, grid, stable):
    world = ["vehicle=lei_li", "plant=blade_element", f"plant.motor_lag={lag}", f"horizon={grid}"]
    world.append("controller.allow_unstable=true")  # without it such a flight is refused
    margins = flown(*world, "controller=nominal_mpc")["margins"]
    assert margins["world_stable"] == stable == (lag < margins["lag"]) and bool(world_note(margins)) != stable
    if not stable:
        assert f"{1e3 * lag:.0f} ms of motor lag" in world_note(margins)


def test_a_lag_that_the_controller_knows_is_no_surprise():
    world = ["vehicle=lei_li", "plant=blade_element", "plant.motor_lag=0.2", "horizon=precise"]
    assert not world_note(flown(*world, "controller=nominal_mpc", "controller.motor_lag=0.2")["margins"])
