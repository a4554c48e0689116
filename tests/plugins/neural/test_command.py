"""`quadexp fit-nn` and sums, from a data set to a flight, as a user types it."""

import json

import pytest

from quadexp.experiment.evaluate import fly_one
from quadexp.models.checkpoint import load_model, load_report
from quadexp.parts.compose import compose
from quadexp.report.summary import summarise
from quadexp.requests import fit
from tests.cli.command import run

SHORT = ["collect.duration=24", "collect.flight_duration=6", "controller.backend=interpreted"]
QUICK = ["nn.hidden=[6]", "nn.max_iterations=40"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    from quadexp.experiment.collect import collect_dataset

    folder = tmp_path_factory.mktemp("nn")
    collect_dataset(compose(SHORT), folder / "data.parquet")
    return folder


def test_a_network_and_a_sum_are_fitted_shown_and_flown(folder, monkeypatch):
    monkeypatch.chdir(folder)
    data = folder / "data.parquet"
    fit("drag", data, [], folder / "drag")
    alone = fit("nn", data, QUICK, folder / "nn")
    rest = fit("nn", data, QUICK, folder / "rest", after=folder / "drag")
    assert any("of what" in line for line in rest["lines"])
    assert load_report(folder / "rest")["after"] == str(folder / "drag")
    assert {row["predictor"] for row in alone["rows"]} == {"nn", "linear_drag", "zero"}
    assert load_model(folder / "nn").network.sizes == (4, 6, 3)
    shown = "\n".join(summarise(folder / "nn")["lines"])
    assert "network     4-6-3 units: a_x, a_y, a_z from v_x, v_y, v_z, thrust" in shown
    circle = ["trajectory.speed=4", "trajectory.acceleration=2", "controller.backend=interpreted"]
    errors = {}
    for name, more in {
        "nominal_mpc": [],
        "neural_mpc": ["model=nn"],
        "sum_mpc": ["controller.models=[drag,rest]"],
    }.items():
        flight = fly_one(compose([f"controller={name}", *circle, *more]))
        errors[name] = flight.metadata["row"]["mean_error"]
        assert flight.metadata["row"]["model"] == {"neural_mpc": "nn", "sum_mpc": "drag+rest"}.get(name, "")
    assert max(errors["neural_mpc"], errors["sum_mpc"]) < 0.6 * errors["nominal_mpc"]


def test_the_command_writes_a_checkpoint_and_says_what_is_wrong(folder):
    code, out, error = run("fit-nn", folder / "data.parquet", *QUICK, "--out", folder / "cli", "--json")
    assert code == 0, error
    assert json.loads(out)["kind"] == "neural"
    code, _, error = run("fit-nn", folder / "data.parquet", "nn.features=[speed]", "--out", folder / "no")
    assert code == 2 and "model.features: unknown feature 'speed'" in error
    assert not (folder / "no").exists()
