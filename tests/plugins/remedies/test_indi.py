"""The INDI loop by its theory: transfer functions, steady errors, and what must break them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import butter

from quadexp.compile.backend import BufferedFunction
from quadexp.control.base import Measurement, Window
from quadexp.control.control_step import InputArrays, run
from quadexp.errors import UsageError
from quadexp.experiment.build import build_controller, build_plant, build_vehicle
from quadexp.parts.compose import compose
from quadexp.physics.state import N_STATE, RATE
from quadexp.plugins.remedies.indi import INDI, indi_function, settled_memory
from quadexp.plugins.remedies.sent_commands import DeliveredThrust
from tests.control.held import Held

TAU = 0.03  # s, lag of the thrusts
FAST = INDI(rate=3000.0)  # near continuous time


class Loop:
    """One vehicle turning about its roll axis: thrusts follow commands with a lag, J w' = G t + disturbance."""

    def __init__(self, vehicle, keys, *, inertia=1.0, distort=lambda rate: rate):
        self.vehicle, self.keys, self.distort = vehicle, keys, distort
        self.law = BufferedFunction(indi_function(vehicle, keys).expand())
        self.J = inertia * vehicle.inertia_matrix
        self.thrust, self.w = np.full(vehicle.n_rotors, vehicle.hover_thrust), np.zeros(3)
        self.before = np.r_[self.w, np.sqrt(self.thrust)]
        self.memory = settled_memory(keys, self.before)

    def step(self, wanted, disturbance):
        """Roll acceleration (rad/s^2) over a period with a wanted one, under a disturbance (N m)."""
        v, dt = self.vehicle, 1 / self.keys.rate
        torque = v.inertia_matrix[0, 0] * wanted
        u = np.linalg.pinv(v.allocation) @ np.array([v.mass * v.gravity, torque, 0, 0])
        given = {"wanted": u, "rate": self.distort(self.w), "delivered": self.thrust}
        for name, value in (given | {"memory": self.memory, "before": self.before}).items():
            self.law.arguments[name][:] = value
        self.law()
        found = self.law.results
        self.memory, self.before = found["memory_next"].copy(), found["filtered"].copy()
        command = found["thrust"]
        decay = np.exp(-dt / TAU)
        mean = command + (self.thrust - command) * TAU / dt * (1 - decay)
        self.thrust = command + (self.thrust - command) * decay
        alpha = ((v.allocation @ mean)[1] + disturbance) / self.J[0, 0]
        self.w = self.w + np.array([alpha, 0, 0]) * dt
        return alpha

    def response(self, frequency, *, wanted=0.0, disturbance=0.0, cycles=2):
        """Complex amplitude of the roll acceleration at a frequency (Hz), once settled."""
        rate, settle = self.keys.rate, 0.6
        k = np.arange(round((settle + cycles / frequency) * rate))
        wave = np.cos(2 * np.pi * frequency * k / rate)
        found = np.array([self.step(wanted * c, disturbance * c) for c in wave])
        last = k >= settle * rate
        return 2 * np.mean(found[last] * np.exp(-2j * np.pi * frequency * (k[last] + 0.5) / rate))


def motor(frequency):
    return 1 / (1 + 2j * np.pi * frequency * TAU)


def low_pass(frequency, cutoff=FAST.cutoff):
    b, a = butter(2, 2 * np.pi * cutoff, analog=True)
    s = 2j * np.pi * frequency
    return np.polyval(b, s) / np.polyval(a, s)


@pytest.mark.parametrize("frequency", [2.0, 8.0])
@pytest.mark.parametrize("inertia", [1.0, 2.0], ids=["right", "half"])
def test_transfer_functions(vehicle, frequency, inertia):
    """alpha/alpha* = D M/(1 + (D - 1) H M), alpha/d = J^-1 (1 - H M)/(1 + (D - 1) H M), D: J assumed by J true."""
    D, H, M = 1 / inertia, low_pass(frequency), motor(frequency)
    closed, J = 1 + (D - 1) * H * M, inertia * vehicle.inertia_matrix[0, 0]
    found = Loop(vehicle, FAST, inertia=inertia).response(frequency, wanted=2.0) / 2.0
    assert abs(found - D * M / closed) < 0.03 * abs(M)
    found = Loop(vehicle, FAST, inertia=inertia).response(frequency, disturbance=0.05) / 0.05
    assert abs(found - (1 - H * M) / (J * closed)) < 0.03 / J


def test_a_settled_filter_is_at_rest(vehicle):
    """What comes through is what went in, and the memory stays."""
    keys, hover = INDI(rate=300.0), np.full(vehicle.n_rotors, vehicle.hover_thrust)
    law, rate = BufferedFunction(indi_function(vehicle, keys).expand()), np.array([0.3, -0.2, 1.0])
    before = np.r_[rate, np.sqrt(hover)]
    memory = settled_memory(keys, before)
    given = {"wanted": hover, "rate": rate, "delivered": hover, "memory": memory, "before": before}
    for name, value in given.items():
        law.arguments[name][:] = value
    law()
    np.testing.assert_allclose(law.results["filtered"], before, rtol=1e-9)
    np.testing.assert_allclose(law.results["memory_next"], memory, rtol=1e-7, atol=1e-12)


