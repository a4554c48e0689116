"""The figures and tables of the experiments on Lei & Li's system."""

from __future__ import annotations

import pytest

from quadexp.compose import compose
from quadexp.experiment.evaluate import fly_one, result_row
from quadexp.experiment.store import CellStore
from quadexp.flight.store import write_flight
from quadexp.report import lei_li

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
    assert f"| 2 | {mean:.3f} +- " in line and f"| 1.65 | {100 * (mean / 1.65 - 1):+.1f} % | ok |" in line


def test_a_lost_flight_stands_in_the_table_with_its_cause():
    row = {"trajectory": "rectangle", "speed": 15.0, "controller": "static_feedback", "variant": "", "outcome": "lost"}
    row |= {"mean_error": 40.0, "cause": "100.3 m from the reference at t=18.82 s"}
    assert "| - |  |  | 1 lost: 100.3 m from the reference" in lei_li.expected_table([row])


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
