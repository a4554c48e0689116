"""Which flights are compared: the rule itself, and that tables, statistics, comparison, page and figures follow it."""

import math

import numpy as np
import pytest

from quadexp.log.store import write_table
from quadexp.plugins.page.compare import compare
from quadexp.plugins.page.document import cell_of
from quadexp.plugins.page.report.answer import answer
from quadexp.plugins.page.report.sections import numbers, scoreboard
from quadexp.plugins.page.report.source import read_comparison
from quadexp.plugins.page.sweep_figures import path_grids
from quadexp.report.metrics import to_columns
from quadexp.report.pairing import Flights, common, flew_least, whole
from quadexp.report.statistics import compute_statistics, overall
from quadexp.report.tables import cell_text, error_table
from tests.report.results import speed_figure, verdicts
from tests.report.test_tables import row

TIMES = {"solve_time_median": 3e-5, "solve_time_p99": 6e-5, "backend": "compiled"}


def at(seeds):
    """Who -> the flights of one condition."""
    return {who: {("x", int(seed)) for seed in own} for who, own in seeds.items()}


class TestRule:
    def test_flights_that_all_completed(self):
        assert common(at({"a": "123", "b": "234", "c": ""})) == (["a", "b"], frozenset({("x", 2), ("x", 3)}))
        assert common({"a": set(), "b": set()}) == ([], frozenset())

    def test_who_has_the_fewest_is_left_out_where_there_would_be_none(self):
        assert common(at({"a": "123", "b": "23", "c": "9"})) == (["a", "b"], frozenset({("x", 2), ("x", 3)}))
        assert common(at({"a": "12", "b": "34"})) == ([], frozenset())  # two that never met

    @pytest.mark.parametrize(
        ("seeds", "kept"),
        [
            ({"x": "0123", "y": "0123"}, {"x": "0123", "y": "0123"}),
            ({"x": "0123456789", "y": "01", "z": "0123456789"}, {"x": "0123456789", "z": "0123456789"}),
            ({"w": "012345", "x": "012345", "y": "01245", "z": "012345"}, dict.fromkeys("wxyz", "01245")),
            ({"x": "0123", "y": "5678", "z": "0123"}, {"x": "0123", "z": "0123"}),
            ({"x": "0", "y": "1"}, {"y": "1"}),
        ],
    )  # fmt: skip
    def test_whole(self, seeds, kept):
        def flights(by_condition):
            return {(condition, int(seed)) for condition, own in by_condition.items() for seed in own}

        assert whole(flights(seeds)) == flights(kept)

    def test_who_flew_least(self):
        flights = {"a": Flights(20, 20), "b": Flights(5, 20), "c": Flights(1, 4), "d": Flights(0, 0)}
        assert flew_least(flights) == {"b", "c"}
        assert flew_least({"a": Flights(3, 3), "b": Flights(5, 5)}) == frozenset()
        assert flights["b"].text() == "5 of 20" and math.isnan(flights["d"].share)


def lost_gp(outcome="lost"):
    """20 paths (seeds), the later the harder; gp_mpc flies only the five easiest, and those best."""
    rng = np.random.default_rng(1)
    path = 0.01 * (1 + np.arange(20.0)) * np.exp(0.02 * rng.normal(size=20))
    factors = {"nominal_mpc": 2.0, "linear_drag_mpc": 1.0, "perfect_mpc": 0.45, "gp_mpc": 0.5}
    made = []
    for name, factor in factors.items():
        for seed in range(20):
            gone = name == "gp_mpc" and seed >= 5
            error = math.nan if gone else float(factor * path[seed] * np.exp(0.01 * rng.normal()))
            made.append(row(name, seed=seed, error=error, trajectory="random") | TIMES)
            made[-1] |= {"key": f"{len(made):020x}", "outcome": outcome if gone else "ok"}
    return made


def mean(rows, name, seeds):
    return 1e3 * float(np.mean([r["mean_error"] for r in rows if r["controller"] == name and r["seed"] in seeds]))


