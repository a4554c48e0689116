"""trajectory=random as it stands: flown cleanly, on every seed, by who knows the air and who does not."""

import math

import numpy as np
import pytest

from quadexp.experiment.build import build_trajectory, build_vehicle
from quadexp.experiment.evaluate import fly_one
from quadexp.parts.compose import compose
from quadexp.report.summary import flight_lines

# Without a model of drag the MPC leans on its feedback, some of whose thrusts meet a limit that the reference keeps.
SATURATED = {"nominal_mpc": 0.05, "perfect_mpc": 0.01}
PERFECT_ERROR = 0.05  # m


def fly(seed, controller, *overrides):
    return fly_one(compose(["trajectory=random", f"seed={seed}", f"controller={controller}", *overrides]))


def clean(flight, controller):
    row = flight.metadata["row"]
    assert flight.outcome == "ok" and row["saturated_share"] < SATURATED[controller]
    assert row["peak_speed"] < 8.5
    if controller == "perfect_mpc":
        assert row["max_error"] < PERFECT_ERROR
    reference = flight.stack([f"ref_u_{i}" for i in range(4)])
    if controller == "nominal_mpc":
        assert reference.min() > 0.5 and reference.max() < 16.0


@pytest.mark.parametrize("controller", SATURATED)
@pytest.mark.parametrize("seeds", [(0, 7), pytest.param(range(100), marks=pytest.mark.slow)])
def test_the_default_is_clean(controller, seeds):
    for seed in seeds:
        clean(fly(seed, controller), controller)


@pytest.mark.parametrize("vehicle", ["vehicle=lei_li", "vehicle=crazyflie", "vehicle=blackbird"])
def test_other_vehicles_too(vehicle):
    flight = fly(3, "nominal_mpc", vehicle, "plant=ideal")
    row = flight.metadata["row"]
    assert flight.outcome == "ok" and row["saturated_share"] == 0 and row["max_error"] < 0.2


def test_limits_are_left_alone_where_that_is_allowed():
    allowed = compose(["trajectory=random", "trajectory.speed=16", "trajectory.allow_infeasible=true"])
    path = build_trajectory(allowed.trajectory, build_vehicle(allowed.vehicle))
    assert path.peak_speed == pytest.approx(16.0, rel=1e-9) and path.note == ""


def test_the_note_says_where_a_limit_comes_before_the_speed():
    flight = fly(1, "nominal_mpc", "trajectory.speed=20")
    assert "instead of the requested 20 m/s: a higher one would bring rotor" in flight.metadata["reference_note"]
    slow = fly(1, "nominal_mpc", "trajectory.speed=3")
    assert slow.metadata["reference_note"] == ""
    speeds = np.linalg.norm(slow.stack(["ref_v_x", "ref_v_y", "ref_v_z"]), axis=1)
    assert speeds.max() == pytest.approx(3.0, abs=2e-3)


class TestFlownByAll:
    """What the nominal controller flies, those that know more fly too: their references contain what they can."""

    @pytest.fixture(scope="class")
    def model(self, tmp_path_factory):
        """A Gaussian process of the default features, learned from half a minute of flights."""
        from quadexp.experiment.collect import collect_dataset
        from quadexp.requests import fit

        folder = tmp_path_factory.mktemp("model")
        collect_dataset(compose(["collect.duration=30"]), folder / "residuals.parquet")
        fit("gp", folder / "residuals.parquet", ["gp.inducing=10"], folder / "gp", figures=False)
        return folder / "gp"

    SLOW = [pytest.param(extent, range(20), marks=pytest.mark.slow) for extent in (20, 40)]

    @pytest.mark.parametrize(("extent", "seeds"), [(20, (2,)), (40, (3,)), *SLOW])
    def test_fast_random_paths(self, model, extent, seeds):
        for seed in seeds:
            self.compare(model, extent, seed)

    def compare(self, model, extent, seed):
        path = [f"trajectory.extent={extent}", "trajectory.speed=20"]
        nominal = fly(seed, "nominal_mpc", *path)
        assert nominal.outcome == "ok" and nominal.metadata["reference_residual"] is None
        for controller in (["perfect_mpc"], ["gp_mpc", f"model={model}"]):
            flight = fly(seed, *controller, *path)
            assert flight.outcome == "ok"
            share = flight.metadata["row"]["reference_residual"]
            assert 0 <= share <= 1 and share == flight.metadata["reference_residual"]
            assert flight.metadata["row"]["mean_error"] < nominal.metadata["row"]["mean_error"]
            line = [line for line in flight_lines(flight.metadata) if line.startswith("reference")]
            assert bool(line) == (share < 1)
            assert not line or f"contains {math.floor(100 * share)} % of the residual" in line[0]

    def test_identified_in_flight(self):
        """The share is the mean over the references that were made in flight."""
        lei_li = ["vehicle=lei_li", "plant=blade_element", "sensor=lei_li", "trajectory.extent=40"]
        whole = fly(2, "rls_mpc", *lei_li, "trajectory.speed=18")
        assert whole.outcome == "ok" and whole.metadata["reference_residual"] == 1.0
        part = fly(3, "rls_mpc", *lei_li, "trajectory.speed=60")
        assert part.outcome != "infeasible" and 0 < part.metadata["reference_residual"] < 1

    def test_a_reference_without_feedforward_has_none_by_design(self):
        flight = fly(0, "perfect_mpc", "controller.feedforward=false")
        assert flight.metadata["reference_residual"] is None

    def test_the_share_is_a_column_of_results(self, tmp_path):
        from quadexp.log.store import read_table
        from quadexp.parts.compose import expand
        from quadexp.sweeps.sweep import SweepRequest, run_sweep

        grid = ["trajectory=random", "trajectory.extent=20", "trajectory.speed=60", "seed=2"]
        result = run_sweep(
            expand([*grid, "controller=nominal_mpc,perfect_mpc"]), tmp_path / "r", SweepRequest(workers=1)
        )
        shares = {row["controller"]: row["reference_residual"] for row in result.rows}
        assert shares["nominal_mpc"] is None and 0 < shares["perfect_mpc"] < 1
        columns, _ = read_table(tmp_path / "r" / "results.parquet", "results")
        assert np.isnan(columns["reference_residual"]).sum() == 1
        assert "reference_residual" in (tmp_path / "r" / "results.csv").read_text().splitlines()[0]
