"""The numbers behind a figure, compared with pandas and with the tables of the same results."""

import json

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from quadexp.errors import UsageError
from quadexp.log.store import read_metadata
from quadexp.parts.settings import read_value
from quadexp.plugins.page.compare import compare
from quadexp.plugins.page.draw import records
from quadexp.plugins.page.sweep_figures import drawings
from quadexp.plugins.page.view import Axis, automatic, points, view
from quadexp.report.condition import chosen
from quadexp.report.frame import SweepFrame, setting_text, unit_of
from quadexp.report.statistics import compute_statistics
from tests.report.sweeps import noise, swept

NODES = [
    "controller=nominal_mpc,perfect_mpc",
    "controller.nodes=5,10,20",
    "controller.horizon=0.5,1,2",
    "seed=range(3)",
]


def of_nodes(config):
    """Decreases with the nodes, increases with the horizon; perfect_mpc is better; the seed is noise."""
    name, nodes, horizon = config.controller.name, config.controller.nodes, config.controller.horizon
    scale = {"nominal_mpc": 0.2, "perfect_mpc": 0.002}[name]
    return scale * horizon / nodes * (1 + 0.1 * noise(config.seed, name, nodes, horizon))


@pytest.fixture(scope="module")
def nodes(tmp_path_factory):
    return swept(tmp_path_factory.mktemp("nodes") / "r", NODES, of_nodes)


@pytest.fixture(scope="module")
def masses(tmp_path_factory):
    """A key of the condition; at 1.4 kg nominal_mpc loses seed 1, and at 1.8 kg all."""

    def error(config):
        mass, name = config.vehicle.mass, config.controller.name
        if name == "nominal_mpc" and (mass == 1.8 or (mass == 1.4 and config.seed == 1)):
            return None
        return 0.01 * mass * (1 + 0.2 * noise(config.seed, name, mass, config.trajectory.name))

    asked = [
        "trajectory=circle,lemniscate",
        "vehicle.mass=1,1.4,1.8",
        "controller=nominal_mpc,perfect_mpc",
        "seed=range(4)",
    ]
    return swept(tmp_path_factory.mktemp("masses") / "r", asked, error)


def flights(folder) -> pd.DataFrame:
    """The flights with their configuration, read without this package's frame."""
    table = pd.read_parquet(folder / "results.parquet")
    configs = [read_metadata(folder / "cells" / key[:2] / f"{key}.parquet")["config"] for key in table["key"]]
    return table.join(pd.json_normalize(configs).add_prefix("c_"))


