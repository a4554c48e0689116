"""The recursion of Lei & Li 2017 sample by sample, so that a test may look at it between two."""

from __future__ import annotations

import numpy as np

from quadexp.compile.backend import realise, resolve
from quadexp.compile.memory import Memory, connected, sizes_of
from quadexp.physics.rotor import BladeCoefficients
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.papers.lei_li.rls import AXES, RLSSettings, bounds, remembered, standard_errors, update_function


class Estimator:
    """Estimator of theta = (C_d0, C_la, C_Dx, C_Dy, C_Dz): `update` at every sample, `reset` at the start of a flight.

    vehicle: with rotor and thrust coefficient. initial: theta_0 (the paper starts from half of the true values).
    change_threshold: detects a change of the vehicle: where the mean square error over the last samples exceeds that of
    the assumed noise by this factor, P = P_0 again. None: never. memory: see `remembered`, what it knows by name.
    """

    def __init__(
        self, vehicle: Vehicle, initial: BladeCoefficients, settings: RLSSettings | None = None,
        change_threshold: float | None = None, *, backend: str = "interpreted",
    ) -> None:  # fmt: skip
        self.vehicle = vehicle
        self.initial = initial
        self.settings = settings or RLSSettings()
        function = update_function(vehicle, initial, self.settings, change_threshold)
        self.memory = Memory("RLS", sizes_of([function]))
        self._update = connected(realise(function, resolve(backend)), {"read": np.ones(1)}, {}, self.memory)
        self.lower, self.upper = bounds(initial, self.settings)
        self.reset()

    def reset(self) -> None:
        """Restart from the initial values."""
        self.memory.begin(remembered(self.initial, self.settings))
        for name in ("error", "regressors", "induced"):
            self._update.results[name][...] = np.nan

    def update(self, body_velocity: np.ndarray, rotor_speed: np.ndarray, specific_force: np.ndarray) -> np.ndarray:
        """Update with one sample; returns the values to use, (5,).

        body_velocity: (3,) FLU (m/s). rotor_speed: (n,) (rad/s). specific_force: reading (3,) FLU (m/s^2). All at the
        same instant, and finite.
        """
        arguments = self._update.arguments
        v, w, y = (arguments[name] for name in ("v", "w", "y"))
        v[...] = body_velocity
        w[...] = rotor_speed
        y[...] = specific_force
        self._update()
        self.memory.commit()
        return self.theta

    @property
    def theta(self) -> np.ndarray:
        """Values to use, clipped, (5,)."""
        return self.memory.of_now["used"].copy()

    @property
    def raw(self) -> np.ndarray:
        """Not clipped, (5,)."""
        return self.memory.of_now["raw"].copy()

    @property
    def clips(self) -> np.ndarray:
        """Number of samples on which each was clipped, (5,)."""
        return self.memory.of_now["clips"].astype(int)

    @property
    def samples(self) -> int:
        """Number of updates."""
        return int(self.memory.of_now["samples"][0])

    @property
    def skipped(self) -> int:
        """Number of samples with a stopped rotor."""
        return int(self.memory.of_now["skipped"][0])

    @property
    def weight(self) -> float:
        """beta_x of the last sample."""
        return float(self.memory.of_now["weight"][0])

    @property
    def error(self) -> np.ndarray:
        """Of the last sample, before the update, (3,) (m/s^2)."""
        return self._update.results["error"].copy()

    @property
    def regressors(self) -> np.ndarray:
        """Of the last sample, (3, 5) (m/s^2)."""
        return self._update.results["regressors"].T.copy()

    @property
    def induced_velocity(self) -> np.ndarray:
        """Of the last sample, (n,) (m/s)."""
        return self._update.results["induced"].copy()

    @property
    def axis_theta(self) -> tuple[np.ndarray, ...]:
        """Estimates of the axes: x (C_d0, C_la, C_Dx), y (C_d0, C_la, C_Dy), z (C_la, C_Dz)."""
        return tuple(self.memory.of_now[f"theta_{axis}"].copy() for axis in "xyz")

    @property
    def covariance(self) -> tuple[np.ndarray, ...]:
        """P of the axes, in the order of `axis_theta`: the estimates' covariance where sigma is the true noise."""
        kept = self.memory.of_now
        return tuple(kept[f"P_{axis}"].reshape(len(at), len(at)).copy() for axis, at in AXES.items())

    def standard_error(self) -> np.ndarray:
        """Standard errors of `raw`, (5,), where the readings have the assumed deviation."""
        return standard_errors({name: values[None] for name, values in self.memory.of_now.items()}, self.settings)[0]
