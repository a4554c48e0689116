"""The figures and tables of the experiments on Lei & Li's system."""

from __future__ import annotations

import numpy as np
import pytest

from quadexp.config.compose import compose
from quadexp.experiment.evaluate import fly_one, result_row
from quadexp.log.cell_store import CellStore
from quadexp.log.store import read_flight, write_flight
from quadexp.papers.lei_li import families
from quadexp.papers.lei_li import report as lei_li

BENCH = ["vehicle=lei_li", "plant.backend=interpreted", "sensor=lei_li", "controller.backend=interpreted"]


def cell(store, key, *overrides, variant=""):
    config = compose([*BENCH, *overrides])
    flight = fly_one(config)
    flight.metadata["row"] = result_row(config, flight) | {"key": key, "variant": variant}
    store.path(key).parent.mkdir(parents=True, exist_ok=True)
    write_flight(store.path(key), flight)
    return flight.metadata["row"]


def test_the_examples(tmp_path):
    store, short = CellStore(tmp_path), ("plant=blade_element", "trajectory=rectangle", "trajectory.duration=3")
    rows = [
        cell(store, "aa1", *short, "controller=rls_feedback", variant="controller.cone=False"),
        cell(store, "aa2", *short, "controller=rls_feedback", "seed=1", variant="controller.cone=False"),
        cell(store, "aa3", *short, "controller=static_feedback", variant="controller.cone=True"),
    ]
    files = lei_li.draw("lei_li", rows, tmp_path)
    assert {"figure_example_path", "figure_example_errors", "figure_example_parameters"} < set(files)
    assert (tmp_path / "figures" / "example_induced_velocity.png").stat().st_size > 10_000
    table = (tmp_path / "expected.md").read_text().splitlines()
    (line,) = (line for line in table if "| rls_feedback |" in line)
    mean = sum(row["mean_error"] for row in rows[:2]) / 2
    highest = sum(read_flight(store.path(row["key"]))["p_z"].max() for row in rows[:2]) / 2
    assert f"| 2 | {mean:.3f} +- " in line
    assert f"| 1.65 | {100 * (mean / 1.65 - 1):+.1f} % | {highest:.2f} | ok |" in line
    (coned,) = (line for line in table if "| static_feedback |" in line)
    assert f"| 1 | {rows[2]['mean_error']:.3f} |  |  |" in coned, "what is expected holds for the law as printed"


def test_what_was_identified(tmp_path):
    """At 10 s by the table, where it is the end of the flight; the deviation is that over the seeds."""
    path = ("plant=blade_element", "trajectory=hover", "trajectory.duration=10", "controller=rls_feedback")
    flights = [fly_one(compose([*BENCH, *path, f"seed={seed}"])) for seed in range(2)]
    table = lei_li.identified_table(flights)
    last = [flight["C_la"][-1] for flight in flights]
    assert f"| C_la | 3.32 | {np.mean(last):.4f} +- {np.std(last, ddof=1):.4f} |" in table
    clips = [flight["clips"][-1] for flight in flights]
    assert f"{np.mean(clips):.0f} ({min(clips):.0f} to {max(clips):.0f})" in table.splitlines()[-1]


def test_the_families():
    """Bold is who had to find out; lost flights are counted, and spoil the mean."""
    rows = [
        {"plant": "blade_element", "trajectory": "circle", "speed": speed, "controller": name, "outcome": outcome}
        | {"mean_error": error}
        for speed, name, outcome, error in (
            (8.0, "perfect_mpc", "ok", 0.001),
            (8.0, "gp_mpc", "ok", 0.003),
            (8.0, "rls_mpc", "ok", 0.0015),
            (8.0, "rls_mpc", "ok", 0.0025),
            (8.0, "static_feedback", "lost", 9.0),
            (8.0, "static_feedback", "ok", 0.5),
            (4.0, "gp_mpc", "ok", 0.2),
        )
    ]
    table = families.families_table(rows).splitlines()
    assert table[2] == "| plant | trajectory | m/s | gp_mpc | rls_mpc | perfect_mpc | static_feedback |"
    assert table[4] == "| blade_element | circle | 4 | **200** |  |  |  |"
    assert table[5] == "| blade_element | circle | 8 | 3 | **2** | 1 | 1 of 2 lost |"
    (panel,) = families.families_figure(rows).axes
    lines = {line.get_label(): (list(line.get_xdata()), list(line.get_ydata())) for line in panel.lines}
    assert lines["gp_mpc"] == ([4.0, 8.0], [200.0, 3.0]) and lines["rls_mpc"] == ([8.0], [2.0])
    assert "static_feedback" not in lines


def test_a_lost_flight_stands_in_the_table_with_its_cause():
    row = {"trajectory": "rectangle", "speed": 15.0, "controller": "static_feedback", "variant": "", "outcome": "lost"}
    row |= {"mean_error": 40.0, "cause": "100.3 m from the reference at t=18.82 s"}
    assert "| - |  |  |  | 1 lost: 100.3 m from the reference" in lei_li.expected_table([row])


@pytest.fixture
def changed(tmp_path):
    store = CellStore(tmp_path)
    path = ("trajectory=hover", "trajectory.duration=3", "controller.backend=interpreted")
    schedule = "plant.schedule=[{t:1.0,payload:0.3}]"
    rows = [
        cell(store, f"bb{name}", "plant=blade_element_payload", schedule, *path, f"controller={name}")
        for name in ("nominal_mpc", "rls_mpc")
    ]
    return tmp_path, rows


def test_adaptation(changed):
    folder, rows = changed
    files = lei_li.draw("adaptation", rows, folder)
    assert set(files) == {"table_adaptation", "figure_adaptation"}
    table = (folder / "adaptation.md").read_text()
    assert "| payload of 0.3 kg taken up | nominal_mpc |" in table and "| 0..1 s |" in table


def test_without_changes_there_is_nothing_to_draw(tmp_path):
    assert lei_li.draw("adaptation", [], tmp_path) == {}
