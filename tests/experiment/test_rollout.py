"""The reference that a flight follows, as its controller sees it."""

import numpy as np
import pytest

import quadexp as qx
from quadexp.control.mpc.mpc import ModelPredictiveController
from quadexp.control.mpc.settings import MPCSettings
from quadexp.experiment.evaluate import fly_one
from quadexp.experiment.rollout import SampledReference, fly
from quadexp.models.residual import no_residual
from quadexp.parts.compose import compose
from quadexp.physics.rotation import heading
from quadexp.physics.state import ATTITUDE
from quadexp.plugins.laws.dfbc import FlatnessBased
from quadexp.reference.circle import Circle
from quadexp.reference.flatness import flat_reference
from quadexp.reference.hover import Hover
from quadexp.world.simplified import PlantEffects, SimplifiedPlant


@pytest.mark.parametrize(
    ("rate", "nodes", "first_node"),
    [(50.0, 10, 0.0), (100.0, 10, 0.0), (50.0, 20, 0.0), (30.0, 8, 0.0), (50.0, 10, 0.02)],
    ids=["5", "10", "2.5", "3.75", "growing"],
)
def test_horizons_are_the_trajectory_at_the_nodes(vehicle, rate, nodes, first_node):
    """Whether or not the node period is a whole number of control periods (the id says how many)."""
    settings, path = MPCSettings(rate=rate, nodes=nodes, first_node=first_node), Circle(speed=3.0)
    controller = ModelPredictiveController(vehicle, no_residual(vehicle), settings, backend="interpreted")
    reference = SampledReference(path, controller)
    whole = not first_node and (settings.node_period / settings.control_period) % 1 < 1e-9
    for k in (0, 1, len(reference) // 2, len(reference) - 1):
        states, inputs = reference.horizon(k)
        times = k * settings.control_period + np.r_[0.0, np.cumsum(settings.node_periods)]
        exact = flat_reference(path, times, vehicle)
        turned = np.sign((states[0, 3:7] * exact.state[0, 3:7]).sum())  # the sign of q is free at the start
        exact.state[:, 3:7] *= turned
        assert states.shape == (nodes + 1, 13) and inputs.shape == (nodes, vehicle.n_rotors)
        assert np.allclose(states, exact.state, atol=1e-7) and np.allclose(inputs, exact.input[:-1], atol=1e-6)
        assert states.flags.writeable != whole  # then it is a view into what later steps will see


def test_what_a_controller_sees_cannot_be_changed_by_it(vehicle):
    controller = ModelPredictiveController(vehicle, no_residual(vehicle), backend="interpreted")
    reference = SampledReference(Circle(speed=3.0), controller)
    states, _ = reference.horizon(0)
    with pytest.raises(ValueError, match="read-only"):
        states[0, 0] = 1.0


HELD = ("trajectory=hover", "wind=constant")


@pytest.mark.parametrize(
    ("given", "outcome", "reaches"),
    [
        (("vehicle=crazyflie", *HELD, "wind.velocity=[9,0,0]", "trajectory.duration=1"), "left_corridor", 20 * 0.092),
        (("vehicle=torrente", *HELD, "wind.velocity=[9,0,0]", "trajectory.duration=1"), "ok", 20 * 0.47),
        (("vehicle=crazyflie", *HELD, "wind.velocity=[30,0,0]", "trajectory.duration=1"), "lost", 20 * 0.092),
        (("vehicle=crazyflie", "plant=ideal", "trajectory=step", "trajectory.target=[4,0,1]"), "ok", 20 * 0.092 + 4),
    ],
)
def test_a_flight_ends_well_inside_a_corridor_in_sizes_of_its_vehicle(given, outcome, reaches):
    """With 6.5 m from its place a vehicle of 92 mm has left it; a set-point that jumps takes its corridor along."""
    flight = fly_one(compose([*given, "controller.backend=interpreted", "plant.backend=interpreted"]))
    row = flight.metadata["row"]
    assert flight.outcome == row["outcome"] == outcome and (flight.metadata["cause"] == "") is (outcome == "ok")
    assert flight.metadata["corridor"] == pytest.approx(reaches, rel=1e-4)
    assert (row["max_error"] > reaches) is (outcome == "left_corridor")
    assert np.isnan([row[name] for name in ("mean_error", "rmse", "max_error")]).all() == (outcome == "lost")


def test_a_renewal_that_fails_is_tried_again_after_twice_the_time():
    """And after the usual time once it has succeeded."""
    from quadexp.errors import UsageError
    from quadexp.experiment.rollout import Renewal

    made = []

    class Reference:
        residual_share = 1.0

        def renew(self, residual):
            made.append(k)
            if k < 60:
                raise UsageError("no reference")

    renewal = Renewal(10)
    for k in range(160):
        if renewal.due(k):
            renewal.renew(k, Reference(), None)
    assert made == [10, 30, 70, 80, 90, 100, 110, 120, 130, 140, 150]
    assert renewal.failed == 2
    assert not Renewal(0).due(0)


@pytest.mark.parametrize(
    "settings",
    [
        ("dfbc",),
        ("geometric",),
        ("pid",),
        ("static_feedback", "vehicle=lei_li", "plant=blade_element", "sensor=perfect"),
    ],
    ids=lambda settings: settings[0],
)
def test_a_free_heading_is_that_of_the_references_attitude(settings):
    """Every law follows it, round by round, and no score counts it."""
    controller, *others = settings
    backends = ("controller.backend=interpreted", "plant.backend=interpreted")
    flight = qx.simulate(f"controller={controller}", *others, *backends, "trajectory=circle", speed=3, radius=1.5)
    flown, wanted = (
        np.unwrap(heading(q[:, ATTITUDE])) for q in (flight.arrays().state, flight.arrays().reference_state)
    )
    assert np.ptp(wanted) > 1.0 and flight.outcome == "ok"
    assert np.sqrt(np.mean((flown - wanted) ** 2)) < 0.2 * np.ptp(wanted)
    assert flight.metrics["heading_rmse"] is None


@pytest.mark.parametrize(("broken", "ends"), [("reading", 0.5), ("rotor_speed", 0.5), (None, 1.0), ("state", 0.4)])
def test_a_flight_ends_where_what_is_measured_is_refused(vehicle, broken, ends):
    """A plant from outside whose sensors fail after 0.4 s: the last readings are held for HELD. A state that is no
    number ends the flight, and is said to be the plant's."""

    class Failing(SimplifiedPlant):
        rotor_speed = np.full(4, 400.0)

        def advance(self, x, u, duration, rng=None):
            x, reading = super().advance(x, u, duration, rng)
            failed = self.time > 0.4
            self.rotor_speed = np.full(4, np.nan if failed and broken == "rotor_speed" else 400.0)
            state = x + (np.nan if failed and broken == "state" else 0.0)
            return state, reading + (np.nan if failed and broken == "reading" else 0.0)

    dfbc = FlatnessBased(backend="interpreted").controller(vehicle)
    plant = Failing(vehicle, PlantEffects.none(), step=0.01, backend="interpreted")
    flight = fly(plant, dfbc, SampledReference(Hover(position=(0, 0, 1), duration=1.0), dfbc), np.random.default_rng(0))
    assert flight.t[-1] == pytest.approx(ends, abs=0.01)
    if broken == "state":
        assert flight.outcome == "lost"
        assert flight.metadata["cause"].startswith("the plant's state is not finite at t=0.4")
    else:
        assert flight.outcome == ("solver_failed" if broken else "ok")
