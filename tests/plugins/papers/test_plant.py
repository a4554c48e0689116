"""The blade-element plant: the motion of the paper in its frame, integrators, options, limits, and flights."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadexp.errors import ModelDomainError, UsageError
from quadexp.physics.rigid_body import corrected_function
from quadexp.physics.state import ATTITUDE, POSITION, RATE, VELOCITY
from quadexp.plugins.papers.lei_li.plant import BladeElementEffects, BladeElementPlant, PlantChange
from tests import paper
from tests.states import random_state

LEVEL = np.r_[np.zeros(3), 1, np.zeros(9)]
ROLL_OVER = Rotation.from_euler("x", np.pi)  # FLU to FRD
ENU_TO_NED = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1.0]])


@pytest.fixture
def plant(lei_li, blade) -> BladeElementPlant:
    return BladeElementPlant(lei_li, blade, backend="interpreted")


def cruise(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A state of fast flight and a command."""
    x = random_state(rng, speed=4.0, rate=1.0)
    x[ATTITUDE] = Rotation.from_euler("zyx", [rng.uniform(-3, 3), *rng.uniform(-0.6, 0.6, 2)]).as_quat(
        scalar_first=True
    )
    return x, rng.uniform(1.5, 4, 4)


def test_hovers(plant, lei_li):
    x, reading = plant.advance(LEVEL, np.full(4, lei_li.hover_thrust), 1.0)
    assert x == pytest.approx(LEVEL, abs=1e-12)
    assert reading == pytest.approx([0, 0, 9.81], rel=1e-13)
    assert plant.induced_velocity == pytest.approx(np.full(4, 4.70714871732553), rel=1e-12)
    assert plant.rotor_speed == pytest.approx(np.sqrt(lei_li.hover_thrust / lei_li.thrust_coefficient))


def test_one_euler_step_of_the_paper(plant, rng):
    """(1)-(3) in NED/FRD with forces by hand: one step of 1e-4 s, all of it converted at the edge."""
    h = 1e-4
    for _ in range(10):
        x, u = cruise(rng)
        after, reading = plant.advance(x, u, h)
        enu = Rotation.from_quat(x[ATTITUDE], scalar_first=True).as_matrix()
        R = ENU_TO_NED @ enu @ ROLL_OVER.as_matrix()  # FRD to NED
        v, omega = ENU_TO_NED @ x[VELOCITY], paper.flip(x[RATE])
        w = np.sqrt(u / 8.662934999418661e-06)
        force = paper.point(R.T @ v, w)
        v_next = v + h * (np.array([0, 0, paper.G]) + R @ force.F / paper.M)
        turn = np.linalg.solve(paper.J, force.Gamma - np.cross(omega, paper.J @ omega))
        assert ENU_TO_NED @ after[VELOCITY] - v == pytest.approx(v_next - v, rel=1e-9, abs=1e-12)
        assert paper.flip(after[RATE]) - omega == pytest.approx(h * turn, rel=1e-9, abs=1e-12)
        assert after[POSITION] == pytest.approx(x[POSITION] + h * x[VELOCITY], rel=1e-12)
        q = Rotation.from_quat(x[ATTITUDE], scalar_first=True) * Rotation.from_rotvec(h * x[RATE])
        step = (Rotation.from_quat(after[ATTITUDE], scalar_first=True).inv() * q).magnitude()
        assert step < 1e-7 and np.linalg.norm(after[ATTITUDE]) == pytest.approx(1, abs=1e-15)
        R_next = Rotation.from_quat(after[ATTITUDE], scalar_first=True)
        V_next = paper.flip(R_next.inv().apply(after[VELOCITY]))
        assert paper.flip(reading) == pytest.approx(paper.point(V_next, w).F / paper.M, rel=1e-9, abs=1e-9)
        assert plant.induced_velocity == pytest.approx(paper.point(V_next, w).V_I, rel=1e-9)


def test_back_ends_and_the_safe_solver_agree(lei_li, blade, rng):
    plants = [BladeElementPlant(lei_li, blade, backend=backend) for backend in ("interpreted", "auto")]
    for _ in range(5):
        x, u = cruise(rng)
        (one, read_one), (two, read_two) = (plant.advance(x, u, 0.01) for plant in plants)
        assert two == pytest.approx(one, rel=1e-11, abs=1e-11)
        assert read_two == pytest.approx(read_one, rel=1e-10, abs=1e-10)
        checked = plants[0].in_doubt(plants[0].prepared(0.01))
        assert checked["x_next"] == pytest.approx(one, rel=1e-12, abs=1e-12)
        assert checked["specific_force"] == pytest.approx(read_one, rel=1e-11, abs=1e-11)


