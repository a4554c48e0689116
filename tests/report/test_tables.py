"""The error table, with means worked by hand."""

from __future__ import annotations

import csv
import io
import math

import numpy as np
import pytest

from quadexp.flight.store import read_table, write_table
from quadexp.report.tables import (
    ROW_COLUMNS,
    error_table,
    escape,
    from_columns,
    to_columns,
    to_csv,
    to_latex,
    to_markdown,
    to_rich,
)
from quadexp.report.wording import significant, with_interval


def row(controller="nominal_mpc", speed=8.0, seed=0, error=0.24, **more):
    made = dict.fromkeys(ROW_COLUMNS, 0.0)
    made |= dict.fromkeys(("model", "variant", "backend", "cause", "key"), "")
    made |= {"plant": "simplified", "vehicle": "torrente", "trajectory": "circle", "outcome": "ok"}
    made |= {"controller": controller, "speed": speed, "seed": seed, "mean_error": error, "rmse": 1.2 * error}
    return made | more


def test_mean_over_seeds_in_millimetres_and_the_best_marked():
    rows = [row(seed=0, error=0.2), row(seed=1, error=0.3), row("gp_mpc", seed=0, error=0.004)]
    table = error_table(rows)
    assert table.columns == ("nominal_mpc", "gp_mpc") and table.rows == (("circle", "8"),)
    nominal, gp = (table.entries[table.rows[0], column] for column in table.columns)
    assert nominal.mean == pytest.approx(250.0) and nominal.spread == pytest.approx(50 * math.sqrt(2))
    assert gp.best and not nominal.best and math.isnan(gp.spread)
    assert error_table(rows, "rmse").entries[table.rows[0], "nominal_mpc"].mean == pytest.approx(300.0)


def test_lost_flights_are_counted_and_not_averaged():
    rows = [
        row(seed=0, error=0.2),
        row(seed=1, error=9.9, outcome="lost"),
        row("gp_mpc", error=math.nan, outcome="lost"),
    ]
    table = error_table(rows)
    texts = [table.entries[table.rows[0], column].text() for column in table.columns]
    assert texts == ["200.0 (1 lost)", "1 lost"]
    assert table.entries[table.rows[0], "nominal_mpc"].best


def test_columns_tell_apart_whatever_differs():
    rows = [
        row("gp_mpc", model="models/a"),
        row("gp_mpc", model="models/b"),
        row("nominal_mpc", variant="controller.nodes=20"),
        row("nominal_mpc", plant="ideal", error=0.0004),
    ]
    table = error_table(rows)
    assert table.columns == (
        "gp_mpc a @simplified",
        "gp_mpc b @simplified",
        "nominal_mpc nodes=20 @simplified",
        "nominal_mpc @ideal",
    )
    same_name = [row("gp_mpc", model="here/gp"), row("gp_mpc", model="there/gp")]
    assert error_table(same_name).columns == ("gp_mpc here/gp", "gp_mpc there/gp")
    # The ideal plant is no rival: nobody flies there but one.
    assert not table.entries[table.rows[0], "nominal_mpc @ideal"].best


def test_rows_are_sorted_by_speed_within_the_order_of_trajectories():
    rows = [
        row(speed=12.0),
        row(speed=4.0, trajectory="lemniscate"),
        row(speed=4.0),
        row(speed=None, trajectory="hover"),
    ]
    assert error_table(rows).rows == (("circle", "4"), ("circle", "12"), ("lemniscate", "4"), ("hover", ""))


@pytest.mark.parametrize(
    ("value", "text"), [(0.01234, "0.0123"), (1.234, "1.23"), (12.34, "12.3"), (241.52, "241.5"), (0.0, "0")]
)
def test_digits(value, text):
    assert significant(value) == text


def test_markdown_and_latex():
    table = error_table([row(error=0.2), row("gp_mpc", error=0.004)])
    assert "| circle | 8 | 200.0 | **4.00** |" in to_markdown(table)
    latex = to_latex(table)
    assert r"circle & 8 & 200.0 & \textbf{4.00} \\" in latex
    assert r"nominal\_mpc & gp\_mpc" in latex
    assert latex.count(r"\toprule") == latex.count(r"\bottomrule") == 1
    assert r"trajectory & speed (m/s) & nominal\_mpc" in latex and r"\multicolumn{2}{c}{mean error (mm)}" in latex
    assert latex.count("&") == 2 + 2 * 3


def test_latex_escapes_outcomes_with_underscores():
    table = error_table([row(outcome="solver_failed")])
    assert r"1 solver\_failed" in to_latex(table)


def test_the_terminal_shows_the_same_numbers():
    from rich.console import Console

    console = Console(width=100, file=io.StringIO())
    console.print(to_rich(error_table([row(error=0.2), row("gp_mpc", error=0.004)])))
    assert "200.0" in console.file.getvalue() and "4.00" in console.file.getvalue()


