"""One controller call equals (27)-(40) computed apart, in the paper's frames; and the pieces mean what they say."""

from dataclasses import replace

import numpy as np
import pytest

from quadexp.control.base import Measurement, Window
from quadexp.errors import UsageError
from quadexp.parts.compose import compose
from quadexp.physics.rotation import air_velocity
from quadexp.physics.state import ATTITUDE, VELOCITY
from quadexp.plugins.papers.lei_li.feedback.frames import FRD_FLU, NED_ENU, state_from_ned, yaw_ned
from quadexp.plugins.papers.lei_li.feedback.law import VARIANTS, FeedbackSettings, law_function, observer_matrices
from quadexp.plugins.papers.lei_li.paths import Rectangle
from tests.plugins.papers.feedback import paper

PRINTED = FeedbackSettings(cone=False, rotor_speed_min=1e-3)
TERMS = {  # hub force, drag, secondary thrust, secondary torque
    "rls": (1, 1, 1, 1),
    "oracle": (1, 1, 1, 1),
    "rls_noH": (0, 1, 1, 1),
    "literal": (0, 0, 0, 0),
    "static": (0, 0, 0, 0),
    "nocomp_statid": (0, 0, 0, 0),
    "static_H": (1, 0, 0, 0),
}
TRUE = {"C_d0": 0.22, "C_la": 3.32, "C_D": np.array([0.01, 0.01, 0.02])}


def random_sample(rng):
    """Everything that one sample of the law depends on, in NED/FRD."""
    now = {
        "xi": rng.normal(0, 3, 3),
        "velocity": rng.normal(0, 4, 3),
        "eta": rng.normal(0, 0.4, 3) + [0, 0, rng.uniform(-3, 3)],
        "rate": rng.normal(0, 1, 3),
        "xi_d": rng.normal(0, 3, 3),
        "v_d": rng.normal(0, 4, 3),
        "a_d": rng.normal(0, 1, 3),
        "heading": np.array([rng.uniform(-3, 3), rng.normal(), rng.normal()]),
    }
    last = {
        "eta_d": rng.normal(0, 0.3, 3),
        "observer_phi": rng.normal(0, 0.3, 3),
        "observer_theta": rng.normal(0, 0.3, 3),
        "v": rng.normal(0, 4, 3),
        "w": rng.uniform(350, 900, 4),
    }
    coefficients = {"C_d0": rng.uniform(0.1, 0.4), "C_la": rng.uniform(2, 5), "C_D": rng.uniform(0, 0.1, 3)}
    return now, last, coefficients


def call(function, now, last, coefficients):
    """The program's law on the same sample, in its own frames."""
    reference = np.stack([NED_ENU @ now[name] for name in ("xi_d", "v_d", "a_d")], axis=1)
    result = function.call(
        {
            "x": state_from_ned(now["xi"], now["eta"], now["velocity"], now["rate"]),
            "reference": reference,
            "yaw": [yaw_ned(now["heading"][0]), *-now["heading"][1:]],
            "theta": [coefficients["C_d0"], coefficients["C_la"], *coefficients["C_D"]],
            "velocity_last": last["v"],
            "rotor_speed_last": last["w"],
            "eta_d_last": last["eta_d"],
            "observer_last": np.stack([last["observer_phi"], last["observer_theta"]], axis=1),
        }
    )
    return {name: value.full().squeeze() for name, value in result.items()}


def coefficient_pair(name, coefficients):
    if name == "nocomp_statid":
        return paper.static(coefficients)
    return paper.static(TRUE) if name in ("static", "static_H") else None


@pytest.mark.parametrize("name", TERMS)
def test_one_call_equals_the_paper(lei_li, name):
    function = law_function(lei_li, PRINTED, VARIANTS[name])
    rng, compared = np.random.default_rng(20170101), 0
    while compared < 25:
        now, last, coefficients = random_sample(rng)
        expected = paper.control(
            *now.values(), last, coefficients, terms=TERMS[name], coefficient_pair=coefficient_pair(name, coefficients)
        )
        if not 1.0 < expected[0].min() < expected[0].max() < 20.0 / lei_li.thrust_coefficient:
            continue  # a speed squared at the floor or at the vehicle's limit: see below
        got = call(function, now, last, coefficients)
        assert got["rotor_speed"] ** 2 == pytest.approx(expected[0], rel=1e-9)
        assert got["thrust"] == pytest.approx(lei_li.thrust_coefficient * expected[0], rel=1e-9)
        assert got["eta_d"] == pytest.approx(expected[1], abs=1e-12)
        assert pytest.approx(np.stack(expected[2:4]), abs=1e-12) == got["observer"].T
        assert got["u_T"] == pytest.approx(expected[4], abs=1e-11)
        compared += 1


