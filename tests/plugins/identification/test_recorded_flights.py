"""A stored flight is composed again, whatever its parts are called and wherever its files lie."""

import json
import shutil
from pathlib import Path

import pytest

from quadexp.errors import UsageError
from quadexp.experiment.evaluate import describe
from quadexp.experiment.identity import flight_record
from quadexp.log.store import write_flight
from quadexp.parts.compose import Composer, compose, session
from quadexp.parts.options import given_folders
from quadexp.plugins.exchange import crazyflies
from quadexp.plugins.identification.config_for import config_for
from quadexp.plugins.margins.recorded import recorded_words
from tests.cli.command import run
from tests.log.flights import straight_flight

EXAMPLES = Path(__file__).resolve().parents[3] / "examples"
SETTINGS = {
    "truth": ["truth.mass=1.2", "truth.thrust_coefficient=1.1"],
    "names": ["controller.name=ours", "plant.name=x", "trajectory.name=q", "wind=constant", "wind.name=breeze"],
    "blank": ["vehicle.name='my quad'", "observer=disturbance", "observer.name='of mine'"],
    "path": ["model='a b/model'", "plant=from_model", "plant.model='c d/it is, mine'"],
    "schedule": ["vehicle=lei_li", "plant=blade_element", "plant.schedule=[{t: 1, payload: 0.1},{t: 2}]"],
    "health": ["health=rotor_loss", "seed=7", "sensor=low", "payload=fixed", "payload.name=cup"],
    "inner keys": ["controller=rls_mpc", "vehicle=lei_li", "controller.rls.noise=0.1", "controller.name=theirs"],
    "name of another option": ["controller=pid", "controller.name=nominal_mpc"],
    "world": ["world=everything", "remedies=auto"],
    "bundle": ["vehicle=sun", "plant=sun", "trajectory=ellipse", "trajectory.name='e 1'"],
}  # fmt: skip


@pytest.mark.parametrize("settings", SETTINGS.values(), ids=SETTINGS)
def test_the_record_is_that_of_the_configuration(settings):
    config = flight_record(compose(settings))
    with session() as composer:
        again = flight_record(composer.compose(recorded_words(composer, config)))
        changed = composer.compose(recorded_words(composer, config, ["seed=3", "trajectory=circle"]))
    names = {group: part.pop("name") for group, part in config.items() if isinstance(part, dict)}
    for group in names:
        again[group].pop("name")
    assert again == config
    assert changed.seed == 3 and changed.trajectory.name == "circle"


def test_a_part_of_ones_own_needs_its_folder():
    settings = ["controller=geometric", "controller.name=mine", "trajectory=helix", "trajectory.speed=3"]
    config = flight_record(compose(settings, EXAMPLES))
    with session(EXAMPLES) as composer:
        again = composer.compose(recorded_words(composer, config))
    assert type(again.trajectory).__name__ == "HelixTrajectory" and again.trajectory.speed == 3
    with session() as composer, pytest.raises(UsageError, match="trajectory=helix: no such option.*--conf"):
        recorded_words(composer, config)


def test_a_class_of_ones_own_with_the_keys_of_a_shipped_one_is_not_taken_for_it(tmp_path):
    (tmp_path / "wind").mkdir()
    (tmp_path / "wind" / "constant.yaml").write_text("_target_: breeze_of_a_test.Breeze\n")
    own = "from quadexp.world.constant_wind import ConstantWind\n\n\nclass Breeze(ConstantWind):\n    pass\n"
    (tmp_path / "breeze_of_a_test.py").write_text(own)
    for conf, other in ((tmp_path, None), (None, tmp_path)):
        config = compose(["wind=constant"], conf)
        about = describe(config, config.vehicle, None)
        with session(conf) as composer:
            words = recorded_words(composer, about["config"], (), about["classes"])
            assert type(composer.compose(words).wind) is type(config.wind)
        with session(other) as composer, pytest.raises(UsageError, match="wind=constant: .*--conf"):
            recorded_words(composer, about["config"], (), about["classes"])


CHANGES = [["world=clean"], ["horizon=precise"], ["remedies=offset_free", "world=only_wind"]]


@pytest.mark.parametrize("chosen", CHANGES, ids=" ".join)
def test_a_bundle_or_preset_that_is_chosen_comes_before_what_was_recorded(chosen):
    settings = ["world=everything", "trajectory=hover", "observer=wind" if "horizon" in chosen[0] else "horizon=stiff"]
    with session() as composer:
        recorded = recorded_words(composer, flight_record(composer.compose(settings)), chosen)
        assert flight_record(composer.compose(recorded)) == flight_record(composer.compose([*settings, *chosen]))


def test_margins_where_the_rotors_stand_at_their_limits_are_those_of_the_loop(here):
    """Not 500 ms, for no command follows the state there: simulate refuses the same loop as not stable."""
    hover = ["trajectory=hover", "trajectory.duration=0.3", "world=everything", "horizon=precise"]
    code, out, err = run("show", "--margins", *hover, "--json")
    assert code == 0 and "not stable" in run("simulate", *hover, "--out", "a.parquet")[2]
    (row,) = json.loads(out)["margins"]
    assert row["growth"] > 1 and row["delay"] == row["lag"] == 0, err


def test_margins_of_a_file_with_any_name(here):
    hover = ["trajectory=hover", "trajectory.duration=0.2", "controller=geometric", "controller.name=ours"]
    assert run("simulate", *hover, "truth.mass=1.1", "--out", "a.parquet")[0] == 0
    Path("my runs").mkdir()
    shutil.copy("a.parquet", "my runs/a=b.parquet")
    first, second = (run("show", "--margins", path) for path in ("a.parquet", "my runs/a=b.parquet"))
    assert first[0] == 0 and first[1] == second[1], first[2] + second[2]


def test_a_flight_without_a_record_of_settings_has_no_margins(here):
    """They were those of the settings that hold where none is given."""
    write_flight(Path("recorded.parquet"), straight_flight())
    code, out, err = run("show", "--margins", "recorded.parquet")
    assert code == 2 and "without a record of its settings" in err and not out


def test_the_vehicle_of_a_flight_has_a_name_of_its_own(here):
    named = ["vehicle.name='my quad'", "vehicle.mass=1.1"]
    assert run("simulate", "trajectory=hover", "trajectory.duration=0.2", *named, "--out", "a.parquet")[0] == 0
    config = config_for([Path("a.parquet")])
    assert config.vehicle.mass == 1.1
    assert config_for([Path("a.parquet")], named).vehicle.name == "my quad"


def test_settings_are_found_without_the_packages_that_other_options_need(monkeypatch):
    """Not those of the Crazyflies, whose numbers a package has; such an option itself says which."""
    monkeypatch.setattr(crazyflies, "FILES", {})
    composer = Composer(given_folders(None))  # which has read nothing before
    record = flight_record(composer.compose(["trajectory=hover", "truth.mass=1.1"]))
    words = recorded_words(composer, record)
    assert flight_record(composer.compose(words)) == record
    with pytest.raises(UsageError, match="pip install crazyflow"):
        composer.compose(["vehicle=cf2x_L250"])
