"""The error table and the comparison, with means worked by hand."""

import csv
import io
import math

import numpy as np
import pytest

from quadexp.log.store import read_table, write_table
from quadexp.report.metrics import ROW_COLUMNS, from_columns, to_columns, to_csv
from quadexp.report.statistics import compute_statistics
from quadexp.report.tables import cell_text, comparison_table, error_table


def row(controller="nominal_mpc", speed=8.0, seed=0, error=0.24, **more):
    made = dict.fromkeys(ROW_COLUMNS, 0.0)
    made |= dict.fromkeys(("model", "variant", "backend", "cause", "key"), "")
    made |= dict.fromkeys(("reference_residual", "outside_data"))
    made |= {"plant": "simplified", "vehicle": "torrente", "trajectory": "circle", "outcome": "ok"}
    made |= {"controller": controller, "speed": speed, "seed": seed, "mean_error": error, "rmse": 1.2 * error}
    return made | more


def statistic(rows, label, metric="mean_error", **options):
    (found,) = [s for s in compute_statistics(rows, metrics=(metric,), **options) if s.label == label]
    return found


def cells(rows, metric="mean_error"):
    """Texts below the counts of completed flights, line by line."""
    return [list(line) for line in error_table(rows, metric).rows[1:]]


def test_mean_over_seeds_in_millimetres_and_the_best_marked():
    rows = [row(seed=s, error=error) for s, error in enumerate([0.2, 0.3, 0.2, 0.3, 0.2, 0.3])]
    rows += [row("gp_mpc", seed=s, error=error) for s, error in enumerate([0.004, 0.00601] * 3)]
    table = error_table(rows)
    assert table.columns == ["trajectory", "m/s", "nominal_mpc", "gp_mpc"]
    assert table.rows[0] == ["flown", "", "6 of 6", "6 of 6"] and len(table.rows) == 2
    nominal, gp = (statistic(rows, name) for name in ("nominal_mpc", "gp_mpc"))
    assert nominal.common_mean == pytest.approx(0.25) and nominal.common_std == pytest.approx(0.05 * math.sqrt(6 / 5))
    assert gp.best and not nominal.best and gp.common_mean == pytest.approx(0.005005)
    assert cells(rows) == [["circle", "8", cell_text(nominal), cell_text(gp)]]
    assert statistic(rows, "nominal_mpc", "rmse").common_mean == pytest.approx(0.3)


def test_lost_flights_are_counted_and_not_averaged():
    rows = [row(seed=0, error=0.2), row(seed=1, error=9.9, outcome="lost")]
    rows += [row("gp_mpc", error=math.nan, outcome="lost")]
    assert error_table(rows).rows == [["flown", "", "1 of 2", "0 of 1"], ["circle", "8", "200.0 (1 lost)", "1 lost"]]


def test_columns_tell_apart_whatever_differs():
    rows = [
        row("gp_mpc", model="models/a"),
        row("gp_mpc", model="models/b"),
        row("nominal_mpc", variant="controller.nodes=20"),
        row("nominal_mpc", plant="ideal", error=0.0004),
    ]
    table = error_table(rows)
    assert table.columns[2:] == [
        "gp_mpc a @simplified", "gp_mpc b @simplified", "nominal_mpc nodes=20 @simplified", "nominal_mpc @ideal",
    ]  # fmt: skip
    assert table.rows[1][-1] == "0.400"  # the ideal plant is no rival: nobody flies there but one
    same_name = [row("gp_mpc", model="here/gp"), row("gp_mpc", model="there/gp")]
    assert error_table(same_name).columns[2:] == ["gp_mpc here/gp", "gp_mpc there/gp"]
    settings = (("nominal_mpc", ""), ("gp_mpc", "controller.a.gain=1"), ("gp_mpc", "controller.b.gain=1"))
    table = error_table([row(name, seed=s, variant=variant) for name, variant in settings for s in range(2)])
    assert table.columns[2:] == ["nominal_mpc", "gp_mpc controller.a.gain=1", "gp_mpc controller.b.gain=1"]