@pytest.mark.parametrize(("name", "settings", "near"), [("static", PRINTED, 1e-12), ("rls", FeedbackSettings(), 2e-2)])
def test_the_paper_s_hover_is_a_fixed_point_of_the_law(lei_li, name, settings, near):
    """At rest on the reference, V exactly zero, every rotor carries a quarter of the weight, whatever the heading."""
    now = {name: np.zeros(3) for name in ("xi", "velocity", "eta", "rate", "xi_d", "v_d", "a_d", "heading")}
    now |= {"eta": np.array([0.0, 0.0, 0.7]), "heading": np.array([0.7, 0.0, 0.0])}
    last = {name: np.zeros(3) for name in ("eta_d", "observer_phi", "observer_theta", "v")} | {"w": np.full(4, 528.0)}
    got = call(law_function(lei_li, settings, VARIANTS[name]), now, last, TRUE)
    assert got["thrust"] == pytest.approx(np.full(4, lei_li.hover_thrust), rel=near)


class TestFrames:
    def test_north_is_y_east_is_x_and_down_is_minus_z(self):
        x = state_from_ned([1.0, 2.0, 3.0], [0.0, 0.0, 0.0], [4.0, 5.0, 6.0], [0.1, 0.2, 0.3])
        assert x[:3].tolist() == [2.0, 1.0, -3.0] and x[7:10].tolist() == [5.0, 4.0, -6.0]
        assert x[10:].tolist() == [0.1, -0.2, -0.3]
        # heading north: the body's x axis along the world's y
        assert air_velocity(x[ATTITUDE], x[VELOCITY]) == pytest.approx([4.0, -5.0, -6.0])

    def test_angles_keep_their_sense(self):
        """Nose up is positive in the paper; its pitch is the opposite of FLU's, its yaw runs clockwise."""
        x = state_from_ned(np.zeros(3), [0.0, 0.3, 0.0], [10.0, 0.0, 0.0], np.zeros(3))
        forward = FRD_FLU @ air_velocity(x[ATTITUDE], x[VELOCITY])
        assert forward == pytest.approx([10 * np.cos(0.3), 0.0, 10 * np.sin(0.3)])
        assert yaw_ned(yaw_ned(1.234)) == pytest.approx(1.234)


class TestObserver:
    def test_two_half_steps_are_one_step(self):
        exact, driven = observer_matrices(6.0, 0.01)
        half, half_driven = observer_matrices(6.0, 0.005)
        assert half @ half == pytest.approx(exact, abs=1e-14)
        assert half @ half_driven + half_driven == pytest.approx(driven, abs=1e-14)

    def test_it_finds_the_derivatives_of_a_ramp(self):
        exact, driven = observer_matrices(6.0, 0.01)
        x = np.zeros(3)
        for k in range(600):
            x = exact @ x + driven * 0.5 * (0.01 * k)
        # held over each period the ramp is a stair: x_2 ripples by l_2 h^2 / 12 of its slope
        assert x[1] == pytest.approx(0.5, rel=1e-3) and x[2] == pytest.approx(0.0, abs=1e-2)