def test_the_state_says_it_all(plant, rng):
    """No memory but the rotors: the same period twice, with anything in between, gives the same numbers."""
    x, u = cruise(rng)
    first = plant.advance(x, u, 0.01)[0]
    plant.advance(*cruise(rng), 0.05)
    assert np.array_equal(first, plant.advance(x, u, 0.01)[0])


@pytest.mark.parametrize("local", [False, True])
@pytest.mark.parametrize("printed", [False, True])
def test_residual_is_what_the_plant_does(lei_li, blade, rng, local, printed):
    effects = BladeElementEffects(rotor_local_velocity=local, printed_coefficients=printed)
    change = PlantChange(0.0, payload=0.3, lift_scale=(1, 1, 0.8, 1), profile_drag_scale=2.0)
    plant = BladeElementPlant(lei_li, blade, effects, schedule=[change], backend="interpreted")
    residual, h = plant.residual(), 1e-6
    corrected = corrected_function(lei_li, residual)
    for _ in range(5):
        x, u = cruise(rng)
        derivative = np.array(corrected(x, u, residual.theta)).reshape(-1)
        found = (plant.advance(x, u, h)[0] - x) / h
        assert found == pytest.approx(derivative, rel=1e-6, abs=1e-5)


class TestOptions:
    def test_payload_and_lost_lift(self, lei_li, blade):
        """At V = 0 the thrust of a rotor is k_T,static(C_la) w^2; the accelerometer sees force over the true mass."""
        schedule = [PlantChange(0.01, payload=0.3), PlantChange(0.02, lift_scale=(1, 1, 1, 0.8))]
        plant = BladeElementPlant(lei_li, blade, step=1e-5, schedule=schedule, backend="interpreted")
        u, tiny = np.full(4, lei_li.hover_thrust), 1e-5
        assert plant.advance(LEVEL, u, tiny)[1][2] == pytest.approx(9.81, rel=1e-6)
        plant.time = 0.01
        assert plant.advance(LEVEL, u, tiny)[1][2] == pytest.approx(9.81 * 0.985 / 1.285, rel=1e-4)
        plant.time = 0.02
        w = np.sqrt(lei_li.hover_thrust / lei_li.thrust_coefficient)
        weak = paper.thrust(w, 0, 0, paper.induced(w, 0, 0, C_la=0.8 * 3.32), C_la=0.8 * 3.32)
        x, reading = plant.advance(LEVEL, u, tiny)
        assert reading[2] == pytest.approx((3 * lei_li.hover_thrust + weak) / 1.285, rel=1e-4)
        assert x[10] / tiny == pytest.approx(  # the left rotor is weak: it rolls to the left
            np.linalg.solve(lei_li.inertia_matrix, [0.225 * (weak - lei_li.hover_thrust), 0, 0])[0], rel=2e-2
        )
        plant.reset()
        assert plant.advance(LEVEL, u, tiny)[1][2] == pytest.approx(9.81, rel=1e-6)

    def test_doubled_profile_drag(self, lei_li, blade, rng):
        double = type(blade)(blade.lift_slope, 2 * blade.profile_drag, blade.body_drag)
        changed = BladeElementPlant(
            lei_li, blade, schedule=[PlantChange(0.0, profile_drag_scale=2.0)], backend="interpreted"
        )
        x, u = cruise(rng)
        expected = BladeElementPlant(lei_li, double, backend="interpreted").advance(x, u, 0.01)[0]
        assert changed.advance(x, u, 0.01)[0] == pytest.approx(expected, rel=1e-12, abs=1e-12)

    def test_limits(self, lei_li, blade):
        def commanded_speed(plant, u):
            plant.advance(LEVEL, np.array(u), 1e-4)
            return plant.rotor_speed

        free = BladeElementPlant(lei_li, blade, backend="interpreted")
        assert commanded_speed(free, [-1.0, 0.0, 2.0, 80.0]) == pytest.approx(
            [50, 50, np.sqrt(2 / lei_li.thrust_coefficient), np.sqrt(80 / lei_li.thrust_coefficient)]
        )
        effects = BladeElementEffects(thrust_limits=True, rotor_speed_min=100, rotor_speed_max=1200)
        limited = BladeElementPlant(lei_li, blade, effects, backend="interpreted")
        assert commanded_speed(limited, [0.0, 80.0, 12.0, 20.0]) == pytest.approx(
            [100, 1200, np.sqrt(12 / lei_li.thrust_coefficient), 1200]
        )

    def test_refused(self, lei_li, blade, vehicle):
        with pytest.raises(UsageError, match=r"needs vehicle.rotor"):
            BladeElementPlant(vehicle, blade)
        with pytest.raises(UsageError, match="plant.method=heun: must be one of euler, rk4"):
            BladeElementPlant(lei_li, blade, method="heun")
        with pytest.raises(UsageError, match="lift_scale needs 4 factors"):
            BladeElementPlant(lei_li, blade, schedule=[PlantChange(1.0, lift_scale=(0.8,))])


