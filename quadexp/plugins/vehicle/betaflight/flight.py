"""A flight of the bench with Betaflight between controller and vehicle.

    controller -> body rates, collective thrust -> pulses -> radio link -> Betaflight -> rotors' shares -> plant

The plant goes on by 1 ms between two packets of the firmware, so that what is flown, measured and logged is the bench's
own. The configuration's link is that of the radio: its delay, jitter and losses meet the pulses, and are in the loop's
margins as on the bench. A rotor gives its share of thrust_max. Rates that an MPC predicts are sent for a time ahead, as
the firmware follows them late:

    w(t + h) = w_0 + h / dt (w_1 - w_0)        w_0, w_1: at the first two nodes, dt apart
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import QuadexpError, UsageError
from quadexp.experiment.evaluate import InfeasibleError, Loop, fly_one
from quadexp.log.schema import Flight
from quadexp.parts.compose import compose
from quadexp.parts.options import Folders
from quadexp.physics.state import ATTITUDE, RATE
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.vehicle.betaflight.firmware import (
    HERE,
    TICK,
    Firmware,
    channels_packet,
    firmware_file,
    state_packet,
)
from quadexp.plugins.vehicle.betaflight.rate_loop import axis_gains, law_margins
from quadexp.plugins.vehicle.rates import Rates, inverse_rates, predicted_rates, rate_gain
from quadexp.world.link import Latency
from quadexp.world.streams import Streams, part_stream
from quadexp.world.world import World

FULL = 700.0  # deg/s of a stick at its end
LOW, MIDDLE, HIGH = 1010, 1500, 2000  # us: throttle from which the mixer acts, stick in the middle, at its end
GROUND, ARMED, HOVERING = (6000, 1000, 500)  # ticks on the stand: throttle down, armed, first thrust
MOST_STEPS = 1000  # of a throw: pulses are whole us
EXACT = 1e-6  # ticks, by which a time may differ from whole ones
SETTINGS = (HERE / "settings.txt").read_text(encoding="utf-8").splitlines()  # no idle thrust, linear rates of FULL
QUADRANTS = ((1, -1), (-1, 1), (1, 1), (-1, -1))  # signs of x and y of the rotors in the order of the firmware's packet
SPINS = (-1, -1, 1, 1)  # their reaction torques in its own order of propellers


@dataclass(frozen=True)
class Radio:
    """rate: pulses are sent (Hz), with every command where it is 0. steps: of a stick's throw. ahead: of predicted
    rates (s). rates: see rates.py."""

    rate: float = 0.0
    steps: int = 1000
    ahead: float = 0.04
    rates: str = "predicted"

    def __post_init__(self) -> None:
        every = 1 / (self.rate * TICK) if self.rate else 1.0
        if not (every >= 1 and abs(every - round(every)) < EXACT):
            raise UsageError(f"--rc-rate {self.rate:g}: must be 0, or 1000 Hz divided by a whole number")
        if not 2 <= self.steps <= MOST_STEPS:
            raise UsageError(f"--rc-steps {self.steps}: must be 2 to {MOST_STEPS}")
        if not 0 <= self.ahead <= 1:
            raise UsageError(f"--ahead {self.ahead:g}: must be 0 to 1 s")


def pulses(rates: np.ndarray, share: float, steps: int) -> list[int]:
    """Body rates (3,) (rad/s), forward left up, and a share of all thrust: roll, pitch, throttle, yaw (us)."""
    roll, pitch, yaw = (np.degrees(rates) / FULL).clip(-1, 1)
    sticks = [roll, pitch, 2 * np.clip(share, 0, 1) - 1, -yaw]
    values = np.round((np.array(sticks) + 1) / 2 * steps) / steps
    lowest = np.array([1000, 1000, LOW, 1000])
    return [int(value) for value in np.round(lowest + values * (HIGH - lowest))]


def rotor_order(vehicle: Vehicle) -> tuple[list[int], list[str]]:
    """Which number of the firmware's packet each rotor gets, and the setting for the way that they turn.

    Raises UsageError for a vehicle that is no quadrotor in X."""
    signs = [(int(np.sign(x)), int(np.sign(y))) for x, y, _ in vehicle.rotor_position]
    if sorted(signs) != sorted(QUADRANTS):
        raise UsageError(f"fly betaflight: vehicle={vehicle.name}: is no quadrotor with a rotor in each quadrant")
    order = [QUADRANTS.index(sign) for sign in signs]
    turned = vehicle.rotor_spin[0] != SPINS[order[0]]
    return order, [f"set yaw_motors_reversed = {'ON' if turned else 'OFF'}"]


def fly_betaflight(overrides: Sequence[str], conf: Folders, radio: Radio, firmware: Path | None = None) -> Flight:
    """Fly one configuration through the firmware. Raises UsageError before a flight."""
    program = firmware_file(firmware)
    config = compose(list(overrides), conf, "fly")
    with tempfile.TemporaryDirectory(prefix="quadexp-betaflight-") as folder:
        through = Through(program, Path(folder), radio)
        try:
            flight = fly_one(config, through=through)
        finally:
            through.end()
    flight.metadata["autopilot"] = through.version
    flight.metadata["radio"] = asdict(radio)
    return flight


class Through:
    """Makes of a loop one with the firmware in it, which runs till `end`."""

    def __init__(self, program: Path, folder: Path, radio: Radio) -> None:
        self.program, self.folder, self.radio = program, folder, radio
        self.version = ""
        self._running: Firmware | None = None

    def __call__(self, loop: Loop) -> Loop:
        """See fly_one. Raises InfeasibleError for a radio that is slower than the loop tolerates."""
        period, sent = loop.controller.control_period, 1 / self.radio.rate if self.radio.rate else 0.0
        if abs(period / TICK - round(period / TICK)) > EXACT:
            raise UsageError(f"fly betaflight: a control period of {period:g} s is no whole number of milliseconds")
        held = max(sent - period, 0.0) / 2  # s, in the mean, beyond the hold of a command
        gain = rate_gain(self.radio.rates, axis_gains(loop.vehicle))
        if gain is None:
            rates, margins = predicted_rates(loop.controller, self.radio.ahead), self._held(loop.margins, held)
        else:
            rates, margins = inverse_rates(loop.controller, gain), law_margins(loop, gain, held)
        order, turning = rotor_order(loop.vehicle)
        with Firmware(self.program, self.folder) as firmware:
            self.version = firmware.settings([*SETTINGS, *turning])
        return replace(loop, plant=Stacked(loop.plant, self.started, rates, self.radio, order), margins=margins)

    def _held(self, margins: dict[str, Any], held: float) -> dict[str, Any]:
        """Margins of the loop of a prediction, which is sent ahead of the firmware's delay: what pulses are held (s)
        beyond a command is taken off. Raises InfeasibleError where that is too long."""
        if not held or "delay" not in margins:
            return margins
        if margins["delay"] <= held:
            raise InfeasibleError(
                f"--rc-rate {self.radio.rate:g}: pulses act {1e3 * held:.0f} ms later than commands; the loop tolerates"
                f" {1e3 * margins['delay']:.0f} ms"
            )
        return margins | {"delay": margins["delay"] - held}

    def started(self) -> Firmware:
        """The firmware, at its boot."""
        self.end()
        self._running = Firmware(self.program, self.folder)
        return self._running

    def end(self) -> None:
        """Stop it."""
        if self._running is not None:
            self._running.stop()
            self._running = None


class Stacked(World):
    """A plant in its world, with the firmware before it and the radio link before that.

    plant: of the bench. start: gives a firmware at its boot. order: of the rotors in its packets."""

    def __init__(
        self, plant: Any, start: Callable[[], Firmware], rates: Rates, radio: Radio, order: Sequence[int]
    ) -> None:
        world = plant if isinstance(plant, World) else World(plant, [Latency()])
        self._link = next((effect for effect in world.effects if isinstance(effect, Latency)), Latency())
        self._start, self._rates, self._radio, self._order = start, rates, radio, list(order)
        others = [effect for effect in world.effects if not isinstance(effect, Latency)]
        super().__init__(world.airframe, [Latency(), *others], world._believed)  # the motors' commands come at once

    def columns(self, period: float) -> dict[str, int]:
        """See World; its own periods are ticks."""
        return super().columns(TICK)

    def begin(
        self, x: np.ndarray, period: float, duration: float, rng: np.random.Generator, thrust: np.ndarray | None = None
    ) -> Streams:
        """See World. The firmware boots, is armed, and gives the first thrust on a stand."""
        streams = super().begin(x, TICK, duration, rng, thrust)
        first = np.full(self.vehicle.n_rotors, self.vehicle.hover_thrust) if thrust is None else thrust
        self._draws, self._sent, self._waiting = part_stream(rng, "radio"), 0, list[tuple[float, int, list[int]]]()
        self._firmware, self._force = self._start(), np.array([0.0, 0.0, self.vehicle.gravity])
        self._firmware.stand(2 * ARMED)
        down, up = [MIDDLE, MIDDLE, 1000, MIDDLE, 1000], self._pulses(np.zeros(3), float(first.sum()))
        for ticks, sticks in ((GROUND, down), (ARMED, [*down[:4], HIGH]), (HOVERING, up)):
            self._firmware.stand(ticks, channels_packet(0.0, sticks))
        if not self._firmware.motors.any():
            raise QuadexpError("the firmware did not arm")
        return streams

    def _pulses(self, rates: np.ndarray, thrust: float) -> list[int]:
        full = self.vehicle.n_rotors * self.vehicle.thrust_max
        return [*pulses(rates, thrust / full, self._radio.steps), HIGH]

    def advance(self, x: np.ndarray, u: np.ndarray, duration: float, rng: Any = None) -> tuple[np.ndarray, np.ndarray]:
        """See SimulatedPlant."""
        command = self._pulses(self._rates(self.measured, u), float(u.sum()))
        every = round(1 / (self._radio.rate * TICK)) if self._radio.rate else round(duration / TICK)
        for _ in range(round(duration / TICK)):
            tick = round(self.time / TICK)
            if tick % every == 0:
                self._send(command)
            state = state_packet(self._firmware.ticks * TICK, x[RATE], self._force, x[ATTITUDE])
            self._firmware.tick(state, self._arrived())
            thrusts = self._firmware.motors[self._order].clip(0, 1) * self.vehicle.thrust_max
            x, self._force = super().advance(x, thrusts, TICK, rng)
        return x, self._force

    def _send(self, command: list[int]) -> None:
        """Pulses are on their way, or lost."""
        share, luck = self._draws.random(2)
        self._sent += 1
        if luck >= self._link.drop:
            arrival = self.time + self._link.latency + self._link.jitter * share
            self._waiting.append((arrival, self._sent, command))

    def _arrived(self) -> bytes | None:
        """The newest pulses that have come by now; older ones are forgotten."""
        come = [waiting for waiting in self._waiting if waiting[0] <= self.time + TICK / 2]
        if not come:
            return None
        _, newest, command = max(come, key=lambda waiting: waiting[1])
        self._waiting = [waiting for waiting in self._waiting if waiting[1] > newest]
        return channels_packet(self._firmware.ticks * TICK, command)
