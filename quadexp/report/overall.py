"""One comparison over all conditions: by what share does a contestant fly closer than the baseline?

Errors differ tenfold between conditions, so ratios are averaged, each condition c with the same weight:

    l_ci = ln(x_ci / b_ci)   over the n_c pairs of condition c, of C conditions
    L = mean_c mean_i l_ci   reduction = 100 (1 - exp L)
    interval: L +- t s, s^2 = sum_c s_c^2 / n_c / C^2, t with Satterthwaite's degrees of freedom
              (sum_c v_c)^2 / sum_c (v_c^2 / (n_c - 1)), v_c = s_c^2 / n_c    (Satterthwaite 1946, Biometrics 2(6))
    p: paired permutation of the weighted l_ci (see inference.py), corrected by Holm for the number of contestants

The conditions are the ones flown, not a sample of others: the interval speaks of new seeds, not of new trajectories.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from quadexp.report.inference import holm, least_p, paired_permutation, rank_biserial, student
from quadexp.report.pairing import Flown, Groups, Row, said
from quadexp.report.statistics import BASELINE, CONFIDENCE, NAN, tally


@dataclass(frozen=True, slots=True, kw_only=True)
class Overall:
    """One contestant against the baseline over all conditions. reduction*: percent, positive where it is better.

    conditions: in how many there was a pair. left_out: pairs that are not in it, by cause. seeds and failures as in
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
    seeds: int
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
    made = []
    for contestant in groups.contestants:
        rival = groups.baseline(contestant)
        if rival is None:
            continue
        logs: list[np.ndarray] = []
        causes: Counter[str] = Counter()
        own: list[Flown] = []
        for condition in dict.fromkeys(at for at, who in groups.cells if who in (contestant, rival)):
            pairs, left_out = groups.pairs(condition, contestant, rival)
            own += groups.cells.get((condition, contestant), [])
            errors = np.array([[flown.values[0] for flown in pair] for pair in pairs]).reshape(-1, 2)
            positive = np.all(errors > 0, axis=1)
            causes.update(left_out)
            if not positive.all():
                causes["without an error above zero"] += int(np.count_nonzero(~positive))
            if positive.any():
                logs.append(np.log(errors[positive, 0] / errors[positive, 1]))
        fields = dict(zip(("controller", "model", "variant"), contestant, strict=True)) | tally(own, confidence)
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
    mean = float(np.mean([np.mean(log) for log in logs]))
    fields |= {"reduction": _percent(mean), "effect": rank_biserial(np.concatenate(logs))}
    if pairs > 1:
        weighted = np.concatenate([log / len(log) for log in logs])
        fields |= {"p": paired_permutation(weighted, seed=seed), "p_least": least_p(pairs)}
    repeated = [log for log in logs if len(log) > 1]
    if len(repeated) == len(logs):
        variances = np.array([np.var(log, ddof=1) / len(log) for log in logs])
        total = float(variances.sum())
        half = 0.0
        if total > 0:
            degrees = total**2 / float(np.sum(variances**2 / [len(log) - 1 for log in logs]))
            half = student(confidence, degrees) * math.sqrt(total) / len(logs)
        fields |= {"reduction_low": _percent(mean + half), "reduction_high": _percent(mean - half)}
    return fields


def _percent(log_ratio: float) -> float:
    return -100 * math.expm1(log_ratio)
