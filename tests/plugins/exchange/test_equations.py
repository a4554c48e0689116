"""The exported equations of motion, in three forms, against the laws of a rigid body in NumPy."""

import ctypes
import importlib.util
import subprocess
from itertools import product

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from quadexp.experiment.vehicle_of import vehicle_named
from quadexp.models.checkpoint import load_model
from quadexp.models.dataset import ResidualDataset
from quadexp.plugins.exchange.equations import equations, python_text
from quadexp.plugins.exchange.known import known_of
from tests.house import ROOT
from tests.plugins.exchange.models import crazyflie, hummingbird, relative, rotation, states, torque

MODELS = {"cf": (crazyflie, vehicle_named("crazyflie", None)), "hb": (hummingbird, vehicle_named("hummingbird", None))}


def wanted(name: str, x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """x' (k, 13): Newton, Euler, and the kinematics of a quaternion; the model's force in full, offsets too."""
    fitted, vehicle = MODELS[name]
    model = fitted()
    R, w = rotation(x[:, 3:7]), x[:, 10:]
    body = np.einsum("kji,kj->ki", R, x[:, 7:10])
    air = model.model().acceleration(body, u / vehicle.mass)
    air[:, 2] += u.sum(axis=1) / vehicle.mass
    acceleration = np.einsum("kij,kj->ki", R, air) - [0, 0, vehicle.gravity]
    scale = 1 + model.model().coefficient("z", "thrust")[0]
    J = vehicle.inertia_matrix
    turn = np.linalg.solve(J, (scale * torque(vehicle, u) - np.cross(w, w @ J)).T).T
    scalar = -0.5 * np.sum(x[:, 4:7] * w, axis=1, keepdims=True)
    vector = 0.5 * (x[:, 3:4] * w + np.cross(x[:, 4:7], w))
    return np.hstack([x[:, 7:10], scalar, vector, acceleration, turn])


def points(name: str) -> tuple[np.ndarray, np.ndarray]:
    fitted, vehicle = MODELS[name]
    velocity, rate, q, thrust = states(fitted(), vehicle, 40)
    world = np.einsum("kij,kj->ki", rotation(q), velocity)
    return np.hstack([0.3 * rate, q, world, rate]), thrust


def in_python(text: str) -> ca.Function:
    space: dict = {}
    exec(compile(text, "model", "exec"), space)
    return space["model"]()


@pytest.mark.parametrize(("name", "out"), product(MODELS, ["model.casadi", "model.py"]))
def test_a_casadi_function_is_the_motion(export, tmp_path, name, out):
    text = export(name, "casadi", out=out)
    function = in_python(text) if out.endswith("py") else ca.Function.load(str(tmp_path / out))
    x, u = points(name)
    found = np.array(function(x.T, u.T)).T
    assert relative(found, wanted(name, x, u)) < 1e-12
    if out.endswith("casadi"):
        beside = (tmp_path / f"{out}.txt").read_text()
        assert "What is not in this file" in beside and "identified" in beside


@pytest.mark.parametrize("name", MODELS)
def test_the_c_code_is_the_motion(export, tmp_path, name):
    export(name, "c", out="model.c")
    done = subprocess.run(
        ["cc", "-O1", "-shared", "-fPIC", "-o", tmp_path / "model.so", tmp_path / "model.c", "-lm"], capture_output=True
    )
    assert done.returncode == 0, done.stderr
    library = ctypes.CDLL(str(tmp_path / "model.so"))
    pointer = ctypes.POINTER(ctypes.c_double)
    x, u = points(name)
    found = np.zeros((len(x), 13))
    for i in range(len(x)):
        arguments = (pointer * 2)(x[i].ctypes.data_as(pointer), u[i].ctypes.data_as(pointer))
        results = (pointer * 1)(found[i].ctypes.data_as(pointer))
        assert library.model(arguments, results, None, None, 0) == 0
    assert relative(found, wanted(name, x, u)) < 1e-12


def test_do_mpc_integrates_it(export):
    if importlib.util.find_spec("do_mpc") is None:
        pytest.skip("do-mpc is not installed")
    import do_mpc

    function = in_python(export("hb", "casadi", out="model.py"))
    model = do_mpc.model.Model("continuous")
    x, u = model.set_variable("_x", "x", (13, 1)), model.set_variable("_u", "u", (4, 1))
    model.set_rhs("x", function(x, u))
    model.setup()
    simulator = do_mpc.simulator.Simulator(model)
    simulator.set_param(integration_tool="cvodes", t_step=0.01, abstol=1e-11, reltol=1e-11)
    simulator.setup()
    start, thrust = (value[0] for value in points("hb"))
    simulator.x0 = start
    found = simulator.make_step(thrust.reshape(4, 1)).ravel()
    exact = solve_ivp(lambda t, s: wanted("hb", s[None], thrust[None])[0], (0, 0.01), start, rtol=1e-11, atol=1e-11)
    assert found == pytest.approx(exact.y[:, -1], abs=1e-8)


@pytest.mark.parametrize("kind", ["linear_drag", "gaussian_process_quadratic", "neural"])
def test_every_kind_of_model_has_equations(kind):
    """In level flight without rates v' is the specific force less gravity; the rest of the force is the prediction."""
    vehicle = vehicle_named("torrente", None)
    model = load_model(ROOT / "tests" / "models" / "stored" / f"{kind}.json")
    rng = np.random.default_rng(0)
    velocity, thrust = rng.uniform(-2, 2, (20, 3)), vehicle.hover_thrust * rng.uniform(0.8, 1.2, (20, 4))
    columns = {f"v_{axis}": velocity[:, i] for i, axis in enumerate("xyz")}
    columns |= {f"w_{axis}": np.zeros(20) for axis in "xyz"} | {f"u_{i}": thrust[:, i] for i in range(4)}
    columns |= {f"a_{axis}": np.zeros(20) for axis in "xyz"} | {"flight": np.zeros(20, int)}
    rows = ResidualDataset(columns, {"vehicle": vehicle.record})
    predicted = {name: prediction.mean for name, prediction in model.predict(rows).items() if name.startswith("a_")}
    function = in_python(python_text(equations(known_of(vehicle, model))))
    states = np.hstack([np.zeros((20, 3)), np.tile([1.0, 0, 0, 0], (20, 1)), velocity, np.zeros((20, 3))])
    found = np.array(function(states.T, thrust.T)).T[:, 7:10]
    found += np.outer(np.ones(20), [0, 0, vehicle.gravity]) - np.outer(thrust.sum(axis=1) / vehicle.mass, [0, 0, 1])
    assert predicted
    for name, mean in predicted.items():
        assert found[:, "xyz".index(name[-1])] == pytest.approx(mean, rel=1e-7, abs=1e-9), name


def test_a_vehicle_alone_is_a_rigid_body(export):
    vehicle = vehicle_named("torrente", None)
    function = in_python(export("vehicle=torrente", "casadi", out="model.py"))
    hover = np.full(4, vehicle.hover_thrust)
    found = np.array(function([0, 0, 1, 1, *np.zeros(9)], hover)).ravel()
    assert found == pytest.approx(np.zeros(13), abs=1e-12)
    falling = np.array(function([0, 0, 1, 1, *np.zeros(9)], 0 * hover)).ravel()
    assert falling[9] == pytest.approx(-vehicle.gravity)


def test_another_suffix_is_refused(export):
    assert "writes .casadi, or .py" in export("cf", "casadi", out="model.txt", code=2)
