"""The figures and tables of the experiments on Lei & Li's system."""

import numpy as np
import pytest

from quadexp.errors import UsageError
from quadexp.experiment.evaluate import fly_one, result_row
from quadexp.log.cell_store import CellStore
from quadexp.log.store import read_flight, write_flight
from quadexp.parts.compose import compose
from quadexp.plugins.papers import adaptation, families
from quadexp.plugins.papers.ladder import means_by_place, means_figure, means_table
from quadexp.plugins.papers.lei_li import report as lei_li
from quadexp.report import paper as papers
from tests.report.test_tables import row

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
    files = papers.write(lei_li, rows, tmp_path)
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


def test_a_paper_that_there_is_not_is_refused():
    with pytest.raises(UsageError, match=r"evaluate.figures=nope: there are standard, adaptation, .*, sun$"):
        papers.check("nope")
    assert papers.paper("standard") is None


def test_what_was_identified(tmp_path):
    """At 10 s by the table, where it is the end of the flight; the deviation is that over the seeds."""
    path = ("plant=blade_element", "trajectory=hover", "trajectory.duration=10", "controller=rls_feedback")
    flights = [fly_one(compose([*BENCH, *path, f"seed={seed}"])) for seed in range(2)]
    table = lei_li.identified_table(flights)
    last = [flight["C_la"][-1] for flight in flights]
    assert f"| C_la | 3.32 | {np.mean(last):.4f} +- {np.std(last, ddof=1):.4f} |" in table
    clips = [flight["clips"][-1] for flight in flights]
    assert f"{np.mean(clips):.0f} ({min(clips):.0f} to {max(clips):.0f})" in table.splitlines()[-1]


def flights(name, speed, errors, plant="blade_element"):
    """Result rows, one per seed; None: a lost flight."""
    ended = ({"outcome": "lost", "error": 9.0} if error is None else {"error": error} for error in errors)
    return [row(name, speed=speed, seed=seed, plant=plant, **{"outcome": "ok"} | one) for seed, one in enumerate(ended)]


def families_table(rows):
    return means_table(means_by_place(rows, "plant", families.ORDER), families.TITLE, bold=True).markdown()


def test_the_families():
    """Means over all flights; a lost flight is counted instead of a mean; oracles are not ranked."""
    rows = [
        *flights("perfect_mpc", 8.0, [0.001] * 12),
        *flights("gp_mpc", 8.0, [0.006, 0.0045, 0.0075] * 4),
        *flights("rls_mpc", 8.0, [0.002, 0.00151, 0.00249] * 4),  # about a third of gp_mpc on every seed
        *flights("static_feedback", 8.0, [None, *[0.3, 0.5] * 5, 0.4]),
        *flights("gp_mpc", 4.0, [0.2]),
    ]
    table = families_table(rows).splitlines()
    assert table[2] == "| plant | trajectory | m/s | gp_mpc | rls_mpc | perfect_mpc | static_feedback |"
    assert table[4] == "| blade_element | circle | 4 | 200 |  |  |  |", (
        "one controller is not significantly different from another"
    )
    assert table[5] == "| blade_element | circle | 8 | 6 | **2** | 1 | 1 of 12 lost |"
    (panel,) = means_figure(means_by_place(rows, "plant")).axes
    lines = {one.get_label(): tuple(map(list, one.lines[0].get_data())) for one in panel.containers}
    assert lines["gp_mpc"] == ([4.0, 8.0], [200.0, pytest.approx(6.0)])
    assert lines["rls_mpc"] == ([8.0], [pytest.approx(2.0)])
    assert "static_feedback" not in lines


def test_the_least_of_the_families_is_bold_only_beyond_chance():
    """Equal controllers with noise: the least of a line is bold in at most 5 % of the tables; a real one is found."""
    rng, found, true = np.random.default_rng(3), 0, 0
    names = ("nominal_mpc", "linear_drag_mpc", "gp_mpc", "rls_mpc")
    for _ in range(40):
        noise = np.exp(0.1 * rng.normal(size=(len(names), 4, 10)))
        rows = [
            made
            for name, lines in zip(names, noise, strict=True)
            for speed, errors in enumerate(0.1 * lines)
            for made in flights(name, float(speed), errors)
        ]
        found += "**" in families_table(rows).partition("|")[2]
        rows = [
            made | {"mean_error": made["mean_error"] / 50} if made["controller"] == "gp_mpc" else made for made in rows
        ]
        cells = families_table(rows).splitlines()[4].split("|")
        assert "**" not in "".join(cells[:6] + cells[7:])
        true += "**" in cells[6]
    assert found <= 5 and true >= 30  # 5 % of 40 are 2, with a standard deviation of 1.4

    one_flight = [made for made in rows if made["seed"] == 0]
    assert "**" not in families_table(one_flight).partition("|")[2]


def test_a_lost_flight_stands_in_the_table_with_its_cause():
    lost = {"trajectory": "rectangle", "speed": 15.0, "controller": "static_feedback", "variant": "", "outcome": "lost"}
    lost |= {"mean_error": 40.0, "cause": "100.3 m from the reference at t=18.82 s"}
    assert "| - |  |  |  | 1 lost: 100.3 m from the reference" in lei_li.expected_table([lost])


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
    files = papers.write(adaptation, rows, folder)
    assert set(files) == {"table_adaptation", "figure_adaptation"}
    table = (folder / "adaptation.md").read_text()
    assert "| payload of 0.3 kg taken up | nominal_mpc |" in table and "| 0..1 s |" in table