def test_filters_that_differ_are_noticed(vehicle):
    """The rates through another low pass than the rotor speeds: the transfer function is another one."""
    b, a = butter(1, 6.0, fs=FAST.rate)
    state = np.zeros(2)

    def distort(w):
        state[:] = w[0], b[0] * w[0] + b[1] * state[0] - a[1] * state[1]
        return np.array([state[1], 0, 0])

    found = Loop(vehicle, FAST, distort=distort).response(4.0, disturbance=0.05) / 0.05
    J = vehicle.inertia_matrix[0, 0]
    assert abs(found - (1 - low_pass(4.0) * motor(4.0)) / J) > 0.15 / J


@pytest.mark.parametrize("inertia", [0.6, 1.0, 2.0])
def test_a_torque_and_a_wrong_inertia_leave_no_steady_error(vehicle, inertia):
    """At the published rate; without the loop the torque would leave d/J = 10 rad/s^2."""
    loop = Loop(vehicle, INDI(), inertia=inertia)
    found = [loop.step(3.0, 10 * loop.J[0, 0]) for _ in range(600)]
    assert abs(found[0] - 3.0) > 5 and found[-1] == pytest.approx(3.0, abs=1e-3)


def test_the_gyroscopic_torque_is_none_to_be_removed(vehicle):
    """Turning steadily about a skew axis: the rotors give what they gave, and J times the wanted acceleration."""
    J, w, wanted = vehicle.inertia_matrix, np.array([6.0, -4.0, 3.0]), np.array([2.0, -3.0, 1.0])
    delivered = vehicle.hover_thrust * np.array([1.1, 0.9, 1.05, 1.0])
    values = np.r_[w, np.sqrt(delivered)]
    asked = np.r_[vehicle.mass * vehicle.gravity, J @ wanted + np.cross(w, J @ w)]
    law = indi_function(vehicle, INDI())
    u = np.linalg.pinv(vehicle.allocation) @ asked
    found = np.array(law(u, w, delivered, settled_memory(INDI(), values).T, values)[0]).ravel()
    assert (vehicle.allocation @ (found - delivered))[1:] == pytest.approx(J @ wanted, abs=1e-9)
    assert (vehicle.allocation @ found)[0] == pytest.approx(vehicle.mass * vehicle.gravity)
    assert np.abs(np.cross(w, J @ w)).max() > 0.1 * np.abs(J @ wanted).max()


def window(vehicle, thrust):
    state = np.zeros((2, N_STATE))
    state[:, 3] = 1
    return Window(state, thrust[None], np.zeros((5, 3)), np.zeros(3))


def test_the_controller_steps_at_its_own_rate(vehicle):
    hover = np.full(4, vehicle.hover_thrust)
    held = Held(vehicle, hover, 0.01)
    loop = INDI(backend="interpreted").around(held)
    x, w = window(vehicle, hover).state[0], window(vehicle, hover)
    loop.reset(x, w)
    for k in range(7):
        u, _ = loop.step(Measurement(k / 300, x, None, None), w)
        assert u == pytest.approx(hover, rel=1e-9)  # nothing is disturbed, so nothing is changed
    assert len(held.inputs) == 3 and loop.control_period == pytest.approx(1 / 300)


def test_a_controller_that_asks_for_no_reference_begins_in_hover(vehicle):
    hover = np.full(4, vehicle.hover_thrust)
    loop = INDI(backend="interpreted").around(Held(vehicle, hover, 0.01))
    whole = window(vehicle, hover)
    loop.reset(whole.state[0], whole._replace(input=np.empty((0, 4))))
    u, _ = loop.step(Measurement(0.0, whole.state[0], None, None), whole)
    assert u == pytest.approx(hover, rel=1e-9)


def test_rates_that_do_not_divide_are_refused(vehicle):
    with pytest.raises(
        UsageError, match=r"rate_loop.rate=250: must be a whole multiple of the controller's rate of 100 Hz"
    ):
        INDI(rate=250.0).around(Held(vehicle, np.zeros(4), 0.01))
    with pytest.raises(UsageError, match="rate_loop.cutoff=200: must be below half"):
        INDI(cutoff=200.0, backend="interpreted").around(Held(vehicle, np.zeros(4), 0.01))


@pytest.mark.parametrize("bandwidth", [0.0, 15.0])
def test_a_torque_is_not_taken_away_twice(bandwidth):
    """An observer's torque and INDI's answer to it are the same: refused by name."""
    given = ["controller=sun_mpc", "controller.backend=interpreted", "vehicle=sun", "plant=sun"]
    given += ["observer=disturbance", "rate_loop=indi"]
    config = compose([*given, f"observer.torque_bandwidth={bandwidth}"])
    vehicle = build_vehicle(config.vehicle)

    def build():
        return build_controller(config, vehicle, build_plant(vehicle, config.plant), None)

    if bandwidth:
        with pytest.raises(UsageError, match=r"set observer.torque_bandwidth=0"):
            build()
    else:
        assert isinstance(build().part, INDI)


