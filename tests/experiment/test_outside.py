"""Flights of a learned model say which share lay outside its data: in the file, the row, the table, the page."""

import json
import math
import re
from itertools import groupby
from operator import itemgetter

import numpy as np
import pytest

from quadexp.log.store import read_flight, read_metadata, read_table
from quadexp.models.checkpoint import load_model, save_model
from quadexp.models.dataset import read_dataset
from quadexp.models.linear_drag import fit_linear_drag
from quadexp.report.notes import notes
from tests.cli.command import run

QUICK = ("controller.backend=interpreted", "plant.backend=interpreted")


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    """Linear drag of one slow minute."""
    folder = tmp_path_factory.mktemp("slow")
    collect = ("collect", "collect.duration=30", "collect.speed_max=7", "plant.backend=interpreted")
    assert run(*collect, "--out", folder / "data.parquet")[0] == 0
    save_model(folder / "drag", fit_linear_drag(read_dataset(folder / "data.parquet")))
    return folder / "drag"


def fly(model, speed, out, *more):
    return run(
        "simulate", "controller=linear_drag_mpc", "trajectory=circle", f"trajectory.speed={speed}", f"model={model}",
        *QUICK, "--out", out, *more,
    )  # fmt: skip


def test_a_fast_flight_says_so_and_a_slow_one_does_not(model, tmp_path):
    code, out, error = fly(model, 12, tmp_path / "fast.parquet")
    assert code == 0, error
    line = next(line for line in out.splitlines() if line.startswith("data  "))
    flight, fit = read_flight(tmp_path / "fast.parquet"), load_model(model)
    record = flight.metadata["outside_data"]
    speed = np.linalg.norm(flight.stack(["v_x", "v_y", "v_z"]), axis=1)
    beyond = np.mean(speed > fit.feature_range["speed"][1])  # no wind: the norm is the same in both frames
    assert record["shares"]["speed"] == pytest.approx(beyond) and beyond > 0.3
    assert record["share"] >= beyond and flight.metadata["row"]["outside_data"] == record["share"]
    values = dict(zip(["v_x", "v_y", "v_z"], flight.air_velocity.T, strict=True))
    values |= {"speed": speed, "thrust": flight.input.sum(axis=1)}
    outside = [any(not low <= values[name][i] <= high for name, (low, high) in fit.feature_range.items()) for i in
               range(len(flight))]  # fmt: skip
    stretches = [[i for i, _ in group] for out, group in groupby(enumerate(outside), itemgetter(1)) if out]
    longest = max(stretches, key=len)
    start, end, *at = map(float, re.findall(r"-?\d+\.\d+", record["where"]))
    assert (start, end) == pytest.approx((flight.t[longest[0]], flight.t[longest[-1]]), abs=0.006)
    assert at == pytest.approx(flight.state[longest[len(longest) // 2], :3], abs=0.3)
    assert flight.metadata["row"]["outside_where"] == record["where"]
    assert f"{100 * record['share']:.1f} % of samples outside the data that {model}" in line and "speed" in line
    code, out, _ = fly(model, 2, tmp_path / "slow.parquet")
    assert code == 0 and "outside the data" not in out
    assert read_metadata(tmp_path / "slow.parquet")["outside_data"]["share"] <= 0.01
    assert "data        0.0 % of samples outside" in run("show", tmp_path / "slow.parquet")[1]


@pytest.mark.parametrize(
    "changes", [["observer=disturbance"], ["controller=geometric", "controller.residual=linear_drag"]]
)
def test_the_model_is_known_inside_remedies_and_in_other_controllers(model, tmp_path, changes):
    code, out, error = fly(model, 12, tmp_path / "fast.parquet", *changes)
    assert code == 0, error
    assert read_metadata(tmp_path / "fast.parquet")["outside_data"]["share"] > 0.3


def test_what_states_no_variance_has_nothing_to_fall_back_by(model, tmp_path):
    code, _, error = fly(model, 2, tmp_path / "a.parquet", "controller.fallback=true")
    assert code == 2 and error == f"error: {model}: linear_drag states no variance to fall back by\n"
    code, _, error = fly(model, 2, tmp_path / "a.parquet", "controller.residual=none", "controller.fallback=true")
    assert code == 2 and "controller.fallback: residual=none is not learned from flights" in error


def test_an_old_checkpoint_says_unknown(model, tmp_path):
    from msgspec.structs import replace

    save_model(tmp_path / "old", replace(load_model(model), feature_range={}))
    code, out, _ = fly(tmp_path / "old", 2, tmp_path / "a.parquet")
    assert code == 0 and "unknown whether the flight lay inside the data" in out
    code, out, _ = fly(tmp_path / "old", 2, tmp_path / "b.parquet", "--json")
    assert json.loads(out)["outside_data"] is None


def test_rows_and_tables_of_a_sweep(model, tmp_path):
    sweep = (
        "evaluate", "--sweep", "trajectory=circle", "trajectory.speed=2,12", "controller=nominal_mpc,linear_drag_mpc",
        f"model={model}", *QUICK, "--no-figures", "--out", tmp_path / "r",
    )  # fmt: skip
    code, out, error = run(*sweep)
    assert code == 0, error
    columns, _ = read_table(tmp_path / "r" / "results.parquet", "results")
    found = dict(zip(zip(columns["controller"], columns["speed"], strict=True), columns["outside_data"], strict=True))
    assert math.isnan(found["nominal_mpc", 2.0]) and math.isnan(found["nominal_mpc", 12.0])
    assert found["linear_drag_mpc", 2.0] <= 0.01 < 0.3 < found["linear_drag_mpc", 12.0]
    note = f"(most: {100 * found['linear_drag_mpc', 12.0]:.3g} %, circle 12 m/s; longest "
    assert "of samples outside the data its model was fitted to" in (tmp_path / "r" / "table.md").read_text()
    assert note in (tmp_path / "r" / "table.md").read_text() and note in " ".join(out.split())
    assert note in run("show", tmp_path / "r")[1]
    assert run("report", tmp_path / "r", "--out", tmp_path / "page.html")[0] == 0
    assert note in (tmp_path / "page.html").read_text(encoding="utf-8")


def test_rows_of_an_older_table_are_unknown_not_inside():
    row = {
        "plant": "simplified", "vehicle": "torrente", "trajectory": "circle", "speed": 8.0, "controller": "gp_mpc",
        "model": "models/gp", "variant": "", "seed": 0, "outcome": "ok",
    }  # fmt: skip
    (note,) = notes([row])
    assert note.startswith("gp_mpc: unknown of 1 flights whether inside the data")
    assert notes([{**row, "model": "", "controller": "nominal_mpc"}]) == []


def test_what_an_older_table_lacks_is_unknown_after_it_is_recalled():
    from quadexp.report.metrics import from_columns, to_columns
    from quadexp.sweeps.sweep_table import table_row

    old = to_columns([{"controller": "gp_mpc", "model": "models/gp", "outcome": "ok"}] * 50)
    del old["outside_data"]
    assert all(row["outside_data"] is None for row in map(table_row, from_columns(old)))
