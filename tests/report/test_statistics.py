"""Statistics of result rows against numbers worked by hand: who is compared with whom, and what is left out."""

import csv
import math

import numpy as np
import pyarrow.parquet as pq
import pytest

from quadexp.log.store import read_metadata, read_table
from quadexp.report import inference
from quadexp.report.pairing import condition_of, contestant_of
from quadexp.report.statistics import DESCRIBED, compared, compute_statistics, overall, results_statistics
from quadexp.report.tables import comparison_texts, write_comparison
from tests.report.test_tables import row


def only(statistics, label, **wanted):
    (found,) = [s for s in statistics if s.label == label and all(getattr(s, k) == v for k, v in wanted.items())]
    return found


def errors(controller, values, **more):
    """One row a seed; a word is an outcome."""
    return [
        row(controller, seed=seed, error=math.nan if isinstance(value, str) else value, **more)
        | ({"outcome": value} if isinstance(value, str) else {})
        for seed, value in enumerate(values)
    ]


class TestOneCondition:
    def test_mean_difference_and_reduction_by_hand(self):
        rows = errors("nominal_mpc", [0.2, 0.3, 0.4]) + errors("gp_mpc", [0.05, 0.06, 0.10])
        gp = only(compute_statistics(rows, metrics=["mean_error"]), "gp_mpc")
        assert (gp.n, gp.seeds, gp.pairs, gp.baseline, gp.left_out) == (3, 3, 3, "nominal_mpc", "")
        assert gp.mean == pytest.approx(0.07) and gp.baseline_mean == pytest.approx(0.3) and gp.unit == "m"
        assert gp.difference == pytest.approx(-0.23)  # -0.15, -0.24, -0.30
        assert gp.reduction == pytest.approx(100 * (1 - 0.07 / 0.3))
        spread = math.sqrt(((-0.15 + 0.23) ** 2 + (-0.24 + 0.23) ** 2 + (-0.30 + 0.23) ** 2) / 2)
        half = 4.302653 * spread / math.sqrt(3)
        assert (gp.difference_low, gp.difference_high) == pytest.approx((-0.23 - half, -0.23 + half), rel=1e-6)
        assert gp.effect == 1.0
        assert gp.p == gp.p_least == 0.25 and gp.p_holm == 0.25 and gp.comparisons == 1 and not gp.significant

    def test_the_baseline_is_compared_with_nobody_and_any_controller_can_be_it(self):
        rows = errors("nominal_mpc", [0.2, 0.3]) + errors("gp_mpc", [0.1, 0.1])
        nominal = only(compute_statistics(rows, metrics=["rmse"]), "nominal_mpc")
        assert nominal.baseline == "" and nominal.pairs == 0 and math.isnan(nominal.p_holm)
        assert nominal.mean == pytest.approx(0.3) and nominal.interval == "t"  # rmse = 1.2 mean_error in `row`
        nominal = only(compute_statistics(rows, metrics=["rmse"], baseline="gp_mpc"), "nominal_mpc")
        assert nominal.baseline == "gp_mpc" and nominal.reduction == pytest.approx(-150) and nominal.effect == -1.0

    def test_pairs_are_of_seeds_and_not_of_rows(self):
        rows = errors("nominal_mpc", [0.2, 0.3, 0.4]) + errors("gp_mpc", [0.1, 0.2, 0.3])[::-1]
        gp = only(compute_statistics(rows, metrics=["mean_error"]), "gp_mpc")
        assert gp.difference == pytest.approx(-0.1)  # the same at every seed
        assert math.isnan(gp.difference_low) and gp.p == 0.25  # no spread, no interval

    def test_six_seeds_can_be_significant_and_one_can_not_be_tested(self):
        rows = errors("nominal_mpc", [0.2, 0.21, 0.22, 0.2, 0.25, 0.3]) + errors("gp_mpc", [0.1] * 6)
        gp = only(compute_statistics(rows, metrics=["mean_error"]), "gp_mpc")
        assert gp.p == gp.p_holm == 2 / 64 and gp.significant
        one = only(compute_statistics([rows[0], rows[6]], metrics=["mean_error"]), "gp_mpc")
        assert one.pairs == 1 and math.isnan(one.p) and one.comparisons == 0 and one.reduction == pytest.approx(50)

    def test_solve_times_are_described_and_not_compared(self):
        rows = errors("nominal_mpc", [0.2, 0.3], solve_time_median=2e-5) + errors("gp_mpc", [0.1, 0.1])
        statistics = compute_statistics(rows)
        assert len(statistics) == 2 * len((*compared(rows), *DESCRIBED))
        time = only(statistics, "nominal_mpc", metric="solve_time_median")
        assert time.mean == 2e-5 and time.interval == "none" and time.unit == "s"
        assert only(statistics, "gp_mpc", metric="solve_time_median").baseline == ""


