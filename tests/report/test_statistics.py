"""Statistics of result rows against numbers worked by hand: who is compared with whom, and what is left out."""

from __future__ import annotations

import csv
import io
import math

import numpy as np
import pytest

from quadexp.log.store import read_metadata
from quadexp.report import inference, statistics_file
from quadexp.report.pairing import contestant_labels, split_variant, variant_parts
from quadexp.report.statistics import COMPARED, DESCRIBED, compute_statistics, overall
from quadexp.report.statistics_file import results_statistics, statistics_csv, write_comparison, write_statistics
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
        assert gp.effect == 1.0 and gp.cohen_d == pytest.approx(0.23 / spread)
        assert gp.p == gp.p_least == 0.25 and gp.p_holm == 0.25 and gp.comparisons == 1 and not gp.significant

    def test_the_baseline_is_compared_with_nobody(self):
        rows = errors("nominal_mpc", [0.2, 0.3]) + errors("gp_mpc", [0.1, 0.1])
        nominal = only(compute_statistics(rows, metrics=["rmse"]), "nominal_mpc")
        assert nominal.baseline == "" and nominal.pairs == 0 and math.isnan(nominal.p_holm)
        assert nominal.mean == pytest.approx(0.3) and nominal.interval == "t"  # rmse = 1.2 mean_error in `row`

    def test_another_baseline(self):
        rows = errors("nominal_mpc", [0.2, 0.2]) + errors("gp_mpc", [0.1, 0.1])
        nominal = only(compute_statistics(rows, metrics=["rmse"], baseline="gp_mpc"), "nominal_mpc")
        assert nominal.baseline == "gp_mpc" and nominal.reduction == pytest.approx(-100) and nominal.effect == -1.0

    def test_pairs_are_of_seeds_and_not_of_rows(self):
        rows = errors("nominal_mpc", [0.2, 0.3, 0.4]) + errors("gp_mpc", [0.1, 0.2, 0.3])[::-1]
        gp = only(compute_statistics(rows, metrics=["mean_error"]), "gp_mpc")
        assert gp.difference == pytest.approx(-0.1) and math.isnan(gp.cohen_d)  # the same at every seed
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
        assert len(statistics) == 2 * len((*COMPARED, *DESCRIBED))
        time = only(statistics, "nominal_mpc", metric="solve_time_median")
        assert time.mean == 2e-5 and time.interval == "none" and time.unit == "s"
        assert only(statistics, "gp_mpc", metric="solve_time_median").baseline == ""


