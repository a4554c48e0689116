"""Stiffness in yaw at every heading: the published attitude error loses it, and a flight says so."""

import math

import numpy as np
import pytest

from quadexp.control.mpc.attitude_error import yaw_share
from quadexp.experiment.evaluate import fly_one
from quadexp.parts.compose import compose, expand
from quadexp.report.metrics import heading_error
from quadexp.report.summary import flight_lines

PUSHED = ["trajectory=hover", "trajectory.duration=3", "external=push", "external.torque=[0,0,0.01]"]
PLAIN = (0.0, 0.1, 0.1, 0.1)


def held(*overrides):
    """The heading error at the end (deg), and whether the note appears."""
    flight = fly_one(compose(["controller=nominal_mpc", *PUSHED, *overrides]))
    note = [line for line in flight_lines(flight.metadata) if "controller.attitude_error=body" in line]
    return abs(math.degrees(heading_error(flight)[-1])), len(note) == 1


@pytest.mark.parametrize("yaw", [math.pi / 2, 2.1, 3.0, math.pi, -math.pi, 3.5])
def test_the_error_rotation_holds_every_heading_alike(yaw):
    there, noted = held(f"trajectory.yaw={yaw}", "controller.attitude_error=body")
    north, _ = held("controller.attitude_error=body")
    assert there == pytest.approx(north, rel=0.05) and not noted


@pytest.mark.parametrize(
    ("yaw", "noted"), [(0.0, False), (1.2, False), (math.pi / 2, True), (math.pi, True), (-3.0, True)]
)
def test_a_flight_whose_yaw_is_soft_says_so(yaw, noted):
    error, says = held(f"trajectory.yaw={yaw}")
    assert says == noted
    assert not abs(yaw) > 3 or error > 1.5 * held()[0]


def test_a_path_on_which_the_heading_turns_says_so_too():
    """Towards the centre of an ellipse, once around."""
    flight = fly_one(compose(["trajectory=ellipse", "trajectory.heading=centre", "trajectory.speed=3", "plant=ideal"]))
    assert any("attitude_error=body" in line for line in flight_lines(flight.metadata))


@pytest.mark.parametrize("controller", ["dfbc", "geometric", "pid"])
def test_laws_without_that_error_say_nothing(controller):
    assert not held(f"controller={controller}", "trajectory.yaw=3.14")[1]


@pytest.mark.parametrize("weight", [PLAIN, (0.1, 0.1, 0.1, 0.1), (0.0, 0.3, 0.1, 0.05)])
def test_the_share_is_the_curvature_of_the_cost(weight, rng):
    """Of (q o turn - q)' W (q o turn - q) by a small turn about z_body, at random attitudes."""
    q = rng.standard_normal((50, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    h = 1e-4

    def cost(w, x, y, z):
        turned = np.stack([w - z * h, x + y * h, y - x * h, z + w * h])  # q o (1, 0, 0, h)
        return np.array(weight) @ (turned - [w, x, y, z]) ** 2 / h**2

    curvature = [cost(*row) / cost(1, 0, 0, 0) for row in q]
    assert yaw_share(q, np.array(weight)) == pytest.approx(min(curvature), rel=1e-9)


def test_experiments_of_this_project_fly_every_heading_alike():
    for name in ("quick", "auto", "reality_ladder", "families"):
        cells = expand([f"experiment={name}", "seed=0"])
        errors = {getattr(cell.config.controller, "attitude_error", "body") for cell in list(cells)[::11]}
        assert errors == {"body"}, name
    assert compose(["experiment=quick", "controller=pid"]).controller.name == "pid"
    for name in ("torrente_table1", "sun"):
        errors = {
            getattr(cell.config.controller, "attitude_error", "") for cell in list(expand([f"experiment={name}"]))[::40]
        }
        assert "body" not in errors, name