class TestFailures:
    ROWS = (
        errors("nominal_mpc", [0.2, 0.3, "lost", 0.5, "lost", 0.2])
        + errors("gp_mpc", [0.1, "lost", 0.1, "solver_failed", "lost", "failed"])
    )  # fmt: skip

    @pytest.mark.parametrize(
        ("nominal", "gp", "pairs", "left_out"),
        [
            (["lost", 0.3, 0.5, "lost"], [0.1, "lost", "solver_failed", "lost"], 0,
             "1 lost by nominal_mpc, 1 lost, 1 solver_failed, 1 lost as was nominal_mpc"),
            ([0.2, "lost"], [0.1, "solver_failed"], 1, "1 solver_failed (nominal_mpc lost)"),
            ([0.2, 0.3], ["infeasible", "infeasible"], 0, "2 infeasible"),
            ([0.2, 0.3], [None, 0.1, 0.1], 1, "1 not asked for, 1 not asked of nominal_mpc"),
            ([0.2, 0.3], [(0.1, 0.2), 0.1], 1, "1 flown more than once"),
        ],
    )  # fmt: skip
    def test_what_was_left_out_is_counted_by_cause(self, nominal, gp, pairs, left_out):
        own = [
            one | {"seed": seed}
            for seed, values in enumerate(gp)
            for one in errors("gp_mpc", [] if values is None else values if isinstance(values, tuple) else [values])
        ]
        found = only(compute_statistics(errors("nominal_mpc", nominal) + own, metrics=["mean_error"]), "gp_mpc")
        assert (found.pairs, found.left_out) == (pairs, left_out)

    def test_flights_are_counted_by_outcome_and_the_success_rate_is_of_trials(self):
        gp = only(compute_statistics(self.ROWS, metrics=["mean_error"]), "gp_mpc")
        assert (gp.seeds, gp.n, gp.mean) == (6, 2, pytest.approx(0.1))
        assert gp.failures == {"lost": 2, "solver_failed": 1, "failed": 1} and gp.success == pytest.approx(2 / 6)
        assert (gp.success_low, gp.success_high) == pytest.approx(inference.success_interval(2, 6))
        # What nobody can fly is no trial, what another one flew is one, and an unknown outcome is a failure.
        rows = errors("gp_mpc", [0.1, "exploded", "infeasible", "infeasible"])
        alone = only(compute_statistics(rows, metrics=["mean_error"]), "gp_mpc")
        assert (alone.success, alone.failed, alone.infeasible, alone.seeds) == (0.5, 1, 2, 4)
        beside = compute_statistics(rows + errors("nominal_mpc", [0.2] * 4), metrics=["mean_error"])
        assert only(beside, "gp_mpc").flown.text() == "1 of 4"