class TestNumbers:
    def test_means_and_intervals_are_those_of_pandas(self, nodes):
        made = pd.DataFrame(records(view(SweepFrame.read(nodes), x="controller.nodes", by=["controller.horizon"])))
        expected = flights(nodes).groupby(["controller", "c_controller.horizon", "c_controller.nodes"])["mean_error"]
        assert len(made) == 18 == len(expected)
        for row in made.itertuples(index=False):
            record = dict(zip(made.columns, row, strict=True))
            at = record["controller"], record["controller.horizon"], record["controller.nodes"]
            own = expected.get_group(at).to_numpy()
            half = stats.t.ppf(0.975, 2) * own.std(ddof=1) / np.sqrt(3)
            assert record["mean_error"] == pytest.approx(own.mean(), rel=1e-12)
            assert record["low"] == pytest.approx(max(own.mean() - half, 0), abs=1e-12)
            assert record["high"] == pytest.approx(own.mean() + half, rel=1e-12)
            assert (record["flights"], record["seeds"], record["interval"]) == (3, 3, "t")

    def test_settings_of_a_contestant_are_not_averaged(self, nodes):
        made = view(SweepFrame.read(nodes), x="controller.nodes")
        assert made.others == () and made.by == ("controller", "controller.horizon")
        table = flights(nodes)
        for (name, horizon, count), point in made.places.items():
            own = table[(table["controller"] == name) & (table["c_controller.nodes"] == count)]
            own = own[own["c_controller.horizon"] == horizon]
            by_seed = own.groupby("seed")["mean_error"].mean()
            assert point.mean == pytest.approx(by_seed.mean(), rel=1e-12) and point.flights == 3
            half = stats.t.ppf(0.975, 2) * by_seed.std(ddof=1) / np.sqrt(3)
            assert point.high == pytest.approx(by_seed.mean() + half, rel=1e-12)

    @pytest.mark.parametrize("y", ["mean_error", "max_error"])
    def test_they_are_the_numbers_of_the_tables(self, masses, y):
        """Also where flights are lost: both take the flights that all controllers of a line completed."""
        frame = SweepFrame.read(masses)
        made = view(frame, x="vehicle.mass", y=y)
        assert made.by == ("controller",) and made.facet == ("trajectory",)
        rows = compute_statistics(frame.rows, metrics=(y,), baseline="")
        assert len(rows) == len(made.places) == 12
        for s in rows:
            mass = float(s.setting.partition("=")[2])
            point = made.places[s.trajectory, s.controller, mass]
            wanted = [s.common_mean, s.common_low, s.common_high]
            assert [point.mean, point.low, point.high] == pytest.approx(wanted, nan_ok=True, rel=1e-12)
            assert (point.seeds, point.ended, point.trials) == (s.common, s.flown.ended, s.flown.trials)

    def test_lost_flights_are_counted_and_take_the_same_flight_from_the_others(self, masses):
        made = view(SweepFrame.read(masses), x="vehicle.mass", facet=["trajectory"])
        nominal, perfect = (made.places["circle", name, 1.4] for name in ("nominal_mpc", "perfect_mpc"))
        assert (nominal.ended, nominal.trials, dict(nominal.lost)) == (3, 4, {"lost": 1})
        assert perfect.ended == 4 and perfect.seeds == nominal.seeds == 3
        assert not made.places["circle", "nominal_mpc", 1.8].is_shown
        assert made.places["circle", "perfect_mpc", 1.8].seeds == 4
        assert "10 of 48 flights were not completed: marked k/n where k of n were" in made.notes

    def test_success_is_a_number_like_the_others(self, masses):
        made = view(SweepFrame.read(masses), x="vehicle.mass", y="success")
        assert [made.places["circle", "nominal_mpc", mass].mean for mass in (1, 1.4, 1.8)] == [1.0, 0.75, 0.0]
        low, high = stats.binomtest(3, 4).proportion_ci(method="exact")
        point = made.places["circle", "nominal_mpc", 1.4]
        assert (point.low, point.high) == (pytest.approx(low), pytest.approx(high))

    def test_any_key_also_one_that_was_not_swept(self, nodes):
        frame = SweepFrame.read(nodes)
        made = view(frame, x="controller.rate")
        assert "controller.rate is 50 in all flights that have it" in made.notes
        assert frame.column("vehicle.mass") == flights(nodes)["c_vehicle.mass"].tolist()
        assert frame.column("controller.position_weight") == ["[10,10,10]"] * len(frame.rows)
        assert set(frame.column("observer")) == {"none"} and set(frame.column("world")) == {"clean"}

    @pytest.mark.parametrize(
        ("asked", "said"),
        [
            ({"x": "controler.nodes"}, "controler.nodes: no such key; did you mean controller.nodes"),
            ({"x": "nodes"}, "nodes: no such key; did you mean controller.nodes"),
            ({"y": "mean_eror"}, "--y mean_eror: no number of a flight; did you mean mean_error"),
            ({"y": "controller"}, "--y controller: no number of a flight"),
            ({"x": "rmse"}, "rmse: is a result of a flight, not a setting: it can be --y"),
            ({"x": "controller.nodes", "by": ["controller.nodes"]}, "stands twice"),
        ],
    )
    def test_what_cannot_be_drawn_is_one_line(self, nodes, asked, said):
        with pytest.raises(UsageError, match=said):
            view(SweepFrame.read(nodes), **asked)