def test_commands_through_the_right_lag_are_as_good_as_rotor_speeds(vehicle):
    """Motors with a lag of the thrust: measured speeds, and commands through the same lag, give the same commands."""
    measuring = replace(vehicle, thrust_coefficient=1e-5)
    hover, rng = np.full(4, vehicle.hover_thrust), np.random.default_rng(0)
    keys = INDI(motor_lag=TAU, backend="interpreted")
    loops = [keys.around(Held(v, hover, 1 / 300)) for v in (measuring, vehicle)]
    motors, w = DeliveredThrust(vehicle, 1 / 300, lag=TAU), window(vehicle, hover)
    motors.reset(hover)
    run(motors.before(InputArrays(4)))
    for loop in loops:
        loop.reset(w.state[0], w)
    for k in range(60):
        x = w.state[0].copy()
        x[RATE] = rng.normal(0, 0.02, 3)
        speeds = np.sqrt(motors.thrust / 1e-5)
        one, _ = loops[0].step(Measurement(k / 300, x, None, speeds), w)
        other, _ = loops[1].step(Measurement(k / 300, x, None, None), w)
        assert one == pytest.approx(other, abs=1e-6)
        run(motors.after(one))
        motors.memory.commit()
        run(motors.before(InputArrays(4)))


def test_the_spin_up_torque_is_part_of_the_answer(vehicle):
    """(35): the static thrusts with the torque of the rotors' own acceleration give the wanted yaw torque, beyond what
    the unequal rotors give already."""
    measured = replace(vehicle, thrust_coefficient=1e-5)
    keys = INDI(rotor_inertia=5e-6)
    given = vehicle.hover_thrust * np.array([0.85, 1.1, 1.0, 1.2])
    values = np.r_[np.zeros(3), np.sqrt(given)]
    yaw = 0.02
    wanted = np.linalg.pinv(vehicle.allocation) @ [vehicle.mass * vehicle.gravity, 0, 0, yaw]
    law = indi_function(measured, keys)
    before = values - np.r_[np.zeros(3), 1e-3 * np.sqrt(given) * [1, 2, -1, 3]]  # they have been spinning up or down
    u = np.array(law(wanted, np.zeros(3), given, settled_memory(keys, values).T, before)[0]).ravel()
    speed, now = np.sqrt(u / 1e-5), np.sqrt(given / 1e-5)
    measured = 5e-6 * np.array(vehicle.rotor_spin) @ (values - before)[3:] / np.sqrt(1e-5) * keys.rate
    spin_up = 5e-6 * np.array(vehicle.rotor_spin) @ (speed - now) / keys.spin_up_time
    more = (vehicle.allocation @ (u - given))[3]
    assert more + spin_up == pytest.approx(yaw + measured, rel=1e-6) and abs(measured) > 0.05 * yaw
    assert abs(spin_up) > 0.01 * yaw  # without it the rotors would be asked for more
    with pytest.raises(UsageError, match="rotor_inertia"):
        indi_function(vehicle, keys)


@pytest.mark.parametrize("age", [0.0, 0.01])
def test_rates_are_compared_with_thrusts_of_their_time(vehicle, age):
    """A vehicle that spins up under a growing torque, given its rotors' speeds `age` late, gets the torque that is
    wanted on top of what it has; compared with rates of now it would miss the growth in that time."""
    vehicle, keys, growth = replace(vehicle, thrust_coefficient=1e-6), INDI(backend="interpreted"), 20.0  # rad/s^3
    spin = np.linalg.pinv(vehicle.allocation) @ np.array([0, vehicle.inertia_matrix[0, 0], 0, 0])  # N for 1 rad/s^2
    hover = np.full(vehicle.n_rotors, vehicle.hover_thrust)
    loop = keys.around(Held(vehicle, hover, 1 / 300), age)
    window = Window(np.zeros((1, N_STATE)), hover[None], np.zeros((5, 3)), np.zeros(3))
    x = np.eye(N_STATE)[3]
    loop.reset(x, window)
    for k in range(150):
        t = k / 300
        x[RATE][0] = growth * t**2 / 2
        speed = np.sqrt((hover + spin * growth * max(t - age, 0)) / vehicle.thrust_coefficient)
        command, _ = loop.step(Measurement(t, x, np.zeros(3), speed), window)
    wrench = vehicle.allocation @ command
    # The rate's slope at the filter's time is half a period older than its newest value
    assert wrench[1] / vehicle.inertia_matrix[0, 0] == pytest.approx(growth / 600, abs=0.02)
    assert wrench[0] == pytest.approx(4 * vehicle.hover_thrust)
