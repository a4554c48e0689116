"""The environments, and policies as controllers: the same flight, seen from training and from the bench."""

from pathlib import Path

import numpy as np
import pytest

from quadexp.experiment.evaluate import fly_one
from quadexp.log.store import read_flight
from quadexp.parts.compose import compose
from quadexp.physics.rotation import rotation_matrix
from quadexp.plugins.gym.task import GAIN, PLAIN, Task
from tests.cli.command import run

gymnasium = pytest.importorskip("gymnasium")
from gymnasium.utils.env_checker import check_env  # noqa: E402

from quadexp.plugins.gym import register  # noqa: E402

register()
BARE = ("plant.backend=interpreted",)
WORLD = ("world=only_noisy_estimate", *BARE)


def vehicle():
    from quadexp.experiment.build import build_vehicle

    return build_vehicle(compose([]).vehicle)


# ---------------------------------------------------------------------------------------------------------------- task
def test_zero_hovers_and_the_ends_are_the_limits():
    quad = vehicle()
    task = Task(quad, "thrusts", 0)
    np.testing.assert_allclose(task.thrusts(np.zeros(4), np.zeros(3)).sum(), quad.mass * quad.gravity)
    np.testing.assert_allclose(task.thrusts(np.ones(4), np.zeros(3)), quad.thrust_max)
    np.testing.assert_allclose(task.thrusts(-np.ones(4), np.zeros(3)), quad.thrust_min)


def test_the_rate_loop_gives_the_angular_acceleration_that_it_asks_for():
    """J w' = G_tau u - w x J w, by the vehicle's allocation: w' = K (w* - w)."""
    quad = vehicle()
    task = Task(quad, "rates", 0)
    rate, wanted = np.array([0.03, -0.02, 0.01]), np.array([0.002, 0.001, -0.001])
    u = task.thrusts(np.array([0.0, *wanted]), rate)
    force, *torque = quad.allocation @ u
    J = quad.inertia_matrix
    turned = np.linalg.solve(J, np.array(torque) - np.cross(rate, J @ rate))
    np.testing.assert_allclose(turned, GAIN * (wanted * quad.rate_max - rate), rtol=1e-9)
    np.testing.assert_allclose(force, quad.mass * quad.gravity)


def test_an_observation_is_what_its_table_says():
    quad = vehicle()
    rng = np.random.default_rng(1)
    x, reference = rng.normal(size=13), rng.normal(size=(3, 13))
    x[3:7] /= np.linalg.norm(x[3:7])
    last = rng.uniform(-1, 1, 4)
    seen = Task(quad, "thrusts", 2).observation(x, reference, last)
    R = np.array(rotation_matrix(x[3:7]), float)
    assert seen.dtype == np.float32 and len(seen) == PLAIN + 4 + 6
    np.testing.assert_allclose(seen[6:15], R.ravel(), atol=1e-6)
    np.testing.assert_allclose(seen[:6], np.concatenate([reference[0, :3] - x[:3], reference[0, 7:10]]), rtol=1e-6)
    np.testing.assert_allclose(seen[15:25], np.concatenate([x[7:13], last]), rtol=1e-6)
    np.testing.assert_allclose(seen[27:], (reference[1:, :3] - x[:3]).ravel(), rtol=1e-6)


# ----------------------------------------------------------------------------------------------------------------- env
@pytest.mark.parametrize("action", ["thrusts", "rates"])
@pytest.mark.parametrize("overrides", [(), ("plant=rotorpy", "vehicle=hummingbird"), WORLD])
def test_gymnasium_finds_nothing_wrong(action, overrides):
    if "plant=rotorpy" in overrides:
        pytest.importorskip("rotorpy")
    env = gymnasium.make("quadexp/Tracking-v0", overrides=overrides, action=action)
    check_env(env.unwrapped)


def rolled(env, seed, steps=60):
    """Observations, rewards and states of a flight with drawn actions."""
    env.action_space.seed(seed)
    seen, _ = env.reset(seed=seed)
    rows = [seen]
    for _ in range(steps):
        seen, reward, terminated, truncated, info = env.step(0.2 * env.action_space.sample())
        rows += [seen, np.array([reward]), info["state"]]
        if terminated or truncated:
            break
    return np.concatenate(rows)


def test_one_seed_is_one_flight_and_another_seed_another():
    env = gymnasium.make("quadexp/Tracking-v0", overrides=WORLD)
    first, other = rolled(env, 3), rolled(env, 4)
    assert np.array_equal(first, rolled(env, 3)) and not np.array_equal(first[:20], other[:20])


