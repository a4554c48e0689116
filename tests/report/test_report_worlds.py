"""`quadexp show` names the world that a flight flew in."""

from __future__ import annotations

import pytest

from quadexp.log.schema import Flight
from quadexp.log.store import write_flight
from quadexp.report.summary import summarise
from tests.log.flights import straight_flight


@pytest.mark.parametrize(
    ("world", "config", "line"),
    [
        ("clean", {"sensor": {"name": "perfect"}}, "world       clean"),
        ("wind=dryden", {"wind": {"name": "dryden"}, "sensor": {"name": "perfect"}}, "world       wind=dryden"),
        (
            "race",
            {"link": {"name": "onboard"}, "estimator": {"name": "late_noisy"}, "sensor": {"name": "perfect"}},
            "world       race: link=onboard, estimator=late_noisy",
        ),
        (None, {}, None),
    ],
)
def test_show_names_the_world_and_its_parts(tmp_path, world, config, line):
    flight = straight_flight(5)
    row = dict.fromkeys(("mean_error", "rmse", "max_error", "attitude_rmse", "duration", "peak_speed"), 0.0)
    row |= {f"solve_time_{name}": 0.0 for name in ("median", "p99", "max")} | {"saturated_share": 0.0, "seed": 0}
    row |= {"controller": "c", "trajectory": "circle", "speed": 8.0, "plant": "p", "outcome": "ok", "backend": "b"}
    metadata = {"row": row | {"model": ""}, "config": config} | ({"world": world} if world else {})
    made = summarise(write_flight(tmp_path / "a.parquet", Flight(flight.columns, metadata)))
    found = [one for one in made["lines"] if one.startswith("world ")]
    assert found == ([line] if line else [])
    assert made["world"]["name"] == world