class TestFailures:
    ROWS = (
        errors("nominal_mpc", [0.2, 0.3, "lost", 0.5, "lost", 0.2])
        + errors("gp_mpc", [0.1, "lost", 0.1, "solver_failed", "lost", "failed"])
    )  # fmt: skip

    def test_what_was_left_out_is_counted_by_cause(self):
        gp = only(compute_statistics(self.ROWS, metrics=["mean_error"]), "gp_mpc")
        assert (gp.seeds, gp.n, gp.lost, gp.solver_failed, gp.failed, gp.infeasible) == (6, 2, 2, 1, 1, 0)
        assert gp.failures == {"lost": 2, "solver_failed": 1, "failed": 1}
        assert gp.pairs == 1 and gp.left_out == (
            "1 lost, 1 lost by nominal_mpc, 1 solver_failed, 1 lost as was nominal_mpc, 1 failed"
        )
        assert gp.mean == pytest.approx(0.1) and gp.baseline_mean == pytest.approx(0.2)

    def test_success_rate(self):
        gp = only(compute_statistics(self.ROWS, metrics=["mean_error"]), "gp_mpc")
        assert gp.success == pytest.approx(2 / 6)
        assert (gp.success_low, gp.success_high) == pytest.approx(inference.success_interval(2, 6))
        # What nobody can fly is no trial.
        rows = errors("gp_mpc", [0.1, "lost", "infeasible", "infeasible"])
        gp = only(compute_statistics(rows, metrics=["mean_error"]), "gp_mpc")
        assert gp.success == 0.5 and gp.infeasible == 2 and gp.seeds == 4

    def test_nothing_flown_at_all(self):
        rows = errors("nominal_mpc", [0.2, 0.3]) + errors("gp_mpc", ["infeasible", "infeasible"])
        gp = only(compute_statistics(rows, metrics=["mean_error"]), "gp_mpc")
        assert gp.n == 0 and math.isnan(gp.mean) and gp.left_out == "2 infeasible"
        assert gp.success == 0 and gp.flown.text() == "0 of 2"  # what nominal_mpc flew, somebody can fly

    def test_an_outcome_nobody_knows_is_a_failure(self):
        gp = only(compute_statistics(errors("gp_mpc", [0.1, "exploded"]), metrics=["rmse"]), "gp_mpc")
        assert gp.failed == 1 and gp.success == 0.5

    def test_seeds_that_only_one_of_them_flew(self):
        rows = errors("nominal_mpc", [0.2, 0.3]) + errors("gp_mpc", [0.1, 0.1, 0.1])[1:]
        gp = only(compute_statistics(rows, metrics=["mean_error"]), "gp_mpc")
        assert gp.pairs == 1 and gp.left_out == "1 not asked for, 1 not asked of nominal_mpc"

    def test_two_flights_of_one_seed_are_no_pair(self):
        rows = errors("nominal_mpc", [0.2, 0.3]) + errors("gp_mpc", [0.1, 0.1]) + errors("gp_mpc", [0.2])
        gp = only(compute_statistics(rows, metrics=["mean_error"]), "gp_mpc")
        assert gp.pairs == 1 and gp.n == 3 and gp.left_out == "1 flown more than once"


class TestConditions:
    def test_settings_of_the_plant_make_conditions_those_of_the_controller_contestants(self):
        assert split_variant("controller.nodes=20 plant.payload=0.1") == ("controller.nodes=20", "plant.payload=0.1")
        assert split_variant("") == ("", "") and split_variant("trajectory.path=a b.csv") == (
            "",
            "trajectory.path=a b.csv",
        )
        assert variant_parts("controller.position_weight=0.5") == ["position_weight=0.5"]
        rows = [
            made
            for payload, scale in (("0", 1.0), ("0.1", 2.0))
            for made in (
                *errors("nominal_mpc", [0.2 * scale, 0.22 * scale], variant=f"plant.payload={payload}"),
                *errors("gp_mpc", [0.1, 0.1], variant=f"plant.payload={payload}"),
            )
        ]
        statistics = compute_statistics(rows, metrics=["mean_error"])
        assert [s.setting for s in statistics] == ["plant.payload=0"] * 2 + ["plant.payload=0.1"] * 2
        assert [s.reduction for s in statistics][1::2] == pytest.approx(
            [100 * (1 - 0.1 / 0.21), 100 * (1 - 0.1 / 0.42)]
        )
        assert all(s.comparisons == 2 for s in statistics if s.baseline)

    def test_several_baselines_are_met_with_the_same_settings(self):
        rows = [
            made
            for nodes, nominal in ((10, 0.2), (20, 0.4))
            for made in (
                *errors("nominal_mpc", [nominal] * 2, variant=f"controller.nodes={nodes}"),
                *errors("gp_mpc", [0.1] * 2, variant=f"controller.nodes={nodes}"),
            )
        ]
        rows += errors("perfect_mpc", [0.1] * 2, variant="controller.nodes=30")
        statistics = compute_statistics(rows, metrics=["mean_error"])
        assert only(statistics, "gp_mpc nodes=10").reduction == pytest.approx(50)
        assert only(statistics, "gp_mpc nodes=20").baseline == "nominal_mpc nodes=20"
        assert only(statistics, "gp_mpc nodes=20").reduction == pytest.approx(75)
        assert only(statistics, "perfect_mpc nodes=30").baseline == ""

    def test_holm_counts_every_comparison_of_a_metric(self):
        rows = [
            made
            for speed in (4.0, 8.0)
            for made in (
                *errors("nominal_mpc", [0.2, 0.3, 0.4, 0.5], speed=speed),
                *errors("gp_mpc", [0.1, 0.1, 0.1, 0.1], speed=speed),
            )
        ]
        for statistic in compute_statistics(rows, metrics=["mean_error", "rmse"]):
            if statistic.baseline:
                assert statistic.p == 1 / 8 and statistic.p_holm == 1 / 4 and statistic.comparisons == 2

    def test_labels_say_the_checkpoint_where_there_are_several(self):
        labels = contestant_labels([("gp_mpc", "models/a", ""), ("gp_mpc", "models/b", ""), ("nominal_mpc", "", "")])
        assert list(labels.values()) == ["gp_mpc a", "gp_mpc b", "nominal_mpc"]