class TestConditions:
    def test_settings_of_the_plant_make_conditions_those_of_the_controller_contestants(self):
        both = row(variant="controller.nodes=20 plant.lift=0.1 trajectory.path=a b.csv")
        assert contestant_of(both)[2] == "controller.nodes=20"
        assert condition_of(both)[4] == "plant.lift=0.1 trajectory.path=a b.csv" and condition_of(row())[4] == ""
        rows = []
        for payload, scale in (("0", 1.0), ("0.1", 2.0)):
            rows += errors("nominal_mpc", [0.2 * scale, 0.22 * scale], variant=f"plant.lift={payload}")
            rows += errors("gp_mpc", [0.1, 0.1], variant=f"plant.lift={payload}")
        statistics = compute_statistics(rows, metrics=["mean_error"])
        assert [s.setting for s in statistics] == ["plant.lift=0"] * 2 + ["plant.lift=0.1"] * 2
        assert [s.reduction for s in statistics][1::2] == pytest.approx(
            [100 * (1 - 0.1 / 0.21), 100 * (1 - 0.1 / 0.42)]
        )
        assert all(s.comparisons == 2 for s in statistics if s.baseline)

    def test_several_baselines_are_met_with_the_same_settings(self):
        rows = []
        for nodes, nominal in ((10, 0.2), (20, 0.4)):
            rows += errors("nominal_mpc", [nominal] * 2, variant=f"controller.nodes={nodes}")
            rows += errors("gp_mpc", [0.1] * 2, variant=f"controller.nodes={nodes}")
        rows += errors("perfect_mpc", [0.1] * 2, variant="controller.nodes=30")
        statistics = compute_statistics(rows, metrics=["mean_error"])
        assert only(statistics, "gp_mpc nodes=10").reduction == pytest.approx(50)
        assert only(statistics, "gp_mpc nodes=20").baseline == "nominal_mpc nodes=20"
        assert only(statistics, "gp_mpc nodes=20").reduction == pytest.approx(75)
        assert only(statistics, "perfect_mpc nodes=30").baseline == ""

    def test_holm_counts_every_comparison_of_a_metric(self):
        rows = [one for v in (4.0, 8.0) for one in errors("nominal_mpc", [0.2, 0.3, 0.4, 0.5], speed=v)]
        rows += [one for v in (4.0, 8.0) for one in errors("gp_mpc", [0.1] * 4, speed=v)]
        for statistic in compute_statistics(rows, metrics=["mean_error", "rmse"]):
            if statistic.baseline:
                assert statistic.p == 1 / 8 and statistic.p_holm == 1 / 4 and statistic.comparisons == 2


class TestOverall:
    @staticmethod
    def rows(rng, reduction, seeds=5, scales=(0.1, 0.2, 0.5)):
        flights = []
        for speed, scale in enumerate(scales, 4):
            base = scale * np.exp(0.1 * rng.normal(size=seeds))
            reduced = base * (1 - reduction) * np.exp(0.05 * rng.normal(size=seeds))
            flights += errors("nominal_mpc", list(base), speed=float(speed))
            flights += errors("gp_mpc", list(reduced), speed=float(speed))
        return flights

    def test_a_ratio_that_is_the_same_everywhere(self):
        rows = errors("nominal_mpc", [0.1, 0.2], speed=4.0) + errors("gp_mpc", [0.02, 0.04], speed=4.0)
        rows += errors("nominal_mpc", [1.0, 2.0], speed=8.0) + errors("gp_mpc", [0.2, 0.4], speed=8.0)
        (gp,) = overall(rows)
        assert (gp.label, gp.conditions, gp.pairs, gp.left_out) == ("gp_mpc", 2, 4, "")
        assert gp.reduction == pytest.approx(80) and gp.units == 2 and gp.effect == 1.0
        assert math.isnan(gp.reduction_low) and math.isnan(gp.p)  # copies
        assert gp.text() == "gp_mpc: 80.0 % less than nominal_mpc over 2 conditions (2 seeds, too few for a test)"

    def test_a_seed_is_the_mean_over_the_conditions_and_one_value(self):
        rng = np.random.default_rng(7)
        logs = rng.normal(size=(3, 6))  # conditions, seeds
        rows = [
            made
            for speed, log in enumerate(logs, 4)
            for made in errors("nominal_mpc", [0.1] * 6, speed=float(speed))
            + errors("gp_mpc", list(0.1 * np.exp(log)), speed=float(speed))
        ]
        (gp,) = overall(rows)
        assert (gp.conditions, gp.units, gp.pairs) == (3, 6, 18)
        seeds = logs.mean(axis=0)
        assert gp.p == inference.paired_permutation(seeds) and gp.p_least == 2 / 64
        assert 1 - gp.reduction_high / 100 == pytest.approx(inference.log_ratio(seeds).low)

    def test_a_condition_with_few_flights_is_left_out(self):
        rows = errors("nominal_mpc", [1.0, 1.0], speed=4.0) + errors("gp_mpc", [0.25, 0.26], speed=4.0)
        rows += errors("nominal_mpc", [1.0] * 8, speed=8.0) + errors(
            "gp_mpc", [1.0 + 0.1 * s for s in range(8)], speed=8.0
        )
        (gp,) = overall(rows)
        assert (gp.conditions, gp.units) == (1, 8) and gp.left_out == "2 with a seed that another condition lacks"

    def test_failures_are_counted(self):
        rows = errors("nominal_mpc", [0.2, 0.3, "lost"]) + errors("gp_mpc", [0.1, "lost", 0.1])
        (gp,) = overall(rows)
        assert gp.pairs == 1 and gp.lost == 1 and gp.success == pytest.approx(2 / 3)
        assert gp.text().endswith("(1 seed, too few for a test; left out: 1 lost, 1 lost by nominal_mpc)")
        (gp,) = overall(errors("nominal_mpc", [0.1, 0.1]) + errors("gp_mpc", [0.12, 0.12]))
        assert gp.text().startswith("gp_mpc: 20.0 % more than nominal_mpc over 1 condition (2 seeds")
        (gp,) = overall(errors("nominal_mpc", ["lost"]) + errors("gp_mpc", [0.1]))
        assert gp.text() == "gp_mpc: no pair with nominal_mpc (1 lost by nominal_mpc)"

    def test_coverage_and_error_rate(self):
        rng = np.random.default_rng(29)
        lines = [overall(self.rows(rng, 0.4))[0] for _ in range(400)]
        covered = np.mean([line.reduction_low <= 40 <= line.reduction_high for line in lines])
        assert 0.917 <= covered <= 0.983  # 95 % and 3 standard errors
        p = np.array([overall(self.rows(rng, 0.0))[0].p for _ in range(400)])
        assert np.mean(p <= 0.05) <= 0.083

    def test_an_error_of_zero_has_no_ratio(self):
        (gp,) = overall(errors("nominal_mpc", [0.0, 0.2]) + errors("gp_mpc", [0.1, 0.1]))
        assert gp.pairs == 1 and gp.left_out == "1 without an error above zero"


