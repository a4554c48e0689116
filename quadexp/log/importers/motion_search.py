"""Which columns are position and velocity: three that are the derivative of three others, in world or body."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quadexp.log.importers.attitude_proposal import Attitude
from quadexp.log.importers.evidence import Samples, correlations, fit_turn
from quadexp.log.importers.names import unit_of
from quadexp.log.importers.proposal import Groups, Proposal
from quadexp.log.importers.sensor_units import force_unit, rate_unit

MOTION = 0.85  # correlation of a velocity with the derivative of a position


class Pair(NamedTuple):
    """score: correlation. position, velocity: columns. frame: of the velocity. slope: of it over the derivative."""

    score: float
    position: list[int]
    velocity: list[int]
    frame: str
    slope: float


class Motion:
    """Position and velocity: which columns are each other's derivative, in the world or in the body."""

    def __init__(
        self,
        names: list[str],
        samples: Samples,
        usable: list[int],
        said: Groups,
        attitude: Attitude | None,
    ) -> None:
        self.names, self.s, self.usable, self.said, self.attitude = names, samples, usable, said, attitude

    def without_attitude(self) -> Proposal | None:
        """Body frame from gravity in the accelerometer alone."""
        for columns in self.said.get("acceleration", []):
            mean = self.s.x[:, columns].mean(axis=0)
            axis = int(np.argmax(np.abs(mean)))
            if axis == 2 and abs(mean[2]) > 3 * np.abs(mean[:2]).max():
                frame = "FLU" if mean[2] > 0 else "FRD"
                return Proposal(frame, 0.7, f"the accelerometer's mean along z is {mean[2]:+.3g}")
        return None

    def fields(self) -> dict[str, Proposal]:
        made: dict[str, Proposal] = {}
        position, velocity = self._pair()
        if position is not None:
            made["position"] = position
        if velocity is not None:
            made["velocity"] = velocity
        if self.attitude is None:
            made |= self._unproved()
        return made

    def _unproved(self) -> dict[str, Proposal]:
        """Rate and acceleration where there is no attitude to check them with: names, and the size of gravity."""
        made = {}
        for columns in self.said.get("rate", [])[:1]:
            unit, sure, why = rate_unit(self.names, columns, self.s.x[:, columns])
            made["rate"] = Proposal({"columns": [self.names[i] for i in columns], "unit": unit}, sure, why)
        for columns in self.said.get("acceleration", [])[:1]:
            entry, sure, why = force_unit(
                self.names, columns, float(np.linalg.norm(self.s.x[:, columns], axis=1).mean())
            )
            made["acceleration"] = Proposal({"columns": [self.names[i] for i in columns], **entry}, sure, why)
        for columns in self.said.get("euler", [])[:1]:
            largest = float(np.abs(self.s.x[:, columns]).max())
            written = unit_of(self.names[columns[0]])[1]
            unit = written if written in ("rad", "deg") else "deg" if largest > 6.4 else "rad"
            made["attitude"] = Proposal(
                {"columns": [self.names[i] for i in columns], "order": "rpy", "unit": unit}, 0.5,
                f"named roll, pitch, yaw; largest {largest:.3g}",
            )  # fmt: skip
        return made

    def _pair(self) -> tuple[Proposal | None, Proposal | None]:
        best = self.derivative()
        if best is None and self.attitude is not None:
            found = [self._in_body(p) for p in self.said.get("position", [])]
            best = max((b for b in found if b is not None), key=lambda b: b[0], default=None)
        if best is not None:
            return self._proposals(*best)
        return self._alone("position"), self._alone("velocity")

    def _triples(self) -> list[list[int]]:
        free = set(self.usable) - set(self.attitude.taken if self.attitude else ())
        return [g for i in range(len(self.names) - 2) if set(g := list(range(i, i + 3))) <= free]

    def derivative(self) -> Pair | None:
        """Three columns that are the derivative of three others, names and all; None where there are none."""
        s, triples = self.s, self._triples()
        C = correlations(s.dx, s.x)
        best: tuple[float, Pair] | None = None
        positions, velocities = self.said.get("position", []), self.said.get("velocity", [])
        for p in [*positions, *(g for g in triples if g not in positions)]:
            for v in [*velocities, *(g for g in triples if g not in velocities)]:
                if set(p) & set(v):
                    continue
                score = min(C[p[k], v[k]] for k in range(3))
                if score < MOTION:
                    continue
                named = 0.05 * (p in positions) + 0.05 * (v in velocities)
                value = score + named - 0.01 * (self._rank("position", p) + self._rank("velocity", v))
                if best is None or value > best[0] + 1e-3:
                    slope = float(np.sum(s.x[:, v] * s.dx[:, p]) / np.sum(s.dx[:, p] ** 2))
                    best = (value, Pair(score, p, v, "world", slope))
        return None if best is None else best[1]

    def _rank(self, quantity: str, columns: list[int]) -> int:
        known = self.said.get(quantity, [])
        return known.index(columns) if columns in known else 3

    def _in_body(self, p: list[int]) -> Pair | None:
        """The columns that are the derivative of a position, turned into the body."""
        assert self.attitude is not None
        expected = np.einsum("nji,nj->ni", self.attitude.R, self.s.dx[:, p])
        best: tuple[float, Pair] | None = None
        for rank, v in enumerate([*self.said.get("velocity", []), *self._triples()]):
            fit = fit_turn(expected, self.s.x[:, v])
            if set(v) & set(p) or fit.score < MOTION or not (fit.matrix == np.eye(3)).all():
                continue
            value = fit.score - 0.01 * min(rank, 5)
            if best is None or value > best[0]:
                best = (value, Pair(fit.score, p, v, "body", fit.scale))
        return None if best is None else best[1]

    def _proposals(
        self, score: float, p: list[int], v: list[int], frame: str, slope: float
    ) -> tuple[Proposal, Proposal]:
        units = {1.0: ("m", "m/s"), 1e3: ("m", "mm/s"), 1e-3: ("mm", "m/s"), 100.0: ("m", "cm/s"), 0.01: ("cm", "m/s")}
        near = min(units, key=lambda u: abs(np.log(max(slope, 1e-12) / u)))
        length, speed = units[near]
        written = [unit_of(self.names[g[0]])[1] for g in (p, v)]
        if near == 1.0 and written[0] in ("mm", "cm"):
            length, speed = written[0], f"{written[0]}/s"
        elif near == 1.0 and np.ptp(self.s.x[:, p], axis=0).max() > 500 and np.abs(self.s.x[:, v]).max() > 80:
            length, speed = "mm", "mm/s"
        clear = abs(slope / near - 1) < 0.1
        named = p in self.said.get("position", []) or v in self.said.get("velocity", [])
        sure = (0.97 if named else 0.9) if clear and score > 0.95 else 0.75 if clear else 0.5
        why = f"the velocity is {slope:.3g} times its derivative, correlation {score:.3f}"
        if not clear:
            why += "; that factor fits no unit: look at the time's unit too"
        names, turned = self.names, " turned into the body" if frame == "body" else ""
        return (
            Proposal({"columns": [names[i] for i in p], "unit": length}, sure, why),
            Proposal(
                {"columns": [names[i] for i in v], "unit": speed, "frame": frame}, sure,
                f"{slope:.3g} times the derivative of the position{turned}",
            ),
        )  # fmt: skip

    def _alone(self, quantity: str) -> Proposal | None:
        known = self.said.get(quantity, [])
        if not known:
            return None
        unit = unit_of(self.names[known[0][0]])[1]
        default = "m" if quantity == "position" else "m/s"
        value = {
            "columns": [self.names[i] for i in known[0]],
            "unit": unit if unit in ("m", "mm", "cm", "m/s", "cm/s") else default,
        }
        if quantity == "velocity" and self.attitude is not None and self.attitude.body_velocity:
            return Proposal(value | {"frame": "body"}, 0.7, "in the body frame the thrust points along one axis")
        return Proposal(value, 0.6, "by its name alone")
