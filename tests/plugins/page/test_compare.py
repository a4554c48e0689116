"""What differs between two flights, two results, two checkpoints: found, counted, and said."""

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
from quadexp.plugins.page.compare import change, compare, differing
from quadexp.report.metrics import to_columns
from quadexp.sweeps.sweep import SweepRequest, run_sweep
from tests.log.flights import straight_flight
from tests.report.test_tables import row
from tests.sweeps import cells


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
        with pytest.raises(UsageError, match="cannot compare"):
            write_table(tmp_path / "r" / "results.parquet", to_columns([row()]), {}, "results")
            compare(*paths, tmp_path / "r")


def test_what_cannot_be_compared_is_one_line(tmp_path):
    path = flight(tmp_path / "a.parquet")
    write_table(tmp_path / "r" / "results.parquet", to_columns([row()]), {}, "results")
    write_table(tmp_path / "d.parquet", {"t": np.zeros(2)}, {}, "residuals")
    write_flight(tmp_path / "recorded.parquet", straight_flight())
    (tmp_path / "empty").mkdir()
    for other, said in {
        "r": r"cannot compare a flight \(.*\) with results \(.*\): give two of one kind",
        "d.parquet": "holds residuals; flights, results and checkpoints can be compared",
        "nowhere": "no such file or folder",
        "empty": "neither a checkpoint",
        "recorded.parquet": "a flight without a result row",
    }.items():
        with pytest.raises(UsageError, match=said):
            compare(path, tmp_path / other)


class TestResults:
    @staticmethod
    def sweep(folder, *overrides):
        """Flights whose error is 10 mm times the seed (tests/sweeps/cells.py)."""
        run_sweep(expand(list(overrides)), folder, SweepRequest(function=cells.quick_cell, isolate=False))
        return folder

    @staticmethod
    def compared(folder, *rows):
        """Two tables without their cells."""
        paths = [folder / name / "results.parquet" for name in "ab"]
        for path, own in zip(paths, rows, strict=True):
            write_table(path, to_columns(own), {"metric": "mean_error"}, "results")
        return compare(*(path.parent for path in paths))

    def test_what_differs_in_configuration_is_read_from_the_cells(self, tmp_path):
        a = self.sweep(tmp_path / "a", "controller=nominal_mpc", "seed=range(1,4)")
        same = compare(a, self.sweep(tmp_path / "again", "controller=nominal_mpc", "seed=range(1,4)"))
        assert same["pairs"] == same["identical"] == 3 and same["configuration"] == {}
        assert same["outcome"] == {"ok -> ok": 3} and same["only"] == {"a": {}, "b": {}}
        assert [record["ratio"] for record in same["metrics"]] == [0.0]
        b = self.sweep(tmp_path / "b", "controller=nominal_mpc,perfect_mpc", "controller.nodes=20", "seed=range(2,4)")
        report = compare(a, b)
        assert report["configuration"] == {"controller.nodes": [10, 20]}
        assert report["pairs"] == 2 and report["only"] == {"a": {"nominal_mpc": 1}, "b": {"perfect_mpc": 2}}

    def test_a_contestant_whose_settings_contradict_each_other(self, tmp_path):
        """Its traceback was shown in place of the others."""
        rows = [row(seed=s, error=0.1) for s in range(3)] + [row("other", outcome="invalid", error=math.nan)]
        report = self.compared(tmp_path, rows, rows)
        assert [record["pairs"] for record in report["metrics"]] == [3]
        assert report["outcome"] == {"ok -> ok": 3, "invalid -> invalid": 1}

    def test_the_change_with_its_interval_by_hand(self, tmp_path):
        a, b = ([row(seed=s, error=e) for s, e in enumerate(own)] for own in ((0.1, 0.2, 0.4), (0.11, 0.24, 0.40)))
        report = self.compared(tmp_path, a, b)
        (record,) = report["metrics"]
        assert (record["a"], record["b"], record["pairs"]) == (pytest.approx(0.7 / 3), pytest.approx(0.75 / 3), 3)
        logs = np.log([1.1, 1.2, 1.0])
        half = 4.302653 * logs.std(ddof=1) / math.sqrt(3)
        for name, log in (("ratio", 0), ("ratio_low", -half), ("ratio_high", half)):
            assert record[name] == pytest.approx(100 * math.expm1(logs.mean() + log), rel=1e-5)
        assert "configuration  not compared: the cells are not beside both tables" in report["lines"]

    def test_lost_flights_are_left_out_by_name_and_in_the_outcome(self, tmp_path):
        a = [row(seed=0), row(seed=1, outcome="lost", error=math.nan), row(seed=2)]
        b = [row(seed=0), row(seed=1), row(seed=2, outcome="failed", error=math.nan)]
        report = self.compared(tmp_path, a, b)
        assert report["outcome"] == {"ok -> ok": 1, "lost -> ok": 1, "ok -> failed": 1}
        assert report["metrics"][0]["pairs"] == 1
        assert "  nominal_mpc: left out 1 lost in a, 1 failed" in report["lines"]

    def test_checkpoints_of_other_names_are_paired_where_there_is_no_doubt(self, tmp_path):
        a = [row("gp_mpc", model="models/gp")]
        report = self.compared(tmp_path, a, [row("gp_mpc", model="models/gp40", error=0.12)])
        assert report["metrics"][0]["relative"] == pytest.approx(-50)
        report = self.compared(tmp_path / "c", a, [row("gp_mpc", model=f"models/{name}") for name in ("gp", "gp40")])
        assert report["pairs"] == 1 and report["only"]["b"] == {"gp_mpc gp40": 1}

    def test_nothing_in_common(self, tmp_path):
        report = self.compared(tmp_path, [row()], [row(speed=4.0)])
        assert report["pairs"] == 0 and report["lines"][-1] == "no cell is in both: nothing to compare"


def test_checkpoints_differ_in_parameters_and_held_out_errors(tmp_path):
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
