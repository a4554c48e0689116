"""Lei & Li's two examples over many seeds, with the default safety options: errors, coefficients, clips.

    python -m benchmarks.lei_li_seeds [--seeds 200] [--figure FILE.png]

A seed draws the accelerometer's noise. Printed are the outcomes, the time average of the position error, the clips (the
samples on which a coefficient in use was held at its bound), and what was identified at 10 s and at the end.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.machine import machine
from quadexp.experiment.evaluate import fly_one
from quadexp.parts.compose import compose
from quadexp.plugins.aerodynamics.coefficients import THETA
from quadexp.report.metrics import position_error

CASES = {"Example 1": "rectangle", "Example 2": "lei_li_circle"}
TIMES = (10.0, 60.0)  # s
TRUTH = {"C_la": 3.320, "C_d0": 0.220}
LIMITS = {"Example 1": 1.65, "Example 2": 2.31}  # m, of an independent implementation


def fly_seeds(trajectory: str, seeds: int) -> dict[str, np.ndarray]:
    """error (m), clips, coefficients (seeds, times, 5), and how many ended ok and finite."""
    errors, clips, found, good = [], [], [], 0
    for seed in range(seeds):
        overrides = [f"trajectory={trajectory}", "controller=rls_feedback", f"seed={seed}"]
        flight = fly_one(compose(["vehicle=lei_li", "plant=blade_element", "sensor=lei_li", *overrides]))
        good += flight.outcome == "ok" and all(np.isfinite(values).all() for values in flight.columns.values())
        rows = np.minimum(np.searchsorted(flight.t, np.array(TIMES) - 1e-9), len(flight) - 1)
        errors.append(position_error(flight).mean())
        clips.append(flight["clips"][-1])
        found.append(np.stack([flight[name][rows] for name in THETA], axis=1))
    return {"error": np.array(errors), "clips": np.array(clips), "theta": np.array(found), "good": np.array(good)}


def table(found: dict[str, dict[str, np.ndarray]]) -> str:
    """Markdown: a line per example, then the coefficients."""
    lines = [machine(), "", "| | seeds | ended ok, all finite | mean error (m) | largest | clips a flight |"]
    lines += ["|---|---:|---:|---:|---:|---:|"]
    for name, values in found.items():
        error, clips = values["error"], values["clips"]
        lines.append(
            f"| {name} | {len(error)} | {values['good']} | {error.mean():.3f} +- {error.std(ddof=1):.3f}"
            f" | {error.max():.3f} | {np.median(clips):.0f} ({clips.min():.0f} to {clips.max():.0f}) |"
        )
    heads = [f"{name} at {t:g} s" for name in found for t in TIMES]
    lines += ["", "| mean +- deviation over seeds | " + " | ".join(heads) + " |", "|---|" + "---:|" * len(heads)]
    for i, coefficient in enumerate(THETA):
        cells = [
            f"{values['theta'][:, k, i].mean():.4f} +- {values['theta'][:, k, i].std(ddof=1):.4f}"
            for values in found.values()
            for k in range(len(TIMES))
        ]
        lines.append(f"| {coefficient} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def figure(found: dict[str, dict[str, np.ndarray]]) -> Any:
    """Errors, and C_la and C_d0 at both times, every seed a point."""
    import matplotlib
    from matplotlib.figure import Figure

    from quadexp.plugins.drawing.style import COLOURS, STYLE

    with matplotlib.rc_context(STYLE):
        drawn = Figure(figsize=(10.0, 3.6), layout="constrained")
        panels = drawn.subplots(1, 3)
        for place, (name, values) in enumerate(found.items()):
            colour, marker = COLOURS[2 + 3 * place], "o^"[place]
            look = {"linestyle": "", "marker": marker, "markersize": 3, "alpha": 0.6, "color": colour}
            spread = np.linspace(-0.3, 0.3, len(values["error"]))
            panels[0].plot(place + spread, np.sort(values["error"]), label=name, **look)
            panels[0].hlines(LIMITS[name], place - 0.4, place + 0.4, color="#000000", linestyle="--", linewidth=1.0)
            for k in range(len(TIMES)):
                for panel, coefficient in zip(panels[1:], TRUTH, strict=True):
                    at = 2 * k + place + spread
                    panel.plot(at, np.sort(values["theta"][:, k, THETA.index(coefficient)]), **look)
        panels[0].set(xticks=range(len(found)), xticklabels=list(found), ylabel="mean position error (m)")
        panels[0].set_title("dashed: independent implementation", fontsize=9, fontweight="normal")
        for panel, (coefficient, truth) in zip(panels[1:], TRUTH.items(), strict=True):
            panel.axhline(truth, color="#000000", linestyle="--", linewidth=1.0)
            panel.set(xticks=(0.5, 2.5), xticklabels=[f"at {t:g} s" for t in TIMES])
            panel.set_ylabel({"C_la": r"$C_{l\alpha}$ (1/rad)", "C_d0": "$C_{d0}$"}[coefficient])
            panel.set_title("dashed: truth", fontsize=9, fontweight="normal")
        drawn.legend(loc="outside lower center", ncols=2)
    return drawn


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=200)
    parser.add_argument("--figure", type=Path, help="where to draw every seed, as PNG")
    arguments = parser.parse_args()
    found = {name: fly_seeds(trajectory, arguments.seeds) for name, trajectory in CASES.items()}
    print(table(found))
    if arguments.figure:
        figure(found).savefig(arguments.figure, dpi=110)
    lost = sum(len(values["error"]) - int(values["good"]) for values in found.values())
    raise SystemExit(1 if lost or any(math.isnan(v["error"].mean()) for v in found.values()) else 0)


if __name__ == "__main__":
    main()
