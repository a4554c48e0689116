"""Delay remedies in flight, the margins of the loop around which they are put, and what is said of these."""

import numpy as np
import pytest

from quadexp.errors import UsageError
from quadexp.experiment.evaluate import InfeasibleError, fly_one
from quadexp.parts.compose import compose
from quadexp.report.page.sections import margins as margins_of
from quadexp.report.summary import flight_lines, margin_line, world_note

WORLD = ["controller=perfect_mpc", "trajectory=lemniscate", "trajectory.speed=6", "seed=1", "horizon=robust"]
FAST = ["controller.backend=interpreted"]


def error(*overrides) -> float:
    """Mean distance from the reference, mm."""
    flight = fly_one(compose([*WORLD, *FAST, *overrides]))
    assert flight.metadata["outcome"] == "ok"
    away = [flight.columns[f"p_{axis}"] - flight.columns[f"ref_p_{axis}"] for axis in "xyz"]
    return 1e3 * float(np.linalg.norm(away, axis=0).mean())


def test_what_a_late_state_costs_and_what_the_remedies_leave_of_it(delay=0.033):
    """With exact readings the delayed flight is the prompt one, to the error of the integration."""
    late = ["estimator=late", f"estimator.delay={delay}", f"delay.time={delay}"]
    prompt, none = error(), error(*late[:2])
    strapdown = error(*late, "estimator.gyro=fresh", "delay=strapdown")
    prediction = error(*late, "delay=prediction")
    assert none > 20 + prompt and strapdown < prompt + 0.3 and prediction < prompt + 0.5


@pytest.mark.parametrize("remedy", ["strapdown", "prediction"])
@pytest.mark.parametrize("share", [0.8, 1.2])
def test_a_delay_that_is_wrong_by_a_fifth_does_not_destabilise(remedy, share):
    """50 ms, horizon=robust: the loop has a margin for the wrong part, at hover and in flight."""
    late = ["estimator=late", "estimator.delay=0.05", "estimator.gyro=fresh", f"delay={remedy}"]
    flight = fly_one(compose([*WORLD, *FAST, *late, f"delay.time={0.05 * share}"]))
    away = np.linalg.norm([flight.columns[f"p_{axis}"] - flight.columns[f"ref_p_{axis}"] for axis in "xyz"], axis=0)
    assert flight.metadata["outcome"] == "ok" and flight.metadata["margins"]["world_stable"]
    assert away.mean() < 1.2 * 6 * 0.05 * 0.2  # speed times what is wrong of the delay
    assert abs(flight.metadata["margins"]["age"] - 0.05 * share) < 1e-12


def test_command_delay_and_age_are_predicted_apart():
    """Told together as dead time, the reference would be that of a wrong time: speed times age of error."""
    world = ["link=latency", "estimator=late"]
    apart = error(*world, "controller.dead_time=0.01", "delay=prediction", "delay.time=0.01")
    together = error(*world, "controller.dead_time=0.02")
    assert apart < 1 and together > 15


def test_the_margins_count_what_a_remedy_predicts():
    """A short first node and 50 ms: refused without a remedy, flown with one, and the record says what it is."""
    world = [*FAST, "controller=nominal_mpc", "trajectory=hover", "trajectory.duration=0.5", "horizon=precise"]
    world += ["estimator=late", "estimator.delay=0.05"]
    with pytest.raises(InfeasibleError, match=r"commands and measurements that are late by 50 ms"):
        fly_one(compose(world))
    margins = fly_one(compose([*world, "delay=prediction", "delay.time=0.05"])).metadata["margins"]
    assert margins["world_stable"] and margins["age"] == 0.05 and margins["dead_time"] == 0.0
    assert "beyond the 50 ms predicted (at hover)" in margin_line(margins) and not world_note(margins)
    with pytest.raises(InfeasibleError, match=r"beyond the 20 ms of delay that it predicts"):
        fly_one(compose([*world, "delay=prediction", "delay.time=0.02"]))


def test_an_observer_is_named_as_not_in_the_margins():
    world = [*FAST, "controller=nominal_mpc", "trajectory=hover", "trajectory.duration=0.5", "observer=disturbance"]
    margins = fly_one(compose(world)).metadata["margins"]
    assert margins["without"] == ["observer"] and "without observer" in margin_line(margins)
    assert margin_line(margins).startswith("the bare MPC tolerates ")


def test_the_name_of_the_remedy_stands_in_the_row():
    from quadexp.parts.schema import controller_name

    assert controller_name(compose(["delay=strapdown"])) == "nominal_mpc+strapdown"
    with pytest.raises(UsageError, match=r"delay.time=0.7: must be in \[0, 0.5\] s"):
        compose(["delay=strapdown", "delay.time=0.7"])


def mean_error(*overrides) -> float:
    """Mean distance over two seeds and two paths at 8 m/s in world=everything, mm; no flight is lost."""
    errors = []
    for path in ("circle", "lemniscate"):
        for seed in (11, 12):
            given = ["controller=perfect_mpc", f"trajectory={path}", "trajectory.speed=8", f"seed={seed}"]
            given += ["world=everything", "sensor.accelerometer_noise=[0.05,0.05,0.05]", *overrides]
            flight = fly_one(compose(given))
            assert flight.metadata["outcome"] == "ok"
            away = [flight.columns[f"p_{axis}"] - flight.columns[f"ref_p_{axis}"] for axis in "xyz"]
            errors.append(1e3 * float(np.linalg.norm(away, axis=0).mean()))
    return float(np.mean(errors))


@pytest.mark.slow
def test_everything_at_once():
    """Delays known, believed half as long, and unknown, as docs/delays.md has them, on seeds of which nobody knew."""
    half = ["controller.dead_time=0.005", "controller.motor_lag=0.015", "delay.time=0.005"]
    assert mean_error("remedies=all") < 17
    assert mean_error("remedies=all", *half) < 30
    assert mean_error("remedies=unknown_delays") < 50


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