class TestOverall:
    @staticmethod
    def rows(rng, reduction, seeds=5, scales=(0.1, 0.2, 0.5)):
        made = []
        for speed, scale in enumerate(scales, 4):
            base = scale * np.exp(0.1 * rng.normal(size=seeds))
            own = base * (1 - reduction) * np.exp(0.05 * rng.normal(size=seeds))
            made += errors("nominal_mpc", list(base), speed=float(speed))
            made += errors("gp_mpc", list(own), speed=float(speed))
        return made

    def test_a_ratio_that_is_the_same_everywhere(self):
        rows = [
            made
            for speed, scale in ((4.0, 1), (8.0, 10))
            for made in (
                *errors("nominal_mpc", [0.1 * scale, 0.2 * scale], speed=speed),
                *errors("gp_mpc", [0.02 * scale, 0.04 * scale], speed=speed),
            )
        ]
        (gp,) = overall(rows)
        assert (gp.label, gp.conditions, gp.pairs, gp.left_out) == ("gp_mpc", 2, 4, "")
        assert gp.reduction == pytest.approx(80) and gp.units == 2 and gp.effect == 1.0
        assert math.isnan(gp.reduction_low) and math.isnan(gp.p)  # copies
        few = "2 seeds cannot show p < 0.05: at least 6 are needed"
        assert gp.text() == f"gp_mpc: 80.0 % less than nominal_mpc over 2 conditions ({few})"

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
        assert (gp.conditions, gp.units) == (1, 8) and gp.left_out == "2 not completed by all"
        assert gp.own_pairs == 10 and "over all 10 that both completed" in gp.text()

    def test_worse_is_said_as_more(self):
        rows = errors("nominal_mpc", [0.1, 0.1]) + errors("gp_mpc", [0.12, 0.12])
        assert overall(rows)[0].text().startswith("gp_mpc: 20.0 % more than nominal_mpc over 1 condition (2 seeds")

    def test_failures_are_counted(self):
        rows = errors("nominal_mpc", [0.2, 0.3, "lost"]) + errors("gp_mpc", [0.1, "lost", 0.1])
        (gp,) = overall(rows)
        assert gp.pairs == 1 and gp.lost == 1 and gp.success == pytest.approx(2 / 3)
        assert gp.text().endswith("at least 6 are needed; left out: 1 lost, 1 lost by nominal_mpc)")
        (gp,) = overall(errors("nominal_mpc", ["lost"]) + errors("gp_mpc", [0.1]))
        assert gp.text() == "gp_mpc: no pair with nominal_mpc (1 lost by nominal_mpc)"

    def test_coverage_and_error_rate(self):
        rng = np.random.default_rng(29)
        made = [overall(self.rows(rng, 0.4))[0] for _ in range(400)]
        covered = np.mean([one.reduction_low <= 40 <= one.reduction_high for one in made])
        assert 0.917 <= covered <= 0.983  # 95 % and 3 standard errors
        p = np.array([overall(self.rows(rng, 0.0))[0].p for _ in range(400)])
        assert np.mean(p <= 0.05) <= 0.083

    def test_an_error_of_zero_has_no_ratio(self):
        (gp,) = overall(errors("nominal_mpc", [0.0, 0.2]) + errors("gp_mpc", [0.1, 0.1]))
        assert gp.pairs == 1 and gp.left_out == "1 without an error above zero"