class TestFile:
    ROWS = (*TestFailures.ROWS, *errors("perfect_mpc", [0.01] * 6), row("gp_mpc", speed=None, trajectory="hover"))

    def written(self, folder, **options):
        statistics = results_statistics(self.ROWS, **options)
        table, texts = comparison_texts(statistics, "rmse")
        return statistics, table, write_comparison(folder, statistics, texts)

    def test_the_files_hold_every_column_in_full_precision_with_its_unit(self, tmp_path):
        statistics, table, files = self.written(tmp_path)
        assert set(files) == {"markdown", "latex", "comparison", "statistics", "statistics_csv"}
        columns, record = read_table(tmp_path / "statistics.parquet", "statistics")
        assert record["baseline"] == "nominal_mpc" and record["fingerprint"] == statistics.fingerprint
        assert columns["mean"].tolist() == pytest.approx([one.mean for one in statistics.rows], rel=0, nan_ok=True)
        schema = pq.read_schema(tmp_path / "statistics.parquet")
        units = {field.name: (field.metadata or {}).get(b"unit") for field in schema}
        assert units["speed"] == b"m/s" and units["reduction_low"] == b"%" and units["mean"] == b"see `unit`"
        first, *_ = csv.DictReader((tmp_path / "statistics.csv").read_text().splitlines())
        assert float(first["low"]) == statistics.rows[0].low and first["p"] == "" and first["lost"] == "2"
        assert "RMSE against nominal_mpc" in (tmp_path / "table.md").read_text()
        # Without a baseline there is nothing to compare, and no table left of another one.
        _, table, files = self.written(tmp_path, baseline="rls_mpc")
        assert "comparison" not in files and not (tmp_path / "comparison.tex").exists()
        assert any("no comparison" in note for note in table.notes)

    def test_rows_that_are_there_are_not_written_again(self, tmp_path):
        self.written(tmp_path)
        before = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
        self.written(tmp_path)
        assert before == {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
        statistics, _, _ = self.written(tmp_path, confidence=0.9)
        assert read_metadata(tmp_path / "statistics.parquet", "statistics")["confidence"] == 0.9
        assert {one.confidence for one in statistics.rows} == {0.9}