class TestChoice:
    """What was swept chooses the figure."""

    def kinds(self, folder):
        return [(one.kind, one.x.key, one.by, one.facet) for one in automatic(SweepFrame.read(folder))]

    def test_one_key(self, masses):
        assert self.kinds(masses) == [("lines", "vehicle.mass", ("controller",), ("trajectory",))]

    def test_two_keys(self, nodes):
        assert self.kinds(nodes) == [
            ("lines", "controller.nodes", ("controller",), ("controller.horizon",)),
            ("heat", "controller.nodes", ("controller.horizon",), ("controller",)),
        ]
        one = SweepFrame.read(nodes)
        kept = one.where([row["controller"] == "nominal_mpc" for row in one.rows])
        assert [(v.kind, v.by, v.facet) for v in automatic(kept)] == [
            ("lines", ("controller.horizon",), ()),
            ("heat", ("controller.horizon",), ()),
        ]

    @pytest.mark.parametrize(
        ("overrides", "expected"),
        [
            (["vehicle.mass=1,2", "controller.nodes=5,10", "plant.lift=0,0.1"], "against_mass"),
            (["trajectory.speed=4"], "against_seed"),
            (["controller=nominal_mpc,perfect_mpc"], "against_controller"),
            (["plant=simplified,ideal"], "against_plant"),
            (["plant=simplified,ideal", "trajectory.speed=4,6"], "against_speed"),
            (["controller.nodes=5,10", "trajectory.speed=4,6,8"], "against_speed"),
            (["wind=constant", "wind.velocity=[0,0,0],[2,0,0]"], "against_velocity"),
            (["wind=none,constant", "seed=0,1"], "against_wind"),
            (["world=clean,outdoor_breeze"], "against_world"),
            (["horizon=published,robust"], "against_horizon"),
        ],
    )
    def test_of_other_sweeps(self, tmp_path, overrides, expected):
        out = swept(tmp_path / "r", overrides, lambda config: 0.01)
        frame = SweepFrame.read(out)
        assert [view.file_name for view in automatic(frame)] == [expected]
        names = [drawing.name for drawing in drawings(frame.rows, out, "mean_error", 0.95, frame.record)]
        assert f"mean_error_{expected}" in names

    def test_without_the_grids_the_rows_tell_what_was_swept(self, nodes):
        frame = SweepFrame.read(nodes)
        assert SweepFrame(frame.rows, nodes).swept == ["controller.nodes", "controller.horizon", "controller", "seed"]
        assert frame.swept == ["controller", "controller.nodes", "controller.horizon", "seed"]

    def test_a_figure_does_not_average_over_controllers(self, nodes):
        made = view(SweepFrame.read(nodes), x="controller.nodes", by=["controller.horizon"])
        assert made.facet == ("controller",) and not made.others


def test_invalid_cells_have_a_place_and_no_number(tmp_path):
    out = swept(tmp_path / "r", ["controller=nominal_mpc,rls_feedback", "controller.nodes=5,10"], lambda config: 0.01)
    made = view(SweepFrame.read(out), x="controller.nodes")
    assert made.places["nominal_mpc", 5].mean == pytest.approx(0.01)
    wrong = made.places["rls_feedback", 10]
    assert not wrong.is_shown and wrong.trials == 0 and "controller.nodes: no such key" in wrong.invalid
    assert "2 places invalid: settings that contradict each other" in made.notes


@pytest.mark.parametrize(
    ("values", "scale"),
    [
        ((4, 8, 12), "linear"), ((5, 10, 20), "log"), ((0.01, 0.1, 1), "log"), ((10, 20), "linear"),
        ((1, 1.2, 1.44), "linear"), ((0, 1, 10, 100), "linear"), ((-1, 1, 10, 100), "linear"), (("a", "b"), "linear"),
        ((0, 0.25, 0.5, 1.0), "linear"), ((1, 2, 3, 4, 5), "linear"), ((10, 30, 100, 300), "log"),
    ],
)  # fmt: skip
def test_axes_are_logarithmic_where_ratios_matter(values, scale):
    assert Axis.of("controller.nodes", values).scale == scale


