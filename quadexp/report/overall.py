"""Each contestant against the baseline over all conditions: by what share is its error smaller?

Errors differ tenfold between conditions, so ratios are averaged, each condition with the same weight (the ratio of
inference.py), over the common flights (pairing.py):

    reduction = 100 (1 - ratio)
    p: paired permutation of the weighted logarithms (see inference.py), corrected by Holm for the number of contestants

The same over all flights that the contestant and the baseline both ended well is in `own_*`. The interval is for new
seeds of these conditions, not for new trajectories.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from quadexp.report.inference import holm, least_p, log_ratio, paired_permutation, rank_biserial
from quadexp.report.pairing import Flights, Flown, Groups, Row, causes_text
from quadexp.report.statistics import BASELINE, CONFIDENCE, NAN, tally
from quadexp.report.text import count, probability


@dataclass(frozen=True, slots=True, kw_only=True)
class Overall:
    """One contestant against the baseline over all conditions. reduction*: percent, positive if it is better.

    conditions: number of those with a pair. own_reduction, own_pairs: over all flights that both ended well. left_out:
    number of missing pairs by cause. seeds and failures as in `Statistic`, over all its flights. p_least: the smallest
    p that so many pairs can give.
    """

    metric: str
    label: str
    controller: str
    model: str
    variant: str
    baseline: str
    confidence: float
    conditions: int
    pairs: int
    left_out: str
    reduction: float
    reduction_low: float
    reduction_high: float
    effect: float
    p: float
    p_holm: float
    p_least: float
    own_pairs: int
    own_reduction: float
    seeds: int
    trials: int
    lost: int
    solver_failed: int
    infeasible: int
    failed: int
    success: float
    success_low: float
    success_high: float

    @property
    def significant(self) -> bool:
        return self.p_holm < 1 - self.confidence

    def text(self) -> str:
        """Such as "gp_mpc: 98.7 % [98.6, 98.8] less than nominal_mpc over 4 conditions (20 pairs, p < 0.0001)"."""
        if not self.pairs:
            return f"{self.label}: no pair with {self.baseline} ({self.left_out})"
        low, high = self.reduction_low, self.reduction_high
        word, (low, high) = ("less", (low, high)) if self.reduction >= 0 else ("more", (-high, -low))
        limits = "" if math.isnan(low) else f" [{low:.1f}, {high:.1f}]"
        about = ", ".join(filter(None, [count(self.pairs, "pair"), probability(self.p_holm)]))
        about += f"; left out: {self.left_out}" if self.left_out else ""
        if self.own_pairs > self.pairs:
            own, more = abs(self.own_reduction), "less" if self.own_reduction >= 0 else "more"
            about += f"; over all {self.own_pairs} that both ended well: {own:.1f} % {more}"
        over = count(self.conditions, "condition")
        return f"{self.label}: {abs(self.reduction):.1f} %{limits} {word} than {self.baseline} over {over} ({about})"


def overall(
    rows: Sequence[Row],
    *,
    metric: str = "mean_error",
    baseline: str = BASELINE,
    confidence: float = CONFIDENCE,
    seed: int = 0,
) -> list[Overall]:
    """Every contestant that has a baseline; see the module's equations."""
    groups = Groups(rows, baseline, (metric,))
    among = {world: groups.common(conditions) for world, conditions in groups.worlds.items()}
    flights = {condition: groups.flights([condition]) for condition in dict.fromkeys(at for at, _ in groups.cells)}
    made = []
    for contestant in groups.contestants:
        rival = groups.baseline(contestant)
        if rival is None:
            continue
        logs: list[np.ndarray] = []
        every: list[np.ndarray] = []  # also beyond the common flights
        causes: Counter[str] = Counter()
        own: list[Flown] = []
        trials = 0
        for condition in dict.fromkeys(at for at, who in groups.cells if who in (contestant, rival)):
            pairs, left_out = groups.pairs(condition, contestant, rival, among[condition[:2]])
            own += groups.cells.get((condition, contestant), [])
            trials += flights[condition].get(contestant, Flights(0, 0)).trials
            causes.update(left_out)
            found, zeros = _logs(pairs)
            if zeros:
                causes["without an error above zero"] += zeros
            if len(found):
                logs.append(found)
            found, _ = _logs(groups.pairs(condition, contestant, rival)[0])
            if len(found):
                every.append(found)
        fields = dict(zip(("controller", "model", "variant"), contestant, strict=True)) | tally(own, trials, confidence)
        fields |= {"own_pairs": sum(map(len, every)), "own_reduction": _percent(log_ratio(every).value)}
        made.append(
            Overall(
                metric=metric,
                label=groups.labels[contestant],
                baseline=groups.labels[rival],
                confidence=confidence,
                left_out=causes_text(causes),
                **fields,
                **_weighted(logs, confidence, seed),
            )
        )
    corrected = holm(np.array([one.p for one in made]))
    return [replace(one, p_holm=float(p)) for one, p in zip(made, corrected, strict=True)]


def _weighted(logs: Sequence[np.ndarray], confidence: float, seed: int) -> dict[str, Any]:
    pairs, ratio = sum(map(len, logs)), log_ratio(logs, confidence)  # NaN without pairs
    several = pairs > 1
    return {
        "conditions": len(logs),
        "pairs": pairs,
        "reduction": _percent(ratio.value),
        "reduction_low": _percent(ratio.high),
        "reduction_high": _percent(ratio.low),
        "effect": rank_biserial(np.concatenate(logs)) if pairs else NAN,
        "p": paired_permutation(np.concatenate([log / len(log) for log in logs]), seed=seed) if several else NAN,
        "p_least": least_p(pairs) if several else NAN,
        "p_holm": NAN,
    }


def _logs(pairs: Sequence[tuple[Flown, Flown]]) -> tuple[np.ndarray, int]:
    """Logarithms of the ratios, and how many pairs have none."""
    errors = np.array([[flown.values[0] for flown in pair] for pair in pairs]).reshape(-1, 2)
    positive = np.all(errors > 0, axis=1)
    return np.log(errors[positive, 0] / errors[positive, 1]), int(np.count_nonzero(~positive))


def _percent(ratio: float) -> float:
    return 100 * (1 - ratio)
