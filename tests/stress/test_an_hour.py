"""An hour of hover: nothing that a controller or a compensation remembers drifts, winds up or ends.

python -m pytest -m slow -n auto tests/stress/test_an_hour.py
"""

import numpy as np
import pytest

import quadexp as qx
from quadexp.physics.state import POSITION
from tests.api.test_readings import LEI_LI, LOOPS

HOUR, PART = 3600.0, 600.0  # s
FORGETTING = [
    *[("controller=rls_feedback", f"controller.rls.forgetting={share}", *LEI_LI) for share in (0.98, 0.8)],
    ("controller=rls_mpc", "controller.rls.forgetting=0.98", *LEI_LI),
    *[("controller=online_mpc", f"controller.adapt.law={law}") for law in ("rls", "composite")],
]


@pytest.mark.slow
@pytest.mark.parametrize("settings", [*LOOPS, *FORGETTING], ids=" ".join)
def test_the_last_ten_minutes_are_as_the_first(settings):
    """With the plant's noise, an accelerometer's, and rotor speeds where the plant has them."""
    loop = qx.controller(*settings, "trajectory=hover", "trajectory.duration=1")
    plant, rng, errors = loop.plant, np.random.default_rng(0), np.empty(round(HOUR / loop.period))
    plant.reset()
    state, reading, speed = loop.start, None, None
    for k in range(len(errors)):
        thrusts = loop.step(qx.Measurement(k * loop.period, state, reading, speed))
        assert not loop.failed and np.isfinite(thrusts).all()
        state, reading = plant.advance(state, thrusts, loop.period, rng)
        reading = reading + 0.05 * rng.normal(size=3)
        speed = getattr(plant, "rotor_speed", None)
        errors[k] = np.linalg.norm(state[POSITION] - loop.start[POSITION])
        assert errors[k] < 1.0
    part = round(PART / loop.period)
    assert errors[-part:].max() < 2 * errors[:part].max() + 1e-3
