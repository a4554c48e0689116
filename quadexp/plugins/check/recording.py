"""A flight's streams on one clock, as the check mends them: corrected, and moved where they come late."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from quadexp.physics.rotation import continuous
from quadexp.physics.state import finite_rows, norms
from quadexp.plugins.check.agreement import agreements, evidence
from quadexp.plugins.check.candidates import KEYS, Candidate
from quadexp.plugins.logs.signal import Stream
from quadexp.plugins.logs.signal.offset import Offset, aligned, find_offsets
from quadexp.plugins.logs.signal.windows import Windows, cut

Offsets = Mapping[tuple[str, str], Offset]  # of the first stream behind the second


@dataclass(frozen=True)
class Recording:
    """t: (k,) s. streams: by letter of windows, (k, 3 or 4). good: samples to be used, (k,). segment: (k,) or None."""

    t: np.ndarray
    streams: Mapping[str, np.ndarray]
    good: np.ndarray
    segment: np.ndarray | None

    @property
    def usable(self) -> np.ndarray:
        """Good samples at which every stream has numbers, (k,)."""
        return self.good & finite(self.streams)

    def windows(self) -> Windows:
        return cut(self.t, self.streams, self.usable, self.segment)

    def evidence(self) -> float:
        """How well the streams agree (log units)."""
        return evidence(agreements(self.windows()))

    def offsets(self) -> Offsets:
        usable = self.usable
        streams = {KEYS[name]: Stream(self.t[usable], x[usable]) for name, x in self.streams.items()}
        return find_offsets(streams)

    def moved(self, late: Mapping[str, np.ndarray | float]) -> Recording:
        """With streams, by letter, that come `late` (s, a number or (k,)), at the times that they are of."""
        streams = {**self.streams}
        for name in late.keys() & streams.keys():
            values = np.nan_to_num(streams[name])
            if name == "q":
                values = continuous(values)
            seen = self.t + late[name]
            columns = [np.interp(seen, self.t, column) for column in values.T]
            streams[name] = np.column_stack(columns)
        return replace(self, streams=streams)

    def aligned(self, offsets: Offsets) -> Recording:
        """With the streams that are late by these offsets at the times that they are of."""
        on_one_clock = aligned({KEYS[name]: Stream(self.t, x) for name, x in self.streams.items()}, offsets)
        late = {}
        for name in self.streams:
            by = self.t - on_one_clock[KEYS[name]].t
            if by.any():
                late[name] = by
        return self.moved(late)

    def repaired(self, candidates: Iterable[Candidate]) -> Recording:
        """With all corrections made; attitudes that are none stay as they are."""
        streams = {**self.streams}
        none = np.zeros(len(self.t), bool)
        if "q" in streams:
            q = streams["q"]
            none = ~(norms(q) > 1e-6)
            streams["q"] = np.where(none[:, None], [1.0, 0.0, 0.0, 0.0], q)
        windows = Windows(self.t[None], {name: x[None] for name, x in streams.items()})
        for candidate in candidates:
            windows = candidate.apply(windows)
        mended = {name: x[0] for name, x in windows.streams.items()}
        if none.any():
            mended["q"] = np.where(none[:, None], self.streams["q"], mended["q"])
        return replace(self, streams=mended)


def finite(streams: Mapping[str, np.ndarray]) -> np.ndarray:
    """Samples at which every stream has numbers, (k,)."""
    return np.logical_and.reduce([finite_rows(values) for values in streams.values()])
