"""What a flight's record, its summary and the report say of the delays that the loop tolerates."""

from __future__ import annotations

import numpy as np
import pytest

from quadexp.experiment.evaluate import InfeasibleError, build_loop, fly_one
from quadexp.log.store import write_flight
from quadexp.parts.compose import compose
from quadexp.plugins.margins import loop_margins
from quadexp.plugins.margins.loop_margins import margins
from quadexp.plugins.margins.requests import margins as along_path
from quadexp.plugins.margins.texts import margin_line, world_note
from quadexp.report.summary import flight_lines

HOVER = ["trajectory=hover", "trajectory.duration=0.2"]


def flown(*overrides: str) -> dict:
    return fly_one(compose([*HOVER, *overrides])).metadata


@pytest.mark.parametrize(
    ("controller", "line"),
    [
        (
            "controller=nominal_mpc horizon=published",
            "tolerates 67 ms more of delay, 92 ms more of motor lag (at hover)",
        ),
        ("controller=nominal_mpc horizon=precise", "tolerates 18 ms more of delay, 51 ms more of motor lag (at hover)"),
        ("controller=geometric", "tolerates 47 ms more of delay, 86 ms more of motor lag (at hover)"),
    ],
)
def test_a_flight_says_what_its_loop_tolerates(controller, line):
    metadata = flown(*controller.split())
    assert f"loop        {line}" in flight_lines(metadata) and not world_note(metadata["margins"])
    assert margin_line(metadata["margins"]) == line


@pytest.mark.parametrize("controller", ["nominal_mpc", "geometric"])
def test_what_only_watches_is_not_linearised(monkeypatch, controller):
    """Of remedies=auto the sums over all hypotheses, some 10,000 numbers, lead to no command but by decisions. Of the
    loop whose margins a flight has."""
    found = []
    monkeypatch.setattr(loop_margins, "margins", lambda loop: found.append(loop) or margins(loop))
    flight = build_loop(compose([f"controller={controller}", "controller.rate=90", *HOVER, "remedies=auto"]), None)
    assert len(found[0].phases[0].A) < 500 and flight.margins["delay"] > 0


def test_a_predicted_dead_time_that_is_there_is_no_surprise():
    """10 ms more than 20 ms that are predicted leave as much as 10 ms more than none: Smith's predictor."""
    world = ["controller=nominal_mpc", "horizon=robust", "plant=ideal"]
    prompt, late = (
        flown(*world, *more)["margins"]
        for more in ((), ("controller.dead_time=0.02", "link=latency", "link.latency=0.02"))
    )
    assert 0.03 < late["delay"] < prompt["delay"]


@pytest.mark.parametrize("lost", [["link=latency", "link.latency=0.02", "link.drop"], ["sensor.pose_drop"]])
def test_losses_are_left_out_of_margins(lost):
    """With more than half lost, the loop was taken for one that nothing ever reaches: it tolerated everything."""
    few, many = (flown("controller=nominal_mpc", *lost[:-1], f"{lost[-1]}={drop}")["margins"] for drop in (0.1, 0.6))
    assert many == few and 0 < many["delay"] < 0.1


def test_who_keeps_its_memory_to_itself_says_so(tmp_path):
    margins = {"unknown": "Mine steps in Python"}
    assert margin_line(margins) == "what it tolerates is not known: Mine steps in Python"
    assert margin_line(None) == world_note({}) == world_note(margins) == ""
    assert margin_line({"growth": 3.0, "delay": 0.0, "lag": 0.0}) == "is not stable at hover"
    assert "over 500 ms more of motor lag" in margin_line({"growth": -1.0, "delay": 0.1, "lag": 0.5})


@pytest.mark.parametrize("late", [["link=latency", "link.latency=0.1"], ["estimator.delay=0.1"]])
@pytest.mark.parametrize("controller", ["nominal_mpc", "geometric"])
def test_what_is_not_stable_is_refused_and_flown_where_it_is_allowed(controller, late):
    world = [f"controller={controller}", *late]
    with pytest.raises(InfeasibleError, match=r"late by 100 ms; this loop is not stable at hover") as refused:
        flown(*world)
    assert ("timing.dead_time=0.1" in str(refused.value)) == (controller == "nominal_mpc")
    margins = flown(*world, "controller.allow_unstable=true")["margins"]
    assert margins["delay"] == 0 and f"doubles every {np.log(2) / margins['growth']:.2g} s" in world_note(margins)


def test_the_hash_of_a_law_does_not_know_of_what_is_as_usual():
    def recorded(*words):
        return compose([*HOVER, *words]).controller.recorded()

    assert "allow_unstable" not in recorded("controller=geometric") | recorded("controller=raptor")
    assert recorded("controller=geometric", "controller.allow_unstable=true")["allow_unstable"]
    assert recorded("controller=nominal_mpc")["allow_unstable"] is False


@pytest.mark.parametrize("remedies", ["none", "auto"])
def test_margins_along_a_path_begin_with_those_at_hover(tmp_path, remedies):
    """At rest at the beginning; of a flight's file as of its settings. With auto these were of its first instants."""
    loop = ["controller=geometric", "world=only_latency", f"remedies={remedies}"]
    words = [*loop, "trajectory=circle", "trajectory.speed=6"]
    rows = along_path(words)
    known = flown(*loop)["margins"]
    assert len(rows) == 9 and rows[0]["speed"] < 0.1 and max(row["speed"] for row in rows) > 5
    assert rows[0]["delay"] == pytest.approx(known["delay"], rel=0.02)
    write_flight(tmp_path / "flight.parquet", fly_one(compose(words)))
    assert along_path([str(tmp_path / "flight.parquet")]) == rows


@pytest.mark.parametrize(("lag", "grid", "stable"), [(0.04, "precise", True), (0.2, "precise", False)])
def test_a_world_that_lags_more_than_the_loop_tolerates_is_noted(lag, grid, stable):
    world = ["vehicle=lei_li", "plant=blade_element", f"plant.motor_lag={lag}", f"horizon={grid}"]
    world.append("controller.allow_unstable=true")  # without it such a flight is refused
    margins = flown(*world, "controller=nominal_mpc")["margins"]
    assert (margins["delay"] > 0) == stable and bool(world_note(margins)) != stable


def test_a_lag_that_the_controller_knows_is_no_surprise():
    world = ["vehicle=lei_li", "plant=blade_element", "plant.motor_lag=0.2", "horizon=precise"]
    assert not world_note(flown(*world, "controller=nominal_mpc", "controller.motor_lag=0.2")["margins"])


def test_a_loop_that_finds_delays_in_flight_is_judged_as_it_flies_then():
    """A state 50 ms late, which is found within a second, was refused as not stable at hover; and the margin that was
    said was that of the softest grid, 40 ms, where the stiffest flies."""
    late = ["controller=perfect_mpc", *HOVER, "remedies=auto", "estimator=late"]
    assert 0.005 < build_loop(compose([*late, "estimator.delay=0.05"]), None).margins["delay"] < 0.02
    with pytest.raises(InfeasibleError, match="not stable at hover"):  # later than what is looked for
        build_loop(compose([*late, "estimator.delay=0.2"]), None)
    loop = build_loop(compose(["controller=perfect_mpc", *HOVER, "remedies=auto"]), None)
    assert 0.008 < loop.margins["delay"] < 0.02 and loop.controller.log()["auto_grid"] == 0