@pytest.mark.parametrize("outcome", ["lost", "infeasible"])
class TestFifteenOfTwentyNotFlown:
    """The case of the complaint, whatever the flights that are missing are called."""

    def test_table_and_statistics(self, outcome):
        rows = lost_gp(outcome)
        table = error_table(rows)
        assert table.rows[0] == ["flown", "", "20 of 20", "20 of 20", "20 of 20", "5 of 20"]
        statistics = compute_statistics(rows, metrics=["mean_error"])
        assert table.rows[1][2:] == list(map(cell_text, statistics)) and "**" not in table.markdown()
        assert f"(all 20: {mean(rows, 'nominal_mpc', range(20)):.1f})" in table.rows[1][2]
        for s in statistics:
            flown = 5 if s.controller == "gp_mpc" else 20
            assert s.common == 5 and 1e3 * s.common_mean == pytest.approx(mean(rows, s.controller, range(5)))
            assert s.n == flown and 1e3 * s.mean == pytest.approx(mean(rows, s.controller, range(flown)))
            assert s.pairs == (flown if s.baseline else 0) and s.success == pytest.approx(flown / 20) and not s.best

    def test_overall(self, outcome):
        rows = lost_gp(outcome)
        linear = next(s for s in overall(rows) if s.controller == "linear_drag_mpc")
        assert linear.pairs == 20 and linear.left_out == "" and linear.significant
        (verdict,) = verdicts(rows)
        assert verdict.least == "gp_mpc" and not verdict.best and verdict.flew_less and verdict.common == 5

    def test_page(self, outcome, tmp_path):
        rows = lost_gp(outcome)
        record = {"metric": "mean_error", "grids": [], "conditions": [], "versions": {}, "provenance": {}}
        write_table(tmp_path / "results.parquet", to_columns(rows), record, "results")
        comparison = read_comparison(tmp_path)
        said = answer(comparison)
        assert said.flown == "Completed flights: perfect_mpc, linear_drag_mpc and nominal_mpc 20 of 20, gp_mpc 5 of 20."
        assert "Least over the 5 flights that all completed, oracles aside: gp_mpc, but others completed" in said.gain
        assert not comparison.verdict.best
        first, *_, last = scoreboard(comparison).rows
        assert (last[0].text, last[1].lost) == ("gp_mpc", "5 of 20")
        assert first[2].small[0].endswith("of 20") and last[2].small == ("",)
        tables = [scoreboard(comparison), numbers(comparison).blocks[0].tables["mean_error"]]
        assert not any(cell_of(cell).best for table in tables for row in table.rows for cell in row)

    def test_figure(self, outcome):
        rows = lost_gp(outcome)
        (panel,) = speed_figure(rows).axes
        names = [text.get_text() for text in panel.get_xticklabels()]
        means = [float(container.lines[0].get_ydata()[0]) for container in panel.containers]
        assert set(names) == {"nominal_mpc", "linear_drag_mpc", "perfect_mpc", "gp_mpc"}
        assert means == [pytest.approx(mean(rows, label, range(5))) for label in names]
        assert [text.get_text() for text in panel.texts] == ["5/20"]

    def test_compare(self, outcome, tmp_path):
        rows = lost_gp(outcome)
        for name, made in (("a", [r | {"outcome": "ok", "mean_error": 0.1} for r in rows]), ("b", rows)):
            write_table(tmp_path / name / "results.parquet", to_columns(made), {"metric": "mean_error"}, "results")
        metrics = {record["label"]: record for record in compare(tmp_path / "a", tmp_path / "b")["metrics"]}
        assert metrics["gp_mpc"]["flown"] == {"a": [20, 20], "b": [5, 20]}
        for name, record in metrics.items():
            flown = 5 if name == "gp_mpc" else 20
            assert record["pairs"] == flown and 1e3 * record["b"] == pytest.approx(mean(rows, name, range(flown)))


def test_compare_says_not_distinguishable(tmp_path):
    rng = np.random.default_rng(4)
    for name in "ab":
        scale = 0.1 if name == "a" else 0.02
        made = [row("gp_mpc", seed=s, error=float(0.1 * np.exp(0.3 * rng.normal()))) for s in range(8)]
        made += [row("rls_mpc", seed=s, error=scale * (1 + 0.01 * s**2 * (name == "a"))) for s in range(8)]
        write_table(tmp_path / name / "results.parquet", to_columns(made), {"metric": "mean_error"}, "results")
    report = compare(tmp_path / "a", tmp_path / "b")
    assert [record["distinguishable"] for record in report["metrics"]] == [False, True]
    lines = {line.split()[0]: line for line in report["lines"] if line.startswith(("gp_mpc", "rls_mpc"))}
    assert lines["gp_mpc"].endswith("not distinguishable") and lines["rls_mpc"].endswith("smaller")


def test_tracked_paths_say_who_is_missing():
    rows = [
        row(name, speed=speed, seed=seed, variant=f"controller.nodes={nodes}", key=f"{name}{nodes}{speed}{seed}")
        | {"outcome": "lost" if (name, speed) == ("nominal_mpc", 10.0) else "ok"}
        for name in ("nominal_mpc", "perfect_mpc")
        for nodes in (8, 12)
        for speed in (4.0, 10.0)
        for seed in (0, 1)
    ]
    grid = path_grids(rows)["circle"]
    assert list(dict.fromkeys(condition for _, condition in grid.cells)) == ["4 m/s", "10 m/s"] and not grid.left_out
    names = {f"{name}_mpc nodes={n}" for name in ("nominal", "perfect") for n in (8, 12)}
    assert {name for name, _ in grid.cells} == names and len(grid.cells) == 8
    lost = {place for place in grid.cells if place[0].startswith("nominal") and place[1] == "10 m/s"}
    assert lost == {place for place, drawn in grid.cells.items() if drawn["outcome"] == "lost"}


def test_paths_of_worlds_are_columns_and_the_fastest_of_each_is_drawn():
    asked = [(plant, speed) for plant in ("simplified", "simplified/wind=constant") for speed in (4.0, 8.0)]
    rows = [row("gp_mpc", plant=plant, speed=speed) for plant, speed in asked]
    grid = path_grids(rows)["circle"]
    assert [condition for _, condition in grid.cells] == ["8 m/s, simplified", "8 m/s, simplified/wind constant"]
    assert grid.left_out == ["4 m/s, simplified", "4 m/s, simplified/wind constant"]
    many = path_grids([row("gp_mpc", speed=speed) for speed in (2.0, 4.0, 6.0, 8.0)])["circle"]
    assert len(many.cells) == 3 and many.left_out == ["4 m/s"]
