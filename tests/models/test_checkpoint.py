"""A checkpoint gives back every bit, and nothing that was touched, or meant for another vehicle, is flown."""

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace

from quadexp.errors import DataError, UsageError
from quadexp.models.checkpoint import load_model, load_report, save_model
from quadexp.models.linear_drag import fit_linear_drag
from tests.deleted import needs
from tests.models.synthetic import synthetic_dataset
from tests.models.test_dataset import VEHICLE

STORED = Path(__file__).parent / "stored"
EXPECTED = json.loads((STORED / "expected.json").read_text())


def assert_same_bits(a, b) -> None:
    assert type(a) is type(b)
    if isinstance(a, msgspec.Struct):
        for name in a.__struct_fields__:
            assert_same_bits(getattr(a, name), getattr(b, name))
    elif isinstance(a, np.ndarray):
        assert a.shape == b.shape and a.tobytes() == b.tobytes()
    elif isinstance(a, tuple):
        assert len(a) == len(b)
        for left, right in zip(a, b, strict=True):
            assert_same_bits(left, right)
    else:
        assert a == b


def test_round_trip_is_bit_exact(tmp_path, model, dataset):
    path = save_model(tmp_path / "gp", model, report={"rows": []})
    loaded = load_model(path)
    assert_same_bits(loaded, model)
    for output, prediction in model.predict(dataset).items():
        assert_same_bits(loaded.predict(dataset)[output], prediction)
    assert load_report(path) == {"rows": []}
    assert sorted(os.listdir(tmp_path)) == ["gp"]


def tamper(path, change):
    document = json.loads((path / "model.json").read_text())
    change(document)
    (path / "model.json").write_text(json.dumps(document))


def test_damaged_or_foreign_checkpoints_are_refused(tmp_path, model):
    path = save_model(tmp_path / "gp", model)

    tamper(path, lambda d: d["payload"]["outputs"][0]["alpha"].__setitem__(3, 0.0))
    with pytest.raises(DataError, match="does not match its sha256"):
        load_model(path)
    save_model(path, model, force=True)
    tamper(path, lambda d: d.__setitem__("schema", 99))
    with pytest.raises(DataError, match="schema 99, this program reads schema 2"):
        load_model(path)
    text = json.dumps({"schema": 2})
    for damaged in (text, "[]", '{"schema": 2, "sha', "\x00\x01"):
        (path / "model.json").write_text(damaged)
        with pytest.raises(DataError, match="damaged"):
            load_model(path)
    (path / "model.json").write_bytes(b"\xff\xfe\x80")
    with pytest.raises(DataError, match="damaged"):
        load_model(path)


def test_other_vehicle_is_refused(tmp_path, model):
    own = replace(model, vehicle={"name": VEHICLE.name, "fingerprint": VEHICLE.fingerprint})
    path = save_model(tmp_path / "gp", own)
    load_model(path, vehicle=VEHICLE)
    with pytest.raises(DataError, match="fitted for vehicle 'test' .*, not for 'heavy'"):
        load_model(path, vehicle=dataclasses.replace(VEHICLE, name="heavy", mass=2.0))


def test_missing_model_names_the_command(tmp_path):
    with pytest.raises(UsageError, match="no model there; make one with `quadexp fit MODEL"):
        load_model(tmp_path / "gp")


def test_existing_checkpoint_needs_force_and_other_files_are_kept(tmp_path, model, dataset):
    path = save_model(tmp_path / "gp", model)
    (path / "notes.txt").write_text("mine")
    with pytest.raises(UsageError, match="--force"):
        save_model(path, model)
    save_model(path, fit_linear_drag(dataset), force=True)
    assert not hasattr(load_model(path), "outputs")
    assert (path / "notes.txt").read_text() == "mine"


def test_a_number_that_is_not_finite_is_never_written(tmp_path, model):
    with pytest.raises(ValueError):
        save_model(tmp_path / "gp", replace(model, feature_range={"v_x": [float("nan"), 1.0]}))
    assert os.listdir(tmp_path) == []


def test_loading_needs_no_torch(tmp_path, model):
    path = save_model(tmp_path / "gp", model)
    program = (
        "import sys; from quadexp.models.checkpoint import load_model;"
        f"load_model({str(path)!r}); print([m for m in ('torch', 'gpytorch', 'casadi', 'pyarrow') if m in sys.modules])"
    )
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"


@pytest.mark.parametrize("name", sorted(EXPECTED))
@needs()
def test_a_stored_checkpoint_predicts_what_it_did(name):
    """Stored with what it predicted at three rows (of an identified vehicle: at one state)."""
    model = load_model(STORED / f"{name}.json")
    if name == "vehicle_model":
        velocity, rotors = np.array([[1.0, -2.0, 0.5]]), np.full((1, 4), 2.5)
        found = {kind: terms.acceleration(velocity, rotors)[0] for kind, terms in model.models.items()}
    else:
        rows = synthetic_dataset(400, 4).rows(np.arange(0, 400, 150))
        found = {output: prediction.mean for output, prediction in model.predict(rows).items()}
    assert found.keys() == EXPECTED[name].keys()
    for key, values in EXPECTED[name].items():
        np.testing.assert_allclose(found[key], values, rtol=1e-12)
