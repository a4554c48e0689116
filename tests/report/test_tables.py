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
    from_columns,
    significant,
    to_columns,
    to_csv,
    to_latex,
    to_markdown,
    to_rich,
)


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
    assert latex.count("&") == 2 * 3


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
