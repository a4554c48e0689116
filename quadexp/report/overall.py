"""One comparison over all conditions: by what share does a contestant fly closer than the baseline?

Errors differ tenfold between conditions, so ratios are averaged, each condition with the same weight (the ratio of
inference.py), over the flights that all who are compared ended well (common.py):

    reduction = 100 (1 - ratio)
    p: paired permutation of the weighted logarithms (see inference.py), corrected by Holm for the number of contestants

What a contestant and the baseline flew beyond them stands beside it (`own_*`). The conditions are the ones flown, not a
sample of others: the interval speaks of new seeds, not of new trajectories.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from quadexp.report.common import Flights
from quadexp.report.inference import holm, least_p, log_ratio, paired_permutation, rank_biserial
from quadexp.report.pairing import Flown, Groups, Row, said
from quadexp.report.statistics import BASELINE, CONFIDENCE, NAN, tally


@dataclass(frozen=True, slots=True, kw_only=True)
class Overall:
    """One contestant against the baseline over all conditions. reduction*: percent, positive where it is better.

    conditions: in how many there was a pair. own_reduction, own_pairs: the same over all flights that both ended well,
    whoever else did. left_out: pairs that are not in it, by cause. seeds and failures as in
    `Statistic`, over all its flights. p_least: the least p that so many pairs can give.
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
        word = "less" if self.reduction >= 0 else "more"
        if self.reduction < 0:
            low, high = -high, -low
        limits = "" if math.isnan(low) else f" [{low:.1f}, {high:.1f}]"
        p = "" if math.isnan(self.p_holm) else ", p < 0.0001" if self.p_holm < 1e-4 else f", p = {self.p_holm:.2g}"
        left = f"; left out: {self.left_out}" if self.left_out else ""
        if self.own_pairs > self.pairs:
            own, more = abs(self.own_reduction), "less" if self.own_reduction >= 0 else "more"
            left += f"; over all {self.own_pairs} that both ended well: {own:.1f} % {more}"
        over = f"{self.conditions} condition{'s' if self.conditions > 1 else ''}"
        pairs = f"{self.pairs} pair{'s' if self.pairs > 1 else ''}"
        return (
            f"{self.label}: {abs(self.reduction):.1f} %{limits} {word} than {self.baseline} over {over}"
            f" ({pairs}{p}{left})"
        )


def overall(
    rows: Sequence[Row],
    *,
    metric: str = "mean_error",
    baseline: str = BASELINE,
    confidence: float = CONFIDENCE,
    seed: int = 0,
) -> list[Overall]:
    """Every contestant that has somebody to be compared with; see the module's equations."""
    groups = Groups(rows, baseline, (metric,))
    among = {world: groups.common(conditions) for world, conditions in groups.worlds.items()}
    flights = {condition: groups.flights([condition]) for condition in dict.fromkeys(at for at, _ in groups.cells)}
    made = []
    for contestant in groups.contestants:
        rival = groups.baseline(contestant)
        if rival is None:
            continue
        logs: list[np.ndarray] = []
        every: list[np.ndarray] = []  # whoever else ended them well
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
                left_out=said(causes),
                **fields,
                **_weighted(logs, confidence, seed),
            )
        )
    corrected = holm(np.array([one.p for one in made]))
    return [replace(one, p_holm=float(p)) for one, p in zip(made, corrected, strict=True)]


def _weighted(logs: Sequence[np.ndarray], confidence: float, seed: int) -> dict[str, Any]:
    pairs = sum(map(len, logs))
    fields: dict[str, Any] = dict.fromkeys(
        ("reduction", "reduction_low", "reduction_high", "effect", "p", "p_least"), NAN
    )
    fields |= {"conditions": len(logs), "pairs": pairs, "p_holm": NAN}
    if not pairs:
        return fields
    ratio = log_ratio(logs, confidence)
    fields |= {"reduction": _percent(ratio.value), "effect": rank_biserial(np.concatenate(logs))}
    fields |= {"reduction_low": _percent(ratio.high), "reduction_high": _percent(ratio.low)}
    if pairs > 1:
        weighted = np.concatenate([log / len(log) for log in logs])
        fields |= {"p": paired_permutation(weighted, seed=seed), "p_least": least_p(pairs)}
    return fields


def _logs(pairs: Sequence[tuple[Flown, Flown]]) -> tuple[np.ndarray, int]:
    """Logarithms of the ratios, and how many pairs have none."""
    errors = np.array([[flown.values[0] for flown in pair] for pair in pairs]).reshape(-1, 2)
    positive = np.all(errors > 0, axis=1)
    return np.log(errors[positive, 0] / errors[positive, 1]), int(np.count_nonzero(~positive))


def _percent(ratio: float) -> float:
    return 100 * (1 - ratio)
