"""The delay and lag that a loop tolerates beyond what it is flown with, and refusing one that is not stable at hover.

Everything that is flown is in the loop (linearised.py). A further delay d or lag tau between command and plant
makes it unstable where 1 is an eigenvalue of its gain with it: about where, with an eigenvalue l of the gain without,

    l e^{-i w d} = 1:  |l| = 1, d = arg(l) / w                  l / (1 + i w tau) = 1:  Re l = 1, tau = Im l / w

and exactly where the largest eigenvalue of the closed loop begins to grow. A margin is the least of all.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from contextlib import nullcontext
from dataclasses import replace
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from quadexp.control.base import Window
from quadexp.errors import UsageError
from quadexp.experiment.build import build_controller, build_trajectory, build_vehicle, build_world
from quadexp.experiment.identity import ModelFile
from quadexp.parts.schema import Config
from quadexp.physics.state import ATTITUDE, N_STATE, VELOCITY
from quadexp.plugins.margins.linear_loop import LinearLoop
from quadexp.plugins.margins.linearised import SETTLING, UnknownLoopError, linear_loop

LIMIT = 0.5  # s: largest margin that is searched for
SLOW = 0.05  # 1/s: what grows no faster is a drift, not an unstable loop
FASTER = 1e-3  # 1/s: growth beyond a drift that is there without, from which on a delay or lag is too long
LOWEST = 0.5  # of the search (rad/s)
FREQUENCIES = 50  # of the search, up to half the control rate
NEAR = 1.05  # how near the search comes
RESOLUTION = 1e-3  # relative accuracy of a margin
POINTS = 9  # along a path
RATES = (100.0, 200.0)  # control rates that are tried (Hz)
SHARES = (1.0, 0.5)  # of the horizon, that are tried
DIGITS = 3  # decimals of what is proposed
TOLD = {"dead_time": "timing.dead_time", "motor_lag": "timing.motor_lag", "motor_lead": "timing.motor_lag"}

_known: WeakKeyDictionary[Any, WeakKeyDictionary[Any, dict[str, Any]]] = WeakKeyDictionary()  # flown many times


def loop_margins(controller: Any, plant: Any) -> dict[str, Any]:
    """{growth, delay, lag} of the loop at hover, see `margins`; {unknown: why} where it cannot be linearised. judged:
    as what, of a controller that finds out in flight.

    Both begin a flight anew afterwards."""
    known = _known.setdefault(controller, WeakKeyDictionary())
    if plant not in known:
        try:
            known[plant] = margins(hover_loop(controller, plant))
            known[plant] |= getattr(controller, "judged", {})
        except UnknownLoopError as error:
            known[plant] = {"unknown": str(error)}
    return known[plant]


def _settled(controller: Any, plant: Any) -> Any:
    """Meanwhile a controller that finds out delays in flight has found those of the plant: the loop that it then flies
    is judged, not that of its first instants, in which nothing is known yet."""
    if not hasattr(controller, "settled"):
        return nullcontext()
    return controller.settled(*_delays(plant))


def _delays(plant: Any) -> tuple[float, float, float]:
    """Age of the state, dead time and lag of a plant (s)."""
    late, lag, age = (float(getattr(plant, name, 0.0)) for name in ("loop_delay", "loop_lag", "age"))
    return age, late - age, lag


def hover_loop(controller: Any, plant: Any) -> LinearLoop:
    """The loop at hover. Raises UnknownLoopError."""
    rest = np.eye(N_STATE)[ATTITUDE.start]
    nodes = len(controller.node_times)
    thrusts = np.full((max(nodes - 1, 0), controller.vehicle.n_rotors), controller.vehicle.hover_thrust)
    window = Window(np.tile(rest, (nodes, 1)), thrusts, np.zeros((5, 3)), np.zeros(3))
    with _settled(controller, plant):
        controller.forget()
        return linear_loop(controller, plant, lambda k: window, lambda k: rest)


def path_margins(config: Config, model: ModelFile | None) -> list[dict[str, Any]]:
    """`margins` at points along the path, with their time (s) and the speed of the reference (m/s), as if the vehicle
    went on as it does there: {t, speed, growth, delay, lag}. Raises UsageError where they are not known."""
    from quadexp.experiment.rollout import SampledReference

    vehicle = build_vehicle(config.vehicle)
    plant = build_world(config, vehicle)
    controller = build_controller(config, vehicle, plant, model)
    reference = SampledReference(build_trajectory(config.trajectory, vehicle), controller)
    last = len(reference) - 1
    before = math.ceil(SETTLING[0] / controller.control_period)
    rows = []
    for at in np.unique(np.linspace(min(before, last), last, POINTS).astype(int)):

        def instant(k: int, first: int = int(at) - before) -> int:
            return min(max(first + k, 0), last)

        window, state = lambda k: reference.window(instant(k)), lambda k: reference.at(instant(k))[0]
        try:
            with _settled(controller, plant):
                loop = linear_loop(controller, plant, window, state, (SETTLING[0], SETTLING[0]))
        except UnknownLoopError as error:
            raise UsageError(f"--margins: not known of {controller.name} in this world: {error}") from None
        speed = float(np.linalg.norm(reference.at(int(at))[0][VELOCITY]))
        rows.append({"t": float(reference.t[at]), "speed": speed, **margins(loop)})
    return rows


def margins(loop: LinearLoop) -> dict[str, Any]:
    """{growth, delay, lag}: rate at which the largest deviation grows (1/s), and what the loop tolerates of a further
    dead time and of a further first-order lag of every rotor, each alone (s); 0 where it is not stable without, LIMIT
    for that and more."""
    growth = loop.growth()
    if growth > SLOW:
        return {"growth": growth, "delay": 0.0, "lag": 0.0}
    frequencies = np.geomspace(LOWEST, (1 - 1e-6) * math.pi / loop.period, FREQUENCIES)
    eigenvalues = np.linalg.eigvals(loop.gain(frequencies))
    delays = (np.angle(value) % (2 * np.pi) / w for value, w in _crossings(np.abs, frequencies, eigenvalues))
    lags = (value.imag / w for value, w in _crossings(np.real, frequencies, eigenvalues))
    most = max(growth, 0.0) + FASTER
    return {
        "growth": growth,
        "delay": _first(lambda delay: loop.growth(delay=delay) > most, delays),
        "lag": _first(lambda lag: loop.growth(lag=lag) > most, lags),
    }


def _crossings(score: Any, frequencies: np.ndarray, eigenvalues: np.ndarray) -> list[tuple[complex, float]]:
    """Eigenvalues of the gain, (k, n), and frequencies (rad/s), about where their score is 1."""
    eigenvalues = np.take_along_axis(eigenvalues, np.argsort(score(eigenvalues), axis=1), 1)
    beyond = score(eigenvalues) - 1
    crossings = list[tuple[complex, float]]()
    for k, i in np.argwhere(beyond[1:] * beyond[:-1] < 0):
        share = beyond[k, i] / (beyond[k, i] - beyond[k + 1, i])
        between = eigenvalues[k, i] + share * (eigenvalues[k + 1, i] - eigenvalues[k, i])
        crossings.append((between, frequencies[k] * (frequencies[k + 1] / frequencies[k]) ** share))
    return crossings


def _first(unstable: Callable[[float], bool], about: Iterable[float]) -> float:
    """Where stability first ends (s), at most LIMIT. about: where it may (s)."""
    low = 0.0
    high = LIMIT
    for time in sorted(time for time in about if 0 < time < LIMIT / NEAR):
        if unstable(high := min(time * NEAR, LIMIT)):
            break
        low = high
        high = LIMIT
    else:
        if low == LIMIT or not unstable(LIMIT):
            return LIMIT
    if not unstable(near := max(low, high / NEAR**2)):
        low = near
    while high - low > RESOLUTION * high:
        middle = (low + high) / 2
        low, high = (low, middle) if unstable(middle) else (middle, high)
    return float(low)


def instability(config: Config, loop: Any, model: ModelFile | None) -> str:
    """Why the loop of a flight (experiment.evaluate.Loop) is not stable at hover, in one line with what helps.

    "" where it is, where that is not known, where the configuration allows it, and where the controller finds such
    delays in flight, since it may then choose a softer horizon than the stiffest, which is judged. What is tried:
    telling the controller lag and delay, and other control rates and horizons without."""
    controller, plant, growth = config.controller, loop.plant, loop.margins.get("growth", 0.0)
    if growth <= SLOW or controller.allow_unstable:
        return ""
    if hasattr(loop.controller, "looks_for") and loop.controller.looks_for(*_delays(plant)):
        return ""
    lag = getattr(config.plant, "motor_lag", 0.0) + getattr(plant, "loop_lag", 0.0)
    late = getattr(plant, "loop_delay", 0.0)
    knows = "motor_lead" if getattr(controller, "motor_lead", 0.0) else "motor_lag"
    true = {knows: round(lag, DIGITS), "dead_time": round(late, DIGITS)}
    unknown = {}
    for name, value in true.items():
        if getattr(controller, name, value) != value:
            unknown[name] = value

    def stable(changes: Mapping[str, float]) -> bool:
        try:
            other = replace(config, controller=replace(controller, **changes))
            changed = build_controller(other, loop.vehicle, plant, model)
            return loop_margins(changed, plant).get("growth", math.inf) <= SLOW
        except UsageError:  # of settings that contradict each other
            return False

    grids = [{"rate": max(rate, controller.rate)} for rate in RATES]
    if hasattr(controller, "horizon"):
        grids = [grid | {"horizon": round(share * controller.horizon, DIGITS)} for grid in grids for share in SHARES]
    known = next((_keys(unknown | grid) for grid in grids if unknown and stable(unknown | grid)), "")
    if unknown and stable(unknown):
        known = f"{_keys(unknown)} at this rate and horizon"
    faster = next((_keys(grid) for grid in grids if stable(grid)), "")
    helps = ", or ".join(filter(None, (known, faster))) or "nothing that was tried"
    causing = {"motors that lag by": lag, "commands and measurements that are late by": late}
    causes = " and ".join(f"{words} {1e3 * value:.0f} ms" for words, value in causing.items() if value) or "no delay"
    return (
        f"{controller.name} on {config.plant.name}: {causes}; this loop is not stable at hover, an error doubles every"
        f" {math.log(2) / growth:.2g} s; what makes it stable: {helps}; to fly it all the same:"
        " controller.allow_unstable=true"
    )


def _keys(changes: Mapping[str, float]) -> str:
    return " ".join(f"{TOLD.get(name, f'controller.{name}')}={value:g}" for name, value in changes.items())