class TestSafety:
    def test_the_cone_keeps_the_quadrant_far_above_the_reference(self, lei_li):
        """34 m above it, the printed law asks for thrust downwards, and (35) answers with the wrong quadrant."""
        now = {name: np.zeros(3) for name in ("eta", "rate", "xi_d", "v_d", "a_d")} | {"heading": np.zeros(3)}
        now |= {"xi": np.array([0.0, 0.0, -34.0]), "velocity": np.array([2.0, 0.0, 0.0])}
        now = {name: now[name] for name in ("xi", "velocity", "eta", "rate", "xi_d", "v_d", "a_d", "heading")}
        last = {"eta_d": np.zeros(3), "observer_phi": np.zeros(3), "observer_theta": np.zeros(3)}
        last |= {"v": np.array([2.0, 0.0, 0.0]), "w": np.full(4, 500.0)}
        printed = call(law_function(lei_li, PRINTED, VARIANTS["oracle"]), now, last, TRUE)
        safe = call(law_function(lei_li, FeedbackSettings(), VARIANTS["oracle"]), now, last, TRUE)
        assert printed["u_T"][2] < 0 and printed["outside"] == 0
        # The printed law answers "brake" (u_T points south) with a nose-down attitude, which accelerates.
        assert printed["u_T"][0] > 0 > printed["eta_d"][1]
        assert safe["outside"] == 1 and safe["u_T"][2] == pytest.approx(0.3 * 0.985 * 9.81)
        assert safe["eta_d"][1] > 0

    @pytest.mark.parametrize("limit", [45.0, 60.0])
    def test_the_tilt_limit(self, lei_li, rng, limit):
        function = law_function(lei_li, FeedbackSettings(tilt_max=np.radians(limit)), VARIANTS["oracle"])
        for _ in range(50):
            now, last, coefficients = random_sample(rng)
            now["xi"] = now["xi"] * 20
            got = call(function, now, last, coefficients)
            roll, pitch, _ = got["eta_d"]
            assert np.degrees(np.arccos(np.cos(roll) * np.cos(pitch))) <= limit + 1e-9
            assert got["u_T"][2] >= 0.3 * 0.985 * 9.81 - 1e-12

    def test_no_rotor_is_asked_for_less_than_its_floor_or_more_than_its_limit(self, lei_li, rng):
        function = law_function(lei_li, FeedbackSettings(), VARIANTS["rls"])
        counted = 0
        for _ in range(200):
            now, last, coefficients = random_sample(rng)
            now["rate"] = now["rate"] * 8
            got = call(function, now, last, coefficients)
            assert np.isfinite(got["thrust"]).all()
            assert got["rotor_speed"].min() >= 50.0 - 1e-9 and got["thrust"].max() <= 20.0 + 1e-12
            held = np.sum(got["rotor_speed"] <= 50.0 + 1e-9) + np.sum(got["thrust"] >= 20.0 - 1e-9)
            assert got["floored"] + got["limited"] == held
            counted += held
        assert counted > 0

    def test_a_pitch_of_89_degrees_gives_a_finite_command(self, lei_li):
        for pitch in (89.0, -89.0, 90.0):
            now, last, coefficients = random_sample(np.random.default_rng(3))
            now["eta"] = np.radians([10.0, pitch, 30.0])
            got = call(law_function(lei_li, FeedbackSettings(), VARIANTS["rls"]), now, last, coefficients)
            assert np.isfinite(got["thrust"]).all()


class TestController:
    def window(self, t=0.0):
        flat = Rectangle().flat_output(np.array([t]))
        return Window(np.zeros((1, 13)), np.zeros((0, 4)), flat.position[0], flat.yaw[0])

    def make(self, vehicle, variant="oracle", theta=(0.22, 3.32, 0.01, 0.01, 0.02), backend="interpreted"):
        law = replace(compose(["controller=oracle_feedback"]).controller, variant=variant, backend=backend)
        return law.controller(vehicle, places={"coefficients": np.array(theta)})

    def test_without_delay_the_secondary_terms_are_those_of_the_command(self, lei_li):
        """A second round from the answer changes nothing."""
        controller, x = self.make(lei_li, "oracle_impl"), Rectangle().start_state
        controller.reset(x, self.window())
        u, _ = controller.step(Measurement(0.0, x, None, None), self.window())
        last = {f"{name}_last": controller.memory.of_now[name] for name in ("rotor_speed", "eta_d", "velocity")}
        flat = Rectangle().flat_output(np.zeros(1))
        function = law_function(lei_li, controller.law, VARIANTS["oracle_impl"])
        theta = [0.22, 3.32, 0.01, 0.01, 0.02]
        given = {"x": x, "reference": flat.position[0, :3].T, "yaw": flat.yaw[0], "theta": theta}
        again = function.call({**given, **last, "observer_last": np.zeros((3, 2))})
        assert np.abs(np.array(again["thrust"]).ravel() - u).max() < 1e-6 * lei_li.hover_thrust
        assert np.abs(np.array(again["eta_d"]).ravel() - last["eta_d_last"]).max() < 1e-9

    def test_back_ends_agree(self, lei_li):
        x, commands = Rectangle().start_state, []
        for backend in ("interpreted", "auto"):
            controller = self.make(lei_li, backend=backend)
            controller.reset(x, self.window())
            commands.append([controller.step(Measurement(0.01 * k, x, None, None), self.window())[0] for k in range(5)])
        assert np.allclose(*commands, rtol=1e-9)

    def test_vehicles_that_it_cannot_fly_are_refused(self, vehicle, lei_li, odd_vehicle):
        with pytest.raises(UsageError, match="vehicle=torrente: feedback control needs vehicle.rotor"):
            self.make(vehicle)
        six = replace(odd_vehicle, rotor=lei_li.rotor, thrust_coefficient=lei_li.thrust_coefficient)
        with pytest.raises(UsageError, match="needs 4 rotors, this vehicle has 6"):
            self.make(six)