def test_environments_side_by_side_do_not_disturb_each_other():
    """They have the same settings, and so might share one simulated vehicle."""
    alone = [rolled(gymnasium.make("quadexp/Tracking-v0", overrides=WORLD), seed) for seed in (5, 6)]
    envs = gymnasium.make_vec("quadexp/Tracking-v0", num_envs=2, vectorization_mode="sync", overrides=WORLD)
    singles = [gymnasium.make("quadexp/Tracking-v0", overrides=WORLD) for _ in range(2)]
    for single, seed in zip(singles, (5, 6), strict=True):
        single.action_space.seed(seed)
    seen, _ = envs.reset(seed=[5, 6])
    rows = [[one] for one in seen]
    for _ in range(40):
        actions = np.array([0.2 * single.action_space.sample() for single in singles])
        seen, reward, ended, _, info = envs.step(actions)
        for i in range(2):
            rows[i] += [seen[i], np.array([reward[i]]), info["state"][i]]
        if ended.any():
            break
    for i in range(2):
        flown = np.concatenate(rows[i])
        np.testing.assert_array_equal(flown, alone[i][: len(flown)])


def test_a_fall_is_lost_and_the_end_is_truncated():
    env = gymnasium.make("quadexp/Hover-v0", lost=0.5, spread=(0, 0, 0)).unwrapped
    env.reset(seed=0)
    for _ in range(100):
        _, reward, terminated, truncated, info = env.step(-np.ones(4))
        if terminated:
            break
    fallen = 0.5 * 9.81 * info["t"] ** 2
    assert reward == -1.0 and not truncated and abs(info["error"] - fallen) < 0.02 and 0.5 < info["error"] < 0.8
    env = gymnasium.make("quadexp/Hover-v0", spread=(0, 0, 0), episode=0.5).unwrapped
    env.reset(seed=0)
    ends = [env.step(np.zeros(4))[2:4] for _ in range(25)]
    assert ends[-1] == (False, True) and not any(map(any, ends[:-1]))


@pytest.mark.parametrize(
    "given",
    [
        {"action": "torques"},
        {"overrides": ["plant=no"]},
        {"overrides": ["controller=pid"]},
        {"rate": 1000.0},
        {"spacing": 0.0},
    ],
)
def test_a_wrong_setting_is_said(given):
    from quadexp.errors import UsageError

    with pytest.raises(UsageError):
        gymnasium.make("quadexp/Tracking-v0", **given)


# -------------------------------------------------------------------------------------------------------------- policy
LAW = '''"""Thrust against the height error, damped: hovers."""
import numpy as np


def act(seen):
    lift = 1.5 * seen[2] - 0.8 * seen[17]
    return np.clip(np.full(4, lift), -1, 1)


def rates(seen):
    return np.array([1.5 * seen[2] - 0.8 * seen[17], 0.0, 0.0, 0.0])


def short(seen):
    return np.zeros(3)
'''


@pytest.fixture
def mine(tmp_path, monkeypatch):
    folder = tmp_path / "mine"
    (folder / "controller").mkdir(parents=True)
    (folder / "my_policy.py").write_text(LAW)
    (folder / "controller" / "hovering.yaml").write_text("defaults: [policy, _self_]\npolicy: my_policy:act\n")
    monkeypatch.chdir(tmp_path)
    return folder


