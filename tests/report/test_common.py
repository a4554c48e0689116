"""Which flights are compared: the rule itself, and that tables, statistics, comparison, page and figures follow it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from quadexp.log.store import write_table
from quadexp.parts.compose import expand
from quadexp.report.compare import compare
from quadexp.report.page import make_report
from quadexp.report.page.answer import answer
from quadexp.report.page.sections import numbers, scoreboard
from quadexp.report.page.source import read_comparison
from quadexp.report.pairing import Flights, common, flew_least, whole
from quadexp.report.result_rows import to_columns
from quadexp.report.statistics import compute_statistics, overall
from quadexp.report.tables import error_table
from quadexp.report.winner import verdicts
from quadexp.sweeps.figures import SweepFigures, path_grids
from quadexp.sweeps.sweep import run_sweep
from tests.report.results import speed_figure
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

    def test_table(self, outcome):
        rows = lost_gp(outcome)
        table = error_table(rows)
        assert {name: one.text() for name, one in table.flown.items()} == {
            "nominal_mpc": "20 of 20", "linear_drag_mpc": "20 of 20", "perfect_mpc": "20 of 20", "gp_mpc": "5 of 20",
        }  # fmt: skip
        for name in table.columns:
            entry = table.entries[table.rows[0], name]
            assert 1e3 * entry.common_mean == pytest.approx(mean(rows, name, range(5)))
            assert entry.common == 5 and not entry.best
            if name != "gp_mpc":
                assert 1e3 * entry.mean == pytest.approx(mean(rows, name, range(20))) and entry.n == 20
        text = table.markdown()
        assert "| flown |  | 20 of 20 | 20 of 20 | 20 of 20 | 5 of 20 |" in text and "**" not in text
        assert f"own {mean(rows, 'nominal_mpc', range(20)):.1f} of 20" in text
        assert r"flown &  & 20 of 20 & 20 of 20 & 20 of 20 & 5 of 20 \\" in table.latex()
        assert r"\textbf" not in table.latex()

    def test_statistics_and_overall(self, outcome):
        rows = lost_gp(outcome)
        for s in compute_statistics(rows, metrics=["mean_error"]):
            assert s.common == 5 and s.common_mean == pytest.approx(mean(rows, s.controller, range(5)) / 1e3)
            assert s.n == (5 if s.controller == "gp_mpc" else 20) and s.pairs == (5 if s.baseline else 0)
            assert s.success == pytest.approx(0.25 if s.controller == "gp_mpc" else 1.0) and not s.best
        linear = next(one for one in overall(rows) if one.controller == "linear_drag_mpc")
        assert linear.pairs == 5 and linear.own_pairs == 20 and linear.left_out == "15 not completed by all"
        assert "over all 20 that both completed: 50" in linear.text()
        (verdict,) = verdicts(rows)
        assert verdict.least == "gp_mpc" and not verdict.best and verdict.flew_less and verdict.common == 5

    def test_page(self, outcome, tmp_path):
        rows = lost_gp(outcome)
        record = {"metric": "mean_error", "grids": [], "conditions": [], "versions": {}, "provenance": {}}
        write_table(tmp_path / "results.parquet", to_columns(rows), record, "results")
        comparison = read_comparison(tmp_path)
        said = answer(comparison)
        assert said.flown == "Completed flights: perfect_mpc, linear_drag_mpc and nominal_mpc 20 of 20, gp_mpc 5 of 20."
        assert said.sentences[0].startswith(said.flown)
        assert "Least over the 5 flights that all completed, bounds aside: gp_mpc, but others completed" in said.gain
        assert "the best of" not in said.gain and not comparison.verdict.best
        first, *_, last = scoreboard(comparison).lines
        assert (last[0].text, last[1].lost) == ("gp_mpc", "5 of 20")
        assert first[2].small[0].endswith("of 20") and last[2].small == ("",)
        tables = [scoreboard(comparison), numbers(comparison).blocks[0].tables[0]]
        assert not any(cell.best for table in tables for line in table.lines for cell in line)

    def test_figure(self, outcome):
        rows = lost_gp(outcome)
        figure = speed_figure(rows)
        names = [text.get_text() for text in figure.axes[0].get_xticklabels()]
        means = [float(one.lines[0].get_ydata()[0]) for one in figure.axes[0].containers]
        drawn = dict(zip(names, means, strict=True))
        assert drawn == {
            label: pytest.approx(mean(rows, label, range(5)))
            for label in ("nominal_mpc", "linear_drag_mpc", "perfect_mpc", "gp_mpc")
        }
        assert [text.get_text() for text in figure.axes[0].texts] == ["5/20"]

    def test_compare(self, outcome, tmp_path):
        rows = lost_gp(outcome)
        for name, made in (("a", [r | {"outcome": "ok", "mean_error": 0.1} for r in rows]), ("b", rows)):
            write_table(tmp_path / name / "results.parquet", to_columns(made), {"metric": "mean_error"}, "results")
        report = compare(tmp_path / "a", tmp_path / "b")
        by_label = {one["label"]: one for one in report["metrics"]}
        assert by_label["gp_mpc"]["flown"] == {"a": [20, 20], "b": [5, 20]}
        for name, one in by_label.items():
            assert one["pairs"] == 5 and 1e3 * one["b"] == pytest.approx(mean(rows, name, range(5)))
        assert by_label["nominal_mpc"]["own"]["pairs"] == 20
        assert 1e3 * by_label["nominal_mpc"]["own"]["b"] == pytest.approx(mean(rows, "nominal_mpc", range(20)))
        assert any("nominal_mpc: over all 20 that it completed in both" in line for line in report["lines"])


def test_compare_says_not_distinguishable(tmp_path):
    rng = np.random.default_rng(4)
    for name in "ab":
        made = [row("gp_mpc", seed=s, error=float(0.1 * np.exp(0.3 * rng.normal()))) for s in range(8)]
        made += [
            row("rls_mpc", seed=s, error=(0.1 if name == "a" else 0.02) * (1 + 0.01 * s**2 * (name == "a")))
            for s in range(8)
        ]
        write_table(tmp_path / name / "results.parquet", to_columns(made), {"metric": "mean_error"}, "results")
    report = compare(tmp_path / "a", tmp_path / "b")
    assert [one["distinguishable"] for one in report["metrics"]] == [False, True]
    lines = {line.split()[0]: line for line in report["lines"] if line.startswith(("gp_mpc", "rls_mpc"))}
    assert lines["gp_mpc"].endswith("not distinguishable") and lines["rls_mpc"].endswith("smaller")


@pytest.fixture(scope="module")
def real(tmp_path_factory):
    """Real flights: at 10 m/s nominal MPC strays further than 0.4 m and is lost, perfect MPC is not."""
    root = tmp_path_factory.mktemp("real")
    asked = ["controller=nominal_mpc,perfect_mpc", "controller.nodes=8,12", "trajectory=circle", "seed=range(2)"]
    result = run_sweep(expand([*asked, "trajectory.speed=4,10", "trajectory.lost_distance=0.4"]), root, isolate=False)
    return root, result


def test_a_real_sweep_in_which_one_controller_is_lost_at_high_speed(real, tmp_path):
    root, result = real
    assert {(r["controller"], r["speed"]) for r in result.rows if r["outcome"] == "lost"} == {("nominal_mpc", 10.0)}
    assert {name: one.text() for name, one in result.table.flown.items()} == {
        "nominal_mpc": "4 of 8",
        "perfect_mpc": "8 of 8",
    }
    text = (root / "table.md").read_text()
    assert "| flown |  |  | 4 of 8 | 8 of 8 |" in text
    assert all(f"| circle | 10 | {nodes} | 2 lost |" in text for nodes in (8, 12))  # a row for each value of the key
    assert "**" not in text  # nominal_mpc flew least, the others are bounds
    made = make_report(root, tmp_path / "report.html")
    first = made["answer"][0]
    assert first.startswith("Completed flights: perfect_mpc nodes=12 and perfect_mpc nodes=8 4 of 4, nominal_mpc")
    assert "2 of 4. Mean error: " in first and "the best of" not in first
    with SweepFigures(root, None, "mean_error", 0.95) as figures:
        figures.begin(result.rows)
        files = figures.end()
    assert any("path_circle" in name for name in files)


def test_paths_of_a_real_sweep_say_who_is_missing(real):
    grid = path_grids(real[1].rows)["circle"]
    assert list(dict.fromkeys(condition for _, condition in grid.cells)) == ["4 m/s", "10 m/s"] and not grid.left_out
    names = {f"{name}_mpc nodes={n}" for name in ("nominal", "perfect") for n in (8, 12)}
    assert {name for name, _ in grid.cells} == names
    outcomes = {place: row["outcome"] for place, row in grid.cells.items()}
    lost = {place for place in outcomes if place[0].startswith("nominal") and place[1] == "10 m/s"}
    assert len(outcomes) == 8 and lost == {place for place, outcome in outcomes.items() if outcome == "lost"}


def test_paths_of_worlds_are_columns_and_the_fastest_of_each_is_drawn():
    asked = [(plant, speed) for plant in ("simplified", "simplified/wind=constant") for speed in (4.0, 8.0)]
    rows = [row("gp_mpc", plant=plant, speed=speed) for plant, speed in asked]
    grid = path_grids(rows)["circle"]
    assert [condition for _, condition in grid.cells] == ["8 m/s, simplified", "8 m/s, wind constant"]
    assert grid.left_out == ["4 m/s, simplified", "4 m/s, wind constant"]
    many = path_grids([row("gp_mpc", speed=speed) for speed in (2.0, 4.0, 6.0, 8.0)])["circle"]
    assert len(many.cells) == 3 and many.left_out == ["4 m/s"]
