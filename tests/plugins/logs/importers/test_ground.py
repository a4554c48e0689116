"""Rest on the ground is left out wherever it stands in a log, and named where it stays."""

import numpy as np
import pytest

from quadexp.log.schema import Flight
from quadexp.plugins.check.quality import check_flight
from quadexp.plugins.logs.importers import Options, checked, import_log
from quadexp.plugins.logs.signal.rest import at_rest
from tests.plugins.logs.importers.logs import MAPPING, truth, ulog, write_csv

G, RATE = 9.81, 100.0
AUTO = MAPPING.replace("crop: none", "crop: auto")


def with_ground(drift: float, flights: int = 1, seed: int = 0) -> Flight:
    """Ground (10 s), flight (20 s), ground (8 s), motors off on the ground; the height drifts by `drift` (m)."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, 38 * flights, 1 / RATE)
    share = np.clip((t % 38 - 10) / 20, 0, 1)
    up = np.clip(np.minimum(share, 1 - share) / 0.15, 0, 1)
    up = up**3 * (10 - 15 * up + 6 * up**2)
    side = 3 * up * np.sin(2 * np.pi * (t % 38 - 10) / 4)
    p = np.column_stack([side, 0 * t, 2 * up])
    v = np.gradient(p, 1 / RATE, axis=0)
    a = np.gradient(v, 1 / RATE, axis=0)
    tilt = np.arctan2(a[:, 0] + 0.3 * v[:, 0] * (up > 0), a[:, 2] + G)
    q = np.column_stack([np.cos(tilt / 2), 0 * t, np.sin(tilt / 2), 0 * t])
    f = np.column_stack([
        np.cos(tilt) * a[:, 0] - np.sin(tilt) * (a[:, 2] + G), 0 * t,
        np.sin(tilt) * a[:, 0] + np.cos(tilt) * (a[:, 2] + G),
    ])  # fmt: skip
    w = np.column_stack([0 * t, np.gradient(tilt, 1 / RATE), 0 * t]) + 0.005 * rng.normal(size=p.shape)
    p[:, 2] += drift * np.floor(t / 38) + drift * share
    columns = {"t": t}
    for name, values in (("p", p), ("v", v), ("w", w), ("acc", f + 0.03 * rng.normal(size=p.shape))):
        columns |= {f"{name}_{axis}": values[:, i] for i, axis in enumerate("xyz")}
    columns |= {f"q_{axis}": q[:, i] for i, axis in enumerate("wxyz")}
    flying = (share > 0) & (share < 1)
    columns |= {f"motor_command_{i}": np.where(flying, np.sqrt(f[:, 2].clip(0) / 40), 0.02) for i in range(4)}
    return Flight(columns, {"recorded": True})


def cropped(folder, flight: Flight, mapping: str = AUTO, **options) -> tuple[Flight, list[str]]:
    (folder / "mapping.yaml").write_text(mapping)
    log = write_csv(folder / "log.csv", dict(flight.columns))
    chosen = Options(mapping=folder / "mapping.yaml", **options)
    return import_log(log, None, chosen, checked(chosen))


@pytest.mark.parametrize("drift", [-0.3, 0.0, 0.3])
@pytest.mark.parametrize("lacking", [(), ("motor_command",), ("acc", "w_", "v_"), ("p_",)])
def test_rest_goes_at_any_height(drift, lacking, tmp_path):
    flight = with_ground(drift, 2)
    left = {name: x for name, x in flight.columns.items() if not name.startswith(lacking or "none")}
    mapping = "\n".join(x for x in AUTO.splitlines() if not any(f"[{name}" in x for name in lacking))
    kept, notes = cropped(tmp_path, Flight(left, {}), mapping)
    steps = np.diff(kept.t) > 1
    assert steps.sum() == 1 and kept["segment"].max() == 1  # two flights, the ground between them a gap
    assert 28 < len(kept) / RATE < 36 and any("at rest in 4" in note for note in notes)


def test_rest_that_stays_is_named(tmp_path):
    kept, _ = cropped(tmp_path, with_ground(0.3, 2), crop=False)
    found = [one for one in check_flight(kept) if one.name == "ground_phase"]
    assert found and found[0].blocks and "47" in found[0].measured


def test_a_hover_and_a_fall_are_no_rest():
    t = np.arange(0, 20, 0.01)
    still = {"f": np.tile([0, 0, G], (len(t), 1)), "w": np.zeros((len(t), 3)), "v": np.zeros((len(t), 3))}
    assert not at_rest(t, still, np.full(len(t), 0.4)).any()
    thrust = np.where((t > 5) & (t < 6), 0.0, 0.4)
    falling = {**still, "f": np.where((thrust == 0)[:, None], 0.0, still["f"])}
    assert not at_rest(t, falling, thrust).any()


def test_ulog_takes_crop_and_corrections_of_a_mapping(tmp_path):
    log = ulog(tmp_path / "a.ulg", truth(20.0))
    mapping = tmp_path / "m.yaml"
    mapping.write_text("format: ulog\ncrop: {height: 100}\ncorrections: [{velocity: {scale: 2}}]\n")
    options = Options(mapping=mapping)
    flight, notes = import_log(log, None, options, checked(options))
    plain, _ = import_log(log, None, Options(crop=False))
    assert np.allclose(flight["v_x"], 2 * plain["v_x"]) and any("never in the air" in note for note in notes)


@pytest.mark.parametrize("idle", [0.0, 0.1, 0.15])
@pytest.mark.parametrize("hover", [0.2, 0.45])
def test_motors_that_idle_on_the_ground_and_a_vehicle_with_much_thrust(idle, hover):
    """5 s of idle with the shaking of it, 10 s of hover, 5 s of hard manoeuvres."""
    rng = np.random.default_rng(0)
    t = np.arange(0, 20, 0.01)
    flies, hard = t > 5, t > 15
    lift = np.where(hard, 1 + 2 * np.sin(3 * t) ** 2, 1.0)
    f = np.column_stack([0 * t, 0 * t, np.where(flies, lift, 1.0) * G]) + 0.3 * rng.normal(size=(len(t), 3))
    command = np.where(flies, np.minimum(hover * np.sqrt(lift), 1.0), min(idle, 0.5 * hover))
    rest = at_rest(t, {"f": f, "w": 0.1 * rng.normal(size=(len(t), 3))}, command**2)
    assert rest[20:480].all() and not rest[520:].any()