def test_units_are_those_of_the_configuration():
    assert unit_of("controller.horizon") == "s" and unit_of("speed") == "m/s" and unit_of("vehicle.mass") == "kg"
    assert unit_of("controller") == "" and unit_of("no.such") == ""


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("wind.velocity", "[4,0,0]", "wind [4,0,0] m/s"), ("link.latency", "0.03", "latency 30 ms"),
        ("controller.horizon", 0.5, "horizon 0.5 s"), ("controller.nodes", 20, "nodes 20"),
        ("vehicle.mass", "1.2", "mass 1.2 kg"), ("wind", "dryden", "wind dryden"),
    ],
)  # fmt: skip
def test_settings_are_said_in_words_with_their_units(key, value, said):
    assert setting_text(key, value) == said


@pytest.mark.parametrize(
    ("text", "value"),
    [("3", 3), ("3.0", 3.0), ("1e-3", 1e-3), ("true", True), ("null", None), ("[1, 2]", "[1,2]"),
     ("'a b'", "a b"), ("x", "x")],
)  # fmt: skip
def test_values_of_overrides(text, value):
    assert read_value(text) == value and type(read_value(text)) is type(value)


def test_a_flight_lost_in_one_setting_takes_its_seed_from_the_mean(tmp_path):
    """Averaged over two speeds, seed 0 lacks one of them: the mean is over seeds 1 and 2 at both."""

    def error(config):
        speed = config.trajectory.speed
        return None if (config.seed, speed) == (0, 6) else 0.001 * (1 + config.seed) * speed

    out = swept(tmp_path / "r", ["controller.nodes=5,10", "trajectory.speed=2,6", "seed=range(3)"], error)
    frame = SweepFrame.read(out)
    (point, _) = points(frame, ["controller.nodes"], "mean_error", others=["trajectory.speed"]).values()
    assert point.mean == pytest.approx(np.mean([0.004 * 2, 0.004 * 3]), rel=1e-9)
    assert (point.seeds, point.flights) == (2, 4)
    assert json.dumps(records(view(frame, x="controller.nodes")))


def test_cells_that_contradict_themselves_take_nothing_from_the_others(tmp_path):
    """Half of them want a horizon that pid has not: no figure was drawn, and compare knew no flight."""
    asked = ["controller=pid", "controller.rate=100,200", "remedies=none,offset_free", "seed=range(2)"]
    folder, again = (swept(tmp_path / name, asked, lambda config: config.controller.rate / 1000) for name in "ab")
    frame = SweepFrame.read(folder)
    for made in (view(frame), *automatic(frame), view(frame, x="controller.rate")):
        assert [round(point.mean, 6) for point in made.places.values()] == [0.1, 0.2]
    report = compare(folder, again)
    assert [record["label"] for record in report["metrics"]] == [f"pid rate={n}" for n in (100, 200)]
    assert report["outcome"] == {"ok -> ok": 4} and report["identical"] == 4


def test_a_list_in_a_condition_is_the_value_of_a_key_that_holds_lists(tmp_path):
    """As tables show it: no flight fulfilled `plant.linear_drag == [0.3,0.3,0]`."""
    asked = ["controller=pid", "wind=constant", "wind.velocity=[1,0,0],[0.0,2.0,0.0]", "seed=range(2)"]
    frame = SweepFrame.read(swept(tmp_path / "r", asked, lambda config: 0.1))
    for condition, count in {
        "wind.velocity == [1, 0, 0.0]": 2,
        "wind.velocity != [1,0,0] and seed in [0]": 1,
        "wind.velocity in [[1,0,0], [0,2,0]] and seed == [0, 1]": 4,
        "wind.velocity = '[0,2,0]'": 2,
    }.items():
        assert sum(chosen(frame, condition)) == count, condition
