"""Rows of a leaderboard with errors that are known, and a small protocol."""

import math

from quadexp.plugins.bench.protocol import Protocol, protocol_of

SMALL = """
version: 1
metric: mean_error
baseline: nominal_mpc
first_seed: 0
families:
  small:
    what: a hover
    given: [vehicle=torrente, plant=simplified]
    models:
      collect: [collect.duration=6]
      fit: [gp.inducing=3, gp.max_iterations=1, gp.holdout=0, drag.holdout=0]
      network: ["nn.hidden=[4]", nn.max_iterations=5, nn.holdout=0]
    tasks: {hover: [trajectory=hover, trajectory.duration=0.2], step: [trajectory=step, trajectory.duration=0.4]}
    worlds: {clean: [world=clean], pushed: [external=push, "external.force=[1,0,0]"]}
    sizes: {quick: {seeds: 2, tasks: [hover]}, standard: {seeds: 3}}
"""


def small(text: str = SMALL) -> Protocol:
    """That protocol."""
    return protocol_of(text.encode())


def row(entry, error, *, seed=0, task="circle", world="clean", outcome="ok", bound=0, **more):
    """One flight of an entry."""
    return {
        "entry": entry, "settings": "as shipped", "bound": bound, "family": "small", "task": task, "world": world,
        "size": "quick", "protocol": 1, "protocol_sha256": "aa" * 32, "seed": seed, "mean_error": error,
        "outcome": outcome, "solve_time_median": 2e-5, "controller": entry, "program": "0", "sources": "0", **more,
    }  # fmt: skip


def board(errors, seeds=range(3), tasks=("circle", "step"), **more):
    """Rows of every entry in every cell. errors: entry -> function of (task, seed), None for a lost flight."""
    found = []
    for entry, error in errors.items():
        for task in tasks:
            for seed in seeds:
                value = error(task, seed)
                outcome = "lost" if value is None else "ok"
                found.append(
                    row(entry, math.nan if value is None else value, seed=seed, task=task, outcome=outcome, **more)
                )
    return found
