"""quadexp export looks at what it is given, and says what it cannot do with it."""

import json

import pytest
from typer.testing import CliRunner

from quadexp import plugin
from quadexp.cli.app import app
from quadexp.log.store import write_flight
from tests.log.flights import straight_flight

TARGETS = (
    "px4", "px4_sih", "ardupilot", "betaflight", "sdf", "rotorpy", "crazyflow", "gym_pybullet", "mjcf", "agilicious",
    "casadi", "c",
)  # fmt: skip


def run(*words) -> tuple[int, str]:
    done = CliRunner().invoke(app, ["export", *map(str, words)])
    return done.exit_code, done.stderr if done.exit_code else done.stdout


@pytest.fixture
def flight(tmp_path):
    return write_flight(tmp_path / "a.parquet", straight_flight(20, outcome="ok"))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("FLIGHT", "--to", "px4"), "is for a model's folder or vehicle=NAME; flights are"),
        (("FLIGHT", "--to", "csv", "--voltage", "4"), "--voltage: --to csv does not use it"),
        (("FLIGHT", "--to", "ros"), "a flight is written as csv, tum, rerun; a model or a vehicle as px4, px4_sih"),
        (("MODEL", "--to", "csv"), "is for flights"),
        (("vehicle=crazyflie", "--to", "tum"), "is for flights"),
        (("MODEL", "--to", "sdf", "--firmware", "1.2"), "--firmware: --to sdf does not use it"),
        (("MODEL", "--to", "rotorpy", "--voltage", "4"), "--voltage: --to rotorpy does not use it"),
        (("MODEL", "--to", "mjcf", "--motor-lag", "0.1"), "--motor-lag: --to mjcf does not use it"),
        (("MODEL", "--to", "px4", "--voltage", "0"), "--voltage 0: must be above 0"),
        (("MODEL", "--to", "sdf", "--motor-lag", "-1"), "--motor-lag -1: must be above 0"),
        (("MODEL", "--to", "sdf", "--motor-lag", "nan"), "--motor-lag nan: must be above 0"),
        (("MODEL", "--to", "px4", "--vehicle", "hummingbird"), "fitted for vehicle 'crazyflie'"),
        (("MODEL", "--to", "px4", "--vehicle", "nobody"), "vehicle=nobody: no such vehicle"),
        (("vehicle=torrente", "--to", "sdf"), "neither does vehicle=torrente have thrust_coefficient"),
        (("vehicle=crazyflie", "--to", "sdf", "--vehicle", "hummingbird"), "two vehicles"),
        (("nowhere", "--to", "sdf"), "no model there"),
    ],
)
def test_what_cannot_be_written_is_said_in_a_line(checkpoints, flight, tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    before = set(tmp_path.iterdir())
    places = {"FLIGHT": flight, "MODEL": checkpoints / "cf"}
    code, said = run(*(places.get(word, word) for word in words))
    assert code in (1, 2) and message in said and said.strip().count("\n") == 0
    assert set(tmp_path.iterdir()) == before


@pytest.mark.parametrize("to", TARGETS)
def test_every_target_writes_a_file_with_its_origin(checkpoints, tmp_path, monkeypatch, to):
    monkeypatch.chdir(tmp_path)
    more = ("--firmware", "4.5") if to == "betaflight" else ()
    code, said = run(checkpoints / "cf", "--to", to, *more, "--json")
    assert code == 0
    record = json.loads(said)
    assert all(set(row) == {"name", "value", "unit", "half_width", "origin", "note"} for row in record["numbers"])
    assert any("identified" in row["origin"] for row in record["numbers"]) and record["lost"]
    file = tmp_path / max(record["files"].values())
    assert file.name.startswith(f"cf_{to}")
    head = file.read_text()
    for words in ("written by quadexp", "fingerprint c0480468d82a", "model.json sha256", "battery voltage: ", "- "):
        assert words in head
    assert run(checkpoints / "cf", "--to", to, *more)[0] == 2, "a file that is there stays"


def test_the_voltage_scales_the_curve(checkpoints, tmp_path, monkeypatch):
    """s V / V_ref: at 3.6 V the slope is 0.9 and the square 0.81 of that at 4 V."""
    monkeypatch.chdir(tmp_path)
    full = {}
    for voltage in (4.0, 3.6):
        _, said = run(checkpoints / "cf", "--to", "px4", "--voltage", voltage, "--force", "--json")
        full[voltage] = next(row["value"] for row in json.loads(said)["numbers"] if row["name"] == "CA_ROTOR0_CT")
    assert 0.81 < full[3.6] / full[4.0] < 0.9
    assert "battery voltage: 3.6 V" in (tmp_path / "cf_px4.params").read_text()


def test_without_the_plug_in_flights_are_exported_and_the_rest_is_refused(flight, checkpoints, monkeypatch):
    rest = tuple(name for name in plugin.shipped_plugins() if name != "exchange")
    monkeypatch.setattr(plugin, "shipped_plugins", lambda: rest)
    for found in (plugin._shipped, plugin._outside):
        found.cache_clear()
    try:
        assert run(flight, "--to", "csv")[0] == 0
        code, said = run(checkpoints / "cf", "--to", "px4")
        assert code == 2 and "--to px4: no such format; a flight is written as csv, tum, rerun\n" in said
        assert "no plug-in writes it" in run(checkpoints / "cf", "--to", "csv")[1]
    finally:
        for found in (plugin._shipped, plugin._outside):
            found.cache_clear()