def test_many_worlds_are_rows():
    names, plants = ["nominal_mpc", "gp_mpc", "perfect_mpc"], ("simplified", "simplified/wind", "ideal")
    table = error_table([row(name, plant=plant, seed=s) for plant in plants for name in names for s in (0, 1)])
    assert table.columns == ["trajectory", "m/s", "plant", *names]
    assert [line[:3] for line in table.rows[1:]] == [["circle", "8", plant] for plant in plants]
    assert r" & & & \multicolumn{3}{c}{mean error (mm)}" in table.latex() and r"\cmidrule(l){4-6}" in table.latex()


@pytest.mark.parametrize(
    ("settings", "headings", "lines"),
    [
        (["payload.mass=0.1", "payload.mass=0.2"], ["mass (kg)"], [["0.1"], ["0.2"]]),
        (["wind.velocity=[4,0,0]", "wind.velocity=[3,4,0]"], ["wind (m/s)"], [["[4,0,0]"], ["[3,4,0]"]]),
        (["wind.velocity=[4,0,0]", "wind.velocity=[0,4,0]"], ["wind (m/s)"], [["[4,0,0]"], ["[0,4,0]"]]),
        (["link.latency=0", "link.latency=0.03"], ["latency (ms)"], [["0"], ["30"]]),
        (["horizon=published", "horizon=robust"], ["horizon"], [["published"], ["robust"]]),
        (["payload.mass=0.1 controller.nodes=5", "payload.mass=0.2 controller.nodes=10"], ["mass (kg)", "nodes"],
         [["0.1", "5"], ["0.2", "10"]]),
    ],
)  # fmt: skip
def test_a_swept_key_has_a_column_with_its_unit_above_and_its_values_down(settings, headings, lines):
    rows = [
        row(name, variant=variant, error=0.001 * (1 + k), seed=s)
        for name in ("nominal_mpc", "gp_mpc")
        for k, variant in enumerate(settings)
        for s in (0, 1)
    ]
    assert error_table(rows).columns == ["trajectory", "m/s", *headings, "nominal_mpc", "gp_mpc"]
    assert cells(rows) == [["circle", "8", *line, *[f"{k}.00"] * 2] for k, line in enumerate(lines, 1)]


def test_the_comparison_names_its_lines_as_the_error_table_does():
    settings = ("horizon=published", "horizon=robust")
    who = {"nominal_mpc": 0.2, "perfect_mpc": 0.001}
    rows = [row(name, seed=s, error=e, variant=v) for v in settings for name, e in who.items() for s in (0, 1)]
    lines = comparison_table(compute_statistics(rows, metrics=("mean_error",))).rows
    assert [line[:3] for line in cells(rows)] == [["circle", "8", "published"], ["circle", "8", "robust"]]
    assert [line[0] for line in lines] == ["circle"] * 2
    assert [line[2] for line in lines] == ["perfect_mpc horizon=published", "perfect_mpc horizon=robust"]


def test_rows_are_sorted_by_speed_within_the_order_of_trajectories():
    courses = ((12.0, "circle"), (4.0, "lemniscate"), (4.0, "circle"), (None, "hover"))
    lines = cells([row(speed=speed, trajectory=name) for speed, name in courses])
    assert [line[:2] for line in lines] == [["circle", "4"], ["circle", "12"], ["lemniscate", "4"], ["hover", ""]]


def test_csv_and_parquet_hold_every_column_in_full_precision(tmp_path):
    rows = [row(error=1 / 3), row("gp_mpc", speed=None, error=math.nan, outcome="infeasible")]
    back = list(csv.DictReader(io.StringIO(to_csv(rows))))
    assert list(back[0]) == list(ROW_COLUMNS) and float(back[0]["mean_error"]) == 1 / 3
    path = write_table(tmp_path / "r.parquet", to_columns(rows), {}, "results")
    again = from_columns(read_table(path, "results")[0])
    assert again[0]["mean_error"] == 1 / 3 and again[1]["outcome"] == "infeasible"
    assert np.isnan(again[1]["speed"]) and isinstance(again[0]["seed"], int)


