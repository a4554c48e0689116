"""What differs between two flights, two results, two checkpoints: found, counted, and said."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from quadexp.errors import UsageError
from quadexp.experiment.build import build_vehicle
from quadexp.experiment.evaluate import describe, result_row
from quadexp.log.schema import Flight
from quadexp.log.store import write_flight, write_table
from quadexp.models.checkpoint import save_model
from quadexp.models.linear_drag import LinearDrag
from quadexp.parts.compose import compose, expand
from quadexp.report.compare import compare
from quadexp.report.compare_results import change, differing
from quadexp.report.result_rows import to_columns
from quadexp.sweeps.sweep import run_sweep
from tests.log.flights import straight_flight
from tests.report.test_tables import row
from tests.sweeps import cells


def flight(path, *overrides, offset=0.1, samples=5, **metadata):
    config = compose(overrides)
    made = straight_flight(samples, (offset, 0.0, 0.0))
    made.metadata.update(describe(config, build_vehicle(config.vehicle), None), **metadata)
    made.metadata["row"] = result_row(config, made)
    write_flight(path, made)
    return path


class TestParts:
    def test_dotted_keys_with_both_values(self):
        a = {"x": {"y": 1, "z": [1, 2]}, "only": 3}
        b = {"x": {"y": 2, "z": [1, 2]}, "new": {"k": None}}
        assert differing(a, b) == {"x.y": [1, 2], "only": [3, "-"], "new.k": ["-", None]}

    def test_change(self):
        assert change(4.0, 5.0) == {"a": 4.0, "b": 5.0, "difference": 1.0, "relative": 25.0}
        assert change(0.0, 0.0)["relative"] == 0.0 and math.isnan(change(0.0, 1.0)["relative"])
        assert math.isnan(change(None, 1.0)["difference"])


class TestFlights:
    def test_a_flight_and_itself(self, tmp_path):
        path = flight(tmp_path / "a.parquet")
        report = compare(path, path)
        assert report["configuration"] == {} and report["outcome"] == ["ok", "ok"] and report["paths"]["identical"]
        assert "configuration  the same" in report["lines"]
        assert any("all 5 are the same to the last bit" in line for line in report["lines"])

    def test_solve_times_do_not_make_another_flight(self, tmp_path):
        path, made = flight(tmp_path / "a.parquet"), straight_flight(5, (0.1, 0.0, 0.0))
        config = compose()
        made.columns["solve_time"] = made["solve_time"] * 3
        made.metadata.update(describe(config, build_vehicle(config.vehicle), None))
        made.metadata["row"] = result_row(config, made)
        write_flight(tmp_path / "b.parquet", made)
        report = compare(path, tmp_path / "b.parquet")
        assert report["paths"]["identical"] and report["metrics"]["solve_time_median"]["relative"] == pytest.approx(200)

    def test_settings_outcome_figures_and_paths(self, tmp_path):
        a = flight(tmp_path / "a.parquet", "trajectory.speed=4", offset=0.1)
        b = tmp_path / "b.parquet"
        config = compose(["trajectory.speed=6", "plant.lift=0.2"])
        made = straight_flight(5, (0.3, 0.0, 0.0))
        made.columns["p_z"] = made["p_z"] + [0.0, 0.0, 0.5, 0.0, 0.0]
        made.metadata.update(describe(config, build_vehicle(config.vehicle), None), outcome="lost", cause="too far")
        made.metadata["row"] = result_row(config, made)
        write_flight(b, made)
        report = compare(a, b)
        assert report["configuration"] == {"plant.lift": [0.0, 0.2], "trajectory.speed": [4.0, 6.0]}
        assert report["outcome"] == ["ok", "lost"]
        assert "outcome  ok -> lost (too far)" in report["lines"]
        assert report["metrics"]["peak_speed"]["relative"] == 0.0
        assert {key: math.isnan(value) for key, value in report["metrics"]["mean_error"].items()} == {
            "a": False, "b": True, "difference": True, "relative": True,
        }  # fmt: skip
        assert report["paths"]["distance"] == pytest.approx(0.5) and report["paths"]["t"] == pytest.approx(0.04)
        assert len(report["lines"]) < 40 and max(map(len, report["lines"])) < 160

    def test_flights_of_different_length(self, tmp_path):
        paths = flight(tmp_path / "a.parquet"), flight(tmp_path / "b.parquet", samples=8)
        assert "(5 common samples of 5 and 8)" in compare(*paths)["lines"][-1]

    def test_flights_with_other_control_rates(self, tmp_path):
        """Every second sample of a flight, 2 cm beside it."""
        fast, slow = flight(tmp_path / "a.parquet", samples=9), straight_flight(9)
        config = compose(["controller.rate=25"])
        slow = Flight({name: column[::2] for name, column in slow.columns.items()}, slow.metadata)
        slow.columns["p_y"] = slow["p_y"] + 0.02
        slow.metadata.update(describe(config, build_vehicle(config.vehicle), None))
        slow.metadata["row"] = result_row(config, slow)
        write_flight(tmp_path / "b.parquet", slow)
        for paths in ((fast, tmp_path / "b.parquet"), (tmp_path / "b.parquet", fast)):
            found = compare(*paths)["paths"]
            assert found["common"] == 5 and found["distance"] == pytest.approx(0.02)

    def test_a_recorded_flight_has_nothing_to_compare(self, tmp_path):
        write_flight(tmp_path / "a.parquet", straight_flight())
        with pytest.raises(UsageError, match="a flight without a result row"):
            compare(tmp_path / "a.parquet", tmp_path / "a.parquet")


class TestKinds:
    def test_two_kinds_and_what_cannot_be_compared(self, tmp_path):
        path = flight(tmp_path / "a.parquet")
        columns = to_columns([row()])
        write_table(tmp_path / "r" / "results.parquet", columns, {}, "results")
        with pytest.raises(
            UsageError, match=r"cannot compare a flight \(.*\) with results \(.*\): give two of one kind"
        ):
            compare(path, tmp_path / "r")
        write_table(tmp_path / "d.parquet", {"t": np.zeros(2)}, {}, "residuals")
        with pytest.raises(UsageError, match="holds residuals; flights, results and checkpoints can be compared"):
            compare(path, tmp_path / "d.parquet")
        with pytest.raises(UsageError, match="no such file or folder"):
            compare(path, tmp_path / "nowhere")
        (tmp_path / "empty").mkdir()
        with pytest.raises(UsageError, match="neither a checkpoint"):
            compare(tmp_path / "empty", path)


class TestResults:
    @staticmethod
    def sweep(folder, *overrides):
        """Flights whose error is 10 mm times the seed (tests/sweeps/cells.py)."""
        run_sweep(expand(list(overrides)), folder, function=cells.quick_cell, isolate=False)
        return folder

    @staticmethod
    def table(folder, rows):
        write_table(folder / "results.parquet", to_columns(rows), {"metric": "mean_error"}, "results")
        return folder

    def test_the_same_sweep_twice(self, tmp_path):
        grid = ("controller=nominal_mpc,perfect_mpc", "seed=range(1,4)")
        report = compare(self.sweep(tmp_path / "a", *grid), self.sweep(tmp_path / "b", *grid))
        assert report["pairs"] == report["identical"] == 6 and report["configuration"] == {}
        assert report["outcome"] == {"ok -> ok": 6} and report["only"] == {"a": {}, "b": {}}
        assert [one["ratio"] for one in report["metrics"]] == [0.0, 0.0]
        assert "same     6 of 6 pairs are the same to the last bit, measured times apart" in report["lines"]

    def test_what_differs_in_configuration_is_read_from_the_cells(self, tmp_path):
        a = self.sweep(tmp_path / "a", "controller=nominal_mpc", "seed=range(1,4)")
        b = self.sweep(tmp_path / "b", "controller=nominal_mpc,perfect_mpc", "controller.nodes=20", "seed=range(2,4)")
        report = compare(a, b)
        assert report["configuration"] == {"controller.nodes": [10, 20]}
        assert report["pairs"] == 2 and report["only"] == {"a": {"nominal_mpc": 1}, "b": {"perfect_mpc": 2}}

    def test_without_the_cells_the_configuration_is_not_compared_and_that_is_said(self, tmp_path):
        a, b = (self.table(tmp_path / name, [row(seed=0), row(seed=1)]) for name in "ab")
        lines = compare(a, b)["lines"]
        assert "configuration  not compared: the cells are not beside both tables" in lines

    def test_the_change_with_its_interval_by_hand(self, tmp_path):
        a = self.table(tmp_path / "a", [row(seed=s, error=e) for s, e in enumerate((0.1, 0.2, 0.4))])
        b = self.table(tmp_path / "b", [row(seed=s, error=e) for s, e in enumerate((0.11, 0.24, 0.40))])
        (one,) = compare(a, b)["metrics"]
        assert (one["a"], one["b"], one["pairs"]) == (pytest.approx(0.7 / 3), pytest.approx(0.75 / 3), 3)
        logs = np.log([1.1, 1.2, 1.0])
        half = 4.302653 * logs.std(ddof=1) / math.sqrt(3)
        assert one["ratio"] == pytest.approx(100 * math.expm1(logs.mean()))
        assert one["ratio_low"] == pytest.approx(100 * math.expm1(logs.mean() - half), rel=1e-5)
        assert one["ratio_high"] == pytest.approx(100 * math.expm1(logs.mean() + half), rel=1e-5)

    def test_lost_flights_are_left_out_by_name_and_in_the_outcome(self, tmp_path):
        a = self.table(tmp_path / "a", [row(seed=0), row(seed=1, outcome="lost", error=math.nan), row(seed=2)])
        b = self.table(tmp_path / "b", [row(seed=0), row(seed=1), row(seed=2, outcome="failed", error=math.nan)])
        report = compare(a, b)
        assert report["outcome"] == {"ok -> ok": 1, "lost -> ok": 1, "ok -> failed": 1}
        assert report["metrics"][0]["pairs"] == 1
        assert "  nominal_mpc: left out 1 lost in a, 1 failed" in report["lines"]

    def test_checkpoints_of_other_names_are_paired_where_there_is_no_doubt(self, tmp_path):
        a = self.table(tmp_path / "a", [row("gp_mpc", model="models/gp")])
        b = self.table(tmp_path / "b", [row("gp_mpc", model="models/gp40", error=0.12)])
        assert compare(a, b)["metrics"][0]["relative"] == pytest.approx(-50)
        b = self.table(tmp_path / "c", [row("gp_mpc", model=f"models/{name}") for name in ("gp", "gp40")])
        report = compare(a, b)
        assert report["pairs"] == 1 and report["only"]["b"] == {"gp_mpc gp40": 1}

    def test_nothing_in_common(self, tmp_path):
        a, b = self.table(tmp_path / "a", [row()]), self.table(tmp_path / "b", [row(speed=4.0)])
        assert compare(a, b)["lines"][-1] == "no cell is in both: nothing to compare"

    def test_the_largest_changes_come_first(self, tmp_path):
        speeds = (4.0, 8.0, 12.0)
        a = self.table(tmp_path / "a", [row(speed=v, error=0.1) for v in speeds])
        b = self.table(tmp_path / "b", [row(speed=v, error=e) for v, e in zip(speeds, (0.11, 0.3, 0.1), strict=True)])
        assert compare(a, b)["lines"][-2:] == [
            "  nominal_mpc on circle 8 m/s: 100.0 -> 300.0 mm (+200 %)",
            "  nominal_mpc on circle 4 m/s: 100.0 -> 110.0 mm (+10 %)",
        ]


class TestCheckpoints:
    def test_parameters_and_held_out_errors(self, tmp_path):
        vehicle = {"name": "torrente", "fingerprint": "abc"}
        for name, drag, rmse in (("a", 0.5, 0.8), ("b", 0.6, 0.4)):
            nothing = dict.fromkeys(
                ("intercept", "drag_error", "intercept_error", "residual_std", "r_squared"), np.zeros(3)
            )
            scalars = {"thrust_gain": 0.0, "thrust_gain_error": 0.0, "n": 10}
            about = {"vehicle": vehicle, "dataset": {"rows": 10, "sha256": name}}
            model = LinearDrag(drag=np.array([drag, 0.5, 0.1]), **nothing, **scalars, **about)
            report = {"rows": [{"output": "a_x", "predictor": "linear_drag", "rmse": rmse}]}
            save_model(tmp_path / name, model, report=report)
        report = compare(tmp_path / "a", tmp_path / "b")
        assert report["configuration"] == {"dataset.sha256": ["a", "b"]}
        assert report["metrics"]["drag_x (1/s)"]["relative"] == pytest.approx(20)
        assert report["metrics"]["drag_y (1/s)"]["relative"] == 0
        assert report["metrics"]["held-out RMSE of a_x by linear_drag (m/s^2)"]["relative"] == pytest.approx(-50)


def test_everything_but_the_lines_is_json(tmp_path):
    a, b = flight(tmp_path / "a.parquet"), flight(tmp_path / "b.parquet", "trajectory.speed=6")
    report = compare(a, b)
    json.dumps({key: value for key, value in report.items() if key != "lines"})


def test_several_are_compared_with_the_first(tmp_path):
    paths = [flight(tmp_path / f"{v}.parquet", f"trajectory.speed={v}") for v in (4, 6, 8)]
    report = compare(*paths)
    assert [one["b"] for one in report["comparisons"]] == [str(path) for path in paths[1:]]
    for one, path in zip(report["comparisons"], paths[1:], strict=True):
        alone = compare(paths[0], path)
        assert repr(one) == repr({key: value for key, value in alone.items() if key != "lines"})
        assert "\n".join(alone["lines"]) in "\n".join(report["lines"])
    with pytest.raises(UsageError, match="cannot compare"):
        write_table(tmp_path / "r" / "results.parquet", to_columns([row()]), {}, "results")
        compare(*paths, tmp_path / "r")
