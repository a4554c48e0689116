"""The worked examples of one's own parts: short, and right about the physics they claim."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from quadexp.config.compose import compose
from quadexp.experiment.build import build_plant, build_trajectory, build_vehicle
from quadexp.experiment.evaluate import fly_one
from quadexp.physics.state import VELOCITY
from quadexp.report.metrics import position_error
from quadexp.sweep.sweep import run_sweep

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
INTERPRETED = ("plant.backend=interpreted", "controller.backend=interpreted")


def flown(*overrides, conf=EXAMPLES):
    flight = fly_one(compose(overrides, conf))
    assert flight.outcome == "ok"
    return flight


def error(flight):
    """Mean position error, m."""
    return flight.metadata["row"]["mean_error"]


def test_each_is_under_60_lines():
    parts = [path for kind in ("*.py", "*/*.yaml") for path in EXAMPLES.glob(kind)]
    assert len(parts) >= 9
    for path in parts:
        assert len(path.read_text().splitlines()) < 60, path


def test_the_helix_is_smooth_and_flown():
    trajectory = build_trajectory(compose(["trajectory=helix", "trajectory.speed=4"], EXAMPLES).trajectory)
    t = np.linspace(0.0, trajectory.duration, 4001)
    position = trajectory.flat_output(t).position
    for order in range(4):
        slope = np.gradient(position[:, order], t, axis=0, edge_order=2)
        scale = np.abs(position[:, order + 1]).max()
        assert np.abs(slope - position[:, order + 1])[2:-2].max() < 1e-4 * scale
    assert np.abs(position[[0, -1], 1:]).max() < 1e-9
    assert np.linalg.norm(position[:, 1], axis=1).max() == pytest.approx(4.0, rel=1e-6)
    assert error(flown("trajectory=helix", "trajectory.options.turns=1", "plant=ideal", *INTERPRETED)) < 2e-3


def test_the_motors_lag():
    config = compose(["plant=motor_lag", "plant.options.drag=[0,0,0]"], EXAMPLES)
    vehicle = build_vehicle(config.vehicle)
    plant = build_plant(vehicle, config.plant)
    x, rng = np.zeros(13), np.random.default_rng(0)
    x[3] = 1.0
    plant.reset()
    end, reading = plant.advance(x, np.full(4, 1.5 * vehicle.hover_thrust), 0.06, rng)
    arrived = 1 + 0.5 * (1 - np.exp(-2.0))  # two time constants
    assert reading[2] == pytest.approx(vehicle.gravity * arrived, rel=1e-6)
    # v = g/2 (t - tau (1 - exp(-t / tau)))
    assert end[VELOCITY][2] == pytest.approx(vehicle.gravity / 2 * (0.06 - 0.03 * (1 - np.exp(-2.0))), rel=1e-6)


def test_knowing_the_air_helps_although_the_lag_stays():
    plant = ("trajectory=helix", "trajectory.options.turns=1", "plant=motor_lag")
    nominal, perfect = (flown(*plant, f"controller={name}", INTERPRETED[1]) for name in ("nominal_mpc", "perfect_mpc"))
    assert error(perfect) < 0.05 * error(nominal)


def test_cubic_drag_is_what_it_says():
    from examples.cubic_drag import cubic_drag

    residual = cubic_drag(build_vehicle(compose([]).vehicle), coefficient=0.01)
    features = np.zeros((1, 10))
    features[0, :3] = 3.0, 0.0, 4.0
    np.testing.assert_allclose(residual(features), [[-0.75, 0, -1.0, 0, 0, 0]], rtol=1e-12)
    flight = flown("trajectory=helix", "trajectory.options.turns=1", "controller=cubic_drag_mpc", *INTERPRETED)
    assert flight.metadata["residual"]["name"] == "cubic_drag"


def test_geometric_control_tracks_and_suffers_from_the_air():
    circle = ("controller=geometric", "trajectory=circle", "trajectory.speed=3", INTERPRETED[0])
    without, within = (flown(*circle, f"plant={plant}") for plant in ("ideal", "simplified"))
    assert error(without) < 0.01
    assert error(within) > 5 * error(without)


def test_six_rotors():
    flight = flown("vehicle=hexacopter", "trajectory=circle", "trajectory.speed=4", "plant=ideal", *INTERPRETED)
    assert flight.n_rotors == 6 and error(flight) < 2e-3


def test_a_loop_of_ones_own_flies_what_simulate_flies():
    from examples.own_loop import main

    overrides = ["plant=ideal", "trajectory=circle", "trajectory.speed=4", "controller=perfect_mpc", *INTERPRETED]
    np.testing.assert_allclose(main(overrides), position_error(fly_one(compose(overrides))), rtol=1e-9, atol=1e-15)


def test_a_loop_of_ones_own_takes_any_controller():
    from examples.own_loop import main

    vehicle = ["vehicle=lei_li", "plant=blade_element", "trajectory=hover", "trajectory.duration=0.5"]
    for controller, far in (("rls_feedback", 0.1), ("rls_mpc", 0.05)):  # m; both begin with half the true coefficients
        assert main([*vehicle, f"controller={controller}", *INTERPRETED]).max() < far


def test_an_edited_class_is_flown_anew(tmp_path, monkeypatch):
    """Its source is an input of the flight, like a checkpoint."""
    conf = tmp_path / "conf"
    shutil.copytree(EXAMPLES, conf)
    module = conf / "circle_of_mine.py"
    text = "from quadexp.reference.hover import Hover\n\ndef make(duration):\n    return Hover(duration=duration)\n"
    module.write_text(text)
    (conf / "trajectory" / "mine.yaml").write_text(
        "defaults: [/schema/trajectory/custom@_here_, _self_]\nname: mine\n_target_: circle_of_mine.make\n"
        "options: {duration: 1.0}\n"
    )
    monkeypatch.syspath_prepend(str(conf))

    def sweep():
        from quadexp.config.compose import expand

        cells = expand(["trajectory=mine", "seed=0,1", *INTERPRETED], conf)
        return run_sweep(cells, tmp_path / "results", isolate=False)

    assert sweep().flown == 2
    assert sweep().flown == 0
    module.write_text(text + "# edited\n")
    assert sweep().flown == 2