class TestIntervals:
    def test_mean_interval_mark_and_failures_in_every_form(self):
        rows = [row(seed=seed, error=0.2 + 0.001 * seed) for seed in range(6)]
        rows += [row("gp_mpc", seed=seed, error=0.004 + 0.0001 * seed) for seed in range(6)]
        rows[1] |= {"outcome": "lost"}
        rows += [row(seed=6, error=0.2), row("gp_mpc", seed=6, error=0.004)]
        nominal, gp = (statistic(rows, name) for name in ("nominal_mpc", "gp_mpc"))
        assert gp.significant and not nominal.significant  # six pairs: p = 2 / 2^6
        assert nominal.common_low < nominal.common_mean < nominal.common_high
        assert 1e3 * gp.mean == pytest.approx((sum(4 + 0.1 * s for s in range(6)) + 4) / 7) and gp.common == 6
        mean, text = f"{1e3 * gp.common_mean:.2f}", f"[{1e3 * gp.common_low:.2f}, {1e3 * gp.common_high:.2f}]"
        table = error_table(rows)
        assert table.rows[1][-1] == f"**{mean}** {text}* (all 7: {1e3 * gp.mean:.2f})"
        assert table.rows[1][-2].endswith("] (1 lost)")
        latex = table.latex()
        assert rf"\textbf{{{mean}}} {text}$^*$" in latex and r"flown &  & 6 of 7 & 7 of 7 \\" in latex
        assert r"trajectory & m/s & nominal\_mpc" in latex and r"\multicolumn{2}{c}{mean error (mm)}" in latex
        assert r"\*: significantly different from the baseline;" in table.markdown()
        mean_note, test, *_ = table.notes
        assert (
            mean_note == "mean over the flights of a line that all completed, of 7 seeds [95 % interval: Student's t]"
        )
        assert test.startswith("bold: the least of its line, significantly different from every other there (p < 0.05)")

    def test_a_controller_that_loses_flights_is_not_the_best_and_who_has_the_larger_error_is_not_either(self):
        rows = [row(seed=seed, error=0.2) for seed in range(4)]
        rows += [row("gp_mpc", seed=seed, error=0.01) for seed in range(3)]
        rows += [row("gp_mpc", seed=3, outcome="lost", error=math.nan)]
        assert not any(s.best for s in compute_statistics(rows, metrics=("mean_error",)))

    def test_the_note_says_how_many_seeds_a_significant_line_takes(self):
        rows = [row(seed=s, error=0.2 + 0.01 * s) for s in range(5)] + [row("gp_mpc", seed=s) for s in range(5)]
        assert error_table(rows).notes[1] == (
            "5 seeds cannot show p < 0.05, so that nothing is bold, * or called best: at least 6 are needed"
        )


def test_a_value_with_blanks_and_signs_is_one_value():
    """ "hover, 1 2.csv" was the name of a row, and its wind "w/wind,"."""
    paths = ["w ö/wind, 1=2.csv", "a b=c.csv"]
    rows = [row(variant=f"wind.path={path} controller.models=[x y=z] horizon=robust") for path in paths]
    table = error_table(rows)
    assert [*table.columns] == ["trajectory", "m/s", "path", "nominal_mpc models=[x y=z] horizon=robust"]
    assert [[*line][:3] for line in table.rows[1:]] == [["circle", "8", path] for path in paths]


@pytest.mark.parametrize("names", [("pid", "gp_mpc"), ("nominal_mpc", "nominal_mpc")])
def test_why_nothing_is_compared_is_true_of_several_baselines_too(names):
    rows = [row(name, variant=f"controller.nodes={5 + i}", seed=s) for i, name in enumerate(names) for s in range(2)]
    assert any("none of these contestants, or several of them" in note for note in error_table(rows).notes)