def torch_file(path, size=PLAIN + 4 + 15):
    """The same law as a network in TorchScript."""
    import torch

    class Net(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            weights = torch.zeros(4, size)
            weights[:, 2], weights[:, 17] = 1.5, -0.8
            self.layer = torch.nn.Linear(size, 4, bias=False)
            self.layer.weight = torch.nn.Parameter(weights)

        def forward(self, seen):
            return torch.clamp(self.layer(seen), -1.0, 1.0)

    torch.jit.trace(Net(), torch.zeros(1, size)).save(str(path))


def onnx_file(path, size=PLAIN + 4 + 15):
    onnx = pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    weights = np.zeros((size, 4), np.float32)
    weights[2], weights[17] = 1.5, -0.8
    names = {"seen": [None, size], "action": [None, 4]}
    seen, action = (onnx.helper.make_tensor_value_info(n, onnx.TensorProto.FLOAT, s) for n, s in names.items())
    kept = [onnx.numpy_helper.from_array(weights, "w")]
    kept += [onnx.numpy_helper.from_array(np.float32(limit), name) for name, limit in (("low", -1), ("high", 1))]
    nodes = [onnx.helper.make_node("MatMul", ["seen", "w"], ["raw"])]
    nodes.append(onnx.helper.make_node("Clip", ["raw", "low", "high"], ["action"]))
    graph = onnx.helper.make_graph(nodes, "law", [seen], [action], kept)
    opset = [onnx.helper.make_opsetid("", 17)]
    onnx.save(onnx.helper.make_model(graph, opset_imports=opset, ir_version=9), path)


COURSE = ("trajectory=hover", "trajectory.duration=3", "controller.rate=50", *BARE)


@pytest.mark.parametrize("action", ["thrusts", "rates"])
def test_a_policy_flies_as_in_the_environment(mine, action):
    """One law, asked by the environment and by the bench: the same path."""
    words = [
        "plant=ideal",
        "trajectory=step",
        "trajectory.duration=3",
        "trajectory.step_time=0.2",
        "trajectory.target=[0,0,2]",
        *BARE,
    ]
    rate = 50 if action == "thrusts" else 500
    function = "my_policy:act" if action == "thrusts" else "my_policy:rates"
    flown = [*words, "controller=hovering", f"controller.rate={rate}", f"controller.action={action}"]
    config = compose([*flown, f"controller.policy={function}", "trajectory.lost_distance=5"], mine)
    flight = fly_one(config)
    space: dict = {}
    exec(LAW, space)
    env = gymnasium.make("quadexp/Tracking-v0", overrides=words, action=action, spread=(0, 0, 0)).unwrapped
    seen, _ = env.reset(seed=0, options={"t": 0.0})
    law = space["act" if action == "thrusts" else "rates"]
    for k in range(1, 101):
        seen, *_, info = env.step(law(seen))
        at = int(np.searchsorted(flight.t, k / 50 - 1e-6))
        np.testing.assert_allclose(info["state"][:3], flight.stack(["p_x", "p_y", "p_z"])[at], atol=1e-7)
    assert info["error"] < 0.2 < abs(flight["p_z"][-1] - flight["p_z"][0])


def test_a_function_and_a_file_are_one_flight(mine, tmp_path):
    torch_file(tmp_path / "law.pt")
    assert run("simulate", "--conf", "mine", "controller=hovering", *COURSE, "--out", "a.parquet")[0] == 0
    code, _, err = run("simulate", "controller=policy", "controller.policy=law.pt", *COURSE, "--out", "b.parquet")
    assert code == 0, err
    a, b = (read_flight(tmp_path / f"{name}.parquet") for name in "ab")
    np.testing.assert_allclose(a["p_z"], b["p_z"], atol=1e-6)
    assert a["action_0"].any()


def test_a_network_in_onnx_flies(mine, tmp_path):
    onnx_file(tmp_path / "law.onnx")
    assert run("simulate", "--conf", "mine", "controller=hovering", *COURSE, "--out", "a.parquet")[0] == 0
    code, _, err = run("simulate", "controller=policy", "controller.policy=law.onnx", *COURSE, "--out", "b.parquet")
    assert code == 0, err
    np.testing.assert_allclose(*(read_flight(tmp_path / f"{n}.parquet")["p_z"] for n in "ab"), atol=1e-6)


def test_an_edited_policy_is_flown_again(mine, tmp_path):
    words = ("evaluate", "--sweep", *COURSE, "seed=0,1", "--out", "r", "--no-figures")
    torch_file(tmp_path / "law.pt")
    own = ("--conf", "mine", "controller=hovering,policy", "controller.policy=my_policy:act,law.pt")
    assert run(*words, *own)[0] == 0
    before = {path: path.stat().st_mtime_ns for path in Path("r/cells").rglob("*.parquet")}
    assert len(before) == 8
    (mine / "my_policy.py").write_text(
        LAW.replace("1.5 * seen[2] - 0.8 * seen[17]\n    return np.clip", "seen[2]\n    return np.clip")
    )
    assert run(*words, *own)[0] == 0
    after = set(Path("r/cells").rglob("*.parquet")) - set(before)
    assert len(after) == 4  # those of the function; the network's are as they were


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("controller=policy",), "controller.policy=: no such file"),
        (("controller=policy", "controller.policy=no.onnx"), "controller.policy=no.onnx: no such file"),
        (("controller=policy", "controller.policy=mine/my_policy.py"), "must end in .onnx"),
        (("controller=policy", "controller.policy=bad.pt"), "is no network in TorchScript"),
        (("controller=policy", "controller.policy=law.pt", "controller.future=2"), "of 33 numbers"),
        (("controller=hovering", "controller.policy=my_policy:short"), "must give 4 finite numbers"),
        (("controller=hovering", "controller.policy=my_policy:none"), "no class or function 'none'"),
        (("controller=hovering", "controller.policy=os:remove"), "there is no module os in the --conf folder"),
        (("controller=hovering", "controller.policy_rate=30"), "must divide 50 Hz"),
    ],
)
def test_a_wrong_policy_is_one_line(mine, tmp_path, words, said):
    torch_file(tmp_path / "law.pt")
    Path("bad.pt").write_bytes(b"nothing")
    code, out, err = run("simulate", "--conf", "mine", *COURSE, *words, "--out", "c.parquet")
    assert code == 2 and said in err and err.count("\n") == 1 and not Path("c.parquet").exists(), err


def test_a_policy_is_an_entry_of_the_leaderboard(mine, tmp_path):
    from quadexp.parts.compose import session
    from quadexp.plugins.bench.entries import read_entries
    from quadexp.plugins.bench.protocol import read_protocol

    torch_file(tmp_path / "law.pt")
    with session(None) as composer:
        (entry,) = read_entries(["policy controller.policy=law.pt"], composer, read_protocol())
    assert (entry.bound, entry.model, entry.settings) == (False, "", "set by hand")
