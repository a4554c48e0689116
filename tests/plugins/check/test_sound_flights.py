"""Sound flights of the kinds that real logs hold are not blocked: slow, hovering, in a plane, with a glitch or two."""

import tracemalloc

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from quadexp.log.schema import Flight
from quadexp.plugins.check.quality import check_flight
from tests.plugins.logs.importers import logs


def vectors(**values: np.ndarray) -> dict[str, np.ndarray]:
    return {f"{name}_{axis}": x[:, i] for name, x in values.items() for i, axis in enumerate("xyz")}


def flight_of(f: logs.Truth, **changes: np.ndarray) -> Flight:
    columns = {"t": f.t} | {f"q_{axis}": f.q[:, i] for i, axis in enumerate("wxyz")}
    return Flight(columns | vectors(**({"p": f.p, "v": f.v, "w": f.w, "acc": f.acc} | changes)), {"recorded": True})


def blocking(flight: Flight) -> list[str]:
    return [one.message for one in check_flight(flight) if one.blocks]


def wander(rng, shape, size, rate, seconds):
    x = gaussian_filter1d(rng.normal(size=shape), seconds * rate, axis=0)
    return size * x / x.std()


def hover(rng, p: float, v: float, *, rate: float = 50.0, duration: float = 20.0) -> Flight:
    """Standing in the air; position and velocity each wander by themselves, as estimators without a fix do."""
    k = int(rate * duration)
    t = np.arange(k) / rate
    tilt = wander(rng, (k, 2), 0.01, rate, 0.2)
    columns = {"t": t, "q_w": np.ones(k), "q_x": tilt[:, 0] / 2, "q_y": tilt[:, 1] / 2, "q_z": 1e-4 * np.sin(t)}
    w = np.column_stack([np.gradient(tilt, t, axis=0), 0 * t]) + rng.normal(0, 0.03, (k, 3))
    acc = np.column_stack([rng.normal(0, 0.1, (k, 2)), 9.81 + rng.normal(0, 0.3, k)])
    columns |= vectors(p=wander(rng, (k, 3), p, rate, 1.0), v=wander(rng, (k, 3), v, rate, 1.0), w=w, acc=acc)
    columns |= {f"motor_command_{i}": 0.5 + rng.normal(0, 0.01, k) for i in range(4)}
    return Flight(columns, {"recorded": True})


@pytest.mark.parametrize("size", [(0.02, 0.03), (0.1, 0.03), (0.005, 0.08)])
def test_a_hover_is_not_in_millimetres(rng, size):
    """Noise becomes small in any larger unit; that explains nothing."""
    named = {one.name for one in check_flight(hover(rng, *size)) if one.blocks}
    assert named <= {"inconsistent"}  # which it is, where the position wanders faster than the velocity says


def test_a_simulated_flight_in_a_plane(rng):
    """Along x and z: y, roll and yaw are zero to the last bit."""
    t = np.arange(1000) / 50
    x, z = 3 * np.sin(t), 0.5 * np.sin(0.7 * t)
    a = np.column_stack([-x, 0 * t, -0.49 * z + 9.81])
    pitch = np.arctan2(a[:, 0], a[:, 2])
    q = {"q_w": np.cos(pitch / 2), "q_x": 0 * t, "q_y": np.sin(pitch / 2), "q_z": 0 * t}
    p = {"p_x": x, "p_y": 0 * t, "p_z": z, "v_x": 3 * np.cos(t), "v_y": 0 * t, "v_z": 0.35 * np.cos(0.7 * t)}
    w = {"w_x": 0 * t, "w_y": np.gradient(pitch, t), "w_z": 0 * t}
    f = {"acc_x": 0 * t, "acc_y": 0 * t, "acc_z": np.linalg.norm(a, axis=1)}
    sound = {"t": t} | p | q | w | f
    assert not [one.message for one in check_flight(Flight(sound, {})) if one.severity != "info"]
    assert blocking(Flight(sound | {"w_y": 0 * t, "w_x": 1e-3 * np.sin(t)}, {}))
    assert [one for one in blocking(Flight(sound | {"p_x": 0 * t}, {})) if "frozen_sensor: p_x" in one]


