"""Numbers that are not finite, in every reading of every controller and compensation: refused or missing, and
forgotten."""

import numpy as np
import pytest

import quadexp as qx
from quadexp.control.readings import HELD
from quadexp.errors import QuadexpError

LEI_LI = ("vehicle=lei_li", "plant=blade_element")
ALONE = ("nominal_mpc", "online_mpc", "dfbc", "geometric", "pid", "raptor", "rotorpy_se3")
SCALES = (
    "observer=disturbance observer.scale_walk=0.005 observer.air_walk=0.01 observer.torque_bandwidth=0 rate_loop=indi"
)
AROUND = {
    "nominal_mpc": (
        "observer=disturbance", "adaptive=l1", "rate_loop=indi", "delay=prediction delay.time=0.01",
        "delay=strapdown delay.time=0.01", SCALES, "remedies=auto",
    ),
    "perfect_mpc": ("observer=wind", "observer=wind delay=prediction motor=states horizon=firm"),
    "dfbc": ("observer=disturbance", "adaptive=l1", "rate_loop=indi", "delay=prediction delay.time=0.01",
    "remedies=auto"),
    "geometric": ("observer=disturbance", "adaptive=l1", "rate_loop=indi", "controller.force_adaptation=1"),
    "pid": ("adaptive=l1", "rate_loop=indi rate_loop.rate=400"),
}  # fmt: skip
LOOPS = [
    *[(f"controller={name}",) for name in ALONE],
    *[
        (f"controller={name}", *LEI_LI)
        for name in ("rls_mpc", "rls_feedback", "static_feedback", "oracle_impl_feedback")
    ],
    *[(f"controller={name}", *remedy.split()) for name, remedies in AROUND.items() for remedy in remedies],
    ("controller=geometric", "observer=disturbance", *LEI_LI),  # whose rotor speeds tell the thrust
]
BAD = (np.nan, np.inf, -np.inf, 1e200)


def measurement(loop, k: int) -> qx.Measurement:
    """A good one, not far from hover, at control instant k."""
    rng = np.random.default_rng(k)
    state = loop.start + 1e-3 * rng.normal(size=13)
    state[3:7] /= np.linalg.norm(state[3:7])
    force = np.array([0.0, 0.0, 9.81]) + 0.05 * rng.normal(size=3)
    coefficient = loop.vehicle.thrust_coefficient or 1e-5
    speed = np.sqrt(loop.vehicle.hover_thrust / coefficient) * (1 + 0.01 * rng.normal(size=loop.vehicle.n_rotors))
    return qx.Measurement(k * loop.period, state, force, speed)


@pytest.mark.parametrize("settings", LOOPS, ids=" ".join)
def test_what_is_not_finite_is_refused_or_missing_and_leaves_no_trace(settings):
    backends = ("plant.backend=interpreted", *["controller.backend=interpreted"] * ("rotorpy" not in settings[0]))
    hover = ("trajectory=hover", "trajectory.duration=1")
    disturbed, calm = (qx.controller(*settings, *backends, *hover) for _ in range(2))
    for loop in (disturbed, calm):
        for k in range(4):
            loop.step(measurement(loop, k))

    k, rng = 4, np.random.default_rng(0)
    for value in BAD:
        for name in ("state", "specific_force", "rotor_speed"):
            good = measurement(calm, k)
            bad = getattr(good, name).copy()
            bad[rng.integers(len(bad))] = value
            if name == "state":
                with pytest.raises(QuadexpError, match="the measured"):
                    disturbed.step(good._replace(state=bad))
                assert disturbed.failed
                thrusts = disturbed.step(good)
            else:
                thrusts = disturbed.step(good._replace(**{name: bad}))
                good = good._replace(**{name: None})
            np.testing.assert_array_equal(thrusts, calm.step(good))
            assert np.isfinite(thrusts).all() and not disturbed.failed
            for loop in (disturbed, calm):
                loop.step(measurement(loop, k + 1))
            k += 2

    for name in ("specific_force", "rotor_speed"):  # not for longer than is stated
        late = measurement(calm, k)._replace(t=(k - 1) * calm.period + HELD + 1e-6)
        with pytest.raises(QuadexpError, match="no good reading"):
            disturbed.step(late._replace(**{name: np.full(len(getattr(late, name)), np.nan)}))
        assert disturbed.failed
        np.testing.assert_array_equal(disturbed.step(late), calm.step(late))
        k = int(late.t / calm.period) + 2