class TestCornersOfTheModel:
    def test_descent_through_its_own_wake(self, plant, lei_li):
        """15 m/s straight down with V_h = 0: V_I > V_z, the paper's assumption, holds, and it flies."""
        x = LEVEL.copy()
        x[9] = -15.0
        for _ in range(20):
            x, reading = plant.advance(x, np.full(4, lei_li.hover_thrust), 0.01)
            assert np.all(plant.induced_velocity > -x[9])
        assert np.isfinite(x).all() and reading[2] > 0

    def test_oblique_descent_without_a_single_answer(self, plant, lei_li):
        """The point of tests/physics that has three roots below V_z: refused, with rotor, time and reason."""
        x, w = LEVEL.copy(), 586.4380536131179
        x[VELOCITY] = [3.2350675658648784, 0, -16.29553718864495]
        with pytest.raises(
            ModelDomainError, match=r"rotor 0 at t=0.0000 s: descending through its own wake .*V_h=3.24"
        ):
            plant.advance(x, np.full(4, lei_li.thrust_coefficient * w**2), 0.01)

    def test_steep_descent_below_it(self, lei_li, blade):
        """Idling, V_z > 2.83 V_h and V_I < V_z: the fast iteration is in doubt, the safe solver knows the only root."""
        plant = BladeElementPlant(lei_li, blade, backend="interpreted")
        x = LEVEL.copy()
        x[VELOCITY] = [1.5, 0, -8]
        x, _ = plant.advance(x, np.zeros(4), 0.001)
        V = paper.flip(x[VELOCITY])
        expected = paper.induced(50.0, np.hypot(V[0], V[1]), V[2])
        assert plant.induced_velocity == pytest.approx(np.full(4, expected), rel=1e-6)
        assert plant.induced_velocity[0] < V[2]

    def test_tilt_of_89_degrees(self, plant, lei_li):
        x = LEVEL.copy()
        x[ATTITUDE] = Rotation.from_euler("y", 89, degrees=True).as_quat(scalar_first=True)
        x[VELOCITY] = [12, 0, 0]
        x, reading = plant.advance(x, np.full(4, lei_li.hover_thrust), 0.1)
        assert np.isfinite(x).all() and np.isfinite(reading).all()

    def test_rotors_idle_at_zero_command(self, plant):
        x, _ = plant.advance(LEVEL, np.zeros(4), 0.5)
        assert plant.rotor_speed == pytest.approx(np.full(4, 50.0))
        assert -9.81 * 0.5 < x[9] < -9.0 * 0.5

    def test_rotors_that_may_stop(self, lei_li, blade):
        """Zero command with no idle speed: in still air no force at all, and after that no model."""
        effects = BladeElementEffects(rotor_speed_min=0.0)
        plant = BladeElementPlant(lei_li, blade, effects, backend="interpreted")
        with pytest.raises(ModelDomainError, match=r"rotor 0 at t=0.0001 s: it is stopped in moving air"):
            plant.advance(LEVEL, np.zeros(4), 0.01)

    def test_not_finite(self, plant):
        with pytest.raises(ModelDomainError, match="not a finite number"):
            plant.advance(np.full(13, np.nan), np.ones(4), 0.01)


IDLE = np.zeros(4)


class Watched(BladeElementPlant):
    """Counts the periods flown again with the safe solver."""

    again = 0

    def in_doubt(self, function):
        self.again += 1
        return super().in_doubt(function)


def moving(velocity) -> np.ndarray:
    x = LEVEL.copy()
    x[VELOCITY] = velocity
    return x


@pytest.mark.parametrize("steps", [1, 2, 7])
def test_rotors_follow_their_command_whatever_the_step(lei_li, blade, steps):
    """w(t) = w_1 + (w_0 - w_1) exp(-t / tau), exact for a held command; odd and even numbers of steps alike."""
    plant = BladeElementPlant(
        lei_li, blade, BladeElementEffects(motor_lag=0.02), step=0.007 / steps, backend="interpreted"
    )
    before, target = plant.rotor_speed.copy(), np.sqrt(np.array([1.0, 2.0, 3.0, 4.0]) / lei_li.thrust_coefficient)
    for period in range(1, 4):
        plant.advance(LEVEL, np.array([1.0, 2.0, 3.0, 4.0]), 0.007)
        expected = target + (before - target) * np.exp(-0.007 * period / 0.02)
        assert plant.rotor_speed == pytest.approx(expected, rel=1e-12)


