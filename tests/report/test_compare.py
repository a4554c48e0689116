"""What differs between flights: found, counted, and said."""

import json
import math

import numpy as np
import pytest

from quadexp.errors import UsageError
from quadexp.experiment.build import build_vehicle
from quadexp.experiment.evaluate import describe, result_row
from quadexp.log.schema import Flight
from quadexp.log.store import write_flight, write_table
from quadexp.parts.compose import compose
from quadexp.report.compare import change, compare, differing
from quadexp.report.metrics import to_columns
from tests.log.flights import straight_flight
from tests.report.test_tables import row


def flight(path, *overrides, samples=5, edit=lambda flight: flight, **metadata):
    """A flight straight on at 0.1 m from its reference. edit: changes it before it is written."""
    config = compose(overrides)
    made = edit(straight_flight(samples, (0.1, 0.0, 0.0)))
    made.metadata.update(describe(config, build_vehicle(config.vehicle), None), **metadata)
    made.metadata["row"] = result_row(config, made)
    return write_flight(path, made)


class TestParts:
    def test_dotted_keys_with_both_values(self):
        a = {"x": {"y": 1, "z": [1, 2]}, "only": 3}
        b = {"x": {"y": 2, "z": [1, 2]}, "new": {"k": None}}
        assert differing(a, b) == {"x.y": [1, 2], "only": [3, "-"], "new.k": ["-", None]}

    def test_change(self):
        assert change(4.0, 5.0) == {"a": 4.0, "b": 5.0, "difference": 1.0, "relative": 25.0}
        assert change(0.0, 0.0)["relative"] == 0.0 and math.isnan(change(0.0, 1.0)["relative"])


class TestFlights:
    def test_solve_times_do_not_make_another_flight(self, tmp_path):
        def slower(made):
            made.columns["solve_time"] = made["solve_time"] * 3
            return made

        paths = flight(tmp_path / "a.parquet"), flight(tmp_path / "b.parquet", edit=slower)
        report = compare(*paths)
        assert report["configuration"] == {} and report["outcome"] == ["ok", "ok"] and report["paths"]["identical"]
        assert report["metrics"]["solve_time_median"]["relative"] == pytest.approx(200)

    def test_settings_outcome_numbers_and_paths(self, tmp_path):
        def higher(made):
            made.columns["p_z"] = made["p_z"] + [0.0, 0.0, 0.5, 0.0, 0.0]
            return made

        a = flight(tmp_path / "a.parquet", "trajectory.speed=4")
        b = flight(
            tmp_path / "b.parquet", "trajectory.speed=6", "plant.lift=0.2", edit=higher, outcome="lost", cause="far"
        )
        report = compare(a, b)
        assert report["configuration"] == {"plant.lift": [0.0, 0.2], "trajectory.speed": [4.0, 6.0]}
        assert report["outcome"] == ["ok", "lost"] and "outcome  ok -> lost (far)" in report["lines"]
        assert report["metrics"]["peak_speed"]["relative"] == 0.0
        assert [math.isnan(value) for value in report["metrics"]["mean_error"].values()] == [False, True, True, True]
        assert report["paths"]["distance"] == pytest.approx(0.5) and report["paths"]["t"] == pytest.approx(0.04)
        assert len(report["lines"]) < 40 and max(map(len, report["lines"])) < 160
        json.dumps({key: value for key, value in report.items() if key not in ("lines", "tables")})

    def test_flights_of_other_lengths_and_control_rates(self, tmp_path):
        """Every second sample of a flight, 2 cm beside it."""

        def every_second(made):
            slow = Flight({name: column[::2] for name, column in made.columns.items()}, made.metadata)
            slow.columns["p_y"] = slow["p_y"] + 0.02
            return slow

        a = flight(tmp_path / "a.parquet", samples=9)
        b = flight(tmp_path / "b.parquet", "controller.rate=25", samples=9, edit=every_second)
        for paths in ((a, b), (b, a)):
            found = compare(*paths)["paths"]
            assert found["common"] == 5 and found["distance"] == pytest.approx(0.02)
        assert "(5 common samples of 9 and 5)" in compare(a, b)["lines"][-1]

    def test_several_stand_side_by_side(self, tmp_path):
        paths = [flight(tmp_path / f"{v}.parquet", f"trajectory.speed={v}") for v in (4, 6, 8)]
        report = compare(*paths)
        assert report["configuration"] == {"trajectory.speed": [4.0, 6.0, 8.0]} and report["names"] == ["4", "6", "8"]
        for other, path in enumerate(paths[1:], 1):
            for name, two in compare(paths[0], path)["metrics"].items():
                assert [two["a"], two["b"]] == [report["metrics"][name][i] for i in (0, other)]


def test_what_cannot_be_compared_is_one_line(tmp_path):
    path = flight(tmp_path / "a.parquet")
    write_table(tmp_path / "r" / "results.parquet", to_columns([row()]), {}, "results")
    write_table(tmp_path / "d.parquet", {"t": np.zeros(2)}, {}, "residuals")
    write_flight(tmp_path / "recorded.parquet", straight_flight())
    (tmp_path / "empty").mkdir()
    for other, said in {
        "r": "holds results; flights are compared: fly both in one sweep",
        "d.parquet": "holds residuals; flights are compared",
        "nowhere": "no such file or folder",
        "empty": "neither a checkpoint",
        "recorded.parquet": "a flight without a result row",
    }.items():
        with pytest.raises(UsageError, match=said):
            compare(path, tmp_path / other)