class TestFile:
    ROWS = (*TestFailures.ROWS, *errors("perfect_mpc", [0.01] * 6), row("gp_mpc", speed=None, trajectory="hover"))

    def test_what_is_written_is_read_back(self, tmp_path, monkeypatch):
        made = results_statistics(tmp_path, self.ROWS)
        write_statistics(tmp_path, made)
        assert read_metadata(tmp_path / "statistics.parquet", "statistics")["baseline"] == "nominal_mpc"
        monkeypatch.setattr(statistics_file, "compute_statistics", lambda *_, **__: pytest.fail("computed again"))
        again = results_statistics(tmp_path, self.ROWS)
        assert repr(again) == repr(made)

    @pytest.mark.parametrize("change", [{"baseline": "gp_mpc"}, {"confidence": 0.9}])
    def test_another_question_is_computed(self, tmp_path, change):
        write_statistics(tmp_path, results_statistics(tmp_path, self.ROWS))
        made = results_statistics(tmp_path, self.ROWS, **change)
        assert {s.confidence for s in made.rows} == {change.get("confidence", 0.95)}
        assert {s.baseline for s in made.rows} - {""} == {change.get("baseline", "nominal_mpc")}

    def test_other_rows_are_computed(self, tmp_path):
        write_statistics(tmp_path, results_statistics(tmp_path, self.ROWS))
        changed = [dict(self.ROWS[0], mean_error=0.7), *self.ROWS[1:]]
        assert only(results_statistics(tmp_path, changed).of("mean_error"), "nominal_mpc").mean == pytest.approx(
            1.7 / 4
        )

    def test_csv_holds_every_column_in_full_precision(self):
        statistics = compute_statistics(errors("gp_mpc", [1 / 3, 1 / 7]), metrics=["mean_error"])
        (back,) = csv.DictReader(io.StringIO(statistics_csv(statistics)))
        assert float(back["mean"]) == statistics[0].mean and float(back["low"]) == statistics[0].low
        assert back["unit"] == "m" and back["p"] == "" and back["lost"] == "0"

    def test_columns_carry_their_units(self, tmp_path):
        import pyarrow.parquet as pq

        write_statistics(tmp_path, results_statistics(None, self.ROWS))
        schema = pq.read_schema(tmp_path / "statistics.parquet")
        units = {field.name: (field.metadata or {}).get(b"unit") for field in schema}
        assert units["speed"] == b"m/s" and units["reduction_low"] == b"%" and units["mean"] == b"see `unit`"

    def test_tables_of_one_metric(self, tmp_path):
        table, files = write_comparison(tmp_path, results_statistics(None, self.ROWS), "rmse")
        assert set(files) == {"markdown", "latex", "comparison", "statistics", "statistics_csv"}
        text = (tmp_path / "table.md").read_text()
        assert "RMSE (mm)" in text and "RMSE against nominal_mpc" in text
        assert "| circle | 8 | gp_mpc | 1 | -120.0 | 50.0 | 1.00 | - | - | 1 lost, 1 lost by nominal_mpc," in text
        latex = (tmp_path / "comparison.tex").read_text()
        assert r"reduction (\%)" in latex and r"1 solver\_failed" in latex and latex.count(r"\toprule") == 1
        # Without a baseline there is nothing to compare, and no table left of another one.
        table, files = write_comparison(tmp_path, results_statistics(None, self.ROWS, baseline="rls_mpc"), "rmse")
        assert "comparison" not in files and not (tmp_path / "comparison.tex").exists()
        assert any("no comparison" in note for note in table.notes)


def test_two_failures_of_two_kinds_are_both_named():
    rows = errors("nominal_mpc", [0.2, "lost"]) + errors("gp_mpc", [0.1, "solver_failed"])
    gp = only(compute_statistics(rows, metrics=["mean_error"]), "gp_mpc")
    assert gp.left_out == "1 solver_failed (nominal_mpc lost)"