def test_changes_come_in_their_time(lei_li, blade):
    """A load taken up at 0.02 s and dropped at 0.04 s, in a flight of periods of 0.01 s from zero."""
    schedule = [PlantChange(0.04, payload=0.0), PlantChange(0.02, payload=0.5)]
    plant = BladeElementPlant(lei_li, blade, step=1e-3, schedule=schedule, backend="interpreted")
    readings = [plant.advance(LEVEL, np.full(4, lei_li.hover_thrust), 0.01)[1][2] for _ in range(6)]
    loaded = 9.81 * paper.M / (paper.M + 0.5)
    assert readings == pytest.approx([9.81, 9.81, loaded, loaded, 9.81, 9.81], rel=0.02)
    assert plant.time == pytest.approx(0.06)


@pytest.mark.parametrize("velocity", [(0, 0, 0), (9, -4, 1), (0, 0, 6), (12, 0, -4), (0.5, 0.5, -2)])
def test_ordinary_flight_is_flown_once(lei_li, blade, velocity):
    """Hover, cruise, climb, a dive at speed and a slow descent: the quick iteration is beyond doubt."""
    plant = Watched(lei_li, blade, backend="interpreted")
    for thrust in (0.5, 1.0, 2.0):
        plant.advance(moving(velocity), np.full(4, thrust * lei_li.hover_thrust), 0.01)
    assert plant.again == 0


@pytest.mark.parametrize("in_plane", [1.5, 3.0])
def test_flown_again_where_there_may_be_several_answers(lei_li, blade, in_plane):
    """Idling, V_I < V_z: g' = K (2 u^2 + V_z u + V_h^2) / sqrt(V_h^2 + u^2) + b has zeros only for V_z^2 > 8 V_h^2."""
    for ratio, again in ((2.8, 0), (2.86, 1)):
        plant = Watched(lei_li, blade, backend="interpreted")
        plant.advance(moving([in_plane, 0, -ratio * in_plane]), IDLE, 1e-4)
        assert np.all(plant.induced_velocity < ratio * in_plane)
        assert plant.again == again


def test_rotors_of_their_own_lift_in_a_steep_descent(lei_li, blade):
    """Where the safe solver flies: each rotor's induced velocity is the one of its own lift slope."""
    share = (1.0, 0.8, 1.2, 0.6)
    plant = Watched(lei_li, blade, schedule=[PlantChange(0.0, lift_scale=share)], backend="interpreted")
    x, _ = plant.advance(moving([1.5, 0, -8]), IDLE, 1e-4)
    V = paper.flip(x[VELOCITY])  # the turn within one step is of the order of 1e-6 rad
    expected = [paper.induced(50.0, np.hypot(V[0], V[1]), V[2], C_la=factor * paper.C_LA) for factor in share]
    assert plant.again == 1
    assert plant.induced_velocity == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize(("method", "told"), [("euler", ["t=0.0001 s", "V_z=0.000245 m/s"]), ("rk4", ["t=0.0000 s"])])
def test_one_rotor_that_stops(lei_li, blade, method, told):
    """In air at rest it may; as soon as the vehicle sinks, by g / 4 with three rotors left, it may not: Euler's method
    meets that in the second step, RK4 within the first."""
    effects = BladeElementEffects(rotor_speed_min=0.0)
    plant = BladeElementPlant(lei_li, blade, effects, method=method, backend="interpreted")
    u = np.full(4, lei_li.hover_thrust)
    u[2] = 0.0
    with pytest.raises(ModelDomainError, match="rotor 2 .* it is stopped in moving air.*w=1e-06 rad/s") as raised:
        plant.advance(LEVEL, u, 0.001)
    assert all(part in str(raised.value) for part in told)


def test_one_rotor_that_stops_in_level_flight(lei_li, blade):
    """At first the quick iteration has no trouble with it, V_I = T / (K V_h); but it has no advance ratio."""
    plant = BladeElementPlant(lei_li, blade, BladeElementEffects(rotor_speed_min=0.0), backend="interpreted")
    u = np.full(4, lei_li.hover_thrust)
    u[1] = 0.0
    with pytest.raises(ModelDomainError, match=r"rotor 1 at t=0.0000 s: it is stopped in moving air.*V_h=5 m/s"):
        plant.advance(moving([5, 0, 0]), u, 1e-4)