def test_csv_and_parquet_hold_every_column_in_full_precision(tmp_path):
    rows = [row(error=1 / 3), row("gp_mpc", speed=None, error=math.nan, outcome="infeasible")]
    back = list(csv.DictReader(io.StringIO(to_csv(rows))))
    assert list(back[0]) == list(ROW_COLUMNS) and float(back[0]["mean_error"]) == 1 / 3
    path = write_table(tmp_path / "r.parquet", to_columns(rows), {}, "results")
    columns, _ = read_table(path, "results")
    again = from_columns(columns)
    assert again[0]["mean_error"] == 1 / 3 and again[1]["outcome"] == "infeasible"
    assert np.isnan(again[1]["speed"]) and isinstance(again[0]["seed"], int)


class TestIntervals:
    def test_on_a_narrow_terminal_intervals_stand_below_their_means(self):
        from rich.console import Console

        table = error_table([row(seed=s, error=0.2 + 0.01 * s) for s in range(3)])
        console = Console(width=60, file=io.StringIO())
        console.print(to_rich(table, stacked=True))
        lines = [line.split("│")[-2].strip() for line in console.file.getvalue().splitlines() if "│" in line]
        assert lines == ["210.0", "[185.2, 234.8]"]  # 10 mm spread, t(0.975, 2) = 4.303

    def test_digits_follow_the_interval(self):
        assert with_interval(240.57, 239.91, 241.22) == ("240.6", " [239.9, 241.2]")
        assert with_interval(240.57, 240.53, 240.61) == ("240.57", " [240.53, 240.61]")
        assert with_interval(0.8291, 0.7331, 0.9247) == ("0.829", " [0.733, 0.925]")
        assert with_interval(12.3, math.nan, math.nan) == ("12.3", "")
        assert with_interval(5.0, 5.0, 5.0) == ("5.00", " [5.00, 5.00]")

    def test_mean_interval_mark_and_failures_in_every_form(self):
        rows = [row(seed=seed, error=0.2 + 0.001 * seed) for seed in range(6)]
        rows += [row("gp_mpc", seed=seed, error=0.004 + 0.0001 * seed) for seed in range(6)]
        rows[1] |= {"outcome": "lost"}
        rows += [row(seed=6, error=0.2), row("gp_mpc", seed=6, error=0.004)]
        table = error_table(rows)
        nominal, gp = (table.entries[table.rows[0], column] for column in table.columns)
        assert gp.significant and not nominal.significant  # six pairs: p = 2 / 2^6
        assert nominal.low < nominal.mean < nominal.high
        text = f"[{gp.low:.2f}, {gp.high:.2f}]"
        assert f"**{gp.mean:.2f}** {text}*" in to_markdown(table)
        assert rf"\textbf{{{gp.mean:.2f}}} {text}$^*$" in to_latex(table)
        assert "] (1 lost) |" in to_markdown(table)
        assert "- &ast; differs from nominal_mpc: p < 0.05" in to_markdown(table)
        assert table.notes[0].startswith("mean over 7 seeds [95 % interval: BCa bootstrap]")

    def test_a_controller_that_loses_flights_is_not_the_best(self):
        rows = [row(seed=0, error=0.2), row(seed=1, error=0.2)]
        rows += [row("gp_mpc", seed=0, error=0.01), row("gp_mpc", seed=1, outcome="lost", error=math.nan)]
        table = error_table(rows)
        assert [table.entries[table.rows[0], c].best for c in table.columns] == [True, False]

    def test_the_note_says_how_many_seeds_a_significant_line_takes(self):
        rows = [row(seed=s, error=0.2 + 0.01 * s) for s in range(5)] + [row("gp_mpc", seed=s) for s in range(5)]
        assert error_table(rows).notes[1] == (
            "5 pairs a line cannot show significance (p is 0.0625 at least, over 1 comparison): 6 could"
        )

    def test_latex_escapes_everything(self):
        assert escape("a_b & 5 % < {x} \\") == r"a\_b \& 5 \% $<$ \{x\} \textbackslash{}"


def test_an_attitude_far_from_the_reference_s_is_said_below_the_table():
    """Each contestant at its worst condition, in degrees; nothing where all are close; lost flights do not count."""
    angle = math.radians
    close = [row(attitude_rmse=angle(9.9)), row("gp_mpc", attitude_rmse=angle(2.0))]
    assert not [note for note in error_table(close).notes if "attitude" in note]
    far = [
        row("static_feedback", speed=4.0, attitude_rmse=angle(40.0)),
        row("static_feedback", speed=8.0, seed=0, attitude_rmse=angle(50.0)),
        row("static_feedback", speed=8.0, seed=1, attitude_rmse=angle(52.0)),
        row("gp_mpc", attitude_rmse=angle(90.0), outcome="lost"),
    ]
    table = error_table([*close, *far])
    expected = "attitude error (rms) above 10 deg, at its largest: static_feedback 51.0 deg on circle 8"
    assert table.notes[-1] == expected and expected in to_markdown(table) and expected in to_latex(table)
