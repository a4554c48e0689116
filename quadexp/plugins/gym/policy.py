"""A policy that was trained elsewhere, as a controller: what it sees and says is that of the environment (task.py).

    controller=policy controller.policy=hover.onnx        a network in ONNX                 (package onnxruntime)
    controller=policy controller.policy=hover.pt          a network in TorchScript
    controller=policy controller.policy=my_policy:act     a function of the --conf folder: observation -> action

It flies in Python's loop; what delays its loop tolerates is not known.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.control.base import Measurement, Window
from quadexp.control.laws.explicit import Rate
from quadexp.control.part import ControllerPart
from quadexp.errors import UsageError, missing_package
from quadexp.models.build_context import BuildContext
from quadexp.parts.part import imported
from quadexp.parts.settings import key, keyed
from quadexp.parts.user_modules import lies_outside, locate, own_folders
from quadexp.physics.state import RATE
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.gym.task import Action, Task

Function = Callable[[np.ndarray], Any]
KEY = "controller.policy"
TORCH = (".pt", ".pth", ".ts")


@keyed
class Policy(ControllerPart):
    """A policy trained elsewhere: a file in ONNX or TorchScript, or a function MODULE:NAME of a --conf folder."""

    policy: str = key("", "file (.onnx, .pt, .pth, .ts) or MODULE:NAME; observation to action, as in the environment")
    action: Action = key("thrusts", "what it says: thrusts of the rotors, or collective thrust and body rates")
    rate: Rate = 500.0
    policy_rate: float = key(50.0, "how often it is asked; its action is held in between", "[1, 1000]", "Hz")
    future: int = key(5, "points of the reference that it sees beyond now", "[0, 50]")
    spacing: float = key(0.1, "time between these points", "(0, 2]", "s")
    allow_unstable: bool = key(True, "fly although the loop is not stable at hover, which is not known of a policy")

    @property
    def is_function(self) -> bool:
        """Whether it is MODULE:NAME, not a file."""
        return ":" in self.policy and not Path(self.policy).is_file()

    @property
    def path(self) -> str:
        """The file whose content decides the flight: the network, or the module."""
        if not self.is_function:
            place: Path | None = Path(self.policy)
            if not self.policy or not Path(self.policy).is_file():
                raise UsageError(f"{KEY}={self.policy}: no such file; give a network (.onnx, .pt) or MODULE:NAME")
        else:
            module = self.policy.partition(":")[0]
            place = locate(module)
            if place is None or not place.is_file():
                raise UsageError(f"{KEY}={self.policy}: {lies_outside(module) or 'is no file'}")
        return str(place)

    @property
    def folders(self) -> tuple[str, ...]:
        """See Part; also those of a user's function."""
        if self.is_function:
            return own_folders()
        return ()

    def build(self, context: BuildContext) -> Any:
        """See ControllerPart."""
        return PolicyController(context.vehicle, self, self._function())

    def _function(self) -> Function:
        if self.is_function:
            module, _, name = self.policy.partition(":")
            function: Function = imported(f"{KEY}={self.policy}", f"{module}.{name}")
            if not callable(function):
                raise UsageError(f"{KEY}={self.policy}: is not a function")
            return function
        suffix = Path(self.path).suffix
        if suffix == ".onnx":
            return of_onnx(self.path)
        if suffix in TORCH:
            return of_torch(self.path)
        raise UsageError(f"{KEY}={self.policy}: must end in .onnx, {', '.join(TORCH)}, or be MODULE:NAME")


class PolicyController:
    """A Controller (see control.base). act: observation, (size,), float32 -> action, (a,).

    Raises UsageError where it gives something else, or its rate does not divide the control rate."""

    reference_period = 0.0
    residual = None
    backend = "interpreted"
    residual_name = "none"
    source = ""

    def __init__(self, vehicle: Vehicle, settings: Policy, act: Function) -> None:
        self.vehicle = vehicle
        self.control_period = 1.0 / settings.rate
        self.node_times = settings.spacing * np.arange(settings.future + 1)
        self.task = Task(vehicle, settings.action, settings.future)
        self._act = act
        self._said = f"{KEY}={settings.policy}"
        every = settings.rate / settings.policy_rate
        self._every = round(every)
        if self._every < 1 or abs(every - self._every) > 1e-9:
            raise UsageError(f"controller.policy_rate={settings.policy_rate:g}: must divide {settings.rate:g} Hz")
        self.forget()
        self._asked(np.zeros(self.task.size, np.float32))

    def forget(self) -> None:
        """See Controller.forget."""
        self._action = np.zeros(self.task.actions)
        self._count = 0

    def reset(self, x: np.ndarray, window: Window) -> None:
        """See Controller.reset; a policy with a memory has a method `reset`."""
        self.forget()
        if hasattr(self._act, "reset"):
            self._act.reset()

    def step(self, measurement: Measurement, window: Window) -> np.ndarray:
        """See Controller.step."""
        x = measurement.state
        if self._count % self._every == 0:
            self._action = self._asked(self.task.observation(x, window.state, self._action))
        self._count += 1
        return self.task.thrusts(self._action, x[RATE])

    def log(self) -> dict[str, float]:
        """See Controller.log; the action in force."""
        return {f"action_{i}": float(value) for i, value in enumerate(self._action)}

    def _asked(self, observation: np.ndarray) -> np.ndarray:
        try:
            action = np.asarray(self._act(observation), float).ravel()
        except Exception as error:
            text = " ".join(str(error).split())[:200]
            size = self.task.size
            raise UsageError(f"{self._said}: of {size} numbers: {type(error).__name__}: {text}") from error
        if action.shape != (self.task.actions,) or not np.isfinite(action).all():
            raise UsageError(f"{self._said}: must give {self.task.actions} finite numbers, it gives {action.tolist()}")
        return np.clip(action, -1.0, 1.0)


def of_onnx(path: str) -> Function:
    """A network in ONNX, its first input a batch of observations and its first output that of actions."""
    try:
        import onnxruntime
    except ImportError:
        raise missing_package(f"{KEY}={path}", "onnxruntime", "rl") from None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    try:
        session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise UsageError(f"{KEY}={path}: is no network in ONNX: {' '.join(str(error).split())[:200]}") from error
    name = session.get_inputs()[0].name
    return lambda observation: session.run(None, {name: observation[None]})[0]


def of_torch(path: str) -> Function:
    """A network in TorchScript: a batch of observations in, a batch of actions out."""
    import torch

    try:
        network = torch.jit.load(path, map_location="cpu").eval()
    except (RuntimeError, ValueError) as error:
        raise UsageError(f"{KEY}={path}: is no network in TorchScript: {str(error).splitlines()[0][:200]}") from error

    def act(observation: np.ndarray) -> np.ndarray:
        with torch.inference_mode():
            return network(torch.from_numpy(observation)[None]).numpy()

    return act