def test_a_tumble_is_not_in_centimetres(rng):
    """Thrown, thrust off: the force is not along the body's z; a smaller motion would fit better, none best of all."""
    t = np.arange(600) / 50
    fall = np.clip(t - 6, 0, 0.6)
    p = np.column_stack([1.5 * np.sin(0.8 * t), np.cos(0.5 * t), 6 - 4.9 * fall**2])
    v = np.gradient(p, t, axis=0)
    angle = np.cumsum(wander(rng, 600, 1.0, 50.0, 0.2) * (0.5 + 6 * (t > 6))) / 50
    q = {"q_w": np.cos(angle / 2), "q_x": np.sin(angle / 2), "q_y": 1e-3 * np.sin(t), "q_z": 1e-3 * np.cos(t)}
    assert "units" not in {one.name for one in check_flight(Flight({"t": t} | q | vectors(p=p, v=v), {}))}


def test_an_estimate_that_wanders_is_no_wrong_clock(rng):
    """Velocity 4 % too large beside an error of 8 % that no factor takes away."""
    f = logs.truth(30.0, 20.0)
    v = 0.1 * (1.04 * f.v + wander(rng, f.v.shape, 0.08 * f.v.std(), 20.0, 0.15))
    assert not blocking(Flight({"t": f.t} | vectors(p=0.1 * f.p, v=v), {"recorded": True}))


def test_a_glitch_or_two_do_not_block(rng):
    f = logs.truth(10.0, 50.0)
    v = f.v.copy()
    v[[200, 330], 0] += 2.0
    found = check_flight(flight_of(f, v=v))
    assert [(one.name, one.severity) for one in found if one.severity != "info"] == [("velocity_outlier", "warning")]
    v[100:130:3, 0] += 2.0
    assert "velocity_outlier" in {one.name for one in check_flight(flight_of(f, v=v)) if one.blocks}


def test_a_hover_seen_by_motion_capture_alone(rng):
    """It may stand in the air, so it is said and let through; one that does not move by a centimetre stands."""
    t = np.arange(1000) / 50
    for size, severity in ((0.02, "warning"), (0.0005, "blocking")):
        columns = {"t": t} | vectors(p=wander(rng, (1000, 3), size, 50.0, 1.0))
        (found,) = [one for one in check_flight(Flight(columns, {})) if one.name == "no_flight"]
        assert found.severity == severity


@pytest.mark.slow
def test_an_hour_at_400_hz(rng):
    """1.44 million rows in less memory than 600 MB on top of the flight."""
    f = logs.truth(62.8318, 400.0)
    rows = np.arange(1_440_000) % len(f.t)
    sizes = {"p": 1e-4, "v": 1e-3, "w": 0.02, "acc": 0.2}
    noisy = {name: getattr(f, name)[rows] + rng.normal(0, size, (len(rows), 3)) for name, size in sizes.items()}
    columns = {"t": np.arange(len(rows)) / 400} | {f"q_{axis}": f.q[rows, i] for i, axis in enumerate("wxyz")}
    columns |= {f"motor_command_{i}": f.command[rows, i] for i in range(4)}
    flight = Flight(columns | vectors(**noisy), {})
    assert not blocking(flight)
    tracemalloc.start()
    check_flight(flight)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 600e6


def test_offsets_that_scatter_by_their_own_errors_are_no_drift(rng):
    """Four stretches of a fast log, whose offsets happen to lie on a line: 0.8 ms a second was assumed, and --align
    brought an accelerometer out of step by 28 ms."""
    from quadexp.plugins.logs.signal import offset

    t = np.arange(0, 40.0, 0.004)
    found = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        smooth = np.cumsum(rng.normal(size=(len(t), 3)), axis=0) * 0.02
        a = smooth - smooth.mean(axis=0)
        b = a + 4.0 * rng.normal(size=a.shape)
        found.append(offset.drifting(offset.as_stream((t, a), "a"), offset.as_stream((t, b), "b")))
    assert not any(found)


@pytest.mark.parametrize("tilt", [0.07, 0.1, 0.13, 0.16])
def test_rows_too_far_apart_do_not_say_how_a_quaternion_is_written(rng, tilt):
    """At 1 Hz the tilt of one row says nothing of the next. Columns in another order made it smaller, as a level
    attitude would, and were named, from 0.12 rad on as sure."""
    t = np.arange(500.0)
    p = np.column_stack([4 * np.cos(0.06 * t), 2 * np.sin(0.06 * t), 1 + 0 * t])
    q = np.column_stack([np.ones(500), rng.normal(0, tilt, (500, 3)) * [1, 1, 0.4]])
    q /= np.linalg.norm(q, axis=1)[:, None]
    columns = {"t": t} | {f"q_{axis}": q[:, i] for i, axis in enumerate("wxyz")}
    found = check_flight(Flight(columns | vectors(p=p, v=np.gradient(p, t, axis=0)), {"recorded": True}))
    assert not {one.name for one in found} & {"quaternion_order", "quaternion_conjugate", "sign_flip"}
