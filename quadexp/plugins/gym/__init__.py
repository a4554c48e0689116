"""Reinforcement learning: the bench's worlds as environments of Gymnasium, policies trained elsewhere as controllers.

    gymnasium.make("quadexp/Tracking-v0", overrides=["trajectory=circle", "world=only_wind"])     env.py
    quadexp simulate controller=policy controller.policy=hover.onnx                               policy.py

What an observation and an action are stands in task.py, once for both.
"""

from __future__ import annotations

BRINGS = {"parts": {"policy": "quadexp.plugins.gym.policy"}, "reads": {"gymnasium.make": "WORLD"}}


def register() -> None:
    """Tell Gymnasium of the environments; it calls this by itself where quadexp is installed with the extra [rl]."""
    import gymnasium

    place = "quadexp.plugins.gym.env:Tracking"
    for name, settings in {"Tracking-v0": {}, "Hover-v0": {"overrides": ("trajectory=hover",)}}.items():
        if f"quadexp/{name}" not in gymnasium.registry:
            gymnasium.register(f"quadexp/{name}", entry_point=place, kwargs=settings)
