"""The worked examples of user-written parts together; what each claims is tested beside it, in examples/test_*.py."""

import shutil
from pathlib import Path

import numpy as np

from quadexp.experiment.evaluate import fly_one
from quadexp.parts.compose import compose
from quadexp.report.metrics import position_error
from quadexp.sweeps.sweep import SweepRequest, run_sweep

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
    assert len(parts) >= 15
    for path in parts:
        assert len(path.read_text().splitlines()) < 80, path


def test_knowing_the_air_helps_although_the_lag_stays():
    plant = ("trajectory=helix", "trajectory.turns=1", "plant=motor_lag")
    nominal, perfect = (flown(*plant, f"controller={name}", INTERPRETED[1]) for name in ("nominal_mpc", "perfect_mpc"))
    assert error(perfect) < 0.05 * error(nominal)


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
    text = "from quadexp.reference.hover import Hover\n\nclass Mine(Hover): pass\n"
    module.write_text(text)
    (conf / "trajectory" / "mine.yaml").write_text("_target_: circle_of_mine.Mine\nduration: 1.0\n")
    monkeypatch.syspath_prepend(str(conf))

    def sweep():
        from quadexp.parts.compose import expand

        cells = expand(["trajectory=mine", "seed=0,1", *INTERPRETED], conf)
        return run_sweep(cells, tmp_path / "results", SweepRequest(isolate=False))

    assert sweep().flown == 2
    assert sweep().flown == 0
    module.write_text(text + "# edited\n")
    assert sweep().flown == 2
